"""`make_propagator` with scattering operators: against the box, series of spheres, and itself moved."""

import logging
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_scenes import AIR, relative_error, small_scene

from autdtorch.propagators import OperatorPropagator, make_propagator
from autdtorch.propagators.body_matrix import _simulated
from autdtorch.propagators.estimate import estimate
from autdtorch.propagators.scene_bodies import bodies_of
from autdtorch.scene.obstacles import Box, Sphere, VoxelMask
from autdtorch.scene.obstacles.moving import shifted, turned
from autdtorch.scene.scene import Scene

ARRAY = small_scene(()).array
POINTS = torch.tensor([[24e-3, 12e-3, 12e-3], [22e-3, 6e-3, 17e-3], [20e-3, 18e-3, 4e-3]]).double()
SMALL = Box((12e-3, 12e-3, 12e-3), (4e-3, 5e-3, 3e-3), rigid=True)
BALL = Sphere((14e-3, 12e-3, 12e-3), 4e-3, density=3.0, sound_speed=500.0)
COARSE = {"spacing": 2e-3, "tolerance": 0.02, "cache": False}


def scene_of(*obstacles: object, points: torch.Tensor = POINTS) -> Scene:
    return Scene(ARRAY, AIR, 40e3, points, obstacles)


def operator(scene: Scene, **settings: object) -> OperatorPropagator:
    propagator = make_propagator(scene, "operator", **{**COARSE, **settings})
    assert isinstance(propagator, OperatorPropagator)
    return propagator


def test_it_is_the_box():
    scene = scene_of(SMALL)
    box = make_propagator(scene, "box", **COARSE)
    matrix = operator(scene).transfer_matrix()
    # two digits of waves were asked for
    assert relative_error(matrix, box.transfer_matrix()) < 0.02
    drive = torch.polar(torch.ones(2, 4).double(), torch.arange(8).double().reshape(2, 4))
    plane = POINTS[0] + torch.cartesian_prod(*(1e-3 * torch.arange(n).double() for n in (1, 3, 4)))
    field = operator(scene).field(drive, plane.reshape(3, 4, 3))
    assert field.shape == (2, 3, 4)
    assert relative_error(field, box.field(drive, plane.reshape(3, 4, 3))) < 0.02


def test_auto_takes_what_is_known_of_a_sphere():
    scene = scene_of(BALL)
    found, box = make_propagator(scene, cache=False), make_propagator(scene, "box", 0.6e-3, cache=False)
    assert found.method == "operator"
    assert (estimate(scene).runs, estimate(scene).spacing) == (0, None)
    # of the box, as in test_sphere.py
    assert relative_error(box.transfer_matrix(), found.transfer_matrix()) < 0.01
    assert found.transfer_matrix(return_error=True)[1] <= 2e-3
    assert make_propagator(scene_of(SMALL), cache=False).method == "box"
    at_surface = scene_of(BALL, points=torch.tensor([[18.1e-3, 12e-3, 12e-3]]).double())
    assert make_propagator(at_surface, cache=False).method == "operator"


def test_auto_takes_operators_where_they_are_fewer_runs():
    many = POINTS[0] + torch.cartesian_prod(*(1e-3 * torch.arange(n).double() for n in (2, 8, 8)))
    array = type(ARRAY).grid((12, 12), 2e-3, (0, 12e-3, 12e-3), (1, 0, 0), radius=0)
    scene = Scene(array, AIR, 40e3, many, [SMALL])
    assert make_propagator(scene, spacing=2e-3, tolerance=0.02, cache=False).method == "operator"
    assert make_propagator(replace(scene, array=ARRAY), spacing=2e-3, tolerance=0.02).method == "box"


def test_points_near_a_body_are_served_by_the_box(caplog):
    caplog.set_level(logging.INFO)
    near = torch.tensor([[12e-3, 12e-3, 14.2e-3], [14.6e-3, 12e-3, 12e-3]]).double()
    scene = scene_of(SMALL, points=torch.cat((POINTS, near)))
    matrix = operator(scene).transfer_matrix()
    assert "2 points are too near an obstacle" in caplog.text
    box = make_propagator(scene, "box", **COARSE).transfer_matrix()
    assert torch.equal(matrix[3:], make_propagator(scene, "box", **COARSE).transfer_matrix(near))
    assert relative_error(matrix, box) < 0.02


def test_transducers_within_a_sphere_are_served_by_the_box():
    array = type(ARRAY).grid((2, 2), 2.6e-3, (9e-3, 12e-3, 12e-3), (1, 0, 0), radius=0)  # 3.5 mm away
    scene = Scene(array, AIR, 40e3, POINTS, [SMALL])
    found = operator(scene).transfer_matrix()
    assert torch.equal(found, make_propagator(scene, "box", **COARSE).transfer_matrix())


def test_waves_near_a_sphere_are_checked():
    """Degrees that suffice far from a sphere do not suffice at its surface."""
    places = torch.tensor([[18.05e-3, 12e-3, 12e-3], [30e-3, 12e-3, 12e-3]]).double()
    scene = scene_of(replace(BALL, radius=4e-3), points=places)
    rough = operator(scene, spacing=0.5e-3, tolerance=0.01).transfer_matrix()
    exact = operator(scene, tolerance=1e-7).transfer_matrix()
    errors = (rough - exact).norm(dim=1) / exact.norm(dim=1)
    assert float(errors[1]) < 0.01
    assert float(errors[0]) < 0.05  # of the box, a tenth of a cell from the surface


def moved(obstacles: tuple[Box, ...], angles: tuple[float, ...], offset: tuple[float, ...]) -> list[Box]:
    from autdtorch.scene.geometry import rotation_matrix

    pivot, shift = torch.tensor([12e-3] * 3).double(), torch.tensor(offset).double()
    return [shifted(turned(one, rotation_matrix(angles), pivot), shift) for one in obstacles]


def test_a_body_is_simulated_once_wherever_it_is():
    pair = (SMALL, replace(SMALL, center=(15e-3, 13e-3, 12e-3), size=(2e-3, 2e-3, 2e-3)))
    _simulated.cache_clear()
    operator(scene_of(*pair)).transfer_matrix()
    for angles, offset in (
        ((0, 0, 0), (1e-3, 0, 1e-3)),
        ((0.3, -0.5, 0.2), (5e-4, 1e-3, 0)),
        ((0, 0, 0.1), (0, 0, 0)),
    ):
        scene = scene_of(*moved(pair, angles, offset))
        found = operator(scene).transfer_matrix()
        # of the tilted box at 2 mm: 1.5 to 4 % from one grid to another
        assert relative_error(found, make_propagator(scene, "box", **COARSE).transfer_matrix()) < 0.1
    assert _simulated.cache_info().misses == 1


def test_operators_are_kept_on_disk(tmp_path):
    scene = scene_of(SMALL)
    _simulated.cache_clear()
    first = operator(scene, cache=tmp_path).transfer_matrix()
    (kept,) = tmp_path.glob("*.matrix")
    _simulated.cache_clear()
    before = kept.stat().st_mtime_ns
    assert torch.equal(operator(scene, cache=tmp_path).transfer_matrix(), first)
    assert torch.equal(
        operator(scene_of(shifted(SMALL, torch.zeros(3).double())), cache=tmp_path).transfer_matrix(), first
    )
    assert [path.stat().st_mtime_ns for path in tmp_path.glob("*.matrix")] == [before]


def test_gradients_by_the_points_are_those_of_finite_differences():
    propagator, drive = operator(scene_of(BALL)), torch.ones(4, dtype=torch.complex128)

    def loudness(points: torch.Tensor) -> torch.Tensor:
        return propagator.field(drive, points).abs().sum()

    points = POINTS.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(loudness(points), points)
    for axis in range(3):
        aside = 1e-6 * torch.eye(3, dtype=torch.float64)[axis]
        slope = (loudness(POINTS + aside) - loudness(POINTS - aside)) / 2e-6
        # the differences err by the square of the step
        assert float(gradient.sum(dim=0)[axis]) == pytest.approx(
            float(slope), rel=1e-4, abs=1e-4 * float(gradient.norm())
        )


def test_obstacles_whose_spheres_overlap_make_one_body():
    apart = replace(SMALL, center=(12e-3, 12e-3, 40e-3))
    near = replace(SMALL, center=(12e-3, 12e-3, 17e-3))
    groups = [body.obstacles for body in bodies_of([SMALL, apart, near])]
    assert groups == [(0, 2), (1,)]
    assert len(operator(scene_of(BALL, replace(BALL, center=(14e-3, 12e-3, 30e-3)))).bodies.operators) == 2


def test_the_error_is_that_of_the_grid():
    scene = scene_of(SMALL)
    matrix, error = operator(scene, spacing=1.4e-3).transfer_matrix(return_error=True)
    fine = make_propagator(scene, "box", 0.7e-3, cache=False).transfer_matrix()
    assert relative_error(matrix, fine) < error < 0.2


def test_a_spacing_is_chosen_by_the_tolerance():
    found = operator(scene_of(SMALL), spacing=None, tolerance=0.05)
    assert 0.5e-3 < found.spacing < 3e-3
    assert math.isfinite(float(found.transfer_matrix().abs().sum()))


def test_obstacles_that_cannot_be_turned_are_simulated_where_they_are():
    mask = VoxelMask(np.ones((3, 3, 3), bool), 1e-3, (11e-3, 11e-3, 11e-3), rigid=True)
    same = Box((12.5e-3, 12.5e-3, 12.5e-3), (3e-3,) * 3, rigid=True)
    found, wanted = (operator(scene_of(each), spacing=1.4e-3).transfer_matrix() for each in (mask, same))
    assert relative_error(found, wanted) < 0.1  # corners of voxels


def test_a_scene_without_obstacles_has_no_operator():
    with pytest.raises(ValueError, match="method: 'operator'; needs a scene with obstacles"):
        make_propagator(small_scene(()), "operator")
