"""The server of a live view: on the local interface alone, in a thread, behind a token in its address."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import secrets
import threading
import weakref
from collections import deque
from collections.abc import Awaitable, Callable
from concurrent.futures import Future, wait
from pathlib import Path
from typing import Any

from aiohttp import web
from trame.app import get_server
from trame.app.core import AVAILABLE_SERVERS
from trame_client.module.vue3 import www

HOST = "127.0.0.1"

_NAMES = HOST, "localhost"  # of this machine in a browser; another name is a sign of an attack
_ASSETS = Path(__file__).with_name("assets")
_PATIENCE = 60.0  # s until the server must have started
_STEP = 0.2  # s between checks that the server still runs, in a wait
_FRAME = b"publish:trame.rca.topic.stream:"  # in the head of a message that is a frame of the picture
_HEAD = 80  # bytes

Defer = Callable[..., None]
End = Callable[[], Awaitable[None]]
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Server:
    """A thread with an event loop, in which a trame application runs and VTK renders.

    Attributes:
        port: the port that it listens on.
        token: the first part of the path of all addresses.
    """

    def __init__(self, build: Callable[[Any, Defer], End], port: int = 0) -> None:
        """Start the server.

        In the thread, `build` makes the application and returns the function that ends it. Its arguments are
        a trame server and a function that queues calls in the thread.

        Raises:
            OSError: the port is taken.
        """
        self.token = secrets.token_urlsafe(24)
        self.port = port
        self._build = build
        self._failure: BaseException | None = None
        self._connections: weakref.WeakSet[asyncio.BaseTransport] = weakref.WeakSet()
        self._started = threading.Event()
        # not the thread's `join`: in Python 3.11, Ctrl-C in it marks the thread as ended while it runs
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="autdtorch explore page", daemon=True)
        self._thread.start()
        if not self._started.wait(_PATIENCE):
            raise TimeoutError(f"explore: the server did not start within {_PATIENCE:g} s")
        if self._failure is not None:
            raise self._failure

    @property
    def address(self) -> str:
        """The address to open in a browser on this machine."""
        return f"http://{HOST}:{self.port}/{self.token}/index.html"

    @property
    def running(self) -> bool:
        """True until it is closed."""
        return not self._ended.is_set()

    def require_running(self) -> None:
        """Raise a `RuntimeError` if it is closed."""
        if not self.running:
            raise RuntimeError("explore: the live view is closed")

    def wait(self) -> None:
        """Wait until it is closed, in steps that let Ctrl+C interrupt."""
        while not self._ended.wait(_STEP):
            pass

    def call(self, function: Callable[[], object]) -> None:
        """Call a function in the thread and wait for its end.

        Raises:
            RuntimeError: it is closed.
        """
        future: Future[None] = Future()

        def called() -> None:
            try:
                function()
            except Exception as error:
                future.set_exception(error)
            else:
                future.set_result(None)

        self.require_running()
        self._call(called)
        while not wait([future], _STEP).done:  # it may be closed before it comes to the call
            self.require_running()
        future.result()

    def close(self) -> None:
        """Stop the server and end the thread."""
        if self.running:
            asyncio.run_coroutine_threadsafe(self._stop(), self._loop)
            if threading.current_thread() is not self._thread:  # in which garbage may be collected
                self._ended.wait(_PATIENCE)

    async def _stop(self) -> None:
        for connection in self._connections:
            if isinstance(connection, asyncio.WriteTransport):
                connection.abort()  # a page that does not read would never take the rest
        await self._trame.stop()

    def _run(self) -> None:
        self._loop = asyncio.new_event_loop()
        asyncio.set_event_loop(self._loop)
        self._loop.set_exception_handler(_note_failure)
        try:
            self._loop.run_until_complete(self._serve())
        except BaseException as error:
            self._failure = error
        finally:
            self._started.set()
            _end_tasks(self._loop)
            self._loop.close()
            self._ended.set()

    async def _serve(self) -> None:
        self._trame = trame = get_server(f"explore-{self.token}", client_type="vue3")
        del AVAILABLE_SERVERS[f"explore-{self.token}"]  # a global reference to all that is shown
        # trame would read the arguments of the calling program, among them the host
        trame.cli.parse_known_args = functools.partial(trame.cli.parse_known_args, [])
        trame.cli.set_defaults(ws=f"{self.token}/ws", host=HOST, nowscompress=True)
        trame.enable_module({"serve": {"__explore": str(_ASSETS)}, "styles": ["__explore/explore.css"],
                             "scripts": ["__explore/explore.js"]})  # fmt: skip
        trame.controller.on_server_bind.add(self._guard)
        trame.controller.on_server_ready.add(self._note)
        end = self._build(trame, self._call)
        try:
            await trame.start(
                port=self.port, host=HOST, exec_mode="coroutine", backend="aiohttp", timeout=0, thread=True,
                open_browser=False, show_connection_info=False, disable_logging=True, follow_symlinks=False,
            )  # fmt: skip
        finally:
            await end()

    def _call(self, function: Callable[..., object], *arguments: object) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(function, *arguments)

    def _note(self, **_: Any) -> None:
        self.port = self._trame.port
        self._started.set()

    def _guard(self, server: Any) -> None:
        """Serve the pages below the token alone, and refuse requests from elsewhere."""
        app: web.Application = server.app
        for handler in server._ws_handlers:
            handler.connections = Outboxes()
        app.middlewares.append(self._refuse_others)
        folders = {"": www} | dict(self._trame.serve)
        for name, path in sorted(folders.items(), reverse=True):
            folder = path[0] if isinstance(path, list | tuple) else path
            app.router.add_static(f"/{self.token}/{name}", folder)

    @web.middleware
    async def _refuse_others(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Refuse requests without the token, from pages of other origins, and by other names of this host."""
        token = request.path.strip("/").partition("/")[0]
        origin = request.headers.get("Origin")
        known = request.host.partition(":")[0] in _NAMES  # with any port, as a tunnel may begin at another
        if not secrets.compare_digest(token.encode(), self.token.encode()) or not known:
            raise web.HTTPForbidden(text="explore: open the address that was printed, with its token")
        if origin is not None and origin != f"http://{request.host}":
            raise web.HTTPForbidden(text="explore: the page of another origin")
        if request.transport is not None:
            self._connections.add(request.transport)
        response = await handler(request)
        if not response.prepared:
            response.headers["Referrer-Policy"] = "no-referrer"  # the address has the token
            response.headers["X-Content-Type-Options"] = "nosniff"
        return response


class Outbox:
    """The messages to a page, sent in order by one task.

    trame's server sends a message to one page after another, so that a page that does not read, such as one
    of a sleeping browser, would delay all others. A frame of the picture replaces an unsent one.
    """

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
        """Queue a message."""
        if _is_frame(message):
            self._messages = deque(message for message in self._messages if not _is_frame(message))
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
    """Outboxes of the open pages, by page; their sockets are assigned."""

    def __setitem__(self, page: str, socket: Any) -> None:
        super().__setitem__(page, Outbox(socket))

    def __delitem__(self, page: str) -> None:
        self[page].end()
        super().__delitem__(page)


def _is_frame(message: bytes) -> bool:
    return _FRAME in message[:_HEAD]


def _note_failure(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log an error of the loop, but not that a page was closed while a message was sent to it."""
    if not isinstance(context.get("exception"), ConnectionResetError):
        loop.default_exception_handler(context)


def _end_tasks(loop: asyncio.AbstractEventLoop) -> None:
    tasks = asyncio.all_tasks(loop)
    for task in tasks:
        task.cancel()
    loop.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))
