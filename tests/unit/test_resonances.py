"""Resonances that ring in sequences, and the error by their shift."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scenes import relative_error

from autdtorch.fdtd.extrapolation import Extrapolation
from autdtorch.fdtd.resonances import Resonance, as_numbers, displacement_error, merged, of_numbers

INTERVAL = 0.75  # Between two values [periods]

widths = st.floats(0.002, 0.02)


@settings(max_examples=30, deadline=None)
@given(st.floats(-0.05, 0.05), widths, widths, st.integers(12, 40), st.integers(0, 2**31))
def test_what_rings_in_sequences_is_known(real, width, other_width, count, seed):
    """Two resonances beside a fast decay, in three sequences, of which the last 30 values are stored."""
    offsets = complex(real, -width), complex(real - math.copysign(0.06, real), -other_width), 0.3 - 0.1j
    random = torch.Generator().manual_seed(seed)
    parts = torch.randn((3, 3, 40), generator=random, dtype=torch.complex128)
    factors = torch.exp(-2j * math.pi * INTERVAL * torch.tensor(offsets, dtype=torch.complex128))
    sequences, places = Extrapolation(30), torch.tensor([0, 2])
    for number in range(count):
        sequences.append(1 + torch.einsum("rmk,m->rk", parts, factors**number))
    rung = list(sequences.ringing(places, INTERVAL))
    first = factors ** max(count - 30, 0)
    for place in range(2):
        known, part = min(rung, key=lambda each, place=place: abs(each[0] - offsets[place]))
        # singular values are left out below 1e-5 of the largest
        assert abs(known - offsets[place]) < 1e-4
        assert relative_error(part.mT, parts[places, place] * first[place]) < 1e-2


def test_nothing_rings_in_sequences_that_stand_still_or_are_short():
    sequences = Extrapolation(30)
    for number in range(20):
        assert number == 0 or not list(sequences.ringing(torch.tensor([0]), INTERVAL))
        sequences.append(torch.ones((1, 5), dtype=torch.complex128))


@pytest.mark.parametrize("cells", [1, 2, 4])
def test_noise_that_fades_is_no_resonance(cells):
    """Windows of one length alone make up 7 to 16 resonances of these 20 sequences."""
    for seed in range(20):
        random, sequences = torch.Generator().manual_seed(seed), Extrapolation(30)
        for number in range(30):
            noise = torch.randn((3, cells), generator=random, dtype=torch.complex128)
            sequences.append(1 + 0.95**number * noise)
        assert not list(sequences.ringing(torch.tensor([0, 2]), INTERVAL))


@given(st.floats(-0.05, 0.05), st.floats(1e-3, 0.02), st.floats(1.2, 1.6))
def test_a_shift_as_the_cube_of_the_spacing_is_known_from_two_grids(real, width, ratio):
    """The error is the change of strength / offset by the shift."""
    true, shift, excited = complex(real, -width), 0.005, 1e-3
    here, other = (complex(true + shift * each) for each in (1.0, ratio**3))
    fine, coarse = (Resonance(offset, excited / abs(offset)) for offset in (here, other))
    expected = abs(excited / true - excited / here)
    assert displacement_error([fine], [coarse], ratio, 0.1, math.inf) == pytest.approx(expected, rel=1e-6)
    assert displacement_error([], [coarse], ratio, 0.1, math.inf) == 0


def test_a_resonance_changes_not_far_more_than_grids_differ():
    """Fits of fields between facing surfaces have resonances that cancel each other, on both grids."""
    fine, coarse = Resonance(0.02 - 0.004j, 0.2), Resonance(0.025 - 0.005j, 0.2)
    errors = [displacement_error([fine], [coarse], 1.4, 0.1, change) for change in (1e-3, 0.01, 0.04, 1.0)]
    assert errors[1] == pytest.approx(10 * errors[0])
    assert errors[2] == errors[3]  # it changes 0.04 of the whole, which is no more than grids differ


@given(st.floats(-0.05, 0.05), st.floats(1e-4, 0.02), st.floats(0.03, 0.2))
def test_a_resonance_on_one_grid_alone_may_be_next_to_the_drive(real, width, spacing):
    """The error is the mean over shifts towards the drive, up to twice the usual 10 spacing^3."""
    fine = Resonance(complex(real, -width), 0.01)
    shifts = -math.copysign(20 * spacing**3, real) * (torch.arange(20000) + 0.5) / 20000
    changes = shifts / (fine.offset + shifts.to(torch.complex128))
    expected = fine.strength * float((changes.abs() ** 2).mean().sqrt())
    # steps of up to 8e-6, a twelfth of the least width
    assert displacement_error([fine], [], 1.3, spacing, math.inf) == pytest.approx(expected, rel=1e-2)


def test_a_resonance_that_another_grid_excites_otherwise_counts_nothing():
    one, other = Resonance(0.02 - 0.003j, 0.01), Resonance(0.021 - 0.003j, 0.1)
    assert displacement_error([one], [other], 1.3, 0.1, math.inf) == 0


def test_resonances_of_runs_are_merged_and_survive_a_file():
    weak, strong = Resonance(0.01 - 0.002j, 0.03), Resonance(0.05 - 0.02j, 0.04)
    both = merged([[weak, strong], [weak._replace(offset=0.0099 - 0.002j)]])
    # in the order of what they would be at no offset
    assert [each.offset for each in both] == [weak.offset, strong.offset]
    # of two runs alike, whose norms are 1, and of one of two
    assert [each.strength for each in both] == pytest.approx([0.03, 0.04 / math.sqrt(2)])
    assert of_numbers(as_numbers(both)) == both
