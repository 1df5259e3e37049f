"""Error estimates against exact solutions, and the spacings that are chosen by them."""

import math

import pytest
import torch
from small_scenes import AIR, relative_error, small_scene

from autdtorch import analytic
from autdtorch.analytic.green import free_space_matrix
from autdtorch.fdtd.grid import RATIO, coarsest_spacing, grid_error, second_spacing, spacing_for
from autdtorch.propagators import FreeSpacePropagator, make_propagator
from autdtorch.propagators.scene_region import region_of
from autdtorch.scene.obstacles import Sphere

CENTER, RADIUS = (12.2e-3, 11.9e-3, 12.1e-3), 3.3e-3
RIGID = Sphere(CENTER, RADIUS, rigid=True)
HEAVY = Sphere(CENTER, RADIUS, density=10 * AIR.density, sound_speed=1.5 * AIR.sound_speed)
EMPTY = small_scene()


def exact(sphere):
    where = EMPTY.control_points, EMPTY.array.positions, EMPTY.wavenumber, CENTER, RADIUS
    field = analytic.rigid_sphere(*where) if sphere is RIGID else analytic.fluid_sphere(*where, 10.0, 1.5)
    return 4 * math.pi * EMPTY.array.source_strength * field


@pytest.mark.parametrize("sphere", [RIGID, HEAVY], ids=["rigid", "heavy"])
@pytest.mark.parametrize(("method", "spacing"), [("full", 1.8e-3), ("full", 1.3e-3), ("box", 1e-3)])
def test_the_estimate_is_honest(sphere, method, spacing):
    """Required: within a factor of 3 of the true error, or above it."""
    propagator = make_propagator(small_scene((sphere,)), method, spacing, tolerance=1e-3)
    matrix, error = propagator.transfer_matrix(return_error=True)
    true = relative_error(matrix, exact(sphere))
    assert true / 3 < error < 20 * true


def test_the_estimate_is_honest_in_free_space():
    propagator = make_propagator(EMPTY, "full", 1.3e-3, tolerance=1e-3)
    matrix, error = propagator.transfer_matrix(return_error=True)
    free = free_space_matrix(EMPTY.control_points, EMPTY.array, EMPTY.wavenumber)
    assert relative_error(matrix, free) / 3 < error < 0.02


def test_exact_fields_have_no_error_and_ignored_obstacles_an_unknown_one():
    assert FreeSpacePropagator(EMPTY).transfer_matrix(return_error=True)[1] == 0
    assert FreeSpacePropagator(small_scene((RIGID,))).transfer_matrix(return_error=True)[1] == math.inf


def test_a_tolerance_chooses_a_spacing_that_meets_it():
    scene = small_scene((RIGID,))
    loose, tight = (make_propagator(scene, "full", None, tolerance=tolerance) for tolerance in (0.2, 0.06))
    assert tight.spacing < loose.spacing <= coarsest_spacing(region_of(scene))
    assert relative_error(tight.transfer_matrix(), exact(RIGID)) < 0.06


def test_a_spacing_is_chosen_also_where_nothing_scatters():
    scene = small_scene((Sphere(CENTER, RADIUS, density=AIR.density, sound_speed=AIR.sound_speed),))
    assert make_propagator(scene, "box", None, tolerance=0.1).spacing == coarsest_spacing(region_of(scene))


@pytest.mark.filterwarnings("ignore:no steady state")
def test_without_an_estimate_no_spacing_is_chosen():
    with pytest.raises(ValueError, match=r"^max_periods: 1; "):
        make_propagator(small_scene((RIGID,)), "box", None, tolerance=0.1, max_periods=1)


def test_spacings_and_errors_scale_with_the_order():
    one, h, region = torch.ones(2, 3, dtype=torch.complex128), 1e-3, region_of(EMPTY)
    fine, coarse = (one * (1 + 1e-3 * scale ** (4 / 3)) for scale in (1, RATIO))
    assert grid_error(fine, coarse, coarser=True) == pytest.approx(1e-3, rel=2e-3)
    assert grid_error(coarse, fine, coarser=False) == pytest.approx(1e-3 * RATIO ** (4 / 3), rel=3e-3)
    assert spacing_for(1e-3, 1e-3 * 2 ** (4 / 3), 2 * h) == pytest.approx(h)
    assert second_spacing(region, h) == RATIO * h
    assert second_spacing(region, 2e-3) == 2e-3 / RATIO
