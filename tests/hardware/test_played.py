"""The quantisation of drives, against each device's emulated firmware; boards of OpenMPD by their files."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from autdtorch import hardware as hw
from autdtorch.hardware.devices.openmpd import OpenMPDBoard
from autdtorch.hardware.link import Wiring
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.drive import drive_from_phases
from autdtorch.scene.scene import Medium, Scene

#: On two boards, where there are two, and in no order.
TRANSDUCERS = [70, 3, *range(200, 186, -1)]


def board(name: str, seed: int = 0, gain: float | None = None) -> OpenMPDBoard:
    """A board with pins in no order. Without a gain, gains and offsets of its transducers are all different;
    with one, offsets are whole levels, so that rounding plays no part."""
    generator = torch.Generator().manual_seed(seed)
    pins = tuple(torch.randperm(256, generator=generator).tolist())
    shares = torch.rand(2, 256, generator=generator, dtype=torch.float64)
    offsets, gains = shares[0], 0.5 + 0.5 * shares[1]
    if gain is not None:
        offsets, gains = (128 * offsets).floor() / 128, torch.full_like(gains, gain)
    return OpenMPDBoard(name, torch.zeros((256, 3)).double(), pins, 2 * torch.pi * offsets, gains)


BOARD, LEFT, RIGHT = board("one"), board("left", 1, 1.0), board("right", 2, 1.0)
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
@settings(max_examples=3)
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


def test_boards_of_files_play_the_drive_that_was_asked_for():
    device = hw.openmpd_boards([LEFT, RIGHT])
    matrix, wired = device.as_built(torch.eye(512).cdouble(), torch.arange(512))
    # On the bench, transducer m is at its pin, and ahead by its offset.
    assert wired.tolist() == [
        256 * number + pin for number, one in enumerate([LEFT, RIGHT]) for pin in one.pins
    ]
    ahead = torch.cat([LEFT.phase_offsets, RIGHT.phase_offsets])
    torch.testing.assert_close(matrix.diagonal(), torch.polar(torch.ones(512).double(), ahead))
    bench = hw.EmulatedBench(device, matrix, wired)
    drive = drive_from_phases(torch.randint(128, (512,)).double() * (2 * torch.pi / 128))
    with hw.open_link(device, backend=bench.bus) as link:
        link.play(drive)
        torch.testing.assert_close(bench.pressure(), drive, rtol=0, atol=1e-12)  # rounding of the angles
        torch.testing.assert_close(Wiring(device).quantised(drive), drive, rtol=0, atol=1e-12)
    assert bench.drive().abs().max() == 0


@pytest.mark.parametrize("gain", [0.5, 0.49])
def test_gains_lower_the_duty(gain: float):
    device = hw.openmpd_boards([board("half", 0, gain)])
    full = torch.ones(256).cdouble()
    assert set(device.frame(full)[256:]) == {21}  # 128 asin(gain) / pi = 21.3 and 20.9
    expected = torch.full((256,), math.sin(21 * math.pi / 128) / gain, dtype=torch.float64)
    torch.testing.assert_close(device.quantised(full).abs(), expected, rtol=1e-12, atol=0)
    assert device.quantised(full).angle().abs().max() < torch.pi / 128 + 1e-9
    assert not device.quantised(0 * full).any()


def test_a_board_that_is_not_there_is_named_and_the_others_are_let_go():
    present = hw.EmulatedBench(hw.openmpd_boards([LEFT]), torch.ones((1, 256)).cdouble())
    with pytest.raises(hw.LinkError, match=r"no USB .* 'right'. Plugged in: .* \(serial number left\)"):
        hw.open_link(hw.openmpd_boards([LEFT, RIGHT]), backend=present.bus)
    with hw.open_link(hw.openmpd_boards([LEFT]), backend=present.bus):
        pass


@pytest.mark.parametrize("in_mid_message", [False, True])
def test_one_board_unplugged_does_not_keep_the_others_on(in_mid_message: bool):
    device = hw.openmpd_boards([LEFT, RIGHT])
    bench = hw.EmulatedBench(device, torch.eye(512).cdouble())
    link = hw.open_link(device, backend=bench.bus)
    link.play(torch.ones(512).cdouble())
    if in_mid_message:
        bench.bus.chips[1].write(device.frame(torch.ones(512).cdouble())[512:1000])
    bench.chip.present = False
    with pytest.raises(hw.LinkError, match=r"left.*unplugged"):
        link.close()
    assert bench.drive()[256:].abs().max() == 0


def test_ambiguous_and_incomplete_boards_are_refused():
    with pytest.raises(ValueError, match=r"boards: \('a', 'a'\)"):
        hw.openmpd_boards([board("a"), board("a")])
    with pytest.raises(ValueError, match=r"left has 2 transducers; must be 256"):
        hw.openmpd_boards([replace(LEFT, pins=(0, 1))])
    with pytest.raises(ValueError, match=r"serial: 'x'; must be None, as OpenMPD has 2 boards"):
        hw.open_link(hw.openmpd_boards([LEFT, RIGHT]), serial="x")
