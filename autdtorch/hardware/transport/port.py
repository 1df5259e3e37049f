"""The port of a device: bytes out, and what goes wrong with them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol, runtime_checkable

#: Hint for a missing package of the transports.
INSTALL_HINT = "pip install 'autdtorch[hardware]' brings what is needed"


class LinkError(OSError):
    """A device is missing, ambiguous, or does not do what it is asked for."""


@contextlib.contextmanager
def closed_on_error(close: Callable[[], None]) -> Iterator[None]:
    """Call `close` if the block fails, and raise the block's error rather than one of closing."""
    try:
        yield
    except BaseException:
        with contextlib.suppress(LinkError):
            close()
        raise


@runtime_checkable
class Port(Protocol):
    """A port that takes the bytes for one device; methods that fail raise `LinkError`.

    A port that subclasses this does nothing in the methods that it leaves out.
    """

    def write(self, data: bytes) -> None:
        """Send all of `data`."""

    def flush(self) -> None:
        """Wait until all bytes have left the chip, if the chip can say so."""
        return

    def recover(self) -> None:
        """Clear a stall and drop waiting bytes after a write that broke off."""
        return

    def close(self) -> None:
        """Release the device."""
        return


class SharedPort:
    """The ports of several boards, which share written bytes evenly.

    If a board fails, the others are still served; then the first error is raised.
    """

    def __init__(self, ports: Sequence[Port]) -> None:
        """Take the `ports`, in the order of the boards."""
        self._ports = ports

    def write(self, data: bytes) -> None:
        """Send each board its part of `data`."""
        part = len(data) // len(self._ports)
        parts = [data[start : start + part] for start in range(0, len(data), part)]
        self._each(lambda port, own: port.write(own), parts)

    def flush(self) -> None:
        """Wait until all bytes have left the chips of all boards."""
        self._each(lambda port, _: port.flush())

    def recover(self) -> None:
        """Recover all boards."""
        self._each(lambda port, _: port.recover())

    def close(self) -> None:
        """Release all boards."""
        self._each(lambda port, _: port.close())

    def _each(self, do: Callable[[Port, Any], None], parts: Sequence[Any] | None = None) -> None:
        errors = []
        for port, part in zip(self._ports, parts or self._ports, strict=True):
            try:
                do(port, part)
            except LinkError as error:
                errors.append(error)
        if errors:
            raise errors[0]
