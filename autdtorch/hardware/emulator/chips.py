"""The chips of `transport.serial_chips`, emulated: they decode requests and pass bytes on to a firmware.

Written from the chips' Linux drivers and data sheets, not from `serial_chips`, so that one checks the other.
"""

from __future__ import annotations

import time
from typing import ClassVar

from autdtorch.hardware.devices.device import Firmware
from autdtorch.hardware.emulator.bus import EmulatedDevice

_VENDOR_DEVICE, _CLASS_INTERFACE, _VENDOR_QUESTION = 0x40, 0x21, 0xC0
_WHILE = 0.01  # [s]
_BAUD_TOLERANCE = 0.03  # beyond it a UART loses the last of its ten bits


class EmulatedChip(EmulatedDevice):
    """A USB chip with a serial port, at `baud` [bits/s] and perhaps `eight_n_one`, in front of a firmware."""

    def __init__(self, vendor: int, product: int, serial: str, firmware: Firmware) -> None:
        """Plug the chip in, with settings of an earlier user."""
        super().__init__(vendor, product, serial)
        self.firmware = firmware
        self.baud, self.eight_n_one = 9600.0, False

    def write(self, data: bytes) -> None:
        """Send bytes on to the firmware, which loses them at another rate or format than its own."""
        wanted = self.firmware.baud
        if wanted is None or (self.eight_n_one and abs(self.baud / wanted - 1) <= _BAUD_TOLERANCE):
            self.firmware.receive(data)


class EmulatedFtdi(EmulatedChip):
    """An FT232R, or an FT232H as a FIFO."""

    interfaces = (((0xFF, 0xFF, 0xFF), (0x81, 0x02)),)

    _BAUD, _FORMAT, _STATUS, _OTHERS = 0x03, 0x04, 0x05, (0x00, 0x01, 0x02, 0x09)
    _IDLE = b"\x01\x60"
    _EIGHTHS: ClassVar[dict[int, int]] = {0: 0, 3: 1, 2: 2, 4: 3, 1: 4, 5: 5, 6: 6, 7: 7}

    def control(self, kind: int, request: int, value: int, index: int, data: bytes) -> bool:
        """Set the baud rate by its divisor of 3 MHz, and the data format."""
        if request == self._BAUD:
            self.baud = 3e6 / ((value & 0x3FFF) + self._EIGHTHS[value >> 14 | (index & 1) << 2] / 8)
        elif request == self._FORMAT:
            self.eight_n_one = value == 8
        return kind == _VENDOR_DEVICE and request in (self._BAUD, self._FORMAT, *self._OTHERS)

    def answer(self, kind: int, request: int) -> bytes | None:
        """Return the status of modem and line: all bytes have been sent."""
        return self._IDLE if (kind, request) == (_VENDOR_QUESTION, self._STATUS) else None

    def read(self, most: int) -> bytes:
        """Return an IN packet: the status alone."""
        return self._IDLE


class EmulatedCdc(EmulatedChip):
    """A serial port of USB's own class: one interface for control, one for data."""

    interfaces = (((0x02, 0x02, 0x01), ()), ((0x0A, 0x00, 0x00), (0x04, 0x83)))

    _LINE_CODING, _LINE_STATE = 0x20, 0x22

    def control(self, kind: int, request: int, value: int, index: int, data: bytes) -> bool:
        """Set the line coding: baud rate, stop bits, parity, bits."""
        if request == self._LINE_CODING:
            self.baud = float(int.from_bytes(data[:4], "little"))
            self.eight_n_one = data[4:] == bytes([0, 0, 8])
        return kind == _CLASS_INTERFACE and request in (self._LINE_CODING, self._LINE_STATE)

    def read(self, most: int) -> bytes:
        """Return an IN packet: none comes within a while."""
        time.sleep(_WHILE)
        return b""


#: Chips by idVendor and idProduct.
CHIPS: dict[tuple[int, int], type[EmulatedChip]] = {
    (0x0403, 0x6001): EmulatedFtdi,
    (0x0403, 0x6014): EmulatedFtdi,
    (0x2341, 0x0042): EmulatedCdc,
}
