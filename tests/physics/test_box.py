"""Scattered fields in boxes: against exact solutions and the whole domain, of obstacles that move."""

import dataclasses
import math
from dataclasses import replace

import pytest
import torch
from small_scenes import AIR, CUBE, matrix_of_sphere, relative_error, scene_of_all_kinds, small_scene

from autdtorch.fdtd.grid import make_box
from autdtorch.fdtd.grouping import box_grid, cheapest_boxes, one_box
from autdtorch.fdtd.kernels.cpu import CpuKernel
from autdtorch.propagators import SimulatedPropagator, box, make_propagator
from autdtorch.propagators.plan import plan, region_of
from autdtorch.propagators.store import BODIES
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.obstacles import Box, Cylinder, Mesh, Sphere, VoxelMask
from autdtorch.scene.scene import OverlapWarning, Scene

SPHERE = Sphere((12.2e-3, 11.9e-3, 12.1e-3), 3.3e-3, rigid=True)
ALL = torch.ones(4, dtype=torch.complex128)


def simulated(scene, method="box", tolerance=1e-4):
    return make_propagator(scene, method, 1e-3, tolerance=tolerance)


def test_scattered_wave_of_a_sphere():
    scene = small_scene((SPHERE,))
    error = simulated(scene).transfer_matrix() - matrix_of_sphere(scene)
    # as on the whole domain, 3.8 % at 3.3 cells a radius: the box adds nothing
    assert error.norm() < 0.05 * matrix_of_sphere(scene, scattered=True).norm()
    far = torch.tensor([[0.5, 0.1, -0.2], [1.0, 0.0, 0.0]])  # outside the domain, which costs no grid
    assert relative_error(simulated(scene).transfer_matrix(far), matrix_of_sphere(scene, far)) < 0.02


@pytest.mark.parametrize(("absorption", "radius"), [(0.0, 0.0), (40.0, 1.5e-3)])
def test_box_and_whole_domain_agree(absorption, radius):
    """Two obstacles, points between the box and the layers; with loss, and with discs for sources."""
    plate = Box((9.3e-3, 8.2e-3, 18.1e-3), (2.2e-3, 5e-3, 3.7e-3), (0.3, 0.1, 0.2), rigid=True)
    scene = small_scene((CUBE, plate), absorption=absorption, radius=radius)
    box, full = (simulated(scene, method).transfer_matrix() for method in ("box", "full"))
    # the grid's error in air, 0.06 % of the whole, is in the one and not in the other; required: 1 %
    assert relative_error(box, full) < 3e-3


def test_points_in_the_box_read_the_grid():
    scene = small_scene((CUBE,))
    beside = torch.tensor([(7.1e-3, 12.3e-3, 11.8e-3), (12.2e-3, 12.1e-3, 15.6e-3)], dtype=torch.float64)
    inside = torch.tensor([(12.2e-3, 11.9e-3, 12.3e-3), (11.1e-3, 13.4e-3, 12.2e-3)], dtype=torch.float64)
    box, full = (simulated(scene, method) for method in ("box", "full"))
    # a point near a surface is spread across it by the grid; the box spreads the scattered part alone
    assert relative_error(box.transfer_matrix(beside), full.transfer_matrix(beside)) < 0.03
    assert relative_error(box.field(ALL, inside), full.field(ALL, inside)) < 0.03


@pytest.mark.parametrize("method", ["box", "full"])
def test_points_beside_a_rigid_surface_read_the_cells_in_front_of_it(method):
    """Sound-hard cells have no pressure; the interpolation is fitted to the others."""
    scene = small_scene((SPHERE,))
    direction = torch.randn((30, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    direction /= direction.norm(dim=1, keepdim=True)
    points = torch.tensor(SPHERE.center) + (SPHERE.radius + 0.05e-3) * direction
    matrix = simulated(scene, method, 1e-3).transfer_matrix(points)
    # 6 %, twice the grid's own error beside a sphere of 3.3 cells; 14 to 17 % where the others are scaled up
    assert relative_error(matrix, matrix_of_sphere(scene, points)) < 0.08


def test_the_field_passes_the_rim_of_the_box_smoothly():
    """From the grid's field inside to the field of the Huygens surface, also on the centre of a cell."""
    scene = small_scene((SPHERE,))
    grid = make_box(region_of(scene), 1e-3)
    rim = grid.origin[0] + 1e-3 * (grid.last[0] - 1)
    across = [grid.origin[axis] + 1e-3 * (grid.first[axis] + 6) for axis in (1, 2)]
    points = torch.tensor([(rim + 1e-3 * step, *across) for step in (-3, -2.5, -2, -1.5, -1, -0.5, 0)])
    # the grid's own error so close to a sphere of 3.3 cells is 2 to 3 %; on a cell that radiates, two cells
    # from the rim, what is radiated is not finite
    assert relative_error(simulated(scene).transfer_matrix(points), matrix_of_sphere(scene, points)) < 0.04


def test_of_overlapping_obstacles_the_later_wins():
    x, y, z = SPHERE.center
    later = Sphere((x - 2.2e-3, y, z), 2.5e-3, density=2 * AIR.density, sound_speed=AIR.sound_speed)
    for obstacles, fluid in (((SPHERE, later), True), ((later, SPHERE), False)):
        with pytest.warns(OverlapWarning):
            scene = small_scene(obstacles)
        pressure = simulated(scene, tolerance=2e-3).field(ALL, [SPHERE.center])
        assert pressure.isfinite().all()
        assert pressure.any() == fluid


def test_runs_side_by_side_are_those_one_after_the_other(monkeypatch):
    runs = []
    for count in (1, 2):
        propagator = make_propagator(small_scene((CUBE,)), "box", 2e-3, tolerance=0.05)
        monkeypatch.setattr(CpuKernel, "at_once", lambda self, shape, count=count: count)
        runs.append((propagator.transfer_matrix().tolist(), [run.periods for run in propagator.runs]))
    assert runs[0] == runs[1]


def test_discs_among_obstacles_of_air():
    air = Box(CUBE.center, CUBE.size, density=AIR.density, sound_speed=AIR.sound_speed)
    with_air, without = (small_scene(each, radius=1e-3) for each in ((air,), ()))
    found = make_propagator(with_air, "box", 1e-3).transfer_matrix()
    assert relative_error(found, make_propagator(without, "free_space").transfer_matrix()) < 1e-6


MOVE = (5e-3, -2.3e-3, 0.7e-3)
PLACES = {Box: "center", Sphere: "center", Cylinder: "center", Mesh: "offset", VoxelMask: "origin"}
BALL = Sphere((40e-3, 50e-3, 50e-3), 4e-3, rigid=True)


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
    matrix(BALL)
    there = replace(BALL, center=by(MOVE, BALL.center))
    warm = matrix(there)
    assert len(assembled) == 1
    BODIES.forget()
    assert torch.equal(matrix(there), warm)
    assert len(assembled) == 2


@pytest.mark.parametrize(
    "other",
    [
        replace(BALL, radius=4.001e-3),
        replace(BALL, rigid=False, density=100.0, sound_speed=340.0),
        Cylinder(BALL.center, 4e-3, 8e-3, rigid=True),
    ],
)
def test_other_bodies_have_boxes_of_their_own(other, assembled):
    matrix(BALL)
    matrix(other)
    assert len(assembled) == 2


def test_large_boxes_are_not_kept(assembled, monkeypatch):
    monkeypatch.setattr(BODIES, "_most_bytes", 1000)
    assert torch.equal(matrix(BALL), matrix(BALL))
    assert len(assembled) == 2


EXTENT, SPACING, TOLERANCE = 64e-3, 1.4e-3, 1e-3
NEAR = (13.8e-3, 15.2e-3, 15.2e-3)
FAR = (NEAR[0] + 27 * SPACING, NEAR[1] + 26 * SPACING, NEAR[2] + 25 * SPACING)
"""Spheres of 4 mm have the same place on the cells of their own boxes, of one box and of the domain."""
ARRAY = TransducerArray.grid((1, 2), pitch=8e-3, center=(1e-3, EXTENT / 2, EXTENT / 2))
POINTS = [[61e-3, 52e-3, 55e-3]]


def boxes(scene, spacing=SPACING, grouping=None):
    """A propagator with the cheapest boxes, or with those of a grouping."""
    planned = plan(scene, "box", spacing, TOLERANCE)
    return SimulatedPropagator(dataclasses.replace(planned, grids=grouping or planned.grouping))


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


def test_points_in_a_box_read_its_grid_and_receive_the_other():
    scene, drive = spheres(), torch.ones(2, dtype=torch.complex128)
    points = [[20e-3, 15e-3, 15.3e-3], [14e-3, 15e-3, 9.5e-3], [52.8e-3, 46.3e-3, 50.8e-3]]
    apart, one = (propagator.field(drive, points) for propagator in (boxes(scene), together(scene)))
    assert relative_error(apart, one) < TOLERANCE


def test_boxes_whose_iteration_does_not_converge_are_joined(monkeypatch):
    monkeypatch.setattr("autdtorch.propagators.multiple_scattering.MOST_PASSES", 2)
    apart, one = boxes(spheres()), together(spheres())
    assert torch.equal(apart.transfer_matrix(), one.transfer_matrix())
    assert [run.periods for run in apart.runs] == [run.periods for run in one.runs]
    # More points than transducers: runs from these, whose one box holds the points.
    monkeypatch.setattr("autdtorch.propagators.multiple_scattering.MOST_PASSES", 2)
    between = torch.tensor(NEAR) + torch.linspace(0.4, 0.6, 5)[:, None] * (
        torch.tensor(FAR) - torch.tensor(NEAR)
    )
    matrix, whole = (each(spheres()).transfer_matrix(between) for each in (boxes, together))
    assert relative_error(matrix, whole) < 2 * TOLERANCE


def test_obstacles_share_a_box_where_that_is_cheaper():
    near = Sphere((NEAR[0], NEAR[1], NEAR[2] + 9e-3), 3e-3, rigid=True)
    scene = far_apart(Sphere(NEAR, 4e-3, rigid=True), Sphere(FAR, 4e-3, rigid=True), near)
    grouping = cheapest(scene, 1e-3)
    assert sorted(grid.group for grid in grouping.grids) == [(0, 2), (1,)]
    assert grouping.box_cost(1) < one_box(region_of(scene), 1e-3).box_cost(1)
    # on coarse cells absorbing layers fill each box: one is cheaper
    assert len(cheapest(scene, 2.8e-3).grids) == 1
    # Steps alone would favour two boxes, 0.8 to 1; the sums between them take as long once more.
    assert [len(cheapest(cubes(36e-3, gap), 2e-3).grids) for gap in (180e-3, 360e-3)] == [1, 2]
    # Multiple reflections between them would need too many passes.
    plate = Box((12e-3, 32e-3, 32e-3), (2e-3, 50e-3, 50e-3), rigid=True)
    other = dataclasses.replace(plate, center=(42e-3, 32e-3, 32e-3))
    assert len(cheapest(far_apart(plate, other), 1e-3).grids) == 1


def test_a_box_takes_the_steps_of_its_bodies_alone():
    fast = Sphere(FAR, 4e-3, density=1100.0, sound_speed=2500.0)
    rigid = Sphere(NEAR, 4e-3, rigid=True)
    scenes = far_apart(rigid), far_apart(rigid, fast)
    alone, beside = (box_grid(region_of(scene), [0], 1e-3).steps_per_period for scene in scenes)
    assert alone == beside


def cheapest(scene, spacing):
    return cheapest_boxes(region_of(scene), spacing, TOLERANCE, runs=1)


def cubes(edge, gap):
    first = (20e-3 + edge / 2,) * 3
    second = (first[0] + edge + gap, *first[1:])
    obstacles = [Box(center, (edge,) * 3, rigid=True) for center in (first, second)]
    array = TransducerArray([(1e-3, 32e-3, 32e-3)], (1, 0, 0))
    return Scene(array, AIR, 40e3, [(second[0] + edge + 10e-3, 35e-3, 37e-3)], obstacles)
