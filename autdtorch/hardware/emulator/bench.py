"""A bench without hardware: an emulated USB bus, a device behind its chip or port, and the pressure it makes.

The bus is a backend of pyusb in place of libusb. Its chips decode requests and pass bytes on to a firmware.
They follow Linux drivers and data sheets, not `serial_chips`, so that one checks the other.
"""

from __future__ import annotations

import errno
import time
from array import array
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import torch
from usb.backend import IBackend
from usb.core import USBError, USBTimeoutError

from autdtorch.hardware.devices.device import Device, Firmware
from autdtorch.hardware.link import Wiring
from autdtorch.hardware.transport.port import Port
from autdtorch.scene.drive import amplitudes_of, phases_of
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.hints import renamed_keywords
from autdtorch.utils.validation import complex_tensor, indices, integers, require_callable

_GET_DESCRIPTOR, _STRING, _ENGLISH = 0x06, 0x03, 0x0409
_FROM_DEVICE, _STANDARD_FROM_DEVICE = 0x80, 0x80
_PACKET = 64

_VENDOR_DEVICE, _CLASS_INTERFACE, _VENDOR_QUESTION = 0x40, 0x21, 0xC0
_READ_SECONDS = 0.01
_BAUD_TOLERANCE = 0.03  # beyond it a UART loses the last of its ten bits


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
        self.watchers: list[Callable[[float], object]] = []  # called with the seconds that have passed

    def sleep(self, seconds: float) -> None:
        """Let time pass on the bench, without waiting."""
        self.slept += seconds
        for watcher in self.watchers:
            watcher(seconds)

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


class EmulatedChip(EmulatedDevice):
    """A USB chip with a serial port, at `baud` [bits/s] and perhaps `eight_n_one`, in front of a firmware."""

    def __init__(self, vendor: int, product: int, serial: str, firmware: Firmware) -> None:
        """Plug the chip in, with settings of an earlier user."""
        super().__init__(vendor, product, serial)
        self.firmware = firmware
        self.baud, self.eight_n_one = 9600.0, False

    def write(self, data: bytes) -> None:
        """Send bytes on to the firmware, which loses them at a wrong rate or in a wrong format."""
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
    """A serial port of the USB class CDC: one interface for control, one for data."""

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
        time.sleep(_READ_SECONDS)
        return b""


#: Chips by idVendor and idProduct.
CHIPS: dict[tuple[int, int], type[EmulatedChip]] = {
    (0x0403, 0x6001): EmulatedFtdi,
    (0x0403, 0x6014): EmulatedFtdi,
    (0x2341, 0x0042): EmulatedCdc,
}


class EmulatedBench:
    """A device on an emulated USB bus, and the pressure it makes at the control points.

    Attributes:
        bus: backend for pyusb; empty if the device is not on USB, and takes its frames by `receive`.
        firmware: emulated firmware behind the chip; of the first of several boards.
        transfer_matrix: (P, M) [Pa], complex128.
        frame_shape: number of chips, and of bytes of a frame for each.
    """

    @renamed_keywords(dead="failed")
    def __init__(
        self,
        device: Device,
        transfer_matrix: torch.Tensor,
        transducers: Sequence[int] | torch.Tensor | None = None,
        failed: Sequence[int] = (),
    ) -> None:
        """Plug the device in, on its usual chip.

        Args:
            device: the device to emulate.
            transfer_matrix: (P, M) of the scene on the bench [Pa].
            transducers: the device's transducer for each of the scene's (M,); by default all in order.
            failed: transducers of the scene that stay silent.

        `ValueError` for `transducers` that the device does not have, or not as many as the matrix has, or
        `failed` ones that the scene does not have.
        """
        self._transducers = Wiring(device, transducers).transducers
        self.transfer_matrix = complex_tensor("transfer_matrix", transfer_matrix).to("cpu", torch.complex128)
        if self.transfer_matrix.ndim != 2 or self.transfer_matrix.shape[1] != len(self._transducers):
            shape = tuple(self.transfer_matrix.shape)
            raise ValueError(f"transfer_matrix: shape {shape}; must be (P, {len(self._transducers)})")
        self._working = torch.ones(len(self._transducers), **REAL)
        if silent := integers("failed", failed, 0, "must be indices of transducers"):
            self._working[indices("failed", silent, len(self._transducers))] = 0
        each = device.transducers // len(device.serials)
        silence = device.frame(torch.zeros(device.transducers, **COMPLEX))
        self.frame_shape = len(device.serials), len(silence) // len(device.serials)
        self._firmwares = [device.firmware(each) for _ in device.serials]
        self.firmware = self._firmwares[0]
        self.bus = EmulatedBus(
            [
                CHIPS[vendor, product](vendor, product, serial or "EMULATED", firmware)
                for vendor, product, _ in device.adapters[:1]
                for serial, firmware in zip(device.serials, self._firmwares, strict=True)
            ]
        )

    @property
    def chip(self) -> EmulatedDevice:
        """The device's USB chip on the bus; of the first of several boards."""
        return self.bus.chips[0]

    def port(self, show: Callable[[str], object] | None = None) -> Port:
        """Return a port without USB, which shows each frame as text if there is a function to."""
        if show is not None:
            require_callable("show", show)
        return BenchPort(self, show)

    def receive(self, frame: bytes) -> None:
        """Have the device take a frame without USB; several chips share it evenly."""
        each = len(frame) // len(self._firmwares)
        for number, firmware in enumerate(self._firmwares):
            firmware.receive(frame[each * number :][:each])

    def emitted(self) -> torch.Tensor:
        """Return the drive (N,), complex128, that the firmware sends to the device's transducers now."""
        return torch.cat([firmware.drive() for firmware in self._firmwares])

    def drive(self) -> torch.Tensor:
        """Return the drive (M,), complex128, that the scene's transducers emit now; 0 for failed ones."""
        return self.emitted()[self._transducers] * self._working

    def pressure(self) -> torch.Tensor:
        """Return the phasors (P,) [Pa], complex128, at the control points now."""
        return self.transfer_matrix @ self.drive()


class BenchPort(Port):
    """A port without USB: an emulated device takes its frames, each of which may be shown."""

    def __init__(self, bench: EmulatedBench, show: Callable[[str], object] | None = None) -> None:
        """Set the `bench` that takes the frames, and the function that takes a text for each."""
        self._bench, self._show = bench, show

    def write(self, data: bytes) -> None:
        """Have the device take frames; show each in hexadecimal, with amplitudes and phases [deg]."""
        chips, size = self._bench.frame_shape
        for frame in np.frombuffer(data, np.uint8).reshape(chips, -1, size).swapaxes(0, 1):
            self._take(frame.tobytes())

    def _take(self, data: bytes) -> None:
        self._bench.receive(data)
        if self._show is None:
            return
        drive = self._bench.emitted()
        pairs = zip(amplitudes_of(drive).tolist(), phases_of(drive).rad2deg().tolist(), strict=True)
        emitted = [f"{number}: {a:.3g} at {phase:.4g}" for number, (a, phase) in enumerate(pairs) if a > 0]
        self._show(f"{data.hex(' ')}\n  {', '.join(emitted) or 'all off'}")
