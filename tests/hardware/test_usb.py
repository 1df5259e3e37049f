"""The FTDI chip as pyusb sees it: which is found, how it is set up, what goes through."""

import errno

import pytest
from usb.core import USBError

from autdtorch.hardware import LinkError
from autdtorch.hardware.devices.openmpd import OpenMPDFirmware
from autdtorch.hardware.devices.sonicsurface import SonicSurfaceFirmware
from autdtorch.hardware.emulator.bus import EmulatedBus
from autdtorch.hardware.emulator.chips import EmulatedChip, EmulatedFtdi
from autdtorch.hardware.transport.serial_chips import BAUD_RATE, FtdiFifo, FtdiUart, baud_divisor
from autdtorch.hardware.transport.usb import VENDOR_REQUEST, find_device

UART, FIFO = (0x0403, 0x6001), (0x0403, 0x6014)


def chip(serial: str = "A1", kind: type[EmulatedChip] = EmulatedFtdi) -> EmulatedChip:
    return kind(*UART, serial, SonicSurfaceFirmware())


def test_the_device_asked_for_is_found_by_its_numbers():
    bus = EmulatedBus([chip("A1"), EmulatedFtdi(*FIFO, "B1", OpenMPDFirmware()), chip("A2")])
    assert find_device([FIFO], backend=bus).serial_number == "B1"
    assert find_device([UART], serial="A2", backend=bus).address == 2


@pytest.mark.parametrize(
    ("chips", "serial", "message"),
    [
        ([], None, "no USB devices are 0403:6001. Plugged in: none"),
        (["A1"], "A2", r"no .* number 'A2'. Plugged in: 0403:6001 \(serial number A1\)"),
        (
            ["A1", "A2"],
            None,
            "2 USB devices .*; give the serial number .* Plugged in: .*A1.*, .*A2",
        ),
    ],
)
def test_none_or_several_are_an_error_that_lists_what_is_there(chips, serial, message):
    with pytest.raises(LinkError, match=message):
        find_device([UART], serial=serial, backend=EmulatedBus([chip(name) for name in chips]))


@pytest.mark.parametrize(
    ("baud", "value", "index"),
    [  # FTDI's application note AN232B-05
        (300, 0x2710, 0),
        (9600, 0x4138, 0),
        (19200, 0x809C, 0),
        (38400, 0xC04E, 0),
        (55944, 0x4035, 1),
        (115_200, 0x001A, 0),
        (230_400, 0x000D, 0),
        (460_800, 0x4006, 0),
    ],
)
def test_baud_divisors_are_those_of_the_application_note(baud, value, index):
    assert baud_divisor(baud) == (value, index)


def test_at_another_rate_the_device_hears_nothing():
    wired = chip()
    device = find_device([UART], backend=EmulatedBus([wired]))
    before = wired.firmware.drive()
    FtdiUart(device, baud=115_200).write(bytes([254, *[32] * 256, 253]))
    assert wired.firmware.drive().equal(before)
    FtdiUart(device, baud=230_400).write(bytes([254, *[32] * 256, 253]))
    assert wired.firmware.drive().abs().max() == 0


def test_a_recovery_drops_what_waits_to_be_sent_and_flushing_asks_the_chip_itself():
    class Slow(EmulatedFtdi):
        waits = b""

        def write(self, data: bytes) -> None:
            self.waits += data

        def read(self, most: int) -> bytes:
            return b"\x01\x60"  # of the time before the write

        def control(self, kind: int, request: int, value: int, index: int, data: bytes) -> bool:
            if (request, value) == (0, 1):  # SIO_TCOFLUSH of libftdi 1.5, from the host to the chip
                self.waits = b""
            return super().control(kind, request, value, index, data)

        def answer(self, kind: int, request: int) -> bytes | None:
            asked.append(len(self.waits))
            self.waits = self.waits[100:]
            return b"\x01\x20" if asked[-1] else super().answer(kind, request)

    asked: list[int] = []
    slow = chip(kind=Slow)
    port = FtdiUart(find_device([UART], backend=EmulatedBus([slow])), baud=230_400)
    port.write(bytes(150))
    port.flush()
    assert asked == [150, 50, 0]
    port.write(bytes(150))
    port.recover()
    assert not slow.waits


def test_an_ft232r_is_told_all_that_somebody_else_may_have_left_otherwise():
    class Listening(EmulatedFtdi):
        def control(self, kind: int, request: int, value: int, index: int, data: bytes) -> bool:
            told.append((request, value, index))
            return super().control(kind, request, value, index, data)

    told: list[tuple[int, int, int]] = []
    FtdiUart(find_device([UART], backend=EmulatedBus([chip(kind=Listening)])), baud=230_400)
    # By the comments of ftdi_sio.h: reset; timer of 2 ms, both purges; 8 bits; no flow control; 3 MHz / 13.
    assert told == [(0, 0, 0), (9, 2, 0), (0, 1, 0), (0, 2, 0), (4, 8, 0), (2, 0, 0), (3, 13, 0)]


def test_a_chip_that_refuses_its_settings_is_given_back_to_the_kernel():
    class Refusing(EmulatedBus):
        attached = True

        def is_kernel_driver_active(self, dev_handle, intf):
            return self.attached

        def detach_kernel_driver(self, dev_handle, intf):
            self.attached = False

        def attach_kernel_driver(self, dev_handle, intf):
            self.attached = True

        def ctrl_transfer(self, dev_handle, bmRequestType, bRequest, wValue, wIndex, data, timeout):
            if bRequest == BAUD_RATE:
                raise USBError("Pipe error", errno=errno.EPIPE)
            assert bmRequestType != VENDOR_REQUEST or not self.attached
            return super().ctrl_transfer(dev_handle, bmRequestType, bRequest, wValue, wIndex, data, timeout)

    bus = Refusing([chip()])
    with pytest.raises(LinkError, match=r"cannot be set up: .*Pipe error"):
        FtdiUart(find_device([UART], backend=bus), baud=230_400)
    assert bus.attached


def test_a_chip_that_takes_nothing_more_is_an_error():
    class Full(EmulatedBus):
        def bulk_write(self, dev_handle, ep, intf, data, timeout):
            return min(len(data), 60 if len(data) > 100 else 0)

    port = FtdiFifo(find_device([UART], backend=Full([chip()])))
    with pytest.raises(LinkError, match="took 60 of 160 bytes"):
        port.write(bytes(160))
