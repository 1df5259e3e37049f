"""A serial port of the operating system, by its name, over pyserial."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

from autdtorch.hardware.transport.port import INSTALL_HINT, LinkError
from autdtorch.utils.validation import require_kind

_TIMEOUT = 1.0  # [s]


class SerialPort:
    """A serial port with the driver of its operating system: 8 bits, no parity, 1 stop bit, no flow control.

    It reaches every adapter that the system knows, and a COM port on Windows. Methods raise `LinkError` if
    the port is gone, or takes nothing for a second.
    """

    def __init__(self, name: str, baud: int) -> None:
        """Open the port of a `name` such as "COM3" or "/dev/ttyUSB0", at `baud` bits/s."""
        require_kind("port", name, str)
        self._name = name
        try:
            import serial
        except ImportError as error:
            raise ImportError(f"{error}; {INSTALL_HINT}") from error
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
            there = f". Ports: {_listed()}" if hint else ""
            raise LinkError(f"{self._name} cannot {what}: {error}{there}") from error


def _listed() -> str:
    from serial.tools.list_ports import comports

    return ", ".join(f"{port.device} ({port.description})" for port in comports()) or "none"
