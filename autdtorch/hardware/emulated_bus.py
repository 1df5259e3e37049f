"""A USB bus without hardware: pyusb talks to it as it talks to libusb.

Everything above the wire is what drives a real device. The chips know FTDI's requests only.
"""

from __future__ import annotations

import errno
from array import array
from collections.abc import Sequence
from types import SimpleNamespace

from usb.backend import IBackend
from usb.core import USBError

from autdtorch.hardware import usb
from autdtorch.hardware.firmware import Firmware

_STRINGS = ("", "autdtorch", "emulated device")  # by index; the serial number comes after
_GET_DESCRIPTOR, _STRING_TYPE, _ENGLISH = 0x06, 0x03, 0x0409
_ENDPOINTS = (0x81, 0x02)  # bulk in, bulk out
_PACKET = 64
_BAUD_TOLERANCE = 0.03  # more, and a UART loses the last of its ten bits


class EmulatedChip:
    """An FTDI chip with one port, in front of a firmware.

    Attributes:
        vendor: idVendor.
        product: idProduct.
        strings: string descriptors by their index.
        firmware: what takes the bytes behind the chip.
        present: whether it is plugged in.
    """

    def __init__(self, vendor: int, product: int, serial: str, firmware: Firmware) -> None:
        """Plug the chip in: 9600 baud, as after its power-up."""
        self.vendor = vendor
        self.product = product
        self.strings = (*_STRINGS, serial)
        self.present = True
        self.firmware = firmware
        self._format = usb.EIGHT_N_ONE
        self._baud = 9600.0

    def control(self, request: int, value: int, index: int) -> None:
        """Take a request of FTDI's own."""
        if request == usb.BAUD_RATE:
            self._baud = _baud(value, index)
        elif request == usb.DATA_FORMAT:
            self._format = value

    def write(self, data: bytes) -> None:
        """Send bytes on to the firmware, which loses them at another rate or format than its own."""
        wanted = self.firmware.baud
        if wanted is not None:
            off_rate = abs(self._baud / wanted - 1) > _BAUD_TOLERANCE
            if off_rate or self._format != usb.EIGHT_N_ONE:
                return
        self.firmware.receive(data)

    def read(self) -> bytes:
        """An IN packet: no device here answers, so that it is the status alone."""
        return b"\x01\x60"


class EmulatedBus(IBackend):  # type: ignore[misc]  # pyusb has no types
    """A backend of pyusb with emulated chips, numbered by their place."""

    def __init__(self, chips: Sequence[EmulatedChip]) -> None:
        """Plug the chips in."""
        super().__init__()
        self.chips = list(chips)

    def enumerate_devices(self) -> list[int]:
        """Addresses of what is plugged in."""
        return [address for address, chip in enumerate(self.chips) if chip.present]

    def get_device_descriptor(self, dev: int) -> SimpleNamespace:
        """USB 2.0, class by interface."""
        chip = self.chips[dev]
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x0200, bDeviceClass=0, bDeviceSubClass=0,
            bDeviceProtocol=0, bMaxPacketSize0=8, idVendor=chip.vendor, idProduct=chip.product,
            bcdDevice=0x0600, iManufacturer=1, iProduct=2, iSerialNumber=3, bNumConfigurations=1,
            address=dev, bus=1, port_number=None, port_numbers=None, speed=None,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: int, config: int) -> SimpleNamespace:
        """The only one."""
        _require_first(config)
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=32, bNumInterfaces=1, bConfigurationValue=1,
            iConfiguration=0, bmAttributes=0x80, bMaxPower=45, extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, dev: int, intf: int, alt: int, config: int) -> SimpleNamespace:
        """The only one, of the vendor's own class."""
        _require_first(intf, alt, config)
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=0, bAlternateSetting=0,
            bNumEndpoints=len(_ENDPOINTS), bInterfaceClass=0xFF, bInterfaceSubClass=0xFF,
            bInterfaceProtocol=0xFF, iInterface=0, extra_descriptors=[],
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev: int, ep: int, intf: int, alt: int, config: int) -> SimpleNamespace:
        """Bulk."""
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=_ENDPOINTS[ep], bmAttributes=2,
            wMaxPacketSize=_PACKET, bInterval=0, bRefresh=0, bSynchAddress=0, extra_descriptors=[],
        )  # fmt: skip

    def open_device(self, dev: int) -> int:
        """The address is the handle."""
        self._chip(dev)
        return dev

    def close_device(self, dev_handle: int) -> None:
        """Nothing is held."""

    def set_configuration(self, dev_handle: int, config_value: int) -> None:
        """There is only one."""
        self._chip(dev_handle)

    def get_configuration(self, dev_handle: int) -> int:
        """The only one."""
        return 1

    def claim_interface(self, dev_handle: int, intf: int) -> None:
        """Nobody else is there."""
        self._chip(dev_handle)

    def release_interface(self, dev_handle: int, intf: int) -> None:
        """Nobody else is there."""

    def clear_halt(self, dev_handle: int, ep: int) -> None:
        """Nothing stalls."""
        self._chip(dev_handle)

    def is_kernel_driver_active(self, dev_handle: int, intf: int) -> bool:
        """There is no kernel."""
        return False

    def ctrl_transfer(
        self,
        dev_handle: int,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: array[int],
        timeout: int,
    ) -> int:
        """String descriptors, and requests to the chip; others stall."""
        chip = self._chip(dev_handle)
        if bmRequestType == usb.VENDOR_REQUEST:
            chip.control(bRequest, wValue, wIndex)
            return 0
        if bRequest == _GET_DESCRIPTOR and wValue >> 8 == _STRING_TYPE:
            text = _string_descriptor(chip.strings, wValue & 0xFF)[: len(data)]
            data[: len(text)] = array("B", text)
            return len(text)
        raise USBError("Pipe error", errno=errno.EPIPE)

    def bulk_write(self, dev_handle: int, ep: int, intf: int, data: array[int], timeout: int) -> int:
        """All of it, at once."""
        self._chip(dev_handle).write(data.tobytes())
        return len(data)

    def bulk_read(self, dev_handle: int, ep: int, intf: int, buff: array[int], timeout: int) -> int:
        """A packet."""
        packet = self._chip(dev_handle).read()
        buff[: len(packet)] = array("B", packet)
        return len(packet)

    def _chip(self, dev: int) -> EmulatedChip:
        chip = self.chips[dev]
        if not chip.present:
            raise USBError("No such device (it may have been disconnected)", errno=errno.ENODEV)
        return chip


def _baud(value: int, index: int) -> float:
    """Rate [bits/s] of a divisor as an FT232R reads it."""
    eighths = {0: 0, 3: 1, 2: 2, 4: 3, 1: 4, 5: 5, 6: 6, 7: 7}
    return 3e6 / ((value & 0x3FFF) + eighths[value >> 14 | (index & 1) << 2] / 8)


def _string_descriptor(strings: Sequence[str], index: int) -> bytes:
    text = _ENGLISH.to_bytes(2, "little") if index == 0 else strings[index].encode("utf-16-le")
    return bytes([len(text) + 2, _STRING_TYPE]) + text


def _require_first(*indices: int) -> None:
    """Pyusb goes through what there is until an IndexError."""
    if any(indices):
        raise IndexError(indices)
