"""Finding a device on USB, bytes to and from its chip over pyusb, and what to say where that fails."""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from autdtorch.utils.validation import require_kind

#: Lets users write to the devices on Linux; to be copied to /etc/udev/rules.d.
UDEV_RULES = Path(__file__).with_name("70-autdtorch.rules")
#: What brings pyusb and libusb.
INSTALL_HINT = "pip install 'autdtorch[hardware]' brings what is needed"
#: bmRequestType: vendor's own, recipient device; to the device, and from it.
VENDOR_REQUEST, VENDOR_QUESTION = 0x40, 0xC0

_TIMEOUT_MS = 1000
_DIRECTION, _TRANSFER_TYPE, _BULK = 0x80, 0x03, 0x02


class LinkError(OSError):
    """A device is missing, ambiguous, or does not do what it is asked for."""


@contextlib.contextmanager
def closed_on_error(close: Callable[[], None]) -> Iterator[None]:
    """Call `close` if what follows fails; that error is raised, and says more than one of closing."""
    try:
        yield
    except BaseException:
        with contextlib.suppress(LinkError):
            close()
        raise


@runtime_checkable
class Port(Protocol):
    """Takes the bytes for one device."""

    def write(self, data: bytes) -> None:
        """Send all of `data`.

        Raises:
            LinkError: the device did not take it.
        """
        ...

    def flush(self) -> None:
        """Wait until all has left the chip, where the chip tells.

        Raises:
            LinkError: it does not leave.
        """
        ...

    def recover(self) -> None:
        """Take up again after a write that broke off: clear a stall, drop what still waits.

        Raises:
            LinkError: the device is gone.
        """
        ...

    def close(self) -> None:
        """Let go of the device.

        Raises:
            LinkError: it cannot be given back to the system.
        """
        ...


def find_device(chips: Collection[tuple[int, int]], serial: str | None = None, backend: Any = None) -> Any:
    """The one USB device (`usb.core.Device`) that answers the description.

    Args:
        chips: idVendor and idProduct of those that will do.
        serial: number, where several such devices are plugged in.
        backend: of pyusb; by default the libusb that the package libusb-package brings.

    Raises:
        LinkError: none or several such devices, with a list of what there is, or no libusb.
        ImportError: pyusb or libusb-package is missing.
        ValueError: a `serial` that is no text.
    """
    if serial is not None:
        require_kind("serial", serial, str)
    usb_core = _pyusb()
    if backend is None:
        backend = _libusb()
    present = list(usb_core.find(find_all=True, backend=backend))
    fitting = [device for device in present if (device.idVendor, device.idProduct) in chips]
    matching = [device for device in fitting if serial is None or _serial_of(device) == serial]
    if len(matching) == 1:
        return matching[0]
    wanted = " or ".join(f"{vendor:04x}:{product:04x}" for vendor, product in chips)
    if serial is not None:
        wanted += f" with serial number {serial!r}"
    listed = ", ".join(_described(device) for device in present) or "none"
    several = "; say which by its serial number, or unplug the others"
    number, hint = (len(matching), several) if matching else ("no", "")
    unread = [device for device in fitting if serial is not None and _serial_of(device) is None]
    permission = f". To read an unknown serial number: {_udev(unread[0])}" if unread else ""
    raise LinkError(f"{number} USB devices are {wanted}{hint}. Plugged in: {listed}{permission}")


class UsbPort:
    """A chip with a bulk endpoint each way, taken from the kernel's drivers."""

    def __init__(self, device: Any, baud: int = 0) -> None:
        """Take the chip and set it up; if that fails it is given back.

        Args:
            device: `usb.core.Device`.
            baud: of its serial line [bits/s]; the chip takes the nearest that it has. 0 without one.

        Raises:
            LinkError: it cannot be opened, or refuses.
        """
        self._device = device
        self._baud = baud
        self._detached: list[int] = []
        with closed_on_error(self.close):
            self._call("be opened", self._take)
            self._out, self._in = self._bulk_endpoint(0), self._bulk_endpoint(_DIRECTION)
            self._set_up()

    def write(self, data: bytes) -> None:
        """Send all of `data`.

        Raises:
            LinkError: the chip did not take it within a second.
        """
        sent = 0
        while sent < len(data):
            taken = self._call("be written to", self._out.write, data[sent:], _TIMEOUT_MS)
            if taken == 0:
                raise LinkError(f"{_described(self._device)} took {sent} of {len(data)} bytes")
            sent += taken

    def flush(self) -> None:
        """Not every chip tells what it still holds."""

    def recover(self) -> None:
        """Clear a stall, and drop what still waits in the chip, where it can be told to.

        Raises:
            LinkError: the chip does not answer.
        """
        self._call("be recovered", self._device.clear_halt, self._out.bEndpointAddress)
        self._purge()

    def close(self) -> None:
        """Give the chip back to the kernel's drivers.

        Raises:
            LinkError: a driver does not take it.
        """
        import usb.util

        usb.util.dispose_resources(self._device)
        try:
            while self._detached:
                self._call("be given back", self._device.attach_kernel_driver, self._detached.pop())
        finally:
            usb.util.dispose_resources(self._device)

    def _set_up(self) -> None:
        """A chip without a serial line may need nothing."""

    def _purge(self) -> None:
        """Not every chip can be told to."""

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
        self._call("be set up", self._device.ctrl_transfer, kind, request, value, index, data, _TIMEOUT_MS)

    def _receive(self, wait_ms: int) -> bytes:
        """A packet; empty if none comes within the time [ms]."""
        from usb.core import USBTimeoutError

        def read() -> bytes:
            with contextlib.suppress(USBTimeoutError):
                return bytes(self._in.read(self._in.wMaxPacketSize, wait_ms))
            return b""

        return bytes(self._call("be read", read))

    def _ask(self, request: int, length: int) -> bytes:
        transfer = self._device.ctrl_transfer
        return bytes(self._call("be asked", transfer, VENDOR_QUESTION, request, 0, 0, length, _TIMEOUT_MS))

    def _call(self, what: str, call: Callable[..., Any], *arguments: object) -> Any:
        from usb.core import USBError

        try:
            return call(*arguments)
        except USBError as error:
            reason = _reason(self._device, error.errno)
            raise LinkError(f"{_described(self._device)} cannot {what}: {reason}{error}") from error
        except NotImplementedError as error:  # what pyusb makes of libusb's "not supported"
            reason = "libusb cannot use its driver; on Windows, give it WinUSB, with Zadig"
            raise LinkError(f"{_described(self._device)} cannot {what}: {reason}: {error}") from error


def _reason(device: Any, number: int | None) -> str:
    """What an errno of libusb most likely means, and what to do."""
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


def _pyusb() -> Any:
    try:
        import usb.core
    except ImportError as error:
        raise ImportError(f"{error}; {INSTALL_HINT}") from error
    return usb.core


def _libusb() -> Any:
    try:
        import libusb_package
    except ImportError as error:
        raise ImportError(f"{error}; {INSTALL_HINT}") from error
    backend = libusb_package.get_libusb1_backend()
    if backend is None:
        raise LinkError("libusb-1.0 cannot be loaded: neither that of libusb-package nor one of the system")
    return backend


def _serial_of(device: Any) -> str | None:
    """Serial number, or None where it has none or we may not ask."""
    from usb.core import USBError

    try:
        number = device.serial_number
    # pyusb's ValueError where the device gives no languages, and what it makes of libusb's "not supported"
    except (USBError, ValueError, NotImplementedError):
        return None
    return None if number is None else str(number)


def _described(device: Any) -> str:
    serial = _serial_of(device)
    return f"{device.idVendor:04x}:{device.idProduct:04x} (serial number {serial or 'unknown'})"
