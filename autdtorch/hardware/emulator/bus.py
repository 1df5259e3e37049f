"""A USB bus without hardware: a backend of pyusb in place of libusb."""

from __future__ import annotations

import errno
from array import array
from collections.abc import Sequence
from types import SimpleNamespace
from typing import ClassVar

from usb.backend import IBackend
from usb.core import USBError, USBTimeoutError

_GET_DESCRIPTOR, _STRING, _ENGLISH = 0x06, 0x03, 0x0409
_FROM_DEVICE, _STANDARD_FROM_DEVICE = 0x80, 0x80
_PACKET = 64


class EmulatedDevice:
    """An emulated USB device; `present` while it is plugged in."""

    #: Class, subclass and protocol of each interface, and its bulk endpoints.
    interfaces: ClassVar[tuple[tuple[tuple[int, int, int], tuple[int, ...]], ...]]

    def __init__(self, vendor: int, product: int, serial: str) -> None:
        """Plug the device in, with idVendor, idProduct and serial number."""
        self.vendor, self.product = vendor, product
        self.strings = ("", "autdtorch", "emulated device", serial)  # by index
        self.present = True

    def control(self, kind: int, request: int, value: int, index: int, data: bytes) -> bool:
        """Take a request with its data; False for an unknown one, which stalls."""
        return False

    def answer(self, kind: int, request: int) -> bytes | None:
        """Answer a request; None for an unknown one, which stalls."""
        return None

    def write(self, data: bytes) -> None:
        """Take a bulk transfer."""
        raise NotImplementedError

    def read(self, most: int) -> bytes:
        """Return a bulk transfer of at most so many bytes."""
        raise NotImplementedError


class EmulatedBus(IBackend):  # type: ignore[misc]  # pyusb has no types
    """A backend of pyusb with emulated devices, numbered by their place; `IBackend` describes its methods."""

    def __init__(self, chips: Sequence[EmulatedDevice]) -> None:
        """Plug the devices in."""
        super().__init__()
        self.chips = list(chips)  # plugged in or not
        self.slept = 0.0  # [s]

    def sleep(self, seconds: float) -> None:
        """Let time pass on the bench, without waiting."""
        self.slept += seconds

    def enumerate_devices(self) -> list[int]:
        return [address for address, chip in enumerate(self.chips) if chip.present]

    def get_device_descriptor(self, dev: int) -> SimpleNamespace:
        chip = self.chips[dev]
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x0200, bDeviceClass=0, bDeviceSubClass=0,
            bDeviceProtocol=0, bMaxPacketSize0=8, idVendor=chip.vendor, idProduct=chip.product,
            bcdDevice=0x0600, iManufacturer=1, iProduct=2, iSerialNumber=3, bNumConfigurations=1,
            address=dev, bus=1, port_number=None, port_numbers=None, speed=None,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: int, config: int) -> SimpleNamespace:
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=32, bNumInterfaces=len(self.chips[dev].interfaces),
            bConfigurationValue=1, iConfiguration=0, bmAttributes=0x80, bMaxPower=45, extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, dev: int, intf: int, alt: int, config: int) -> SimpleNamespace:
        if alt:
            raise IndexError  # the end of pyusb's enumeration
        (kind, subclass, protocol), endpoints = self.chips[dev].interfaces[intf]
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=intf, bAlternateSetting=0,
            bNumEndpoints=len(endpoints), bInterfaceClass=kind, bInterfaceSubClass=subclass,
            bInterfaceProtocol=protocol, iInterface=0, extra_descriptors=[],
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev: int, ep: int, intf: int, alt: int, config: int) -> SimpleNamespace:
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=self.chips[dev].interfaces[intf][1][ep],
            bmAttributes=2, wMaxPacketSize=_PACKET, bInterval=0, bRefresh=0, bSynchAddress=0,
            extra_descriptors=[],
        )  # fmt: skip

    def open_device(self, dev: int) -> int:
        self._chip(dev)
        return dev

    def close_device(self, dev_handle: int) -> None: ...

    def set_configuration(self, dev_handle: int, config_value: int) -> None:
        self._chip(dev_handle)

    def get_configuration(self, dev_handle: int) -> int:
        return 1

    def claim_interface(self, dev_handle: int, intf: int) -> None:
        self._chip(dev_handle)

    def release_interface(self, dev_handle: int, intf: int) -> None: ...

    def clear_halt(self, dev_handle: int, ep: int) -> None:
        self._chip(dev_handle)

    def is_kernel_driver_active(self, dev_handle: int, intf: int) -> bool:
        return False

    def ctrl_transfer(
        self, dev_handle: int, kind: int, request: int, value: int, index: int, data: array[int], timeout: int
    ) -> int:
        chip = self._chip(dev_handle)
        if not kind & _FROM_DEVICE:
            if chip.control(kind, request, value, index, data.tobytes()):
                return len(data)
            raise stall()
        if kind == _STANDARD_FROM_DEVICE and (request, value >> 8) == (_GET_DESCRIPTOR, _STRING):
            answer: bytes | None = _string_descriptor(chip.strings, value & 0xFF)
        else:
            answer = chip.answer(kind, request)
        if answer is None:
            raise stall()
        return _fill(data, answer[: len(data)])

    def bulk_write(self, dev_handle: int, ep: int, intf: int, data: array[int], timeout: int) -> int:
        self._chip(dev_handle).write(data.tobytes())
        return len(data)

    def bulk_read(self, dev_handle: int, ep: int, intf: int, buff: array[int], timeout: int) -> int:
        return _fill(buff, self._chip(dev_handle).read(len(buff)))

    def _chip(self, dev: int) -> EmulatedDevice:
        chip = self.chips[dev]
        if not chip.present:
            raise unplugged()
        return chip


def stall() -> USBError:
    """Return the error of a request that a device refuses."""
    return USBError("Pipe error", errno=errno.EPIPE)


def unplugged() -> USBError:
    """Return the error of a request to a device that is gone."""
    return USBError("No such device (it may have been disconnected)", errno=errno.ENODEV)


def time_out() -> USBError:
    """Return the error of a transfer that does not end."""
    return USBTimeoutError("Operation timed out", errno=errno.ETIMEDOUT)


def _fill(buffer: array[int], data: bytes) -> int:
    buffer[: len(data)] = array("B", data)
    return len(data)


def _string_descriptor(strings: Sequence[str], index: int) -> bytes:
    text = _ENGLISH.to_bytes(2, "little") if index == 0 else strings[index].encode("utf-16-le")
    return bytes([len(text) + 2, _STRING]) + text
