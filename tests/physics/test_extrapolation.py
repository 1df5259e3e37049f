"""Transfer matrices and fields that are extrapolated in the spacing, next to a resonance of a slow ball."""

from functools import cache

import pytest
import torch
from small_scenes import relative_error

import autdtorch as at
from autdtorch import analytic
from autdtorch.propagators import make_propagator

CENTER, RADIUS, DENSITY, SPEED = (1.8e-3, -1.8e-3, -1.7e-3), 2.23e-3, 1.25, 0.277
TOLERANCE = 0.02


def slow_ball(absorption=0.0, speed=SPEED):
    """A ball whose resonance of a width of 0.4 % is 1 % beside the drive's frequency, on cells of 0.3 mm."""
    air = at.Medium(1.2, 343.0)
    material = {"density": DENSITY * air.density, "sound_speed": speed * air.sound_speed}
    ball = at.Sphere(CENTER, RADIUS, absorption=absorption, **material)
    array = at.TransducerArray([[-9e-3, -17e-3, 5e-3], [15e-3, 22e-3, 13e-3]], (1, 0, 0))
    return at.Scene(array, air, 40e3, [[-11e-3, -7e-3, -13e-3], [4e-3, 7e-3, -16e-3]], [ball])


@cache
def extrapolating():
    return make_propagator(slow_ball(), "box", None, TOLERANCE)


def exact(scene, speed=SPEED):
    where = scene.control_points, scene.array.positions, scene.wavenumber, CENTER, RADIUS
    return 4 * torch.pi * scene.array.source_strength * analytic.fluid_sphere(*where, DENSITY, speed)


def test_the_matrix_is_nearer_the_truth_than_any_grid():
    """Required: half the error of the finer grid, a claim within a factor of 3, and the tolerance."""
    propagator, truth = extrapolating(), exact(slow_ball())
    matrix, claim = propagator.transfer_matrix(return_error=True)
    true = relative_error(matrix, truth)
    on_grid = make_propagator(slow_ball(), "box", propagator.spacing, 1e-3).transfer_matrix()
    assert propagator.extrapolation is not None
    assert true < relative_error(on_grid, truth) / 2
    assert true / 3 < claim < min(3 * true, TOLERANCE)


def test_fields_and_changed_scenes_are_extrapolated_too():
    """A sum of rows, a run of the drive, and a scene that has not changed: equal to the steady states."""
    propagator, drive = extrapolating(), torch.tensor([1.0, 0.5j], dtype=torch.complex128)
    matrix, points = propagator.transfer_matrix(), slow_ball().control_points
    assert relative_error(propagator.field(drive, points), matrix @ drive) < TOLERANCE / 5
    changed = propagator.for_scene(slow_ball())
    assert relative_error(changed.transfer_matrix(), matrix) < 1e-6


@pytest.mark.parametrize("faster", [1.005, 1.02])
def test_a_changed_scene_is_extrapolated_by_its_resonance_alone(faster):
    """Required: claims within a factor of 3. By the resonance before the change, errors are 2 and 28 times as
    large as claims."""
    changed = slow_ball(speed=faster * SPEED)
    matrix, claim = extrapolating().for_scene(changed).transfer_matrix(return_error=True)
    true = relative_error(matrix, exact(changed, faster * SPEED))
    assert true / 3 < claim < 3 * true


def test_bodies_that_absorb_are_simulated_without():
    """Absorbed power is a square of pressures in the body, which cells of two sizes do not share."""
    absorbing = slow_ball(absorption=3000.0)
    assert make_propagator(absorbing, "box", None, 0.1).extrapolation is None
    assert extrapolating().for_scene(absorbing).extrapolation is None
