"""Distant obstacles in boxes of their own, against one box and the whole domain."""

import dataclasses
import math

import pytest
import torch
from small_scenes import AIR, relative_error

from autdtorch.analytic.green import free_space_matrix
from autdtorch.fdtd.grouping import cheapest_boxes, one_box
from autdtorch.propagators import SimulatedPropagator, make_propagator
from autdtorch.propagators.plan import plan
from autdtorch.propagators.scene_region import region_of
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.obstacles import Box, Sphere
from autdtorch.scene.scene import Scene

EXTENT, SPACING, TOLERANCE = 64e-3, 1.4e-3, 1e-3
NEAR = (13.8e-3, 15.2e-3, 15.2e-3)
FAR = (NEAR[0] + 27 * SPACING, NEAR[1] + 26 * SPACING, NEAR[2] + 25 * SPACING)
"""Spheres of 4 mm have the same place on the cells of their own boxes, of one box and of the domain."""
ARRAY = TransducerArray.grid((1, 2), pitch=8e-3, center=(1e-3, EXTENT / 2, EXTENT / 2))
POINTS = [[61e-3, 52e-3, 55e-3]]


def boxes(scene, spacing=SPACING, grouping=None):
    """A propagator with the cheapest boxes, or with those of a grouping."""
    planned = plan(scene, "box", spacing, TOLERANCE)
    return SimulatedPropagator(dataclasses.replace(planned, grouping=grouping or planned.grouping))


def together(scene, spacing=SPACING):
    return boxes(scene, spacing, one_box(region_of(scene), spacing))


def cells(propagator):
    return [math.prod(assembly.grid.shape) for assembly in propagator.simulation.assemblies]


def far_apart(*obstacles):
    return Scene(ARRAY, AIR, 40e3, POINTS, obstacles, domain=((0, 0, 0), (EXTENT,) * 3))


def spheres(**material):
    return far_apart(*(Sphere(center, 4e-3, **(material or {"rigid": True})) for center in (NEAR, FAR)))


@pytest.mark.parametrize(
    "scene", [spheres(), spheres(density=100.0, sound_speed=340.0)], ids=["rigid", "dense"]
)
def test_boxes_apart_are_one_box_and_the_domain(scene):
    apart, one = boxes(scene), together(scene)
    full = make_propagator(scene, "full", SPACING, tolerance=TOLERANCE)
    matrix = apart.transfer_matrix()
    assert [len(cells(each)) for each in (apart, one)] == [2, 1]
    assert relative_error(matrix, one.transfer_matrix()) < TOLERANCE
    # the domain has the grid's error in air as well, 0.2 % at 1.4 mm over this distance
    assert relative_error(matrix, full.transfer_matrix()) < 4e-3
    # what was stepped: both boxes the same number of cells, to a few
    assert max(cells(apart)) * apart.runs[0].periods < 0.8 * cells(one)[0] * one.runs[0].periods


def test_without_coupling_the_error_would_be_far_above_the_tolerance():
    scene = spheres()
    matrix = boxes(scene).transfer_matrix()
    free = free_space_matrix(scene.control_points, ARRAY, scene.wavenumber)
    alone = sum(together(far_apart(obstacle)).transfer_matrix() - free for obstacle in scene.obstacles)
    assert relative_error(free + alone, matrix) > 4 * TOLERANCE


def test_reciprocity_between_boxes():
    """From a point between the boxes to the transducers as back."""
    points = torch.tensor([[30e-3, 31e-3, 32e-3]], dtype=torch.float64)
    propagator = make_propagator(spheres(), "box", SPACING, tolerance=1e-6, dtype="float64")
    backward = propagator.transfer_matrix(points)
    assert len(propagator.runs) == 1
    forward = propagator.transfer_matrix(torch.cat((points, points + 0.2e-3)))[:1]
    assert len(propagator.runs) == 1 + 2
    # Scheme and Green's function are symmetric. What drives a box and what it radiates are so up to the
    # grid's error in air, over a box, and what its boundary layer reflects: 2.6e-4 here.
    assert relative_error(backward, forward) < 6e-4


def test_points_in_a_box_read_its_grid_and_receive_the_other():
    scene, drive = spheres(), torch.ones(2, dtype=torch.complex128)
    points = [[20e-3, 15e-3, 15.3e-3], [14e-3, 15e-3, 9.5e-3], [52.8e-3, 46.3e-3, 50.8e-3]]
    apart, one = (propagator.field(drive, points) for propagator in (boxes(scene), together(scene)))
    assert relative_error(apart, one) < TOLERANCE


def test_boxes_whose_iteration_does_not_converge_are_joined(monkeypatch):
    monkeypatch.setattr("autdtorch.propagators.multiple_scattering.MOST_PASSES", 1)
    apart, one = boxes(spheres()), together(spheres())
    assert torch.equal(apart.transfer_matrix(), one.transfer_matrix())
    assert [run.periods for run in apart.runs] == [run.periods for run in one.runs]
    # More points than transducers: runs from these, whose one box holds the points.
    monkeypatch.setattr("autdtorch.propagators.multiple_scattering.MOST_PASSES", 1)
    between = torch.tensor(NEAR) + torch.linspace(0.4, 0.6, 5)[:, None] * (
        torch.tensor(FAR) - torch.tensor(NEAR)
    )
    matrix, whole = (each(spheres()).transfer_matrix(between) for each in (boxes, together))
    assert relative_error(matrix, whole) < 2 * TOLERANCE


def test_obstacles_share_a_box_where_that_is_cheaper():
    near = Sphere((NEAR[0], NEAR[1], NEAR[2] + 9e-3), 3e-3, rigid=True)
    scene = far_apart(Sphere(NEAR, 4e-3, rigid=True), Sphere(FAR, 4e-3, rigid=True), near)
    grouping = cheapest(scene, 1e-3)
    assert sorted(grouping.groups) == [(0, 2), (1,)]
    assert grouping.box_cost(1) < one_box(region_of(scene), 1e-3).box_cost(1)
    # on coarse cells boundary layers fill each box: one is cheaper
    assert len(cheapest(scene, 2.8e-3).groups) == 1
    # Steps alone would favour two boxes, 0.8 to 1; the sums between them take as long once more.
    assert [len(cheapest(cubes(36e-3, gap), 2e-3).groups) for gap in (180e-3, 360e-3)] == [1, 2]
    # Multiple reflections between them would need too many passes.
    plate = Box((12e-3, 32e-3, 32e-3), (2e-3, 50e-3, 50e-3), rigid=True)
    other = dataclasses.replace(plate, center=(42e-3, 32e-3, 32e-3))
    assert len(cheapest(far_apart(plate, other), 1e-3).groups) == 1


def cheapest(scene, spacing):
    return cheapest_boxes(region_of(scene), spacing, TOLERANCE, runs=1)


def cubes(edge, gap):
    first = (20e-3 + edge / 2,) * 3
    second = (first[0] + edge + gap, *first[1:])
    obstacles = [Box(center, (edge,) * 3, rigid=True) for center in (first, second)]
    array = TransducerArray([(1e-3, 32e-3, 32e-3)], (1, 0, 0))
    return Scene(array, AIR, 40e3, [(second[0] + edge + 10e-3, 35e-3, 37e-3)], obstacles)
