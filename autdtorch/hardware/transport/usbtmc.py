"""Messages to and from measuring instruments of the USB class USBTMC, over its bulk endpoints.

From the class's specification, revision 1.0 (USB Implementers Forum, 2003); tried on no instrument.
"""

from __future__ import annotations

import struct
import time
from typing import Any

from autdtorch.hardware.transport.port import LinkError, closed_on_error
from autdtorch.hardware.transport.usb import UsbPort

TELL, ASK = 1, 2  # MsgID of a message to the instrument; of a request for an answer, and of the answer
END = 1  # bmTransferAttributes: the message ends with this transfer
INTERFACE_CLASS = (0xFE, 0x03)  # bInterfaceClass and bInterfaceSubClass
CLASS_REQUEST = 0xA1  # bmRequestType: from the instrument, of the class, recipient interface
INITIATE_CLEAR, CHECK_CLEAR_STATUS = 5, 6  # its bRequests
SUCCESS, PENDING = 1, 2  # first byte of their answers
IN_WAITS = 1  # bmClear of a pending clear: the rest of an answer must be read first

_HEADER = struct.Struct("<BBBxLB3x")
_MOST = 2**16  # bytes of an answer in one transfer
_CHECKS = 100


def message(kind: int, tag: int, length: int, attributes: int, data: bytes = b"") -> bytes:
    """Return a bulk transfer: a header of 12 bytes, the data, and zeros up to a multiple of 4 bytes.

    `kind` is its MsgID; `length` is of the data, or the most that the instrument may send.
    """
    return _HEADER.pack(kind, tag, tag ^ 0xFF, length, attributes) + data + bytes(-len(data) % 4)


def announced(packet: bytes, tag: int) -> tuple[int, bool]:
    """Return the length of the data in an instrument's transfer, and true if its message ends with it.

    `LinkError` if the first `packet` does not answer the request `tag`, or announces more than requested.
    """
    if len(packet) < _HEADER.size:
        raise LinkError(f"USBTMC: {len(packet)} bytes {packet.hex(' ')}; a header has {_HEADER.size}")
    kind, number, complement, length, attributes = _HEADER.unpack_from(packet)
    if (kind, number, complement) != (ASK, tag, tag ^ 0xFF) or length > _MOST:
        header = packet[: _HEADER.size].hex(" ")
        raise LinkError(f"USBTMC: header {header} does not answer request {tag}")
    return length, bool(attributes & END)


def block(data: bytes) -> bytes:
    """Return the content of a definite-length block of IEEE 488.2; `LinkError` if it is none, or incomplete.

    A block is ``#``, a digit n, n digits with the number of bytes, the bytes, and optionally a line end.
    """
    digits = data[2 : 2 + int(data[1:2])] if data[:1] == b"#" and data[1:2].isdigit() else b""
    if not digits.isdigit():
        raise LinkError(f"USBTMC: {data[:20]!r} begins no definite-length block")
    start, length = 2 + len(digits), int(digits)
    if len(data) < start + length:
        raise LinkError(f"USBTMC: {len(data) - start} of {length} bytes in a block")
    return data[start : start + length]


class UsbtmcPort(UsbPort):
    """An instrument that takes commands and answers questions; methods raise `LinkError` if it does not."""

    _timeout_ms = 3000

    def __init__(self, device: Any) -> None:
        """Take the instrument (`usb.core.Device`), and clear unread answers."""
        super().__init__(device)
        self._tag = 0
        with closed_on_error(self.close):
            self._interface = self._number()
            self._clear()

    def tell(self, command: str) -> None:
        """Send a command."""
        data = f"{command}\n".encode("ascii")
        self.write(message(TELL, self._next(), len(data), END, data))

    def ask(self, question: str) -> str:
        """Return the answer to a question, as text."""
        data = self._answer(question)
        try:
            return data.decode("ascii").strip()
        except UnicodeDecodeError as error:
            raise LinkError(f"USBTMC: {question} is answered by {data[:40]!r}, which is no text") from error

    def ask_block(self, question: str) -> bytes:
        """Return the answer to a question, the content of a definite-length block."""
        return block(self._answer(question))

    def recover(self) -> None:
        """Clear a stall of an answer, unread answers and incomplete commands."""
        self._call("be recovered", self._in.clear_halt)
        self._clear()

    def _answer(self, question: str) -> bytes:
        self.tell(question)
        received, ended = b"", False
        while not ended:
            tag = self._next()
            self.write(message(ASK, tag, _MOST, 0))
            data, ended = self._data(question, tag)
            if not data and not ended:
                raise LinkError(f"USBTMC: the answer to {question} stops after {len(received)} bytes")
            received += data
        return received

    def _data(self, question: str, tag: int) -> tuple[bytes, bool]:
        """Return the data of a transfer from the instrument, and true if its message ends with it."""
        # Read to the length in its header: not all instruments send an empty packet after one of whole
        # packets. If one does, that is read before the next transfer.
        packet = self._in.wMaxPacketSize
        received = self._piece(question, packet) or self._piece(question, packet)
        length, ended = announced(received, tag)
        left = _HEADER.size + length + -length % 4 - len(received)
        if left > 0 and len(received) == packet:
            received += self._piece(question, -(-left // packet) * packet)
        data = received[_HEADER.size : _HEADER.size + length]
        if len(data) < length:
            raise LinkError(f"USBTMC: {len(data)} of {length} bytes in a transfer that answers {question}")
        return data, ended

    def _piece(self, question: str, size: int) -> bytes:
        return bytes(self._call(f"answer {question}", self._in.read, size, self._timeout_ms))

    def _number(self) -> int:
        for interface in self._device[0]:
            if (interface.bInterfaceClass, interface.bInterfaceSubClass) == INTERFACE_CLASS:
                return int(interface.bInterfaceNumber)
        raise LinkError("USBTMC: the device is no measuring instrument of this class")

    def _next(self) -> int:
        self._tag = self._tag % 255 + 1
        return self._tag

    def _clear(self) -> None:
        status, *_ = self._ask("be cleared", CLASS_REQUEST, INITIATE_CLEAR, 1, self._interface)
        for _ in range(_CHECKS):
            status, waits = self._ask("be cleared", CLASS_REQUEST, CHECK_CLEAR_STATUS, 2, self._interface)
            if status != PENDING:
                break
            if waits & IN_WAITS:
                self._call("be cleared", self._in.read, _MOST, self._timeout_ms)
            time.sleep(0.01)
        if status != SUCCESS:
            raise LinkError(f"USBTMC: the instrument does not clear its answers: status {status:#04x}")
        self._call("be cleared", self._out.clear_halt)
