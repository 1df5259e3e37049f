"""Live views: bodies that are moved, planes, what is undone; calculations, and what ends them."""

import math
import queue
import time

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from small_scenes import AIR, CUBE, small_scene

import autdtorch as at
from autdtorch.plot.explore import calculation
from autdtorch.plot.explore import situation as situation_module
from autdtorch.plot.explore.calculation import Calculator, Finished, Request, Result
from autdtorch.plot.explore.display import _force_text, _summary, offered
from autdtorch.plot.explore.rendering import followed
from autdtorch.plot.explore.situation import SCENE_PLANE, History, MovedObstacle, Situation, in_phase

PLACE = st.tuples(*[st.floats(-0.1, 0.1)] * 3)
ANGLES = st.tuples(*[st.floats(-math.pi, math.pi)] * 3)
BRICK = at.Box((10e-3, 20e-3, 5e-3), (3e-3, 4e-3, 5e-3), (0.3, -0.2, 0.5), rigid=True)
PEG = at.Cylinder((10e-3, 20e-3, 5e-3), 2e-3, 7e-3, (1, 2, 3), rigid=True)
WEDGE = at.Mesh.from_surface(
    ([[0, 0, 0], [5e-3, 0, 0], [0, 6e-3, 0], [0, 0, 7e-3]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
    offset=(10e-3, 0, 0), rotation=(0.1, 0.2, 0.3), rigid=True,
)  # fmt: skip
DRIVE = torch.ones(4, dtype=torch.complex128)


def oblique_scene():
    plane = at.Plane((20e-3, 12e-3, 12e-3), (1, 1, 0), (4e-3, 4e-3))
    scene = small_scene()
    return at.Scene(scene.array, AIR, scene.frequency, scene.control_points, (), plane, scene.domain)


@given(st.sampled_from([BRICK, PEG, WEDGE]), PLACE, ANGLES)
def test_the_pose_of_a_picture_is_that_of_the_obstacle(obstacle, center, angles):
    body = MovedObstacle(obstacle, center, angles)
    turn, pivot, offset = body.pose
    moved = (obstacle.surface()[0] - pivot) @ turn.mT + pivot + offset
    # A cylinder's polygon may begin elsewhere on its rim; its axis has ten decimals
    surface, tolerance = (body.obstacle.surface()[0], 1e-9)
    if obstacle is PEG:
        surface, moved = (torch.stack([part.amin(dim=0), part.amax(dim=0)]) for part in (surface, moved))
        tolerance = 1e-5
    torch.testing.assert_close(surface, moved, rtol=0, atol=tolerance)


def test_bodies_stand_for_their_obstacles():
    ball = at.Sphere((0, 0, 0), 1e-3, rigid=True)
    for obstacle in (BRICK, PEG, WEDGE, ball):
        assert MovedObstacle.of(obstacle).obstacle is obstacle
    turned = MovedObstacle(BRICK, BRICK.center, (0.0, 0.0, 0.7)).obstacle
    assert turned.rotation == pytest.approx((0, 0, 0.7), abs=1e-9)
    body = MovedObstacle(ball, (1e-3, 0, 0), (1.0, 0, 0))
    assert body.obstacle.center == (1e-3, 0, 0)
    assert not body.turns


def test_the_weight_of_a_body_is_that_of_its_volume_where_its_density_is_known():
    fluid = {"density": 100.0, "sound_speed": 340.0}
    box = at.Box((0, 0, 0), (3e-3, 4e-3, 5e-3), (0.3, -0.2, 0.5), **fluid)
    ball = at.Sphere((0, 0, 0), 2e-3, **fluid)
    assert MovedObstacle.of(box).weight == pytest.approx(100 * 60e-9 * 9.81)
    assert MovedObstacle.of(ball).weight == pytest.approx(100 * 4 / 3 * math.pi * 8e-9 * 9.81)
    assert MovedObstacle.of(BRICK).weight is None  # rigid
    assert _force_text(np.array([3e-3, 0, -4e-3]), 5.89e-5) == (
        "Force of the sound 5.00 mN: (3.00, 0.00, -4.00) mN. Weight 58.9 µN."
    )


def test_a_plane_without_observation_plane_passes_through_the_foci():
    scene = small_scene()
    situation = Situation.of(scene, DRIVE)
    normal, center = (
        torch.tensor(part, dtype=torch.float64) for part in (situation.sheet.normal, situation.sheet.center)
    )
    assert float((scene.control_points.mean(dim=0) - center) @ normal) == pytest.approx(0, abs=1e-9)
    assert SCENE_PLANE not in situation.planes


@pytest.mark.parametrize("plane", ["x", "y", "z"])
@pytest.mark.parametrize("height", [-1.0, 10e-3, 1.0])
def test_planes_stay_in_the_domain(plane, height):
    situation = Situation.of(small_scene(), DRIVE).with_plane(plane, height)
    lower, upper = (torch.tensor(corner, dtype=torch.float64) for corner in situation.scene.domain)
    corners = situation.sheet.corners
    assert (corners > lower - 1e-9).all()
    assert (corners < upper + 1e-9).all()


def test_an_oblique_observation_plane_moves_along_its_normal():
    situation = Situation.of(oblique_scene(), DRIVE)
    assert situation.plane == SCENE_PLANE
    moved = situation.with_plane(SCENE_PLANE, 2e-3)
    steps = torch.tensor(moved.sheet.center) - torch.tensor(situation.sheet.center)
    assert steps.tolist() == pytest.approx([2e-3 / math.sqrt(2), 2e-3 / math.sqrt(2), 0], abs=1e-9)
    assert moved.with_plane("x").with_plane(SCENE_PLANE).sheet == situation.sheet
    with pytest.raises(ValueError, match="plane: 'w'"):
        moved.with_plane("w")


def test_a_drag_is_undone_and_repeated_in_one_step():
    first = Situation.of(small_scene(), DRIVE)
    history = History(first)
    for height in (1e-3, 2e-3, 3e-3):
        history.change(first.with_plane("z", height))
    history.settle()
    last = history.now
    history.settle()  # nothing was changed since
    history.undo()
    assert history.now is first
    assert not history.can_undo
    history.redo()
    assert history.now is last
    assert not history.can_redo
    history.change(first.with_plane("z"))
    history.undo()  # also of a step that has not ended
    assert history.now is last
    history.change(first.with_plane("y"))
    history.settle()
    assert not history.can_redo  # a change forgets the undone step


def test_what_changes_nothing_is_no_step():
    scene = at.load_scene("configs/scene/two_cubes.yaml")
    situation = Situation.of(scene, torch.ones(16, dtype=torch.complex128))
    body = situation.bodies[0]
    history = History(situation)
    history.change(situation.with_body(0, body.center, body.angles))
    history.change(situation.with_points(scene.control_points.clone()))
    history.change(situation.with_drive(situation.drive.clone()))
    history.change(situation.with_plane(situation.plane, situation.height))
    assert not history.settle()
    assert history.now is situation


def test_the_history_of_large_meshes_is_short(monkeypatch):
    scene = small_scene()
    mesh = at.Mesh.from_surface(WEDGE.triangles, offset=(10e-3, 10e-3, 10e-3), rigid=True)
    scene = at.Scene(scene.array, AIR, scene.frequency, scene.control_points, (mesh,), None, scene.domain)
    monkeypatch.setattr(situation_module, "_MOST_BYTES", 3 * mesh.vertices.nbytes)
    first = Situation.of(scene, DRIVE)
    history = History(first)
    for step in range(5):
        history.change(first.with_plane("z", 1e-3 * step))
        history.settle()
    for _ in range(3):
        assert history.can_undo
        history.undo()
    assert not history.can_undo


@pytest.mark.parametrize("rows", [1, 3])
def test_all_methods_begin_with_few_transducers(rows):
    array = at.TransducerArray.grid((2, rows), 10e-3, (0, 0, 0))
    scene = at.Scene(array, AIR, 40e3, [[0.05, 0, 0]], (), None, [[-0.05] * 3, [0.1] * 3])
    objective = at.SimulatedObjective(scene, at.make_propagator(scene))
    for method in offered().values():
        state = method.start(at.Problem.of(objective), 0)
        assert method.ask(state).shape[-1] == 2 * rows


@given(
    st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda sight: math.hypot(*sight) > 0.1),
    st.tuples(*[st.floats(-0.1, 0.1)] * 3),
    st.tuples(*[st.floats(-0.05, 0.05)] * 3),
    st.booleans(),
)
def test_what_is_dragged_stays_at_its_height_or_on_its_vertical(sight, place, offset, upright):
    sight, place, near = np.array(sight), np.array(place), np.add(place, offset)
    point = followed(place, near, sight, upright)
    moved = np.abs(point - place)
    assert (moved[:2] == 0).all() if upright else moved[2] == 0
    assert moved.max() <= 6 * math.hypot(*offset) + 1e-12  # also where one looks along the table
    slope = abs(sight[2]) / np.linalg.norm(sight)
    away = np.linalg.norm(np.cross(point - near, sight)) / np.linalg.norm(sight)
    if not upright and slope > 0.25:
        assert away < 1e-9  # it is below the mouse
    if upright and slope < 0.9:
        beside = place + np.array([[0, 0, 1e-4], [0, 0, -1e-4]]) + point - place
        others = np.linalg.norm(np.cross(beside - near, sight), axis=1) / np.linalg.norm(sight)
        assert away <= others.min() + 1e-9  # no other height is nearer to it


PATIENCE = 60  # s; the machine may be busy


@pytest.fixture
def calculator():
    """A calculator of small cells, and the queue of what it reports."""
    reports = queue.SimpleQueue()
    made = Calculator(2e-3, reports.put)
    yield made, reports
    made.close()


def until_finished(reports, number):
    results = []
    while True:
        report = reports.get(timeout=PATIENCE)
        if isinstance(report, Finished) and report.request.number == number:
            return results
        if isinstance(report, Result):
            results.append(report)


def test_a_plane_that_takes_long_is_shown_coarse_before_the_error_and_sharp_after(calculator, monkeypatch):
    monkeypatch.setattr(calculation, "_MOST_PAIRS", 2e4)
    monkeypatch.setattr(calculation, "_REST", 0.01)
    made, reports = calculator
    scene = small_scene((CUBE,))
    made.ask(Request(1, Situation.of(scene, in_phase(scene))))
    first, second, with_forces, last = until_finished(reports, 1)
    assert (first.forces, second.forces) == (None, None)
    assert torch.equal(with_forces.forces, last.forces)
    assert (first.error, second.error, last.error) == (None, last.error, pytest.approx(second.error))
    assert first.field.shape == second.field.shape
    assert last.field.size > 2 * first.field.size
    assert torch.equal(second.pressure, last.pressure)  # the picture alone is sharper
    largest = [np.nanmax(np.abs(one.field)) for one in (first, last)]
    assert largest[0] == pytest.approx(largest[1], rel=0.3)  # a cell apart


def test_a_newer_request_and_the_end_stop_what_is_calculated():
    reports = queue.SimpleQueue()
    made = Calculator(0.35e-3, reports.put)  # takes ten times as long as what is waited for
    scene = at.load_scene("configs/scene/two_cubes.yaml")
    made.ask(Request(1, Situation.of(scene, in_phase(scene))))
    time.sleep(0.1)
    made.ask(Request(2, Situation.of(scene, in_phase(scene)), fine=False))
    assert [one.request.number for one in until_finished(reports, 2)] == [2]
    made.ask(Request(3, Situation.of(scene, in_phase(scene))))
    time.sleep(0.2)
    made.close()
    while not reports.empty():
        assert not isinstance(reports.get(), Result)


@pytest.mark.parametrize(
    ("bound", "text"),
    [(832.0, "99.7 % of what any drive can reach"), (0.0, "Weakest focus"), (None, "Weakest focus")],
    ids=["all but 2 Pa", "in a hollow body", "unknown"],
)
def test_the_share_of_the_bound_is_rounded_down_and_left_out_where_nothing_is_heard(bound, text):
    field, pressure = np.zeros((1, 1)), torch.tensor([830.0 if bound else 0.0], dtype=torch.float64)
    result = Result(Request(1, None), pressure, None, pressure, field, bound)
    assert text in _summary(result)
    assert ("%" in _summary(result)) is bool(bound)
