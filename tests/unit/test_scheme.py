"""The discrete scheme: stencil and absorbing layer, the place of the grid, and points between its cells."""

import math

import numpy as np
import pytest
import torch
from checks.absorbing_layer import measured_reflection
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scenes import AIR

from autdtorch.fdtd.grid import make_grid, path_between
from autdtorch.fdtd.interpolation import (
    WIDTH_ERROR,
    average_nodes,
    exclude_cells,
    interpolate_points,
    interpolation_width,
)
from autdtorch.fdtd.perfectly_matched_layer import DOMAIN_LAYER, box_layer, reflection, tuned_profile
from autdtorch.fdtd.placement import fitting_spacing, grid_offset
from autdtorch.fdtd.stencil import OFFSETS, tuned_stencil
from autdtorch.propagators.plan import region_of
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.obstacles import Box, Mesh, Sphere
from autdtorch.scene.scene import Scene

KAPPAS = st.floats(0.1, 2 * math.pi / 3)


def directions(count):
    vectors = np.random.default_rng(0).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def symbol_at(stencil, kappa):
    """The symbol (...) of real or complex wave vectors times spacing (..., 3)."""
    return (stencil.weights * (1 - np.cos(kappa @ np.array(OFFSETS).T))).sum(-1)


@pytest.mark.parametrize(("cells", "bound"), [(17.0, 1e-8), (8.5, 1e-6), (4.25, 1e-4), (3.0, 1e-3)])
def test_symbol_is_the_same_in_every_direction(cells, bound):
    # relative error of the frequency, half the symbol's: 4e-7 at 8.5 and 3e-5 at 4.25 cells per wavelength
    stencil = tuned_stencil(2 * math.pi / cells)
    symbol = symbol_at(stencil, stencil.kappa * directions(2000))
    assert np.abs(symbol / stencil.symbol - 1).max() / 2 < bound


@given(KAPPAS, st.integers(4, 40))
def test_plane_wave_at_the_drive_frequency_turns_by_one_period_in_whole_steps(kappa, steps):
    stencil = tuned_stencil(kappa)
    # Exact up to the anisotropy that is left, 1e-3 at the coarsest.
    cosine = 1 - stencil.time_factor(steps) * symbol_at(stencil, kappa * directions(20)) / 2
    assert np.allclose(cosine, math.cos(2 * math.pi / steps), atol=2e-3)


@pytest.mark.parametrize(("cells", "bound"), [(17.0, 2e-3), (8.5, 1e-2), (4.25, 4e-2)])
def test_plane_wave_falls_by_its_attenuation(cells, bound):
    """The residual of e^{i (kappa + i eta) n - i w t} in the discrete equation, in all directions."""
    kappa, steps = 2 * math.pi / cells, 20
    eta = 5e-3 * kappa
    stencil = tuned_stencil(kappa, eta)
    damping, turn = stencil.damping(steps), 2 * math.pi / steps
    symbol = symbol_at(stencil, (kappa + 1j * eta) * directions(200))
    left = 2 * math.cos(turn) - 2j * damping * math.sin(turn) - 2 + stencil.time_factor(steps) * symbol
    # divided by the slope of the symbol it is an error of the wavenumber
    error = left / (stencil.time_factor(steps) * stencil.slope)
    assert np.abs(error).max() < bound * eta
    assert abs(np.mean(error)) < 0.1 * bound * eta


@given(KAPPAS)
def test_no_loss_no_damping_and_long_waves_see_the_laplacian(kappa):
    assert tuned_stencil(kappa).damping(12) == 0
    # The term D (p_new - p_old) lets a wave fall by D a step: eta / kappa of the turn.
    assert tuned_stencil(kappa, 1e-3 * kappa).damping(200) == pytest.approx(1e-3 * math.pi / 100, rel=0.5)
    stencil = tuned_stencil(kappa)
    assert stencil.weights.sum() == pytest.approx(stencil.total)
    # the next term of the expansion is of relative size 1e-6
    assert np.allclose(symbol_at(stencil, 1e-3 * directions(20)), 1e-6, rtol=1e-5)
    stencil = tuned_stencil(kappa)
    axis = np.linspace(0, math.pi, 9)
    waves = np.stack(np.meshgrid(axis, axis, axis), axis=-1)
    assert symbol_at(stencil, waves).max() == pytest.approx(stencil.largest_symbol, rel=1e-12)


def test_source_factor_tends_to_that_of_the_continuum_on_fine_grids():
    # naive normalisation: 4 pi (c dt / h)^2; the grid's factor differs by kappa^2 / 6 or so
    stencil = tuned_stencil(0.05)
    courant = 2 * math.pi / 40 / 0.05
    assert stencil.source_factor(40) == pytest.approx(4 * math.pi * courant**2, rel=5e-3)


BOX_LAYER = box_layer(1.0)
# cells per wavelength and steps per period: largest reflection up to 60 degrees and at 75 [dB], and largest
# energy that evanescent fields gain: measured 0.16, 0.07, 0.04 and 0.01, in a box 0.19, 0.10, 0.07 and 0.03.
# With a tenth of the frequency shift it is 0.56, 0.43, 0.37 and 0.28.
LAYERS = [
    (DOMAIN_LAYER, 34.0, 43, -95, -70, None),
    (DOMAIN_LAYER, 17.0, 25, -98, -78, 0.2),
    (DOMAIN_LAYER, 8.5, 12, -82, -63, 0.1),
    (DOMAIN_LAYER, 6.0, 8.5, -68, -50, 0.1),
    (DOMAIN_LAYER, 4.25, 6, -66, -48, 0.1),
    (DOMAIN_LAYER, 3.0, 4, -32, -18, None),
    (BOX_LAYER, 17.0, 25, -70, None, 0.25),
    (BOX_LAYER, 8.5, 12, -58, None, 0.15),
    (BOX_LAYER, 6.0, 8.5, -48, None, 0.1),
    (BOX_LAYER, 4.25, 6, -49, None, 0.1),
    (BOX_LAYER, 3.0, 4, -24, None, None),
]


@pytest.mark.parametrize(("layer", "cells_per_wavelength", "steps", "bound", "grazing", "energy"), LAYERS)
def test_a_tuned_layer_reflects_little_at_the_drive_frequency(
    layer, cells_per_wavelength, steps, bound, grazing, energy
):
    """The frequency shift costs reflection; without it the near field of a light obstacle grows.

    The design goal is -70 dB to 60 degrees and -45 dB at 75 with 10 cells at 8.5 cells per wavelength. Of the
    field e^{q j} + r e^{-q j} in air cell j, -2 q Im(r) flows away from the layer.
    """
    kappa, turn = 2 * math.pi / cells_per_wavelength, 2 * math.pi / steps
    profile = tuned_profile(kappa, steps, layer.cells(kappa))

    def decibels(*degrees):
        along = kappa * np.cos(np.radians(degrees))
        return 20 * np.log10(np.abs(reflection(profile, along, np.full(len(along), turn)))).max()

    assert decibels(0, 7, 15, 22, 30, 37, 45, 52, 60) < bound
    assert grazing is None or decibels(75) < grazing
    if energy:
        fading, shares = np.geomspace(1e-3, 2, 40), np.geomspace(3e-3, 1, 40)
        waves = (reflection(profile, 1j * fading, np.full(len(fading), turn * share)) for share in shares)
        assert max(-wave.imag.min() for wave in waves) < energy


def test_a_layer_absorbs_other_frequencies_and_its_echo_is_measured():
    # waves of half and of 1.5 times the frequency, which the switch-on excites, at normal incidence
    kappa, steps = 2 * math.pi / 8.5, 13
    profile = tuned_profile(kappa, steps, DOMAIN_LAYER.fine)
    along = kappa * np.array([0.5, 1.5])
    scale = math.sin(math.pi / steps) / math.sin(kappa / 2)
    turn = 2 * np.arcsin(scale * np.sin(along / 2))
    assert (20 * np.log10(np.abs(reflection(profile, along, turn))) < -40).all()
    # required: -70 dB from 0 to 60 degrees and -45 dB at 75, in at most 10 cells at 8.5 cells per wavelength;
    # the other layers are a wavelength off, so that the grid's edges and corners are in it
    angles, echo = measured_reflection(8.5, DOMAIN_LAYER.fine, np.array((0.0, 30.0, 60.0, 75.0)), 5, aside=9)
    assert np.allclose(angles, (0, 30, 60, 75), atol=2)  # as whole cells allow
    decibels = 20 * np.log10(echo)
    assert decibels[:3].max() < -70
    assert decibels[3] < -45
    # and the comparison itself resolves it: the echo is not zero
    assert decibels.min() > -130


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


@settings(max_examples=5)
@given(st.tuples(*[st.floats(-3, 3)] * 3), st.floats(3e-3, 60e-3))
def test_sound_arrives_between_most_places_on_surfaces(angles, size):
    """A run waits for that. The share of the pairs that are farther apart follows from geometry.

    It is 0.005 of those on a sphere from 0.9975 of its diameter on. Places are a lattice: 2 %.
    """
    sphere = Sphere((0.1, 0.0, 0.0), size, rigid=True)
    assert path_between([sphere]) == pytest.approx(2 * size * math.sqrt(0.995), rel=0.02)
    plate = Box((0.0, 0.0, 0.0), (size, size, size / 100), angles, rigid=True)
    assert size < path_between([plate]) < 1.25 * size  # of a square all but 0.005 are within 1.16 sides
    far = Sphere((0.1, 0.3, 0.0), 1e-3, rigid=True)  # of bodies apart, however small, half of the pairs
    assert 0.3 <= path_between([sphere, far]) <= 0.301 + size
    surfaces = [shape.surface() for shape in (sphere, far)]
    faces = torch.cat([surfaces[0][1], surfaces[1][1] + len(surfaces[0][0])])
    both = Mesh.from_surface((torch.cat([vertices for vertices, _ in surfaces]), faces), rigid=True)
    assert 0.3 <= path_between([both]) <= 0.301 + size  # nor do parts of one body that are apart


@pytest.mark.parametrize("size", [14.56, 15.56])
def test_faces_that_fall_between_are_nearer_to_the_last_centre_than_to_the_next(size):
    """0.22 cells behind it, not 0.72, where edges miss twice as much."""
    side = size * SPACING
    region = region_of(scene(Box((20e-3,) * 3, (side,) * 3, rigid=True)))
    lower = 20e-3 - side / 2
    offset = grid_offset(region, SPACING, (lower,) * 3, (lower + side,) * 3)
    np.testing.assert_allclose((np.array(offset) - 0.5) % 1, 0.22, atol=0.01)


@given(st.floats(8, 40), st.floats(0.6, 2.0))
def test_a_spacing_is_moved_until_opposite_faces_fall_alike(side, spacing):
    """Faces of a cube of whole cells and 0.04 are both 0.48 cells behind a centre."""
    region = region_of(scene(box((20, 20, 20), (side,) * 3)))
    fitting = fitting_spacing([region.unbounded], spacing * 1e-3) * 1e3
    assert 0.92 * spacing - 1e-9 <= fitting <= 1.08 * spacing + 1e-9
    reached = any(abs(side / (cells + 0.04) / spacing - 1) < 0.08 for cells in range(100))
    assert not reached or abs((side / fitting - 0.04 + 0.5) % 1 - 0.5) < 0.13  # of spacings an eighth apart
    assert fitting_spacing([region.unbounded], spacing * 1e-3, spacing * 1e-3) <= spacing * 1e-3
    large = region_of(scene(box((20, 20, 20), (300 + side,) * 3)))  # suits a spacing in each 0.2 to 0.7 %
    assert fitting_spacing([large.unbounded], spacing * 1e-3) == pytest.approx(spacing * 1e-3, rel=0.02)
    sphere = Sphere((20e-3, 20e-3, 20e-3), 5e-3, rigid=True)
    assert fitting_spacing([region_of(scene(sphere))], SPACING) == SPACING


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


def test_a_point_on_a_cell_centre_is_that_cell_and_groups_of_nodes_read_their_mean():
    weights = interpolate_points(np.array([[9.0, 8.0, 7.0]]), SHAPE, FIRST, LAST, 2 * math.pi / 8.5)
    largest = weights.weight[0].argmax()
    assert weights.index[0, largest] == np.ravel_multi_index((9, 8, 7), SHAPE)
    # not to the last digit: the fit is regularised, which costs up to WIDTH_ERROR an axis
    assert weights.weight[0, largest] == pytest.approx(1, abs=3 * WIDTH_ERROR)
    assert np.sort(np.abs(weights.weight[0]))[-2] < WIDTH_ERROR
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
