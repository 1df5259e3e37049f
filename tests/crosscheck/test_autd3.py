"""Our arrays, levels and free-space fields against the emulator of the AUTD3 SDK.

Its RMS field is computed in float32, of phases k r up to 200 rad: 200 * 2^-24 = 1e-5 rad.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

pytest.importorskip("autd3_emulator", reason="the AUTD3 SDK's emulator: install autdtorch[crosscheck]")
pytest.importorskip("autd3_pattern", reason="the emulator needs it: install autdtorch[crosscheck]")

from checks.autd3 import (
    FOCUS,
    FULL_PULSE,
    WAVENUMBER,
    largest_shift,
    our_array,
    ours,
    phasor,
    plane,
    play_focus,
    play_levels,
    played_sequence,
    random_drive,
    rms,
    scaled,
    wrong_levels,
)
from shared.scenes import relative_error

import autdtorch as at
from autdtorch.hardware import AUTD3
from autdtorch.scene.sequence import Sequence, modulated

FLOAT32 = 1e-5


def test_transducers_lie_where_theirs_do_in_their_order() -> None:
    # float32 of 173 mm
    assert largest_shift() < 173e-3 * 2**-23


def test_a_focus_has_the_same_levels_and_the_same_field() -> None:
    emission, array = play_focus(), our_array()
    levels = AUTD3.levels(at.drive_from_phases(at.focus_phases(array.positions, FOCUS, WAVENUMBER)))
    # float32 may round a level the other way where it is half-way
    assert int((levels[0].numpy() != emission.phases).sum()) <= 1
    points, theirs = rms(emission, plane(20.0))
    assert relative_error(ours(array, emission.drive, points).abs() / math.sqrt(2), theirs) < FLOAT32


def test_amplitudes_are_what_the_pulse_widths_make_of_them() -> None:
    drive = random_drive(249)
    levels = AUTD3.levels(drive)
    emission, array = play_levels(levels), our_array()
    # A pulse width is off by half a count at most, and the slope of sin(pi w / 512) by w is below pi / 512.
    assert float((emission.drive - AUTD3.drive(*levels)).abs().max()) < 0.5 * math.pi / FULL_PULSE
    points, theirs = rms(emission, plane(20.0))
    assert relative_error(ours(array, emission.drive, points).abs() / math.sqrt(2), theirs) < FLOAT32


def test_the_waveform_has_our_phases() -> None:
    emission = play_focus()
    points, theirs = phasor(emission, plane(20.0))
    factor, left = scaled(theirs, ours(our_array(), emission.drive, points))
    # Read between two of 512 samples a period: (pi / 512)^2 / 2 of a sine at most.
    assert left < 0.5 * (math.pi / FULL_PULSE) ** 2
    # The same for all points: half a turn off would be a sign.
    assert abs(torch.tensor(factor).angle()) < math.pi / 2


def swinging(count: int) -> torch.Tensor:
    """Drives (count, 249) whose phases swing: emulator 0.12.0 smooths wrongly where they wind down twice."""
    turn = torch.sin(math.pi * torch.arange(count, dtype=torch.float64)[:, None] / 10)
    return random_drive(249) * torch.polar(torch.ones_like(turn), turn)


@pytest.mark.parametrize("rate", [500.0, 4000.0, 40_000.0])
def test_boards_emit_every_frame_in_order_at_its_time(rate: float) -> None:
    assert wrong_levels(Sequence(swinging(20), rate)) == 0


def test_boards_emit_laps_of_a_path_times_factors() -> None:
    factor = 0.6 + 0.4 * torch.cos(2 * math.pi * torch.arange(1220) / 61)[:, None]  # 61 frames, in laps of 20
    sequence = Sequence(factor * swinging(1220), 4000.0)
    phases, widths = played_sequence(sequence, 1)
    phase, intensity = (level.T.numpy() for level in AUTD3.levels(sequence.drives))
    assert np.array_equal(phases[:, 9::10][intensity > 0], phase[intensity > 0])
    emitted = np.sin(math.pi * widths[:, 9::10] / FULL_PULSE)
    # Half a level of factor and of intensity, and of 512 pulse widths.
    wanted = factor.T * random_drive(249).abs()[:, None]
    assert np.abs(emitted - wanted.numpy()).max() < 1 / 255 + math.pi / FULL_PULSE


def test_amplitude_modulation_has_its_frequency_and_depth_within_a_hundredth() -> None:
    widths = played_sequence(modulated(torch.ones(249).cdouble(), 200.0), 8)[1]
    ends = (np.sin(math.pi * widths[:, 9::10] / FULL_PULSE) ** 2).mean(axis=0)  # radiation pressure
    wanted = (1 + np.sin(2 * math.pi * np.arange(160) / 20)) / 2
    # 8 bits of the factor and of the intensity, 9 bits of the pulse width.
    assert np.abs(ends - wanted).max() < 0.01
    assert np.abs(np.fft.rfft(ends - ends.mean())).argmax() * 4000 / 160 == 200.0
