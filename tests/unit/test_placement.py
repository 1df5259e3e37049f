"""Placement of the grid: axis-aligned faces half-way between cell centres where possible."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scenes import AIR

from autdtorch.fdtd.grid import make_grid
from autdtorch.fdtd.interpolation import interpolation_width
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


def test_only_axis_aligned_faces_move_the_grid():
    sphere = Sphere((12.3e-3, 10.2e-3, 9.9e-3), 5e-3, rigid=True)
    tilted = Box((20e-3, 20e-3, 20e-3), (3e-3, 4e-3, 5e-3), (0.3, 0.2, 0.1), rigid=True)
    assert grid_offset(region_of(scene(sphere, tilted)), SPACING, *CORNERS) == (0.0, 0.0, 0.0)
    assert grid_offset(region_of(scene()), SPACING, *CORNERS) == (0.0, 0.0, 0.0)


def test_the_grid_covers_the_domain_wherever_it_lies():
    grid = make_grid(region_of(scene(box((5.3, 6.7, 7.9), (8, 9, 10)))), SPACING)
    margin = interpolation_width(grid.kappa) // 2 - 1  # cells that points beside the rim of the domain need
    for centers, first, last in zip(grid.centers, grid.first, grid.last, strict=True):
        assert centers[first + margin] <= 0.5 * SPACING + 1e-9
        assert centers[last - 1 - margin] >= 30e-3 - 0.5 * SPACING - 1e-9
