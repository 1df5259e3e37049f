"""`make_propagator` with scattering operators: against the box, series of spheres, and itself moved."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_scenes import AIR, assert_slopes, matrix_of_sphere, relative_error, small_scene

from autdtorch.propagators import SteadyStateWarning, TMatrixPropagator, make_propagator
from autdtorch.propagators.estimate import estimate
from autdtorch.propagators.plan import plan
from autdtorch.propagators.store import BODIES
from autdtorch.propagators.tmatrix.body_simulation import StillBody
from autdtorch.propagators.tmatrix.obstacle_groups import bodies_of
from autdtorch.scene.geometry import sphere_points
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


def by_tmatrix(scene: Scene, **settings: object) -> TMatrixPropagator:
    propagator = make_propagator(scene, "tmatrix", **{**COARSE, **settings})
    assert isinstance(propagator, TMatrixPropagator)
    return propagator


def test_it_is_the_box():
    scene = scene_of(SMALL)
    box = make_propagator(scene, "box", **COARSE)
    matrix = by_tmatrix(scene).transfer_matrix()
    # two digits of waves were asked for
    assert relative_error(matrix, box.transfer_matrix()) < 0.02
    drive = torch.polar(torch.ones(2, 4).double(), torch.arange(8).double().reshape(2, 4))
    plane = POINTS[0] + torch.cartesian_prod(*(1e-3 * torch.arange(n).double() for n in (1, 3, 4)))
    field = by_tmatrix(scene).field(drive, plane.reshape(3, 4, 3))
    assert field.shape == (2, 3, 4)
    assert relative_error(field, box.field(drive, plane.reshape(3, 4, 3))) < 0.02


@pytest.mark.filterwarnings("ignore::autdtorch.ScaleWarning")  # of a light fluid of a low sound speed
@pytest.mark.filterwarnings("ignore::autdtorch.OverlapWarning")
def test_the_shift_of_resonances_is_claimed():
    """Required: within a factor of 3. Both grids moved a narrow resonance away: they are off alike."""
    gas = {"density": 0.2384 * AIR.density, "sound_speed": 0.35145 * AIR.sound_speed}
    ball = Sphere((12e-3, 12e-3, 12e-3), 2.344e-3 * AIR.sound_speed / 343, **gas)
    within = Sphere(ball.center, ball.radius / 2, **gas)  # of two spheres no series is known
    propagator = by_tmatrix(scene_of(ball, within), spacing=0.377e-3, tolerance=1e-3)
    matrix, error = propagator.transfer_matrix(return_error=True)
    true = relative_error(matrix, matrix_of_sphere(scene_of(ball)))
    assert true > 0.3  # the resonance is there
    assert true / 3 < error < 3 * true


def test_auto_takes_what_is_known_of_few_spheres_and_t_matrices_where_they_are_fewer_runs():
    scene = scene_of(BALL)
    found, box = make_propagator(scene, cache=False), make_propagator(scene, "box", 0.6e-3, cache=False)
    assert found.method == "tmatrix"
    assert (estimate(scene).runs, estimate(scene).spacing) == (0, None)
    # of the box, as in test_shapes.py
    assert relative_error(box.transfer_matrix(), found.transfer_matrix()) < 0.01
    assert found.transfer_matrix(return_error=True)[1] <= 2e-3
    assert make_propagator(scene_of(SMALL), cache=False).method == "box"
    at_surface = scene_of(BALL, points=torch.tensor([[18.1e-3, 12e-3, 12e-3]]).double())
    assert make_propagator(at_surface, cache=False).method == "tmatrix"
    many = POINTS[0] + torch.cartesian_prod(*(1e-3 * torch.arange(n).double() for n in (2, 8, 8)))
    array = type(ARRAY).grid((12, 12), 2e-3, (0, 12e-3, 12e-3), (1, 0, 0), radius=0)
    scene = Scene(array, AIR, 40e3, many, [SMALL])
    assert make_propagator(scene, spacing=2e-3, tolerance=0.02, cache=False).method == "tmatrix"
    assert make_propagator(replace(scene, array=ARRAY), spacing=2e-3, tolerance=0.02).method == "box"
    grid = [replace(BALL, center=(x, y, 12e-3), radius=2e-3) for x in (9e-3, 15e-3) for y in (9e-3, 15e-3)]
    assert make_propagator(scene_of(*grid), cache=False).method == "box"
    large = replace(BALL, center=(0.0, 12e-3, -0.2), radius=0.15)
    assert plan(scene_of(large)).method != "tmatrix"


def test_points_and_transducers_near_a_body_are_served_by_the_box(caplog):
    caplog.set_level(logging.DEBUG)
    near = torch.tensor([[12e-3, 12e-3, 14.2e-3], [14.6e-3, 12e-3, 12e-3]]).double()
    scene = scene_of(SMALL, points=torch.cat((POINTS, near)))
    matrix = by_tmatrix(scene).transfer_matrix()
    assert "2 points are too near an obstacle" in caplog.text
    box = make_propagator(scene, "box", **COARSE).transfer_matrix()
    assert torch.equal(matrix[3:], make_propagator(scene, "box", **COARSE).transfer_matrix(near))
    assert relative_error(matrix, box) < 0.02
    array = type(ARRAY).grid((2, 2), 2.6e-3, (9e-3, 12e-3, 12e-3), (1, 0, 0), radius=0)  # 3.5 mm away
    scene = Scene(array, AIR, 40e3, POINTS, [SMALL])
    found = by_tmatrix(scene).transfer_matrix()
    assert torch.equal(found, make_propagator(scene, "box", **COARSE).transfer_matrix())


def test_waves_near_a_sphere_are_checked():
    """Degrees that suffice far from a sphere do not suffice at its surface."""
    places = torch.tensor([[18.05e-3, 12e-3, 12e-3], [30e-3, 12e-3, 12e-3]]).double()
    scene = scene_of(replace(BALL, radius=4e-3), points=places)
    rough = by_tmatrix(scene, spacing=0.5e-3, tolerance=0.01).transfer_matrix()
    exact = by_tmatrix(scene, tolerance=1e-7).transfer_matrix()
    errors = (rough - exact).norm(dim=1) / exact.norm(dim=1)
    assert float(errors[1]) < 0.01
    assert float(errors[0]) < 0.05  # of the box, a tenth of a cell from the surface


def moved(obstacles: tuple[Box, ...], angles: tuple[float, ...], offset: tuple[float, ...]) -> list[Box]:
    from autdtorch.scene.geometry import rotation_matrix

    pivot, shift = torch.tensor([12e-3] * 3).double(), torch.tensor(offset).double()
    return [shifted(turned(one, rotation_matrix(angles), pivot), shift) for one in obstacles]


def test_a_body_is_simulated_once_wherever_it_is(monkeypatch):
    pair = (SMALL, replace(SMALL, center=(15e-3, 13e-3, 12e-3), size=(2e-3, 2e-3, 2e-3)))
    simulate, simulated = StillBody.simulated, []
    monkeypatch.setattr(StillBody, "simulated", lambda still: simulated.append(still) or simulate(still))
    BODIES.forget()
    by_tmatrix(scene_of(*pair)).transfer_matrix()
    for angles, offset in (
        ((0, 0, 0), (1e-3, 0, 1e-3)),
        ((0.3, -0.5, 0.2), (5e-4, 1e-3, 0)),
        ((0, 0, 0.1), (0, 0, 0)),
    ):
        scene = scene_of(*moved(pair, angles, offset))
        found = by_tmatrix(scene).transfer_matrix()
        # of the tilted box at 2 mm: 1.5 to 4 % from one grid to another
        assert relative_error(found, make_propagator(scene, "box", **COARSE).transfer_matrix()) < 0.1
    assert len(simulated) == 1


def test_t_matrices_are_kept_on_disk(tmp_path):
    scene = scene_of(SMALL)
    BODIES.forget()
    first = by_tmatrix(scene, cache=tmp_path).transfer_matrix()
    (kept,) = tmp_path.glob("*.matrix")
    BODIES.forget()
    before = kept.stat().st_ino  # a file that is written again is another; one that is read gets a new time
    assert torch.equal(by_tmatrix(scene, cache=tmp_path).transfer_matrix(), first)
    assert torch.equal(
        by_tmatrix(scene_of(shifted(SMALL, torch.zeros(3).double())), cache=tmp_path).transfer_matrix(), first
    )
    assert [path.stat().st_ino for path in tmp_path.glob("*.matrix")] == [before]
    whole = kept.read_bytes()
    kept.write_bytes(whole[:-1])  # damaged: written again, from memory
    by_tmatrix(scene, cache=tmp_path).transfer_matrix()
    assert kept.read_bytes() == whole


def test_gradients_by_the_points_are_those_of_finite_differences():
    propagator, drive = by_tmatrix(scene_of(BALL)), torch.ones(4, dtype=torch.complex128)

    def loudness(offset: torch.Tensor) -> torch.Tensor:
        return propagator.field(drive, POINTS + offset).abs().sum()

    assert_slopes(loudness, torch.zeros(3, dtype=torch.float64), steps=[1e-6] * 3)


def test_obstacles_whose_spheres_overlap_or_touch_make_one_body():
    apart = replace(SMALL, center=(12e-3, 12e-3, 40e-3))
    near = replace(SMALL, center=(12e-3, 12e-3, 17e-3))
    groups = [body.numbers for body in bodies_of([SMALL, apart, near])]
    assert groups == [(0, 2), (1,)]
    assert len(by_tmatrix(scene_of(BALL, replace(BALL, center=(14e-3, 12e-3, 30e-3)))).bodies.bodies) == 2
    pair = [replace(BALL, center=(14e-3, y, 12e-3)) for y in (8e-3, 16e-3)]
    (body,) = bodies_of(pair)
    assert body.numbers == (0, 1)
    apart = replace(pair[1], center=(14e-3, 16e-3 + 1e-6, 12e-3))
    near = make_propagator(scene_of(pair[0], apart), tolerance=1e-4, cache=False)
    box = make_propagator(scene_of(*pair), "box", 0.7e-3, cache=False).transfer_matrix()
    assert near.method == "tmatrix"
    # of the box at two surfaces that touch
    assert relative_error(near.transfer_matrix(), box) < 0.02
    assert make_propagator(scene_of(*pair), cache=False).method == "box"


def test_the_error_is_that_of_the_grid_which_the_tolerance_chooses():
    scene = scene_of(SMALL)
    matrix, error = by_tmatrix(scene, spacing=1.4e-3).transfer_matrix(return_error=True)
    fine = make_propagator(scene, "box", 0.7e-3, cache=False).transfer_matrix()
    assert relative_error(matrix, fine) < error < 0.2
    chosen = by_tmatrix(scene, spacing=None, tolerance=0.01)
    assert 0.5e-3 < chosen.spacing < 1.5e-3  # 1.65 mm for 0.05 and more
    matrix, error = chosen.transfer_matrix(return_error=True)
    assert relative_error(matrix, fine) < error <= 0.01


def test_obstacles_that_cannot_be_turned_are_simulated_where_they_are():
    mask = VoxelMask(np.ones((3, 3, 3), bool), 1e-3, (11e-3, 11e-3, 11e-3), rigid=True)
    same = Box((12.5e-3, 12.5e-3, 12.5e-3), (3e-3,) * 3, rigid=True)
    found, wanted = (by_tmatrix(scene_of(each), spacing=1.4e-3).transfer_matrix() for each in (mask, same))
    assert relative_error(found, wanted) < 0.1  # corners of voxels


def test_a_scene_without_obstacles_has_no_t_matrix_and_one_of_air_scatters_nothing():
    with pytest.raises(ValueError, match="method: 'tmatrix'; needs a scene with obstacles"):
        make_propagator(small_scene(()), "tmatrix")
    air = replace(SMALL, rigid=False, density=AIR.density, sound_speed=AIR.sound_speed)
    found = by_tmatrix(scene_of(air))
    assert not found.bodies.bodies[0].matrix.any()
    assert found.bodies.bodies[0].reciprocity == 0
    free = make_propagator(scene_of(), cache=False).transfer_matrix()
    assert torch.allclose(found.transfer_matrix(), free)


def test_points_just_outside_a_turned_body_are_served():
    """The sphere around obstacles turns with them, and their T-matrix has the same one."""
    pair = (SMALL, replace(SMALL, center=(14.5e-3, 14e-3, 12e-3), size=(3e-3, 2e-3, 2e-3)))
    for angle in (0.3, 0.8, 1.4):
        scene = scene_of(*pair).moved(rotation=(0, 0.2, angle))
        (body,) = bodies_of(scene.obstacles)
        points = sphere_points(body.center, body.radius + 1e-6, 20)
        propagator = by_tmatrix(replace(scene, control_points=points))
        assert propagator.serves(points).all()
        own = propagator.bodies.bodies[0]
        assert torch.allclose(own.center, body.center, atol=1e-8)
        assert own.radius == pytest.approx(body.radius, abs=1e-8)
        assert torch.isfinite(propagator.transfer_matrix().abs()).all()


def test_a_picture_through_a_sphere_is_one_run():
    propagator = make_propagator(scene_of(BALL), "tmatrix", 1.4e-3, cache=False)
    plane = torch.tensor([14e-3, 0, 0]).double() + torch.cartesian_prod(
        torch.zeros(1).double(), *(0.5e-3 * torch.arange(48).double() for _ in range(2))
    )
    drive = torch.ones(4, dtype=torch.complex128)
    field = propagator.field(drive, plane)  # in several parts
    assert len(propagator.runs) == 1
    box = make_propagator(scene_of(BALL), "box", 1.4e-3, cache=False).field(drive, plane)
    served = propagator.serves(plane)
    # the box differs by its own error at 1.4 mm: 2 % in some runs of test_shapes.py
    assert relative_error(field[served], box[served]) < 0.05
    # a box converges where it is read
    assert relative_error(field[~served], box[~served]) < 0.02


def test_errors_of_points_within_a_body_are_those_of_the_box():
    inside = torch.cat((POINTS, torch.tensor([[14e-3, 12e-3, 12.5e-3]]).double()))
    scene = scene_of(BALL)
    propagator = make_propagator(scene, "tmatrix", 1e-3, cache=False)
    matrix, error = propagator.transfer_matrix(inside, return_error=True)
    errors = propagator.point_errors(inside)
    assert (errors[:3] < 2e-3).all()  # of the waves left out
    box = make_propagator(scene, "box", 1e-3, cache=False)
    assert float(errors[3]) == pytest.approx(float(box.point_errors(inside[3:])), rel=0.1)
    whole = (errors * matrix.norm(dim=1)).norm() / matrix.norm()
    assert error == pytest.approx(float(whole))
    assert make_propagator(scene, "tmatrix", None, 0.02, cache=False).transfer_matrix(inside).isfinite().all()


def test_runs_that_do_not_settle_are_warned_of_each_time(tmp_path):
    scene = scene_of(SMALL)
    for _ in range(2):
        with pytest.warns(SteadyStateWarning, match="waves of a body after 3 periods"):
            by_tmatrix(scene, max_periods=3, cache=tmp_path, tolerance=1e-3).transfer_matrix()
    assert not list(tmp_path.glob("*.matrix"))
