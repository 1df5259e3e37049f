"""The chips that devices hang on: what they are told, and that the device behind them hears the frames."""

import pytest
import torch

from autdtorch.hardware import SONICSURFACE, ULTRAINO, Device, EmulatedBench, open_link
from autdtorch.hardware.adapters import Adapter, ch340_divisor
from autdtorch.hardware.emulated_bus import EmulatedBus
from autdtorch.hardware.emulated_chips import CHIPS, EmulatedCdc
from autdtorch.hardware.firmware import SonicSurfaceFirmware
from autdtorch.hardware.usb import UDEV_RULES, find_device

WIRED = [(device, adapter) for device in (SONICSURFACE, ULTRAINO) for adapter in device.adapters]


@pytest.mark.parametrize(("device", "adapter"), WIRED)
def test_every_adapter_brings_the_frames_to_its_device(device: Device, adapter: Adapter):
    bench = EmulatedBench(device, torch.ones((1, 16)).cdouble(), range(16), adapter)
    with open_link(device, range(16), backend=bench.bus) as link:
        assert bench.chip.eight_n_one
        assert bench.chip.baud == pytest.approx(device.baud, rel=0.002)  # the divisor's rounding
        link.play(-torch.ones(16).cdouble())  # not what they start with
        torch.testing.assert_close(bench.drive(), -torch.ones(16).cdouble(), rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    ("baud", "value"),
    [(9600, 0xB202), (38400, 0x6403), (57600, 0x9803), (115_200, 0xCC03), (230_400, 0xE603)],
)
def test_divisors_of_a_ch340_are_those_of_the_linux_driver(baud: int, value: int):
    assert ch340_divisor(baud) == value


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
