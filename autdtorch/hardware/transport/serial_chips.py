"""The USB chips that devices hang on, over pyusb.

Control requests are those that the chips' Linux drivers make: ftdi_sio, ch341, cp210x, cdc_acm. None was
tried on a real chip.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from autdtorch.hardware.transport.usb import LinkError, Port, UsbPort

#: FTDI's requests.
RESET, FLOW_CONTROL, BAUD_RATE, DATA_FORMAT, STATUS, LATENCY = 0x00, 0x02, 0x03, 0x04, 0x05, 0x09
#: wValue of RESET. The names of the purges in ftdi_sio, RX and TX, are from the chip's side (libftdi 1.5).
RESET_CHIP, PURGE_OUTPUT, PURGE_INPUT = 0, 1, 2
#: wValue of DATA_FORMAT: 8 bits, no parity, 1 stop bit.
EIGHT_N_ONE = 0x0008
#: Every IN packet of FTDI's begins with modem and line status.
STATUS_BYTES = 2

_LATENCY_MS = 2
_TRANSMITTER_EMPTY = 0x40  # of the second status byte
_FLUSH_SECONDS = 1.0
_EIGHTHS = (0, 3, 2, 4, 1, 5, 6, 7)  # code of the fraction 0/8 ... 7/8 of a baud divisor

_CH340_INIT, _CH340_WRITE = 0xA1, 0x9A
_CH340_RATE, _CH340_LINE = 0x1312, 0x2518  # pairs of registers: divisor and prescaler, line control
_CH340_EIGHT_N_ONE = 0xC3  # receiver and sender on, 8 bits

_CP2102_REQUEST = 0x41  # to the interface, vendor's own
_CP2102_ENABLE, _CP2102_LINE, _CP2102_PURGE, _CP2102_BAUD = 0x00, 0x03, 0x12, 0x1E
_CP2102_EIGHT_N_ONE, _CP2102_ALL_QUEUES = 0x0800, 0x000F

_CDC_REQUEST, _CDC_LINE_CODING = 0x21, 0x20  # to the interface, of its class
_READ_MS = 50


class FtdiPort(UsbPort):
    """An FTDI chip with one port, as it is after a reset."""

    def read(self, packets: int = 1) -> bytes:
        """What has arrived, at most so many packets, without the status bytes that begin each.

        Raises:
            LinkError: the chip does not answer within a second; one without data still sends its status.
        """
        length = self._in.wMaxPacketSize
        received = bytes(self._call("be read", self._in.read, packets * length))
        starts = range(0, len(received), length)
        return b"".join(received[start + STATUS_BYTES : start + length] for start in starts)

    def _set_up(self) -> None:
        self._request(RESET, RESET_CHIP)
        self._request(LATENCY, _LATENCY_MS)
        self._purge()

    def _purge(self) -> None:
        self._request(RESET, PURGE_OUTPUT)
        self._request(RESET, PURGE_INPUT)


class FtdiUart(FtdiPort):
    """An FT232R as a serial port: 8 bits, no parity, 1 stop bit, no flow control."""

    def flush(self) -> None:
        """Wait until the chip says that its transmitter is empty.

        Raises:
            LinkError: it does not say so within a second.
        """
        deadline = time.monotonic() + _FLUSH_SECONDS
        while not self._line_status() & _TRANSMITTER_EMPTY:
            if time.monotonic() > deadline:
                raise LinkError("the adapter does not send what it was given; is something else on its line?")

    def _line_status(self) -> int:
        # Asked for as ftdi_sio does: an IN packet may have waited in the chip since before the last bytes.
        status = self._ask(STATUS, STATUS_BYTES)
        if len(status) < STATUS_BYTES:
            raise LinkError("the adapter gives no line status; is it an FT232R?")
        return status[1]

    def _set_up(self) -> None:
        super()._set_up()
        self._request(DATA_FORMAT, EIGHT_N_ONE)
        self._request(FLOW_CONTROL, 0)
        self._request(BAUD_RATE, *baud_divisor(self._baud))


class FtdiFifo(FtdiPort):
    """An FT232H as a FIFO. That its EEPROM puts it into this mode is inferred, not verified."""


class Ch340Uart(UsbPort):
    """A CH340 as a serial port: 8 bits, no parity, 1 stop bit."""

    def _set_up(self) -> None:
        self._request(_CH340_INIT, 0)
        self._request(_CH340_WRITE, _CH340_RATE, ch340_divisor(self._baud))
        self._request(_CH340_WRITE, _CH340_LINE, _CH340_EIGHT_N_ONE)


class Cp2102Uart(UsbPort):
    """A CP2102 as a serial port: 8 bits, no parity, 1 stop bit."""

    def _set_up(self) -> None:
        self._request(_CP2102_ENABLE, 1, kind=_CP2102_REQUEST)
        self._purge()
        self._request(_CP2102_BAUD, 0, data=self._baud.to_bytes(4, "little"), kind=_CP2102_REQUEST)
        self._request(_CP2102_LINE, _CP2102_EIGHT_N_ONE, kind=_CP2102_REQUEST)

    def _purge(self) -> None:
        self._request(_CP2102_PURGE, _CP2102_ALL_QUEUES, kind=_CP2102_REQUEST)


class CdcUart(UsbPort):
    """A serial port of USB's own class, as on an Arduino Mega 2560: 8 bits, no parity, 1 stop bit.

    What comes in is read all the time, as cdc_acm does, and dropped: an Ultraino sends what is for its next
    board, and its commands, on the line that leads back to USB too. Older firmwares of the Arduino's chip
    (Arduino-usbserial on LUFA 100807) wait 0.1 s for every byte that nobody takes, and pass nothing on
    meanwhile.
    """

    def __init__(self, device: Any, baud: int) -> None:
        """Take the chip and set it up; if that fails it is given back.

        Args:
            device: `usb.core.Device`.
            baud: of its serial line [bits/s].

        Raises:
            LinkError: it cannot be opened, or refuses.
        """
        self._closing = threading.Event()
        self._reader = threading.Thread(target=self._drop_input, daemon=True)
        super().__init__(device, baud)

    def close(self) -> None:
        """Give the chip back to the kernel's drivers.

        Raises:
            LinkError: a driver does not take it.
        """
        self._closing.set()
        try:
            if self._reader.is_alive():
                self._reader.join()
        finally:
            super().close()

    def _set_up(self) -> None:
        one_stop_bit, no_parity, data_bits = 0, 0, 8
        coding = self._baud.to_bytes(4, "little") + bytes([one_stop_bit, no_parity, data_bits])
        self._request(_CDC_LINE_CODING, 0, data=coding, kind=_CDC_REQUEST)
        self._reader.start()

    def _drop_input(self) -> None:
        with contextlib.suppress(LinkError):  # a write tells of it
            while not self._closing.is_set():
                self._receive(_READ_MS)


class Adapter(NamedTuple):
    """A USB chip that a device may hang on.

    Attributes:
        vendor: idVendor.
        product: idProduct.
        open_port: opens a `usb.core.Device`.
    """

    vendor: int
    product: int
    open_port: Callable[[Any], Port]


def ft232r(baud: int) -> Adapter:
    """An FT232R at `baud` bits/s."""
    return Adapter(0x0403, 0x6001, partial(FtdiUart, baud=baud))


def ch340(baud: int) -> Adapter:
    """A CH340 at `baud` bits/s."""
    return Adapter(0x1A86, 0x7523, partial(Ch340Uart, baud=baud))


def cp2102(baud: int) -> Adapter:
    """A CP2102 at `baud` bits/s."""
    return Adapter(0x10C4, 0xEA60, partial(Cp2102Uart, baud=baud))


def arduino_mega(baud: int) -> Adapter:
    """The chip of an Arduino Mega 2560, revision 3, at `baud` bits/s."""
    return Adapter(0x2341, 0x0042, partial(CdcUart, baud=baud))


#: An FT232H as a FIFO.
FT232H = Adapter(0x0403, 0x6014, FtdiFifo)


def baud_divisor(baud: int) -> tuple[int, int]:
    """Value and index of the request that sets `baud` [bits/s] on an FT232R; below 1.5 Mbit/s.

    The divisor of 3 MHz has 14 bits before the point and a code of three bits for its eighths.
    """
    whole, eighth = divmod(round(8 * 3_000_000 / baud), 8)
    code = _EIGHTHS[eighth]
    return whole | (code & 3) << 14, code >> 2


def ch340_divisor(baud: int) -> int:
    """Contents of the registers that set `baud` [bits/s] on a CH340, divisor and prescaler.

    The rate is 48 MHz / (2^(12 - 3 ps - fact) div), with div to 256 from 2, or from 9 if fact = 1. Of equal
    rates the driver takes fact = 0, which bears more error, then the largest ps.
    """

    def error(choice: tuple[int, int, int]) -> float:
        fact, ps, div = choice
        return abs(48e6 / (div << 12 - 3 * ps - fact) - baud)

    choices = [
        (fact, ps, div) for fact in (0, 1) for ps in (3, 2, 1, 0) for div in range(9 if fact else 2, 257)
    ]
    fact, ps, div = min(choices, key=error)
    return (256 - div) << 8 | fact << 2 | ps
