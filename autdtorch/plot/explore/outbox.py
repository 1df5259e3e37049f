"""The messages to each page of a live view, sent in a task of their own.

The server of trame sends a message to one page after another. A page that does not read, such as that of a
browser which sleeps, would keep it from all others.
"""

from __future__ import annotations

import asyncio
from collections import deque
from typing import Any

from aiohttp import web

_FRAME = b"publish:trame.rca.topic.stream:"  # in the head of a message that is a frame of the picture
_HEAD = 80  # bytes


class Outbox:
    """The messages to a page, in order; a frame of the picture replaces one that has not been sent."""

    def __init__(self, socket: web.WebSocketResponse) -> None:
        """Send through a socket, in the running event loop."""
        self._socket = socket
        self._messages: deque[bytes] = deque()
        self._filled = asyncio.Event()
        self._task = asyncio.get_running_loop().create_task(self._send())

    @property
    def closed(self) -> bool:
        """True once the socket is closed."""
        return self._socket.closed

    async def send_bytes(self, message: bytes) -> None:
        """Send a message, soon."""
        if _is_frame(message):
            self._messages = deque(one for one in self._messages if not _is_frame(one))
        self._messages.append(message)
        self._filled.set()

    async def close(self, **reason: Any) -> None:
        """Close the socket."""
        self.end()
        await self._socket.close(**reason)

    def end(self) -> None:
        """Send no more."""
        self._task.cancel()

    async def _send(self) -> None:
        while True:
            await self._filled.wait()
            while self._messages:
                try:
                    await self._socket.send_bytes(self._messages.popleft())
                except ConnectionResetError:  # the page was closed
                    return
            self._filled.clear()


class Outboxes(dict[str, Outbox]):
    """Outboxes of the pages that are open, by page; it is given their sockets."""

    def __setitem__(self, page: str, socket: Any) -> None:
        """Make the outbox of a page."""
        super().__setitem__(page, Outbox(socket))

    def __delitem__(self, page: str) -> None:
        """End the outbox of a page."""
        self[page].end()
        super().__delitem__(page)


def _is_frame(message: bytes) -> bool:
    return _FRAME in message[:_HEAD]
