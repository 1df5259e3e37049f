"""Obstacles that only move: the field moves along, and their box is not assembled again."""

from dataclasses import replace

import pytest
import torch
from small_scenes import AIR, relative_error, scene_of_all_kinds

from autdtorch.propagators import box, make_propagator
from autdtorch.propagators.store import BODIES
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.obstacles import Box, Cylinder, Mesh, Sphere, VoxelMask
from autdtorch.scene.scene import Scene

MOVE = (5e-3, -2.3e-3, 0.7e-3)
PLACES = {Box: "center", Sphere: "center", Cylinder: "center", Mesh: "offset", VoxelMask: "origin"}
SPHERE = Sphere((40e-3, 50e-3, 50e-3), 4e-3, rigid=True)


@pytest.fixture
def assembled(monkeypatch):
    """A list with an entry for every box that is assembled; none is kept before."""
    boxes, assemble_on = [], box.assemble_on
    BODIES.forget()
    monkeypatch.setattr(
        box, "assemble_on", lambda grid, *more: boxes.append(grid) or assemble_on(grid, *more)
    )
    return boxes


def by(move, place):
    return tuple(a + b for a, b in zip(move, place, strict=True))


def matrix(obstacle, move=(0.0, 0.0, 0.0)):
    """Transfer matrix of an array, an obstacle and two points, all moved."""
    array = TransducerArray.grid((2, 2), pitch=10e-3, center=by(move, (1e-3, 50e-3, 50e-3)))
    points = [by(move, place) for place in ((80e-3, 50e-3, 52e-3), (75e-3, 20e-3, 55e-3))]
    name = PLACES[type(obstacle)]
    there = replace(obstacle, **{name: by(move, getattr(obstacle, name))})
    scene = Scene(array, AIR, 40e3, points, [there], domain=((-0.02,) * 3, (0.12,) * 3))
    return make_propagator(scene, "box", 2e-3, cache=False).transfer_matrix()


@pytest.mark.parametrize("kind", PLACES, ids=lambda kind: kind.__name__)
def test_a_scene_that_moves_as_a_whole_keeps_its_matrix_and_its_assembly(kind, tmp_path, assembled):
    obstacle = next(each for each in scene_of_all_kinds(tmp_path).obstacles if type(each) is kind)
    # float32 rounds the incident field, whose distances change by rounding
    assert relative_error(matrix(obstacle, MOVE), matrix(obstacle)) < 1e-5
    assert len(assembled) == 1


def test_a_kept_assembly_changes_no_bit(assembled):
    matrix(SPHERE)
    there = replace(SPHERE, center=by(MOVE, SPHERE.center))
    warm = matrix(there)
    assert len(assembled) == 1
    BODIES.forget()
    assert torch.equal(matrix(there), warm)
    assert len(assembled) == 2


@pytest.mark.parametrize(
    "other",
    [
        replace(SPHERE, radius=4.001e-3),
        replace(SPHERE, rigid=False, density=100.0, sound_speed=340.0),
        Cylinder(SPHERE.center, 4e-3, 8e-3, rigid=True),
    ],
)
def test_other_bodies_have_boxes_of_their_own(other, assembled):
    matrix(SPHERE)
    matrix(other)
    assert len(assembled) == 2


def test_large_boxes_are_not_kept(assembled, monkeypatch):
    monkeypatch.setattr(BODIES, "_most_bytes", 1000)
    assert torch.equal(matrix(SPHERE), matrix(SPHERE))
    assert len(assembled) == 2
