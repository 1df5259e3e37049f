import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from autdtorch.fdtd.interpolation import WIDTH_ERROR, average_nodes, exclude_cells, interpolate_points

SHAPE = (24, 22, 20)
FIRST, LAST = (2, 2, 2), (22, 20, 18)


def wave(kappa, seed):
    """A plane wave on all cells, and its wave vector times spacing."""
    vector = np.random.default_rng(seed).normal(size=3)
    vector *= kappa / np.linalg.norm(vector)
    cells = np.stack(np.indices(SHAPE), axis=-1)
    return np.exp(1j * cells @ vector).ravel(), vector


@pytest.mark.parametrize("cells", [17.0, 8.5, 6.0, 4.25])
@given(seed=st.integers(0, 2**31))
def test_plane_waves_are_interpolated(cells, seed):
    kappa = 2 * math.pi / cells
    field, vector = wave(kappa, seed)
    positions = np.random.default_rng(seed).uniform(7, 13, (5, 3))
    weights = interpolate_points(positions, SHAPE, FIRST, LAST, kappa)
    read = (field[weights.index] * weights.weight).sum(1)
    # WIDTH_ERROR an axis, and three axes, each with an error norm of the other two of about 1.5 (sum of
    # |weights|)
    assert np.abs(read - np.exp(1j * positions @ vector)).max() < 3 * 1.5**2 * WIDTH_ERROR


@pytest.mark.parametrize("cells", [17.0, 8.5])
def test_points_within_a_cell_of_the_rim_are_read_from_inside(cells):
    kappa = 2 * math.pi / cells
    field, vector = wave(kappa, seed=1)
    positions = np.array([[2.5, 2.5, 2.5], [20.5, 18.5, 16.5], [2.5, 10.2, 16.5]])
    weights = interpolate_points(positions, SHAPE, FIRST, LAST, kappa)
    touched = np.stack(np.unravel_index(weights.index, SHAPE), axis=-1)
    assert (touched >= FIRST).all()
    assert (touched < LAST).all()
    read = (field[weights.index] * weights.weight).sum(1)
    # one-sided: 2e-4 an axis at 8.5 cells per wavelength, amplified by |weights| sums of 2.8 on the other two
    # axes
    assert np.abs(read - np.exp(1j * positions @ vector)).max() < 3 * 2.8**2 * 3e-4


@pytest.mark.parametrize("cells", [17.0, 8.5])
def test_points_next_to_excluded_cells_use_the_others(cells):
    """Up to a cell beyond the last one; a point without adjacent cells reads zero."""
    kappa = 2 * math.pi / cells
    field, vector = wave(kappa, seed=2)
    positions = np.array([[10.2, 9.6, 8.3], [10.6, 9.1, 8.8], [10.95, 9.0, 8.5], [11.01, 9.0, 8.5]])
    whole = interpolate_points(positions, SHAPE, FIRST, LAST, kappa)
    excluded = np.unravel_index(whole.index, SHAPE)[0] > 10
    weights = exclude_cells(whole, positions, excluded, SHAPE, kappa)
    assert not weights.weight[excluded].any()
    assert not weights.weight[3].any()
    read = (field[weights.index] * weights.weight).sum(1)
    # a line through the last two cells would miss up to kappa^2, 0.14 and 0.55; a parabola kappa^3
    assert np.abs(read - np.exp(1j * positions @ vector))[:3].max() < 0.1
    same = exclude_cells(whole, positions, np.zeros_like(excluded), SHAPE, kappa)
    assert np.array_equal(same.weight, whole.weight)


def test_a_point_on_a_cell_centre_is_that_cell():
    weights = interpolate_points(np.array([[9.0, 8.0, 7.0]]), SHAPE, FIRST, LAST, 2 * math.pi / 8.5)
    largest = weights.weight[0].argmax()
    assert weights.index[0, largest] == np.ravel_multi_index((9, 8, 7), SHAPE)
    # not to the last digit: the fit is regularised, which costs up to WIDTH_ERROR an axis
    assert weights.weight[0, largest] == pytest.approx(1, abs=3 * WIDTH_ERROR)
    assert np.sort(np.abs(weights.weight[0]))[-2] < WIDTH_ERROR


def test_groups_of_nodes_read_their_mean():
    positions = np.random.default_rng(0).uniform(7, 13, (6, 3))
    positions[4:] = positions[3]  # of the second group one point alone: fewer cells than the first
    share = np.array([0.2, 0.3, 0.5])
    weights = interpolate_points(positions, SHAPE, FIRST, LAST, 2 * math.pi / 8.5)
    groups = average_nodes(weights, share)
    field = np.random.default_rng(1).normal(size=math.prod(SHAPE))
    each = (field[weights.index] * weights.weight).sum(1).reshape(2, 3)
    assert np.allclose((field[groups.index] * groups.weight).sum(1), each @ share, rtol=1e-12)
    for index, weight in zip(groups.index, groups.weight, strict=True):
        carrying = index[weight != 0]
        assert len(np.unique(carrying)) == len(carrying)
