"""The quantisation of drives, against the emulated firmware of each device."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from autdtorch import hardware as hw
from autdtorch.hardware.devices.openmpd import OpenMPDBoard
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.scene import Medium, Scene

#: On two boards, where there are two, and in no order.
TRANSDUCERS = [70, 3, *range(200, 186, -1)]


def board() -> OpenMPDBoard:
    """A board whose transducers all have other gains and offsets, and other pins."""
    generator = torch.Generator().manual_seed(0)
    return OpenMPDBoard(
        "one",
        torch.zeros((256, 3), dtype=torch.float64),
        tuple(torch.randperm(256, generator=generator).tolist()),
        2 * torch.pi * torch.rand(256, generator=generator).double(),
        0.5 + 0.5 * torch.rand(256, generator=generator).double(),
    )


BOARD = board()
#: Phases of each device, and the largest step of its amplitude: of a pulse's the first, by the least gain.
DEVICES = {
    "SonicSurface": (hw.SONICSURFACE, 32, 1.0),
    "OpenMPD": (hw.OPENMPD, 128, math.pi / 128),
    "OpenMPD, calibrated": (hw.openmpd_boards([BOARD]), 128, math.pi / 128 / 0.5),
    "Ultraino": (hw.ultraino_boards(4), 10, math.pi / 10),
    "AUTD3": (hw.AUTD3, 256, 1 / 255),
}


class Bench(hw.EmulatedBench, hw.Port):
    """A port too, so that a device needs no USB; its pressures are what the transducers emit."""

    def __init__(self, device: hw.Device) -> None:
        calibrated = device.serials == (BOARD.name,)
        emits = torch.ones(256).cdouble() / (BOARD.calibrated(torch.ones(256).cdouble()) if calibrated else 1)
        pins = [BOARD.pins[place] if calibrated else place for place in TRANSDUCERS]
        super().__init__(device, torch.diag(emits[TRANSDUCERS]), pins)

    def write(self, data: bytes) -> None:
        self.receive(data)


class Silence:
    """An objective that is never asked."""

    scene = Scene(TransducerArray.grid((4, 4), 10e-3, (0, 0, 0)), Medium(1.2, 340.0), 40e3, [(80e-3, 0, 0)])
    evaluations = 0

    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        raise NotImplementedError


def random_drives(seed: int) -> torch.Tensor:
    """Three of them; the first has full amplitudes."""
    generator = torch.Generator().manual_seed(seed)
    amplitudes, angles = torch.rand(2, 3, 16, generator=generator, dtype=torch.float64)
    amplitudes[0] = 1
    return torch.polar(amplitudes, 7 * angles)


@pytest.mark.parametrize("name", DEVICES)
@settings(max_examples=6)
@given(seed=st.integers(0, 2**31), limit=st.sampled_from([1.0, 0.8, 0.35]))
def test_the_firmware_plays_the_quantised_drive(name: str, seed: int, limit: float):
    device, phases, step = DEVICES[name]
    limit = 1.0 if device is hw.SONICSURFACE else limit
    drives = random_drives(seed)
    played = hw.Played(Silence(), device, TRANSDUCERS, limit)
    emitted = played.emitted(drives)
    # Rounding, of the levels' trigonometry.
    torch.testing.assert_close(played.emitted(emitted), emitted, rtol=0, atol=1e-12)
    assert torch.equal(played.emitted(drives.T.contiguous().T[1:2]), emitted[1:2])

    bench = Bench(device)
    with hw.Link(device, bench, TRANSDUCERS, sleep=bench.bus.sleep) as link:
        limited = hw.LimitedLink(link, hw.Limits(limit))
        limited.play(torch.ones(16).cdouble())
        full = bench.pressure().abs().max()
        assert limit - step < full <= limit + 1e-6  # the tolerance of an amplitude
        for asked, expected in zip(drives, emitted, strict=True):
            limited.play(asked)
            torch.testing.assert_close(bench.pressure(), full * expected, rtol=0, atol=1e-12)

    turned = (emitted / drives)[emitted != 0].angle().abs()
    assert turned.max() <= math.pi / phases + 1e-9
    off = full * (emitted.abs() - drives.abs())
    assert off.max() <= step / 2 + 1e-9
    # Of a calibrated transducer the nearest level may be above the limit, and is then the one below.
    assert -off.min() <= (step if name == "OpenMPD, calibrated" else step / 2) + 1e-9


@pytest.mark.parametrize(
    ("transducers", "amplitude", "message"),
    [
        (None, 1.0, "transducers: 64; must be 16"),
        ([3] * 16, 1.0, "transducers: .* each once"),
        (range(16), 1.1, "amplitude: 1.1"),
        (range(16), 0.3, "amplitude: 0.3; must be >= 0.309, the lowest level of Ultraino"),
    ],
)
def test_limits_and_transducers_that_a_device_does_not_have_are_refused(
    transducers, amplitude: float, message: str
):
    with pytest.raises(ValueError, match=message):
        hw.Played(Silence(), hw.ultraino_boards(), transducers, amplitude)
