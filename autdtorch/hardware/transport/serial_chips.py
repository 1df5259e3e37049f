"""The USB chips of devices over pyusb, set up as the Linux drivers ftdi_sio and cdc_acm do.

None was tried on a real chip.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

from autdtorch.hardware.transport.port import LinkError, Port
from autdtorch.hardware.transport.usb import UsbPort

#: Requests of FTDI.
RESET, FLOW_CONTROL, BAUD_RATE, DATA_FORMAT, STATUS, LATENCY = 0x00, 0x02, 0x03, 0x04, 0x05, 0x09
#: wValue of RESET. The names of the purges in ftdi_sio, RX and TX, are from the chip's side (libftdi 1.5).
RESET_CHIP, PURGE_OUTPUT, PURGE_INPUT = 0, 1, 2
EIGHT_N_ONE = 0x0008  # wValue of DATA_FORMAT: 8 bits, no parity, 1 stop bit
_LATENCY_MS = 2
_TRANSMITTER_EMPTY = 0x40  # of the second status byte
_FLUSH_SECONDS = 1.0
_EIGHTHS = (0, 3, 2, 4, 1, 5, 6, 7)  # code of the fraction 0/8 ... 7/8 of a baud divisor

_VENDOR_QUESTION = 0xC0  # bmRequestType: of the vendor, from the device
_CDC_REQUEST, _CDC_LINE_CODING = 0x21, 0x20  # to the interface, of its class
_READ_MS = 50


class FtdiFifo(UsbPort):
    """An FT232H as a FIFO; its EEPROM is assumed to select this mode."""

    def _set_up(self) -> None:
        self._request(RESET, RESET_CHIP)
        self._request(LATENCY, _LATENCY_MS)
        self._purge()

    def _purge(self) -> None:
        self._request(RESET, PURGE_OUTPUT)
        self._request(RESET, PURGE_INPUT)


class FtdiUart(FtdiFifo):
    """An FT232R as a serial port: 8 bits, no parity, 1 stop bit, no flow control."""

    def flush(self) -> None:
        """Wait until the chip reports that its transmitter is empty, for at most a second."""
        deadline = time.monotonic() + _FLUSH_SECONDS
        while True:
            # By request, as in ftdi_sio: an IN packet may have waited since before the last bytes.
            status = self._ask("be asked", _VENDOR_QUESTION, STATUS, 2)  # of modem and line
            if len(status) < 2:
                raise LinkError("the adapter gives no line status; is it an FT232R?")
            if status[1] & _TRANSMITTER_EMPTY:
                return
            if time.monotonic() > deadline:
                raise LinkError("the adapter does not send its bytes; is another program on its line?")

    def _set_up(self) -> None:
        super()._set_up()
        self._request(DATA_FORMAT, EIGHT_N_ONE)
        self._request(FLOW_CONTROL, 0)
        self._request(BAUD_RATE, *baud_divisor(self._baud))


class CdcUart(UsbPort):
    """A serial port of the USB class CDC, as on an Arduino Mega 2560: 8 bits, no parity, 1 stop bit.

    A thread reads and drops all input, as cdc_acm does: an Ultraino echoes commands and the bytes for its
    next board. Older firmwares of the Arduino's chip (Arduino-usbserial on LUFA 100807) pause for 0.1 s at
    every byte that is not read.
    """

    def __init__(self, device: Any, baud: int) -> None:
        """Take the chip and set it up, as `UsbPort`."""
        self._closing = threading.Event()
        self._reader = threading.Thread(target=self._drop_input, daemon=True)
        super().__init__(device, baud)

    def close(self) -> None:
        """Give the chip back to the kernel's drivers."""
        self._closing.set()
        try:
            if self._reader.is_alive():
                self._reader.join()
        finally:
            super().close()

    def _set_up(self) -> None:
        coding = self._baud.to_bytes(4, "little") + bytes([0, 0, 8])  # one stop bit, no parity, 8 bits
        self._request(_CDC_LINE_CODING, 0, data=coding, kind=_CDC_REQUEST)
        self._reader.start()

    def _drop_input(self) -> None:
        from usb.core import USBError, USBTimeoutError

        with contextlib.suppress(USBError, NotImplementedError):  # a write reports it
            while not self._closing.is_set():
                with contextlib.suppress(USBTimeoutError):
                    self._in.read(self._in.wMaxPacketSize, _READ_MS)


class Adapter(NamedTuple):
    """A USB chip of a device: idVendor, idProduct, and the function that opens a `usb.core.Device`."""

    vendor: int
    product: int
    open_port: Callable[[Any], Port]


def ft232r(baud: int) -> Adapter:
    """Return an FT232R at `baud` bits/s."""
    return Adapter(0x0403, 0x6001, partial(FtdiUart, baud=baud))


def arduino_mega(baud: int) -> Adapter:
    """Return the chip of an Arduino Mega 2560, revision 3, at `baud` bits/s."""
    return Adapter(0x2341, 0x0042, partial(CdcUart, baud=baud))


#: An FT232H as a FIFO.
FT232H = Adapter(0x0403, 0x6014, FtdiFifo)


def baud_divisor(baud: int) -> tuple[int, int]:
    """Return value and index of the request that sets `baud` [bits/s] on an FT232R; below 1.5 Mbit/s."""
    # The divisor of 3 MHz has 14 bits before the point and a code of three bits for its eighths.
    whole, eighth = divmod(round(8 * 3_000_000 / baud), 8)
    code = _EIGHTHS[eighth]
    return whole | (code & 3) << 14, code >> 2
