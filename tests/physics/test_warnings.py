"""Warnings of a scene and its grid: each once for all obstacles, and none of auxiliary grids."""

import dataclasses

import pytest
import torch
from small_scenes import AIR, CUBE, small_scene

from autdtorch.propagators import SteadyStateWarning, differentiable_field, make_propagator
from autdtorch.scene.obstacles import Box, Sphere
from autdtorch.scene.scene import OverlapWarning

DRIVE = torch.ones(4, dtype=torch.complex128)

#: A cell and a half from the transducers, at 1.4 mm.
BESIDE_ARRAY = Box(center=(5.3e-3, 12e-3, 12e-3), size=(4e-3, 14e-3, 14e-3), rigid=True)


def messages(caplog, text):
    return [message for message in caplog.messages if text in message]


def simulated(scene, method, spacing, **settings):
    return make_propagator(scene, method, spacing, **{"tolerance": 0.1, **settings})


def of_two_speeds(extent):
    near, far = (14e-3,) * 3, (extent - 14e-3,) * 3
    obstacles = (
        Sphere(near, 4e-3, rigid=True),
        Sphere(far, 4e-3, density=100.0, sound_speed=320.0),
        Sphere(far, 2e-3, density=50.0, sound_speed=330.0),
    )
    with pytest.warns(OverlapWarning):
        return small_scene(obstacles, extent)


@pytest.mark.parametrize(("method", "extent"), [("box", 200e-3), ("full", 48e-3)])
def test_a_coarse_spacing_is_logged_once_for_all_obstacles(method, extent, caplog):
    propagator = simulated(of_two_speeds(extent), method, 2.5e-3)
    assert len(propagator.simulation.assemblies) == (2 if method == "box" else 1)
    assert propagator._others[0].plan.spacing < propagator.spacing
    assert propagator._others[0].matrix_runs(propagator.scene.control_points)
    (message,) = messages(caplog, "coarse")
    assert "2.5 mm" in message
    assert all(where in message for where in ("the medium", "obstacle 1", "obstacle 2"))
    assert "obstacle 0" not in message  # which is rigid


def test_a_coarse_spacing_is_logged_once_where_the_medium_is_differentiated(caplog):
    speed = torch.tensor([335.0], dtype=torch.float64, requires_grad=True)
    field = differentiable_field(small_scene((CUBE,)), DRIVE, sound_speed=speed, spacing=2.5e-3)
    field.abs().sum().backward()
    (message,) = messages(caplog, "coarse")
    assert "the medium given" in message


def test_free_space_warns_of_ignored_obstacles(caplog):
    make_propagator(small_scene((CUBE,)), "free_space")
    assert "1 obstacle of" in caplog.text


def test_pilot_grids_are_not_logged(caplog):
    scene = small_scene((BESIDE_ARRAY,))
    points = torch.cat((scene.control_points, scene.control_points - 0.5e-3))  # more than transducers
    simulated(dataclasses.replace(scene, control_points=points), "box", None, tolerance=0.5)
    assert not messages(caplog, "coarse") + messages(caplog, "of an obstacle")


@pytest.mark.parametrize("method", ["box", "full"])
def test_a_source_beside_an_obstacle_is_logged_once(method, caplog):
    propagator = simulated(small_scene((BESIDE_ARRAY,)), method, 1.4e-3, tolerance=0.5)
    points = propagator.scene.control_points
    propagator.transfer_matrix()
    assert not messages(caplog, "of an obstacle")  # the runs begin at the three points
    for turn in (1, 1j, -1):
        propagator.field(turn * DRIVE, points)
    everywhere = torch.cat((points, points - 0.5e-3))
    propagator.transfer_matrix(everywhere, return_error=True)
    assert len(propagator.runs) > 3 + 3
    assert len(messages(caplog, "of an obstacle")) == 1


@pytest.mark.parametrize("method", ["box", "full"])
def test_points_closer_to_a_surface_than_a_cell_are_logged_on_both_sides(method, caplog):
    scene = small_scene((CUBE,))  # its faces across x are at 9 and 15 mm
    propagator = simulated(scene, method, 1.4e-3, tolerance=0.5)
    assert not messages(caplog, "of a surface")
    points = torch.tensor([[20e-3, 12e-3, 12e-3], [15.3e-3, 12e-3, 12e-3]], dtype=torch.float64)
    propagator.field(DRIVE, points.expand(2, 2, 3))  # a picture
    assert not messages(caplog, "of a surface")
    for _ in range(2):
        propagator.field(DRIVE, points)
    (message,) = messages(caplog, "of a surface")
    assert "points[1] at (15.3, 12.0, 12.0) mm is 0.3 mm from obstacle 0" in message
    caplog.clear()
    within = torch.tensor([[14.6e-3, 12e-3, 12e-3], [12e-3, 12e-3, 12e-3]], dtype=torch.float64)
    simulated(scene, method, 1.4e-3, tolerance=0.5).transfer_matrix(within)
    (message,) = messages(caplog, "of a surface")
    assert "points[0] at (14.6, 12.0, 12.0) mm is 0.4 mm inside obstacle 0" in message


def test_control_points_and_transducers_next_to_a_surface_are_logged(caplog):
    plate = Box(center=(4e-3, 12e-3, 12e-3), size=(4e-3, 14e-3, 14e-3), rigid=True)  # 0.8 mm from the array
    scene = dataclasses.replace(small_scene((plate,)), control_points=[(6.2e-3, 12e-3, 12e-3)])
    simulated(scene, "full", 1.4e-3)
    array, point = messages(caplog, "of a surface")
    assert "array.positions[0]" in array
    assert "3 more" in array
    assert "control_points[0]" in point
    caplog.clear()
    differentiable_field(scene, DRIVE, spacing=1.4e-3, periods=2)
    assert len(messages(caplog, "of a surface")) == 1


def test_runs_that_do_not_converge_give_one_warning():
    propagator = simulated(small_scene((CUBE,)), "full", 1.4e-3, tolerance=1e-6, max_periods=8)
    drives, points = torch.stack((DRIVE, 1j * DRIVE)), propagator.scene.control_points
    for counts, call in (
        (r"(\d+) of \1", lambda: propagator.transfer_matrix(return_error=True)),  # on both grids
        ("2 of 2", lambda: propagator.field(drives, points)),
    ):
        with pytest.warns(SteadyStateWarning, match=f" in {counts} runs: ") as caught:
            call()
        assert [warning.filename for warning in caught] == [__file__]


def test_walls_that_end_are_logged_once(caplog):
    walls = [
        Box((22e-3, 12e-3, 12e-3), (1e-3, 1.0, 1.0), density=2.0, sound_speed=AIR.sound_speed),
        *(Box((12e-3, y, 12e-3), (1.0, 1e-3, 1.0), density=2.0, sound_speed=340.0) for y in (1e-3, 23e-3)),
    ]
    scene = dataclasses.replace(small_scene(), control_points=[(10e-3, 12e-3, 11e-3)], obstacles=walls)
    assert simulated(scene, "full", 2e-3)._others
    (message,) = messages(caplog, "another direction")
    assert "obstacle 1, 2 " in message
