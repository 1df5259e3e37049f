"""Named changes of a scene: against scenes changed by hand, and derivatives against independent ones."""

import math
from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
import torch
from small_scenes import AIR, relative_error, small_scene

from autdtorch.propagators import TMatrixPropagator, box, make_propagator
from autdtorch.propagators.scene_changes import SceneChanges
from autdtorch.propagators.tmatrix.body_simulation import StillBody
from autdtorch.propagators.tmatrix.tmatrix import TMatrixCluster
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.changes import KINDS
from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.medium import Medium
from autdtorch.scene.obstacles import Box, Cylinder, Sphere, VoxelMask
from autdtorch.scene.reflectors import Reflector
from autdtorch.scene.scene import OverlapWarning, Scene

BALL = Sphere((14e-3, 12e-3, 12e-3), 3e-3, rigid=True)
TILTED = Box((12e-3, 12e-3, 12e-3), (4e-3, 5e-3, 3e-3), rotation=(0.1, 0.2, 0.3), rigid=True)
COARSE = {"spacing": 2e-3, "tolerance": 0.02, "cache": False}
DISCS = small_scene(radius=3e-3)
ROUNDING = 1e-9  # positions are rounded to 1e-14 m, which is 1e-11 of a wavelength


def changes_of(scene: Scene, *names: str, method: str = "auto", points=None, **settings) -> SceneChanges:
    return SceneChanges(make_propagator(scene, method, **{**COARSE, **settings}), names, points)


def with_ball(*more: object, **changed: object) -> Scene:
    return replace(DISCS, obstacles=(BALL, *more), **changed)


@pytest.mark.parametrize("method", ["tmatrix", "box"])
def test_a_scene_that_moves_as_a_whole_stays_what_it_is(method):
    names = [f"{part}.{axis}" for part in ("array", "obstacles", "points") for axis in "xyz"]
    changes = changes_of(with_ball(), *names, method=method)
    shift = 3 * [1.3e-3, -2.1e-3, 0.7e-3]
    rounding = ROUNDING if method == "tmatrix" else 1e-6  # fields are of single precision
    assert relative_error(changes.matrix(shift), changes.matrix([0.0] * 9)) < rounding


def test_a_matrix_is_the_changed_scenes():
    scene = replace(with_ball(), reflectors=(Reflector((0, 0, -6e-3), (0, 0, 1)),))
    names = "obstacles[0].y", "array.turn_x", "points[1].z", "reflectors[0].distance", "temperature", "radius"
    amounts = 0.5e-3, 0.1, -0.4e-3, 1e-3, 4.0, 0.3e-3
    center = scene.array.positions.mean(dim=0)
    turn = rotation_matrix((0.1, 0, 0))
    array = TransducerArray(
        center + (scene.array.positions - center) @ turn.mT, scene.array.normals @ turn.mT, radius=3.3e-3
    )
    points = scene.control_points + 0.4e-3 * torch.tensor([[0, 0, 0], [0, 0, -1], [0, 0, 0]]).double()
    warmer = 1 + 4.0 / (AIR.sound_speed**2 * 28.9647e-3 / (1.4 * 8.314462618))
    expected = replace(
        scene,
        array=array,
        control_points=points,
        medium=Medium(AIR.density / warmer, AIR.sound_speed * math.sqrt(warmer)),
        obstacles=(replace(BALL, center=(14e-3, 12.5e-3, 12e-3)),),
        reflectors=(Reflector((0, 0, -5e-3), (0, 0, 1)),),
    )
    changes = changes_of(scene, *names)
    for changed, each in ((amounts, expected), ([0.0] * 6, scene)):
        matrix = make_propagator(each, **COARSE).transfer_matrix()
        assert relative_error(changes.matrix(changed), matrix) < ROUNDING
    assert changes.units == ("m", "rad", "m", "m", "K", "m")


def test_obstacles_turn_as_one_body_after_each_on_its_own():
    scene = with_ball(replace(TILTED, center=(9e-3, 5e-3, 12e-3)))
    changes = changes_of(scene, "obstacles.turn_z", "obstacles[1].turn_x", "obstacles.x")
    first, second = changes.scene([0.2, 0.1, 1e-3]).obstacles
    turned = replace(scene, obstacles=(BALL, *scene.moved(rotation=(0, 0, 0)).obstacles[1:]))
    by_hand = replace(
        turned,
        obstacles=(
            BALL,
            *replace(scene, obstacles=scene.obstacles[1:]).moved(rotation=(0.1, 0, 0)).obstacles,
        ),
    )
    assert (first, second) == by_hand.moved((1e-3, 0, 0), (0, 0, 0.2)).obstacles


def test_derivatives_of_places_are_those_of_automatic_differentiation():
    scene = with_ball(replace(BALL, center=(12e-3, 2e-3, 5e-3), radius=1.5e-3))
    propagator = make_propagator(scene, **COARSE)
    assert isinstance(propagator, TMatrixPropagator)
    places = scene.control_points.clone().requires_grad_()
    shifts = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    bodies = [body.moved(shift) for body, shift in zip(propagator.bodies.bodies, shifts, strict=True)]
    entry = TMatrixCluster(bodies).transfer_matrix(scene.array, places)[1, 2]
    parts = [
        torch.autograd.grad(part, (shifts, places), retain_graph=True) for part in (entry.real, entry.imag)
    ]
    expected = torch.complex(*(torch.cat([of_shifts, of_places[1:2]]) for of_shifts, of_places in parts))
    names = [f"{part}.{axis}" for part in ("obstacles[0]", "obstacles[1]", "points[1]") for axis in "xyz"]
    slope = SceneChanges(propagator, names).derivatives([0.0] * 9)
    # half a step of 6e-7 rad, and rounding
    assert relative_error(slope[:, 1, 2], expected.reshape(-1)) < 1e-6
    assert not slope[6:, 0].any()


def test_grids_turn_with_obstacles_that_turn_as_one_body():
    scene = with_ball(Cylinder((12e-3, 5e-3, 12e-3), 2e-3, 6e-3, axis=(1, 2, 1), rigid=True))
    points = torch.tensor([[20e-3, 10e-3, 9e-3], [22e-3, 14e-3, 12e-3]]).double()
    names = "obstacles.turn_x", "obstacles.z", "obstacles[0].y", "points.x", "temperature"
    for some in (None, points):
        changes = changes_of(scene, *names, method="box", points=some, spacing=1e-3)
        matrix = changes.matrix(amounts := [0.3, 0.5e-3, 0.2e-3, 0.3e-3, 2.0])
        propagator = make_propagator(changes.scene(amounts), "box", **COARSE | {"spacing": 1e-3})
        afresh = propagator.transfer_matrix(changes.points(amounts))
        assert relative_error(changes.matrix([0.0, *amounts[1:]]), afresh) > 0.1
        assert relative_error(matrix, afresh) < 0.01  # cells along other axes
    with mock.patch.object(box, "assemble_on", wraps=box.assemble_on) as assembled:
        for turn in (0.1, 0.2):
            changes_of(scene, names[0], method="box", spacing=0.9e-3).matrix([turn])
    assert assembled.call_count == 1


SIMULATED = replace(DISCS, obstacles=(TILTED,))


def test_obstacles_at_the_edge_of_the_domain_turn():
    cube = Box((14e-3, 12e-3, 20e-3), (4e-3, 6e-3, 8e-3), rigid=True)
    tight, wide = (
        replace(DISCS, obstacles=(cube,), domain=((-beyond, -beyond, -beyond), (24e-3 + beyond,) * 3))
        for beyond in (0.0, 9e-3)
    )
    one, other = (changes_of(each, "obstacles.turn_x", method="box").matrix([0.6]) for each in (tight, wide))
    assert torch.equal(one, other)  # boxes hold obstacles as they are, whatever the domain
    plain = (make_propagator(each, "box", **COARSE).transfer_matrix() for each in (tight, wide))
    assert torch.equal(*plain)


def test_derivatives_on_grids_are_those_of_t_matrices():
    names, levers = ["obstacles.x", "obstacles[0].turn_z"], [1.0, 3.5e-3]
    changes = [changes_of(SIMULATED, *names, method=method) for method in ("box", "tmatrix")]
    size = changes[1].matrix([0.0, 0.0]).norm()
    by_box, by_waves = (each.derivatives([0.0, 0.0]) for each in changes)
    for one, other, lever in zip(by_box, by_waves, levers, strict=True):
        # two digits of the matrix were asked for, which a radian of phase may use up
        assert (one - other).norm() < 0.02 * size * SIMULATED.wavenumber * lever


def test_simulated_bodies_move_and_warm_without_further_simulations():
    changes = changes_of(SIMULATED, "obstacles.x", "obstacles[0].turn_y", "temperature", method="tmatrix")
    changes.matrix([0.0, 0.0, 1.0])  # the temperatures around
    amounts = [-0.5e-3, 0.2, 2.5]
    with mock.patch.object(StillBody, "simulated", side_effect=AssertionError):
        matrix = changes.matrix(amounts)
        changes.derivatives(amounts)
    exact = make_propagator(changes.scene(amounts), "tmatrix", **COARSE).transfer_matrix()
    # of T between simulations 12 K apart: the phase across the body, 0.02 rad in 2.5 K, cubed, and runs
    assert relative_error(matrix, exact) < 1e-3
    assert relative_error(changes.matrix([0.0, 0.0, 0.0]), exact) > 0.05  # there is something to follow


@pytest.mark.parametrize("name", ["array.turn_y", "temperature", "radius", "reflectors[0].distance"])
def test_a_matrix_grows_by_its_derivative(name):
    scene = replace(DISCS, reflectors=(Reflector((0, 0, -6e-3), (0, 0, 1), reflection=0.8),))
    changes, step = changes_of(scene, name), {"temperature": 0.5}.get(name, 1e-4)
    ends = changes.matrix([3 * step]), changes.matrix([step])
    slope = changes.derivatives([2 * step])[0]
    # central differences of a large step: (k step)^2 / 6 with a phase of 0.1 rad
    assert relative_error((ends[0] - ends[1]) / (2 * step), slope) < 5e-3


def test_explicit_points_move_and_control_points_stay():
    points = DISCS.control_points[:2] + 1e-3
    changes = changes_of(DISCS, "points.x", "points[1].y", points=points)
    moved = points + 1e-3 * torch.tensor([[1, 0, 0], [1, 2, 0]]).double()
    torch.testing.assert_close(changes.points([1e-3, 2e-3]), moved)
    expected = make_propagator(DISCS).transfer_matrix(moved)
    assert relative_error(changes.matrix([1e-3, 2e-3]), expected) < ROUNDING
    assert torch.equal(changes.scene([1e-3, 2e-3]).control_points, DISCS.control_points)
    assert changes.derivatives([0.0, 0.0]).shape == (2, 2, 4)


def test_a_panel_moves_with_its_array():
    scene = replace(DISCS, reflectors=(Reflector.behind(DISCS.array),))
    changes = changes_of(scene, "array.x", "array.turn_y", "points.x")
    panel = changes.scene([1e-3, 0.1, 0]).reflectors[0]
    assert panel.point == pytest.approx((2.2e-3, 12e-3, 12e-3))
    assert panel.normal == pytest.approx((math.cos(0.1), 0, -math.sin(0.1)))
    assert relative_error(changes.matrix([1e-3, 0, 1e-3]), changes.matrix([0, 0, 0])) < ROUNDING


def test_the_domain_grows_with_what_leaves_it():
    assert changes_of(DISCS, "array.x").scene([-2e-3]).domain[0] == pytest.approx((-0.8e-3, 0, 0))
    wall = replace(DISCS, obstacles=(Box((12e-3, 12e-3, 0), (2e-3, 24e-3, 8e-3), rigid=True),))
    with pytest.raises(ValueError, match=r"scene changed by array.x -0.002 m: Scene.array.*domain"):
        changes_of(wall, "array.x").scene([-2e-3])


def test_air_warms_as_an_ideal_gas():
    warmed, air = Medium.air(15.0, 0.0).warmed(5.0), Medium.air(20.0, 0.0)
    assert (warmed.density, warmed.sound_speed) == pytest.approx((air.density, air.sound_speed), rel=1e-12)
    with pytest.raises(ValueError, match=r"kelvin: 31.0 K; must be in -40 to 30"):
        Medium.air(20.0, 0.0).warmed(31.0)
    with pytest.raises(ValueError, match="must be air"):
        Medium(998.0, 1482.0).warmed(1.0)


CUT = Box((12e-3, 12e-3, 12e-3), (2e-3, 2e-3, 2e-3), density=AIR.density, sound_speed=AIR.sound_speed)


def test_obstacles_of_air_stay_air():
    with pytest.warns(OverlapWarning):
        scene = with_ball(replace(CUT, center=BALL.center))
    changed = changes_of(scene, "temperature").scene([5.0])
    assert changed.obstacles[1].sound_speed == changed.medium.sound_speed > AIR.sound_speed


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ("obstacle.x", r"names: 'obstacle.x'; must be a change \(did you mean 'obstacles.x'\?\)"),
        (["obstacles[0].distance"], r"must be a change"),
        ([3], r"names: 3; must be a change"),
        ("obstacles[2].x", r"the index must be in 0 to 1"),
        ("points[3].x", r"the index must be in 0 to 2"),
        ("reflectors[1].distance", r"the index must be in 0 to 0"),
        ("reflectors[0].distance", r"the array stands in this plane"),
        ("obstacles[0].turn_x", r"a sphere that turns about its centre stays what it is"),
        ("obstacles[1].turn_x", r"a VoxelMask cannot be turned"),
        ("obstacles.turn_x", r"a VoxelMask cannot be turned"),
        ("radius", r"a point has no radius"),
        ("temperature", r"needs a medium of air"),
        (["array.x", "array.x"], r"must be there once each"),
    ],
)
def test_a_change_that_makes_no_sense_is_refused(names, message):
    voxels = VoxelMask(np.ones((2, 2, 2), bool), 1e-3, origin=(12e-3, 4e-3, 4e-3), rigid=True)
    scene = replace(
        small_scene((BALL, voxels)), medium=Medium(998.0, 1482.0), reflectors=(Reflector.behind(DISCS.array),)
    )
    with pytest.raises(ValueError, match=message):
        SceneChanges(make_propagator(scene, "box", cache=False), names)


def test_amounts_that_make_no_scene_are_refused():
    changes = changes_of(with_ball(), "obstacles.x", "obstacles.y")
    message = r"scene changed by obstacles.x 0.006 m, obstacles.y 0.005 m: Scene.control_points.*obstacle 0"
    with pytest.raises(ValueError, match=message):
        changes.matrix([6e-3, 5e-3])
    with pytest.raises(ValueError, match=r"amounts: shape \(1,\); must be \(2,\), as names"):
        changes.matrix([0.0])
    with pytest.raises(ValueError, match=r"propagator: 'Scene'; must be one that make_propagator makes"):
        SceneChanges(DISCS, ["array.x"])


def test_every_kind_has_a_unit_and_a_meaning():
    assert {kind.unit for kind in KINDS.values()} == {"m", "rad", "K"}
    assert all(kind.meaning for kind in KINDS.values())
