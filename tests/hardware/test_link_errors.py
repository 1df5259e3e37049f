"""What a user is told when a link cannot be had or breaks: USB errors as libusb raises them."""

import builtins
import errno
import sys

import pytest
import torch
from usb.core import USBError, USBTimeoutError

from autdtorch.hardware import OPENMPD, SONICSURFACE, ULTRAINO, Device, EmulatedBench, LinkError, open_link
from autdtorch.hardware.devices.sonicsurface import SonicSurfaceFirmware
from autdtorch.hardware.emulator.bus import EmulatedBus
from autdtorch.hardware.emulator.chips import EmulatedFtdi

# Method of the backend that fails, the error of libusb, and what the message says.
ACCESS = USBError("Access denied (insufficient permissions)", -3, errno.EACCES)
BUSY = USBError("Resource busy", -6, errno.EBUSY)
GONE = USBError("No such device (it may have been disconnected)", -4, errno.ENODEV)
BROKEN = USBError("Input/output error", -1, errno.EIO)
STALL = USBError("Pipe error", -9, errno.EPIPE)
TIME_OUT = USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)
OTHER = USBError("Overflow", -8, errno.EOVERFLOW)


def failing(method: str, error: Exception) -> EmulatedBus:
    bus = EmulatedBus([EmulatedFtdi(0x0403, 0x6001, "A1", SonicSurfaceFirmware())])

    def fail(*arguments: object) -> None:
        raise error

    setattr(bus, method, fail)
    return bus


@pytest.mark.parametrize(
    ("method", "error", "message"),
    [
        ("open_device", ACCESS, r"cannot be opened: you may not write to it.* sudo cp .*70-autdtorch.rules"),
        ("open_device", ACCESS, r'ATTR{idVendor}=="0403", ATTR{idProduct}=="6001", MODE="0660"'),
        ("set_configuration", NotImplementedError(), "on Windows, give it WinUSB"),
        ("set_configuration", BUSY, "cannot be opened: another program, or another link, has it open"),
        ("claim_interface", BUSY, "cannot be opened: another program, or another link, has it open"),
        ("bulk_write", GONE, "cannot be written to: it was unplugged"),
        ("bulk_write", BROKEN, "cannot be written to: the transfer broke off; look at cable and power"),
        ("bulk_write", TIME_OUT, r"cannot be written to: it takes or gives no bytes \(time-out\)"),
        ("bulk_write", STALL, r"cannot be written to: it refuses \(stall\)"),
        ("ctrl_transfer", STALL, r"cannot be set up: it refuses \(stall\)"),
        ("bulk_write", OTHER, r"cannot be written to: \[Errno \d+\] Overflow"),
    ],
)
def test_each_error_of_usb_has_a_message_of_its_own(method: str, error: Exception, message: str):
    with pytest.raises(LinkError, match=message):
        open_link(SONICSURFACE, backend=failing(method, error))


def test_devices_that_libusb_cannot_open_as_on_windows_are_listed_all_the_same():
    with pytest.raises(LinkError, match=r"no USB devices .*: 0403:6001 \(serial number unknown\)"):
        open_link(OPENMPD, backend=failing("open_device", NotImplementedError()))


def test_a_serial_number_that_may_not_be_read_is_said_to_be_a_matter_of_permission():
    with pytest.raises(
        LinkError, match=r"no USB devices .* number 'A1'.* unknown serial number: on Linux, sudo cp"
    ):
        open_link(SONICSURFACE, serial="A1", backend=failing("open_device", ACCESS))


def test_without_libusb_the_message_says_so(monkeypatch):
    import libusb_package

    monkeypatch.setattr(libusb_package, "get_libusb1_backend", lambda: None)
    with pytest.raises(LinkError, match=r"libusb-1.0 cannot be loaded"):
        open_link(SONICSURFACE)


@pytest.mark.parametrize("package", ["usb", "libusb_package"])
def test_without_the_packages_there_is_a_hint(monkeypatch, package: str):
    def without(name: str, *arguments: object, **named: object):
        if name.split(".")[0] == package:
            raise ModuleNotFoundError(f"No module named {package!r}")
        return real(name, *arguments, **named)

    real = builtins.__import__
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r"pip install 'autdtorch\[hardware\]'"):
        open_link(SONICSURFACE)
    if package == "usb":
        monkeypatch.delitem(sys.modules, "autdtorch.hardware.emulator.bus")
        with pytest.raises(ImportError, match=r"pip install 'autdtorch\[hardware\]'"):
            import autdtorch.hardware.emulator.bus  # noqa: F401


def test_that_the_outputs_may_be_on_is_not_hidden_by_a_driver_that_does_not_come_back():
    class Bound(EmulatedBus):
        def is_kernel_driver_active(self, dev_handle, intf):
            return True

        def detach_kernel_driver(self, dev_handle, intf):
            pass

        def attach_kernel_driver(self, dev_handle, intf):
            raise GONE

    bus = Bound([EmulatedFtdi(0x0403, 0x6001, "A1", SonicSurfaceFirmware())])
    link = open_link(SONICSURFACE, backend=bus)
    bus.chips[0].present = False
    with pytest.raises(LinkError, match="the outputs may still be on"):
        link.close()
    link.close()  # nothing is left to do


@pytest.mark.parametrize("device", [SONICSURFACE, OPENMPD, ULTRAINO])
def test_a_device_left_in_mid_frame_is_switched_off_all_the_same(device: Device):
    bench = EmulatedBench(device, torch.ones((1, device.transducers)).cdouble())
    with open_link(device, backend=bench.bus) as link:
        link.play(torch.ones(device.transducers).cdouble())
        frame = device.frame(torch.ones(device.transducers).cdouble())
        bench.firmware.receive(frame[: len(frame) // 3])
    assert bench.firmware.drive().abs().max() == 0


def test_a_play_takes_the_time_on_the_wire_and_the_settle_time(trial):
    bench = trial.bench()
    with open_link(SONICSURFACE, range(16), backend=bench.bus, settle=0.02) as link:
        before = bench.bus.slept
        link.play(torch.ones(16).cdouble())
        # 258 bytes of ten bits at 230400 baud, and the settle time.
        assert bench.bus.slept - before == pytest.approx(0.0112 + 0.02, abs=1e-5)
    with pytest.raises(ValueError, match=r"settle: -1"):
        open_link(SONICSURFACE, backend=bench.bus, settle=-1.0)
