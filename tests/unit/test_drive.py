import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from autdtorch.scene.drive import (
    amplitudes_of,
    drive_from_phases,
    focus_phases,
    normalise,
    phases_of,
    validate_drive,
)

# phases may be whole numbers
pytestmark = pytest.mark.filterwarnings("ignore::autdtorch.utils.units.ScaleWarning")

phases_arrays = hnp.arrays(
    float, hnp.array_shapes(min_dims=1, max_dims=3, max_side=5), elements=st.floats(-1e3, 1e3)
)


def test_a_positive_phase_turns_the_drive_clockwise():
    assert drive_from_phases(torch.zeros(5, 1, 2), [1.0, 0.5])[3, 0].tolist() == [1.0, 0.5]  # broadcasts
    drive = drive_from_phases([0.0, math.pi / 2], [1.0, 0.5])
    expected = torch.tensor([1.0, -0.5j], dtype=torch.complex128)
    # cos(pi / 2) is 6e-17 in float64.
    torch.testing.assert_close(drive, expected, rtol=0, atol=1e-16)


@given(phases=phases_arrays)
def test_drive_and_phases_round_trip(phases):
    drive = drive_from_phases(phases)
    found = phases_of(drive)
    assert found.shape == phases.shape
    assert ((found >= 0) & (found < 2 * math.pi)).all()
    # Compared on the circle, where 0 and 2 pi are one; 1e3 rad leaves 1e-13 of rounding in sine and cosine.
    torch.testing.assert_close(drive_from_phases(found), drive, rtol=0, atol=1e-12)


@given(phases=phases_arrays, data=st.data())
def test_amplitudes_round_trip(phases, data):
    amplitudes = data.draw(hnp.arrays(float, phases.shape, elements=st.floats(0, 1)))
    found = amplitudes_of(drive_from_phases(phases, amplitudes))
    # Subnormal amplitudes lose their relative precision in |q|.
    torch.testing.assert_close(found, torch.from_numpy(amplitudes), rtol=1e-15, atol=1e-300)


def test_phases_stay_below_a_full_turn_and_are_zero_for_silence():
    phases = phases_of(torch.tensor([1 + 1e-17j, 0j, complex(-0.0, 0.0), -1 + 0j], dtype=torch.complex128))
    assert phases.tolist() == [0.0, 0.0, 0.0, math.pi]


def test_drive_carries_the_gradient_of_phases_and_amplitudes():
    phases = torch.tensor([0.3, 2.0], dtype=torch.float64, requires_grad=True)
    amplitudes = torch.tensor([0.4, 0.9], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(drive_from_phases, (phases, amplitudes))


def test_focus_phases_are_the_distance_in_radians():
    positions, foci = [[0, 0, 0], [0, 0, 0.5]], [[0.3, 0.4, 0.0], [0.0, 0.0, 2.0]]
    phases = focus_phases(positions, foci, wavenumber=10.0)
    assert phases[0].tolist() == pytest.approx([5.0, 10 * math.sqrt(0.5)], rel=1e-15)
    assert phases[1].tolist() == pytest.approx([20.0, 15.0], rel=1e-15)
    assert torch.equal(phases[1], focus_phases(positions, foci[1], wavenumber=10.0))


def test_normalise_brings_every_drive_to_full_amplitude():
    drive = torch.tensor([[3j, 4.0], [0.0, -0.1j]], dtype=torch.complex128)
    expected = torch.tensor([[0.75j, 1.0], [0.0, -1j]], dtype=torch.complex128)
    torch.testing.assert_close(normalise(drive), expected, rtol=1e-15, atol=0)


def test_validate_drive_accepts_single_precision_of_unit_amplitude():
    drive = drive_from_phases(torch.arange(16.0)).to(torch.complex64)
    assert validate_drive(drive, 16).dtype == torch.complex128
