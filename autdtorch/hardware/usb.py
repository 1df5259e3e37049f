"""Bytes to and from the FTDI chips that devices hang on, over pyusb.

Control requests are FTDI's own, as the Linux driver ftdi_sio states them; none was tried on a real chip.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any, Protocol

#: bmRequestType: to the device, vendor's own, recipient device.
VENDOR_REQUEST = 0x40
RESET, FLOW_CONTROL, BAUD_RATE, DATA_FORMAT, LATENCY = 0x00, 0x02, 0x03, 0x04, 0x09
#: wValue of RESET.
RESET_CHIP, PURGE_INPUT, PURGE_OUTPUT = 0, 1, 2
#: wValue of DATA_FORMAT: 8 bits, no parity, 1 stop bit.
EIGHT_N_ONE = 0x0008
#: Every IN packet begins with modem and line status.
STATUS_BYTES = 2

_OUT, _IN = 0x02, 0x81
_LATENCY_MS = 2
_TIMEOUT_MS = 1000
_EIGHTHS = (0, 3, 2, 4, 1, 5, 6, 7)  # code of the fraction 0/8 ... 7/8 of a baud divisor


class LinkError(OSError):
    """A device is missing, ambiguous, or does not do what it is asked for."""


class Port(Protocol):
    """Takes the bytes for one device."""

    def write(self, data: bytes) -> None:
        """Send all of `data`.

        Raises:
            LinkError: the device did not take it.
        """
        ...

    def close(self) -> None:
        """Let go of the device.

        Raises:
            LinkError: it cannot be given back to the system.
        """
        ...


def find_device(vendor: int, product: int, serial: str | None = None, backend: Any = None) -> Any:
    """The one USB device (`usb.core.Device`) that answers the description.

    Args:
        vendor: idVendor.
        product: idProduct.
        serial: number, where several such devices are plugged in.
        backend: of pyusb; by default the libusb that the package libusb-package brings.

    Raises:
        LinkError: none or several such devices, with a list of what there is, or no libusb.
        ImportError: pyusb or libusb-package is missing.
    """
    usb_core = _pyusb()
    if backend is None:
        backend = _libusb()
    present = list(usb_core.find(find_all=True, backend=backend))
    matching = [device for device in present if (device.idVendor, device.idProduct) == (vendor, product)]
    if serial is not None:
        matching = [device for device in matching if _serial_of(device) == serial]
    if len(matching) == 1:
        return matching[0]
    wanted = f"{vendor:04x}:{product:04x}" + (f" with serial number {serial!r}" if serial else "")
    listed = ", ".join(_described(device) for device in present) or "none"
    number, hint = ("no", "") if not matching else (len(matching), "; say which by its serial number")
    raise LinkError(f"{number} USB devices are {wanted}{hint}. Plugged in: {listed}")


class FtdiPort:
    """An FTDI chip with one port, as it is after a reset."""

    def __init__(self, device: Any) -> None:
        """Take the chip from the kernel's driver, and set it up; if that fails it is given back.

        Args:
            device: `usb.core.Device`.

        Raises:
            LinkError: the chip refuses.
        """
        self._device = device
        self._detached = False
        try:
            self._call("be opened", self._take)
            self._set_up()
        except BaseException:
            with contextlib.suppress(LinkError):  # the first error says more
                self.close()
            raise

    def write(self, data: bytes) -> None:
        """Send all of `data`.

        Raises:
            LinkError: the chip did not take it within a second.
        """
        sent = 0
        while sent < len(data):
            taken = self._call("be written to", self._device.write, _OUT, data[sent:], _TIMEOUT_MS)
            if taken == 0:
                raise LinkError(f"{_described(self._device)} took {sent} of {len(data)} bytes")
            sent += taken

    def read(self, packets: int = 1) -> bytes:
        """What has arrived, at most so many packets, without the status bytes that begin each.

        Raises:
            LinkError: the chip does not answer within a second; one without data still sends its status.
        """
        length = self._device[0][0, 0][0].wMaxPacketSize
        received = bytes(self._call("be read", self._device.read, _IN, packets * length, _TIMEOUT_MS))
        starts = range(0, len(received), length)
        return b"".join(received[start + STATUS_BYTES : start + length] for start in starts)

    def close(self) -> None:
        """Give the chip back to the kernel's driver.

        Raises:
            LinkError: the driver does not take it.
        """
        import usb.util

        usb.util.dispose_resources(self._device)
        if self._detached:
            self._detached = False
            try:
                self._call("be given back", self._device.attach_kernel_driver, 0)
            finally:
                usb.util.dispose_resources(self._device)

    def _set_up(self) -> None:
        self._request(RESET, RESET_CHIP)
        self._request(LATENCY, _LATENCY_MS)
        self._request(RESET, PURGE_INPUT)
        self._request(RESET, PURGE_OUTPUT)

    def _take(self) -> None:
        try:
            if self._device.is_kernel_driver_active(0):
                self._device.detach_kernel_driver(0)
                self._detached = True
        except NotImplementedError:  # only Linux has drivers to detach
            pass
        self._device.set_configuration()

    def _request(self, request: int, value: int, index: int = 0) -> None:
        self._call("be set up", self._device.ctrl_transfer, VENDOR_REQUEST, request, value, index)

    def _call(self, what: str, call: Callable[..., Any], *arguments: object) -> Any:
        from usb.core import USBError

        try:
            return call(*arguments)
        except USBError as error:
            raise LinkError(f"{_described(self._device)} cannot {what}: {error}") from error


class FtdiUart(FtdiPort):
    """An FT232R as a serial port: 8 bits, no parity, 1 stop bit, no flow control."""

    def __init__(self, device: Any, baud: int) -> None:
        """Take the chip and set its rate.

        Args:
            device: `usb.core.Device`.
            baud: bits/s; the chip takes the nearest that 3 MHz over a number of eighths gives.

        Raises:
            LinkError: the chip refuses.
        """
        self._divisor = baud_divisor(baud)
        super().__init__(device)

    def _set_up(self) -> None:
        super()._set_up()
        self._request(DATA_FORMAT, EIGHT_N_ONE)
        self._request(FLOW_CONTROL, 0)
        self._request(BAUD_RATE, *self._divisor)


class FtdiFifo(FtdiPort):
    """An FT232H as a FIFO. That its EEPROM puts it into this mode is inferred, not verified."""


def baud_divisor(baud: int) -> tuple[int, int]:
    """Value and index of the request that sets `baud` [bits/s] on an FT232R; below 1.5 Mbit/s.

    The divisor of 3 MHz has 14 bits before the point and a code of three bits for its eighths.
    """
    whole, eighth = divmod(round(8 * 3_000_000 / baud), 8)
    code = _EIGHTHS[eighth]
    return whole | (code & 3) << 14, code >> 2


def _pyusb() -> Any:
    try:
        import usb.core
    except ImportError as error:
        raise ImportError(f"{error}; pip install 'autdtorch[hardware]' brings what is needed") from error
    return usb.core


def _libusb() -> Any:
    try:
        import libusb_package
    except ImportError as error:
        raise ImportError(f"{error}; pip install 'autdtorch[hardware]' brings what is needed") from error
    backend = libusb_package.get_libusb1_backend()
    if backend is None:
        raise LinkError("libusb-1.0 cannot be loaded: neither that of libusb-package nor one of the system")
    return backend


def _serial_of(device: Any) -> str | None:
    """Serial number, or None where it has none or we may not ask."""
    from usb.core import USBError

    try:
        number = device.serial_number
    except (USBError, ValueError):  # pyusb's ValueError where the device gives no languages
        return None
    return None if number is None else str(number)


def _described(device: Any) -> str:
    serial = _serial_of(device)
    return f"{device.idVendor:04x}:{device.idProduct:04x} (serial number {serial or 'unknown'})"
