"""The port of a device: bytes out, and what goes wrong with them; a serial port of the operating system."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, runtime_checkable

from autdtorch.utils.array_types import Bytes
from autdtorch.utils.validation import require_kind

_TIMEOUT = 1.0  # [s]


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


@dataclass(frozen=True)
class HeldSequence:
    """A sequence that a device holds in its memory and plays by its own clock.

    Attributes:
        frames: bytes of its frames (T, B).
        modulation: factors of all amplitudes (S,), of 255, one after the other at the rate of the frames.
        divider: number of ticks of the device's clock that a frame lasts.
        loop: whether the first frame follows the last one; otherwise that stays.
    """

    frames: Bytes
    modulation: Bytes
    divider: int
    loop: bool


@runtime_checkable
class Port(Protocol):
    """A port that takes the bytes for one device; methods that fail raise `LinkError`.

    A subclass does nothing in the methods that it leaves out.
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


@runtime_checkable
class MemoryPort(Port, Protocol):
    """The port of a device with a memory for a sequence."""

    def hold(self, sequence: HeldSequence) -> None:
        """Begin a sequence, which the device plays by itself until the next `write`."""
        ...


@dataclass
class SharedPort:
    """The ports of several boards, which share written bytes evenly.

    If a board fails, the others are still served; then the first error is raised.
    """

    ports: Sequence[Port]

    def write(self, data: bytes) -> None:
        """Send each board its part of `data`."""
        part = len(data) // len(self.ports)
        _call_all(partial(port.write, data[part * place :][:part]) for place, port in enumerate(self.ports))

    def flush(self) -> None:
        """Wait until all bytes have left the chips of all boards."""
        _call_all(port.flush for port in self.ports)

    def recover(self) -> None:
        """Recover all boards."""
        _call_all(port.recover for port in self.ports)

    def close(self) -> None:
        """Release all boards."""
        _call_all(port.close for port in self.ports)


def _call_all(calls: Iterable[Callable[[], None]]) -> None:
    errors = []
    for call in calls:
        try:
            call()
        except LinkError as error:
            errors.append(error)
    if errors:
        raise errors[0]


class SerialPort:
    """A serial port of the operating system over pyserial: 8 bits, no parity, 1 stop bit, no flow control.

    Methods raise `LinkError` if the port is gone, or takes nothing for a second.
    """

    def __init__(self, name: str, baud: int) -> None:
        """Open the port of a `name` such as "COM3" or "/dev/ttyUSB0", at `baud` bits/s."""
        require_kind("port", name, str)
        import serial

        self._name = name
        with self._errors("be opened", hint=True):
            # Another program that wrote to the port would break frames.
            self._port: Any = serial.Serial(name, baud, write_timeout=_TIMEOUT, exclusive=True)

    def write(self, data: bytes) -> None:
        """Send all of `data`, and drop all input: boards in a row echo their commands."""
        with self._errors("be written to"):
            self._port.reset_input_buffer()
            self._port.write(data)

    def flush(self) -> None:
        """Wait until the driver has sent all bytes."""
        with self._errors("be flushed"):
            self._port.flush()

    def recover(self) -> None:
        """Drop the bytes that the driver still holds."""
        with self._errors("be recovered"):
            self._port.reset_output_buffer()

    def close(self) -> None:
        """Close the port."""
        with self._errors("be closed"):
            self._port.close()

    @contextlib.contextmanager
    def _errors(self, what: str, hint: bool = False) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # termios.error is no OSError
            from serial.tools.list_ports import comports

            ports = [f"{port.device} ({port.description})" for port in comports()] if hint else []
            there = f". Ports: {', '.join(ports) or 'none'}" if hint else ""
            raise LinkError(f"{self._name} cannot {what}: {error}{there}") from error
