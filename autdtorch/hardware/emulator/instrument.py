"""The USB interface of a measuring instrument on the emulated bus: USBTMC around its lines of text.

Written from the class's specification alone, not from `usbtmc`, so that one checks the other.
"""

from __future__ import annotations

from typing import Protocol

from autdtorch.hardware.emulator.bus import EmulatedDevice, stall, time_out

_PACKET = 64
_CLASS_INTERFACE = 0xA1  # from the device
_INITIATE_CLEAR, _CHECK_CLEAR_STATUS = 5, 6


class Instrument(Protocol):
    """An instrument behind its USB interface."""

    def execute(self, line: str) -> bytes | None:
        """Execute a line, and return its answer, if it has one."""


class EmulatedInstrument(EmulatedDevice):
    """The USB interface of an instrument: USB488, without its interrupt endpoint.

    A message longer than `longest` bytes comes in several transfers. If `sends_empty_packets`, one follows a
    transfer of whole packets, as USB demands; some instruments send none.
    """

    interfaces = (((0xFE, 0x03, 0x01), (0x82, 0x01)),)

    def __init__(self, vendor: int, product: int, serial: str, instrument: Instrument) -> None:
        """Plug it in."""
        super().__init__(vendor, product, serial)
        self.sends_empty_packets, self.longest = True, 512
        self._instrument = instrument
        self._received = self._answer = b""
        self._asked: tuple[int, int] | None = None  # tag, bytes
        self._sending: bytes | None = None

    def answer(self, kind: int, request: int) -> bytes | None:
        """Answer INITIATE_CLEAR and CHECK_CLEAR_STATUS, which succeed at once."""
        if kind != _CLASS_INTERFACE:
            return None
        if request == _INITIATE_CLEAR:
            self._received, self._answer, self._asked, self._sending = b"", b"", None, None
        return {_INITIATE_CLEAR: b"\x01", _CHECK_CLEAR_STATUS: b"\x01\x00"}.get(request)

    def write(self, data: bytes) -> None:
        """Take a transfer: part of a message, or the request for an answer."""
        kind, tag, complement = data[:3]
        length = int.from_bytes(data[4:8], "little")
        if tag == 0 or tag + complement != 255:
            raise stall()
        if kind == 2 and len(data) == 12:
            self._asked = tag, length
        elif kind == 1 and len(data) == 12 + length + -length % 4:
            self._take(data[12 : 12 + length], ends=bool(data[8] & 1))
        else:
            raise stall()

    def read(self, most: int) -> bytes:
        """Return at most `most` bytes of a requested transfer."""
        transfer = self._transfer() if self._sending is None else self._sending
        given, rest = transfer[:most], transfer[most:]
        whole = len(given) % _PACKET == 0
        if whole and len(given) < most and not self.sends_empty_packets:
            raise time_out()  # the host waits for more
        empty_is_due = whole and len(given) == most and self.sends_empty_packets
        self._sending = rest if rest or empty_is_due else None
        return given

    def _transfer(self) -> bytes:
        """Return the next transfer of the answer."""
        if self._asked is None or not self._answer:
            raise time_out()
        tag, most = self._asked
        self._asked = None
        size = min(most, self.longest)
        data, self._answer = self._answer[:size], self._answer[size:]
        header = bytes([2, tag, 255 - tag, 0, *len(data).to_bytes(4, "little"), not self._answer, 0, 0, 0])
        return header + data + bytes(-len(data) % 4)

    def _take(self, data: bytes, ends: bool) -> None:
        self._received += data
        if ends:
            line, self._received = self._received.decode("ascii").strip(), b""
            self._answer = self._instrument.execute(line) or b""
