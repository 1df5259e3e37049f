"""Devices on USB over pyusb: finding one, bulk transfers, and the reasons of errors."""

from __future__ import annotations

import errno
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from autdtorch.hardware.transport.port import LinkError, Port, closed_on_error
from autdtorch.utils.validation import require_kind

#: Rules that let users write to the devices on Linux; to be copied to /etc/udev/rules.d.
UDEV_RULES = Path(__file__).with_name("70-autdtorch.rules")
#: bmRequestType: of the vendor, to the device.
VENDOR_REQUEST = 0x40

_DIRECTION, _TRANSFER_TYPE, _BULK = 0x80, 0x03, 0x02


def find_device(chips: Collection[tuple[int, int]], serial: str | None = None, backend: Any = None) -> Any:
    """Return the one USB device (`usb.core.Device`) whose idVendor and idProduct are in `chips`.

    `LinkError` if none or several have them and the `serial` number, or without libusb.
    """
    if serial is not None:
        require_kind("serial", serial, str)
    import usb.core

    backend = _libusb() if backend is None else backend
    present = list(usb.core.find(find_all=True, backend=backend))
    fitting = [device for device in present if (device.idVendor, device.idProduct) in chips]
    matching = [device for device in fitting if serial is None or _serial_of(device) == serial]
    if len(matching) == 1:
        return matching[0]
    wanted = " or ".join(f"{vendor:04x}:{product:04x}" for vendor, product in chips)
    if serial is not None:
        wanted += f" with serial number {serial!r}"
    listed = ", ".join(_described(device) for device in present) or "none"
    several = "; give the serial number of one, or unplug the others"
    number, hint = (len(matching), several) if matching else ("no", "")
    unread = [device for device in fitting if serial is not None and _serial_of(device) is None]
    permission = f". To read an unknown serial number: {_udev(unread[0])}" if unread else ""
    raise LinkError(f"{number} USB devices are {wanted}{hint}. Plugged in: {listed}{permission}")


class UsbPort(Port):
    """A chip with a bulk endpoint each way, taken from the kernel's drivers.

    Methods raise `LinkError` if the chip refuses, is gone, or takes nothing within a time.
    """

    _timeout_ms = 1000

    def __init__(self, device: Any, baud: int = 0) -> None:
        """Take a chip (`usb.core.Device`), and set its serial line, if it has one, to `baud` [bits/s]."""
        self._device, self._baud = device, baud
        self._detached: list[int] = []
        with closed_on_error(self.close):
            self._call("be opened", self._take)
            self._out, self._in = self._bulk_endpoint(0), self._bulk_endpoint(_DIRECTION)
            self._set_up()

    def write(self, data: bytes) -> None:
        """Send all of `data`."""
        sent = 0
        while sent < len(data):
            written = self._call("be written to", self._out.write, data[sent:], self._timeout_ms)
            if written == 0:
                raise LinkError(f"{_described(self._device)} took {sent} of {len(data)} bytes")
            sent += written

    def recover(self) -> None:
        """Clear a stall, and drop waiting bytes if the chip has a request for that."""
        self._call("be recovered", self._device.clear_halt, self._out.bEndpointAddress)
        self._purge()

    def close(self) -> None:
        """Give the chip back to the kernel's drivers."""
        import usb.util

        usb.util.dispose_resources(self._device)
        try:
            while self._detached:
                self._call("be released", self._device.attach_kernel_driver, self._detached.pop())
        finally:
            usb.util.dispose_resources(self._device)

    def _set_up(self) -> None:
        """Send the settings of the chip."""

    def _purge(self) -> None:
        """Drop bytes that wait in the chip."""

    def _take(self) -> None:
        import usb.util

        for interface in self._device[0]:
            number = interface.bInterfaceNumber
            try:
                if self._device.is_kernel_driver_active(number):
                    self._device.detach_kernel_driver(number)
                    self._detached.append(number)
            except NotImplementedError:  # only Linux has drivers to detach
                break
        self._device.set_configuration()
        for interface in self._device[0]:
            usb.util.claim_interface(self._device, interface.bInterfaceNumber)

    def _bulk_endpoint(self, direction: int) -> Any:
        for interface in self._device[0]:
            for endpoint in interface:
                bulk = endpoint.bmAttributes & _TRANSFER_TYPE == _BULK
                if bulk and endpoint.bEndpointAddress & _DIRECTION == direction:
                    return endpoint
        raise LinkError(f"{_described(self._device)} has no bulk endpoint in each direction")

    def _request(
        self, request: int, value: int, index: int = 0, data: bytes = b"", kind: int = VENDOR_REQUEST
    ) -> None:
        self._call(
            "be set up", self._device.ctrl_transfer, kind, request, value, index, data, self._timeout_ms
        )

    def _ask(self, what: str, kind: int, request: int, length: int, index: int = 0) -> bytes:
        transfer = self._device.ctrl_transfer
        return bytes(self._call(what, transfer, kind, request, 0, index, length, self._timeout_ms))

    def _call(self, what: str, call: Callable[..., Any], *arguments: object) -> Any:
        from usb.core import USBError

        try:
            return call(*arguments)
        except USBError as error:
            reason = _reason(self._device, error.errno)
            raise LinkError(f"{_described(self._device)} cannot {what}: {reason}{error}") from error
        except NotImplementedError as error:  # pyusb's form of libusb's "not supported"
            reason = "libusb cannot use its driver; on Windows, give it WinUSB by Zadig, or use its COM port"
            raise LinkError(f"{_described(self._device)} cannot {what}: {reason}: {error}") from error


def _reason(device: Any, number: int | None) -> str:
    """Return the likely meaning of an errno of libusb, and what to do."""
    reasons = {
        errno.EACCES: f"you may not write to it. {_udev(device)}: ",
        errno.EBUSY: "another program, or another link, has it open; close that first: ",
        errno.ENODEV: "it was unplugged: ",
        errno.EIO: "the transfer broke off; look at cable and power: ",
        errno.ETIMEDOUT: "it takes or gives no bytes (time-out); is the board powered, is this the chip? ",
        errno.EPIPE: "it refuses (stall); is this the chip? ",
    }
    return reasons.get(number, "") if number is not None else ""


def _udev(device: Any) -> str:
    return (
        f"on Linux, sudo cp {UDEV_RULES} /etc/udev/rules.d/, then sudo udevadm control --reload, and plug it "
        f'in again. The rule for it: SUBSYSTEM=="usb", ATTR{{idVendor}}=="{device.idVendor:04x}", '
        f'ATTR{{idProduct}}=="{device.idProduct:04x}", MODE="0660", GROUP="plugdev", TAG+="uaccess"'
    )


def _libusb() -> Any:
    import libusb_package

    backend = libusb_package.get_libusb1_backend()
    if backend is None:
        raise LinkError("libusb-1.0 cannot be loaded: neither that of libusb-package nor one of the system")
    return backend


def _serial_of(device: Any) -> str | None:
    """Return the serial number, or None where there is none or permission is missing."""
    from usb.core import USBError

    try:
        number = device.serial_number
    # pyusb's ValueError where the device gives no languages, and its form of libusb's "not supported"
    except (USBError, ValueError, NotImplementedError):
        return None
    return None if number is None else str(number)


def _described(device: Any) -> str:
    serial = _serial_of(device)
    return f"{device.idVendor:04x}:{device.idProduct:04x} (serial number {serial or 'unknown'})"
