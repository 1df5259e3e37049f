"""The grid: where it lies, and what is read between its cells."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scenes import AIR

from autdtorch.fdtd.grid import make_grid
from autdtorch.fdtd.interpolation import (
    WIDTH_ERROR,
    average_nodes,
    exclude_cells,
    interpolate_points,
    interpolation_width,
)
from autdtorch.fdtd.placement import grid_offset
from autdtorch.propagators.scene_region import region_of
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.obstacles import Box, Sphere
from autdtorch.scene.scene import Scene

SPACING = 1e-3
CORNERS = (0, 0, 0), (30e-3, 30e-3, 30e-3)
ARRAY = TransducerArray([(1e-3, 10e-3, 10e-3)], (1, 0, 0))


def scene(*obstacles):
    return Scene(ARRAY, AIR, 40e3, [(29e-3, 10e-3, 10e-3)], obstacles, domain=((0, 0, 0), (30e-3,) * 3))


def box(low, size, density=92.0):
    """From its lower corner on [mm]."""
    center = tuple(1e-3 * (one + length / 2) for one, length in zip(low, size, strict=True))
    material = {"rigid": True} if density is None else {"density": density, "sound_speed": 340.0}
    return Box(center, tuple(1e-3 * length for length in size), **material)


def after_center(scene, place, axis=0):
    """Return the distance of a coordinate [m] from the cell centre below it [cells]."""
    grid = make_grid(region_of(scene), SPACING)
    return float((place - grid.origin[axis]) / SPACING % 1)


@settings(max_examples=30)
@given(
    st.tuples(*[st.floats(3, 20)] * 3),
    st.tuples(*[st.integers(1, 7)] * 3),
    st.sampled_from([None, 92.0, 0.1]),
)
def test_faces_whole_cells_apart_lie_half_way_between_centres(low, size, density):
    obstacle = box(low, size, density)
    for axis in range(3):
        # a gain of less than a tenth does not move the grid
        for corner in (obstacle.lower, obstacle.upper):
            assert after_center(scene(obstacle), corner[axis], axis) == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize("density", [92.0, 0.01])
def test_a_face_that_cannot_lie_half_way_lies_closer_to_the_lighter_side(density):
    plate = box((10.0, 3, 3), (3.5, 20, 20), density)
    first, last = (after_center(scene(plate), corner[0]) for corner in (plate.lower, plate.upper))
    behind = (first, 1 - last) if density > AIR.density else (1 - first, last)
    # the two add up to a half or to one and a half cells; the error is larger beyond a half
    assert max(behind) < 0.5


def test_only_axis_aligned_faces_move_the_grid_which_covers_the_domain():
    sphere = Sphere((12.3e-3, 10.2e-3, 9.9e-3), 5e-3, rigid=True)
    tilted = Box((20e-3, 20e-3, 20e-3), (3e-3, 4e-3, 5e-3), (0.3, 0.2, 0.1), rigid=True)
    assert grid_offset(region_of(scene(sphere, tilted)), SPACING, *CORNERS) == (0.0, 0.0, 0.0)
    assert grid_offset(region_of(scene()), SPACING, *CORNERS) == (0.0, 0.0, 0.0)
    grid = make_grid(region_of(scene(box((5.3, 6.7, 7.9), (8, 9, 10)))), SPACING)
    margin = interpolation_width(grid.kappa) // 2 - 1  # cells that points beside the rim of the domain need
    for centers, first, last in zip(grid.centers, grid.first, grid.last, strict=True):
        assert centers[first + margin] <= 0.5 * SPACING + 1e-9
        assert centers[last - 1 - margin] >= 30e-3 - 0.5 * SPACING - 1e-9


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
