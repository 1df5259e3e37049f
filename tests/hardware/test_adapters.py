"""The chips that devices hang on: what they are told, and that the device behind them hears the frames."""

import threading
import time

import pytest
import torch

from autdtorch.hardware import SONICSURFACE, ULTRAINO, Device, EmulatedBench, open_link, ultraino_boards
from autdtorch.hardware.devices.sonicsurface import SonicSurfaceFirmware
from autdtorch.hardware.devices.ultraino import UltrainoFirmware
from autdtorch.hardware.emulator.bus import EmulatedBus, time_out
from autdtorch.hardware.emulator.chips import CHIPS, EmulatedCdc
from autdtorch.hardware.transport.usb import UDEV_RULES, find_device


@pytest.mark.parametrize("device", [SONICSURFACE, ULTRAINO])
def test_a_serial_chip_is_set_to_the_rate_of_its_device(device: Device):
    bench = EmulatedBench(device, torch.ones((1, 16)).cdouble(), range(16))
    with open_link(device, range(16), backend=bench.bus) as link:
        assert bench.chip.eight_n_one
        assert bench.chip.baud == pytest.approx(device.baud, rel=0.002)  # the divisor's rounding
        link.play(-torch.ones(16).cdouble())  # not what they start with
        torch.testing.assert_close(bench.drive(), -torch.ones(16).cdouble(), rtol=0, atol=1e-14)


def test_what_a_row_of_boards_hands_on_is_read_and_dropped():
    class Waiting(EmulatedCdc):
        """As on LUFA 100807: what comes from the board goes first, and waits for the host to read it."""

        unread = 0

        def write(self, data: bytes) -> None:
            until = time.monotonic() + 1.0
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

    bus = EmulatedBus([Waiting(0x2341, 0x0042, "A1", UltrainoFirmware(2))])
    with open_link(ultraino_boards(2), backend=bus) as link:
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
    bus = Bus([Asleep(0x2341, 0x0042, "A1", UltrainoFirmware())])
    port = ULTRAINO.adapters[0].open_port(find_device([(0x2341, 0x0042)], backend=bus))
    assert reading.wait(1)
    port.close()
    assert port._reader.daemon  # for another Python would wait before it exits and switches off
    assert released_while_reading == [False, False]


def test_every_chip_has_its_udev_rule():
    rules = UDEV_RULES.read_text()
    for vendor, product in CHIPS:
        assert f'ATTR{{idVendor}}=="{vendor:04x}", ATTR{{idProduct}}=="{product:04x}"' in rules
    assert 'ENV{ID_USB_INTERFACES}=="*:fe03*:*"' in rules


def test_the_kernels_drivers_are_put_aside_and_come_back():
    bound = {0, 1}

    class Bound(EmulatedBus):
        def is_kernel_driver_active(self, dev_handle, intf):
            return intf in bound

        def detach_kernel_driver(self, dev_handle, intf):
            bound.remove(intf)

        def attach_kernel_driver(self, dev_handle, intf):
            bound.add(intf)

    bus = Bound([EmulatedCdc(0x2341, 0x0042, "A1", SonicSurfaceFirmware())])
    port = ULTRAINO.adapters[0].open_port(find_device([(0x2341, 0x0042)], backend=bus))
    assert not bound
    port.close()
    assert bound == {0, 1}
