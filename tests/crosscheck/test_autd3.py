"""Our arrays, levels and free-space fields against the emulator of the AUTD3 SDK.

Its RMS field is computed in float32, of phases k r up to 200 rad: 200 * 2^-24 = 1e-5 rad.
"""

from __future__ import annotations

import math

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
    random_drive,
    rms,
    scaled,
)
from shared.scenes import relative_error

import autdtorch as at
from autdtorch.hardware import AUTD3

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
