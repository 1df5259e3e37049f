"""Boards of OpenMPD by their files: pins, calibration, and several of them by their serial numbers."""

import math
from dataclasses import replace

import pytest
import torch

from autdtorch.hardware import EmulatedBench, LinkError, open_link, openmpd_boards
from autdtorch.hardware.devices.openmpd import OpenMPDBoard
from autdtorch.hardware.played import Wiring
from autdtorch.scene.drive import drive_from_phases


def board(name: str, seed: int, gain: float = 1.0) -> OpenMPDBoard:
    generator = torch.Generator().manual_seed(seed)
    return OpenMPDBoard(
        name,
        torch.zeros((256, 3), dtype=torch.float64),
        tuple(torch.randperm(256, generator=generator).tolist()),
        # Whole levels, so that rounding plays no part.
        torch.randint(128, (256,), generator=generator).double() * (2 * torch.pi / 128),
        torch.full((256,), gain, dtype=torch.float64),
    )


def test_boards_of_files_play_the_drive_that_was_asked_for():
    boards = board("left", 1), board("right", 2)
    device = openmpd_boards(boards)
    # On the bench, transducer m hangs on its pin, and is ahead by its offset.
    pins = [256 * number + pin for number, one in enumerate(boards) for pin in one.pins]
    ahead = torch.cat([one.phase_offsets for one in boards])
    bench = EmulatedBench(device, torch.diag(torch.polar(torch.ones(512).double(), ahead)), pins)
    drive = drive_from_phases(torch.randint(128, (512,)).double() * (2 * torch.pi / 128))
    with open_link(device, backend=bench.bus) as link:
        link.play(drive)
        torch.testing.assert_close(bench.pressure(), drive, rtol=0, atol=1e-12)  # rounding of the angles
        torch.testing.assert_close(Wiring(device).quantised(drive), drive, rtol=0, atol=1e-12)
    assert bench.drive().abs().max() == 0


@pytest.mark.parametrize("gain", [0.5, 0.49])
def test_gains_lower_the_duty(gain: float):
    one = board("half", 0, gain)
    device = openmpd_boards([one])
    full = torch.ones(256).cdouble()
    assert set(device.frame(full)[256:]) == {21}  # 128 asin(gain) / pi = 21.3 and 20.9
    expected = torch.full((256,), math.sin(21 * math.pi / 128) / gain, dtype=torch.float64)
    torch.testing.assert_close(device.quantised(full).abs(), expected, rtol=1e-12, atol=0)
    assert device.quantised(full).angle().abs().max() < torch.pi / 128 + 1e-9
    assert not device.quantised(0 * full).any()


def test_a_board_that_is_not_there_is_named_and_the_others_are_let_go():
    present = EmulatedBench(openmpd_boards([board("left", 1)]), torch.ones((1, 256)).cdouble())
    with pytest.raises(LinkError, match=r"no USB devices .* 'right'. Plugged in: .* \(serial number left\)"):
        open_link(openmpd_boards([board("left", 1), board("right", 2)]), backend=present.bus)
    with open_link(openmpd_boards([board("left", 1)]), backend=present.bus):
        pass


@pytest.mark.parametrize("in_mid_message", [False, True])
def test_one_board_unplugged_does_not_keep_the_others_on(in_mid_message: bool):
    device = openmpd_boards([board("left", 1), board("right", 2)])
    bench = EmulatedBench(device, torch.eye(512).cdouble())
    link = open_link(device, backend=bench.bus)
    link.play(torch.ones(512).cdouble())
    if in_mid_message:
        bench.bus.chips[1].write(device.frame(torch.ones(512).cdouble())[512:1000])
    bench.chip.present = False
    with pytest.raises(LinkError, match=r"left.*unplugged"):
        link.close()
    assert bench.drive()[256:].abs().max() == 0


def test_ambiguous_and_incomplete_boards_are_refused():
    with pytest.raises(ValueError, match=r"boards: \('a', 'a'\)"):
        openmpd_boards([board("a", 1), board("a", 2)])
    small = replace(board("small", 1), pins=(0, 1))
    with pytest.raises(ValueError, match=r"small has 2 transducers; must be 256"):
        openmpd_boards([small])
    with pytest.raises(ValueError, match=r"serial: 'x'; must be None, as OpenMPD has 2 boards"):
        open_link(openmpd_boards([board("a", 1), board("b", 2)]), serial="x")
