"""Devices on USB as pyusb sees them: chips looked up and set up, bytes sent, errors explained."""

import errno
import sys
import threading
import time

import pytest
import torch
from usb.core import USBError, USBTimeoutError

from autdtorch.hardware import OPENMPD, SONICSURFACE, ULTRAINO, Device, EmulatedBench, LinkError
from autdtorch.hardware.emulator.bench import (
    CHIPS,
    EmulatedBus,
    EmulatedCdc,
    EmulatedChip,
    EmulatedFtdi,
    time_out,
)
from autdtorch.hardware.link import open_autd3, open_link
from autdtorch.hardware.transport.serial_chips import BAUD_RATE, CdcUart, FtdiUart, baud_divisor
from autdtorch.hardware.transport.usb import UDEV_RULES, find_device

UART, FIFO, MEGA = (0x0403, 0x6001), (0x0403, 0x6014), (0x2341, 0x0042)

# Errors as libusb raises them.
ACCESS = USBError("Access denied (insufficient permissions)", -3, errno.EACCES)
BUSY = USBError("Resource busy", -6, errno.EBUSY)
GONE = USBError("No such device (it may have been disconnected)", -4, errno.ENODEV)
BROKEN = USBError("Input/output error", -1, errno.EIO)
STALL = USBError("Pipe error", -9, errno.EPIPE)
TIME_OUT = USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)
OTHER = USBError("Overflow", -8, errno.EOVERFLOW)


def chip(serial: str = "A1", kind: type[EmulatedChip] = EmulatedFtdi) -> EmulatedChip:
    return kind(*UART, serial, SONICSURFACE.firmware(256))


def mega(kind: type[EmulatedCdc] = EmulatedCdc, boards: int = 1) -> EmulatedCdc:
    return kind(*MEGA, "A1", ULTRAINO.firmware(64 * boards))


def uart(wired: EmulatedChip) -> FtdiUart:
    return FtdiUart(find_device([UART], backend=EmulatedBus([wired])), baud=230_400)


def failing(method: str, error: Exception) -> EmulatedBus:
    bus = EmulatedBus([chip()])

    def fail(*arguments: object) -> None:
        raise error

    setattr(bus, method, fail)
    return bus


class Bound(EmulatedBus):
    """A bus whose interfaces have drivers of the kernel, which are put aside and come back."""

    bound = frozenset({0, 1})

    def is_kernel_driver_active(self, dev_handle, intf):
        return intf in self.bound

    def detach_kernel_driver(self, dev_handle, intf):
        self.bound -= {intf}

    def attach_kernel_driver(self, dev_handle, intf):
        self.bound |= {intf}


@pytest.mark.parametrize(
    ("chips", "serial", "message"),
    [
        ([], None, "no USB devices are 0403:6001. Plugged in: none"),
        (["A1"], "A2", r"no .* number 'A2'. Plugged in: 0403:6001 \(serial number A1\)"),
        (["A1", "A2"], None, "2 USB devices .*; give the serial number .* Plugged in: .*A1.*, .*A2"),
    ],
)
def test_the_device_is_found_by_its_numbers_or_an_error_lists_those_plugged_in(chips, serial, message):
    bus = EmulatedBus([chip("A1"), EmulatedFtdi(*FIFO, "B1", OPENMPD.firmware(256)), chip("A2")])
    assert find_device([FIFO], backend=bus).serial_number == "B1"
    assert find_device([UART], serial="A2", backend=bus).address == 2
    with pytest.raises(LinkError, match=message):
        find_device([UART], serial=serial, backend=EmulatedBus([chip(name) for name in chips]))


@pytest.mark.parametrize("device", [SONICSURFACE, ULTRAINO])
def test_a_serial_chip_is_set_to_the_rate_of_its_device(device: Device):
    bench = EmulatedBench(device, torch.ones((1, 16)).cdouble(), range(16))
    full = -torch.ones(16).cdouble()  # not what they start with
    with open_link(device, range(16), backend=bench.bus) as link:
        assert bench.chip.eight_n_one
        assert bench.chip.baud == pytest.approx(device.baud, rel=0.002)  # the divisor's rounding
        link.play(full)
        bench.chip.baud = 19_200  # at another rate the device receives nothing
        link.play(-full)
        bench.chip.baud = device.baud
        torch.testing.assert_close(bench.drive(), full, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("baud", "value", "index"),
    [(9600, 0x4138, 0), (38400, 0xC04E, 0), (55944, 0x4035, 1), (115_200, 0x001A, 0), (460_800, 0x4006, 0)],
)
def test_baud_divisors_are_those_of_the_application_note(baud, value, index):
    assert baud_divisor(baud) == (value, index)


def test_a_recovery_drops_waiting_bytes_and_flushing_asks_the_chip_itself():
    class Slow(EmulatedFtdi):
        waits = b""

        def write(self, data: bytes) -> None:
            self.waits += data

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
    port = uart(slow)
    port.write(bytes(150))
    port.flush()
    assert asked == [150, 50, 0]
    port.write(bytes(150))
    port.recover()
    assert not slow.waits


def test_an_ft232r_gets_all_settings_that_another_program_may_have_changed():
    class Listening(EmulatedFtdi):
        def control(self, kind: int, request: int, value: int, index: int, data: bytes) -> bool:
            requests.append((request, value, index))
            return super().control(kind, request, value, index, data)

    requests: list[tuple[int, int, int]] = []
    uart(chip(kind=Listening))
    # By the comments of ftdi_sio.h: reset; timer of 2 ms, both purges; 8 bits; no flow control; 3 MHz / 13.
    assert requests == [(0, 0, 0), (9, 2, 0), (0, 1, 0), (0, 2, 0), (4, 8, 0), (2, 0, 0), (3, 13, 0)]


def test_the_echo_of_a_row_of_boards_is_read_and_dropped():
    class Waiting(EmulatedCdc):
        """A chip on LUFA 100807: bytes from the board go first, and wait for the host to read them."""

        unread = 0

        def write(self, data: bytes) -> None:
            until = time.monotonic() + 30.0
            while self.unread > 64:
                if time.monotonic() > until:
                    raise time_out()
                time.sleep(1e-3)
            super().write(data)
            self.unread += sum(byte & 0x0F != 1 for byte in data)

        def read(self, most: int) -> bytes:
            if not self.unread:
                time.sleep(1e-3)
                raise time_out()
            taken = bytes(min(most, self.unread))
            self.unread -= len(taken)
            return taken

    with open_link(ULTRAINO.with_boards(2), backend=EmulatedBus([mega(Waiting, 2)])) as link:
        for _ in range(3):
            link.play(torch.ones(128).cdouble())


def test_a_chip_is_given_back_only_when_nobody_reads_from_it():
    class Asleep(EmulatedCdc):
        def read(self, most: int) -> bytes:
            reading.set()
            time.sleep(0.02)
            reading.clear()
            raise time_out()

    class Bus(EmulatedBus):
        def release_interface(self, dev_handle, intf):
            released_while_reading.append(reading.is_set())

    reading = threading.Event()
    released_while_reading: list[bool] = []
    port = CdcUart(find_device([MEGA], backend=Bus([mega(Asleep)])), baud=115_200)
    assert reading.wait(30)
    port.close()
    assert port._reader.daemon  # for another Python would wait before it exits and switches off
    assert released_while_reading == [False, False]


def test_every_chip_has_its_udev_rule():
    rules = UDEV_RULES.read_text()
    for vendor, product in CHIPS:
        assert f'ATTR{{idVendor}}=="{vendor:04x}", ATTR{{idProduct}}=="{product:04x}"' in rules
    assert 'ENV{ID_USB_INTERFACES}=="*:fe03*:*"' in rules


def test_the_kernels_drivers_come_back_also_if_a_chip_refuses_its_settings():
    class Refusing(Bound):
        def ctrl_transfer(self, dev_handle, bmRequestType, bRequest, *arguments):
            if bRequest == BAUD_RATE:
                assert 0 not in self.bound
                raise STALL
            return super().ctrl_transfer(dev_handle, bmRequestType, bRequest, *arguments)

    bus = Bound([mega()])
    port = CdcUart(find_device([MEGA], backend=bus), baud=115_200)
    assert not bus.bound
    port.close()
    assert bus.bound == {0, 1}
    bus = Refusing([chip()])
    with pytest.raises(LinkError, match=r"cannot be set up: .*Pipe error"):
        FtdiUart(find_device([UART], backend=bus), baud=230_400)
    assert bus.bound == {0, 1}


@pytest.mark.parametrize(
    ("method", "error", "message"),
    [
        ("open_device", ACCESS, 'sudo cp .*70-autdtorch.rules.*idVendor}=="0403", .*idProduct}=="6001"'),
        ("set_configuration", NotImplementedError(), "on Windows, give it WinUSB"),
        ("claim_interface", BUSY, "cannot be opened: another program, or another link, has it open"),
        ("bulk_write", GONE, "cannot be written to: it was unplugged"),
        ("bulk_write", BROKEN, "cannot be written to: the transfer broke off; look at cable and power"),
        ("bulk_write", TIME_OUT, r"cannot be written to: it takes or gives no bytes \(time-out\)"),
        ("bulk_write", STALL, r"cannot be written to: it refuses \(stall\)"),
        ("ctrl_transfer", STALL, r"cannot be set up: it refuses \(stall\)"),
        ("bulk_write", OTHER, r"cannot be written to: \[Errno \d+\] Overflow"),
        # Devices that cannot be opened, as without permission, are listed.
        ("serial A1", ACCESS, r"no USB .* number 'A1'.* unknown serial number: on Linux, sudo cp"),
    ],
)
def test_each_error_of_usb_has_a_message(method: str, error: Exception, message: str):
    serial = "A1" if method == "serial A1" else None
    with pytest.raises(LinkError, match=message):
        open_link(SONICSURFACE, serial=serial, backend=failing("open_device" if serial else method, error))


def test_devices_that_cannot_be_opened_are_listed_as_on_windows():
    with pytest.raises(LinkError, match=r"no USB devices .*: 0403:6001 \(serial number unknown\)"):
        open_link(OPENMPD, backend=failing("open_device", NotImplementedError()))


def test_without_libusb_there_is_an_error(monkeypatch):
    import libusb_package

    monkeypatch.setattr(libusb_package, "get_libusb1_backend", lambda: None)
    with pytest.raises(LinkError, match=r"libusb-1.0 cannot be loaded"):
        open_link(SONICSURFACE)


def test_without_the_kit_of_autd3_there_is_a_hint(monkeypatch):
    monkeypatch.setitem(sys.modules, "autd3", None)
    with pytest.raises(ImportError, match=r"pip install .*\[autd3\]"):
        open_autd3()


def test_a_warning_of_outputs_that_may_be_on_is_not_hidden_by_a_driver_that_does_not_come_back():
    class Lost(Bound):
        def attach_kernel_driver(self, dev_handle, intf):
            raise GONE

    bus = Lost([chip()])
    link = open_link(SONICSURFACE, backend=bus)
    bus.chips[0].present = False
    with pytest.raises(LinkError, match="the outputs may still be on"):
        link.close()
    link.close()  # nothing is left to do


def test_a_play_takes_the_time_on_the_wire_and_the_settle_time(trial):
    bench = trial.bench()
    with open_link(SONICSURFACE, range(16), backend=bench.bus, settle=0.02) as link:
        before = bench.bus.slept
        link.play(torch.ones(16).cdouble())
        # 258 bytes of ten bits at 230400 baud, and the settle time.
        assert bench.bus.slept - before == pytest.approx(0.0112 + 0.02, abs=1e-5)
    with pytest.raises(ValueError, match=r"settle: -1"):
        open_link(SONICSURFACE, backend=bench.bus, settle=-1.0)
