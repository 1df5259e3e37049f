"""Spheres, thin plates, slits, corners, needles and voxels at cells of 1 mm; cavities and closed rooms."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import pyvista
import pyvista as pv
import torch
from shared.families import scene_of
from small_scenes import AIR, relative_error, small_scene

from autdtorch.analytic import fluid_sphere, rigid_sphere
from autdtorch.propagators import make_propagator
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.obstacles import Box, Mesh, Sphere, VoxelMask
from autdtorch.scene.scene import Scene

CENTER, RADIUS, RATIO = (12.2e-3, 11.9e-3, 12.1e-3), 3.3e-3, 77.0


def sphere_scene(rigid):
    if rigid:
        return small_scene((Sphere(CENTER, RADIUS, rigid=True),))
    return small_scene((Sphere(CENTER, RADIUS, density=RATIO * AIR.density, sound_speed=AIR.sound_speed),))


def exact(scene, scattered):
    arguments = scene.control_points, scene.array.positions, scene.wavenumber, CENTER, RADIUS
    if scene.obstacles[0].rigid:
        field = rigid_sphere(*arguments, scattered=scattered)
    else:
        field = fluid_sphere(*arguments, RATIO, 1.0, scattered=scattered)
    return 4 * math.pi * scene.array.source_strength * field


def scattered_error(scene, spacing):
    simulated = make_propagator(scene, "full", spacing, tolerance=1e-4).transfer_matrix()
    whole = exact(scene, scattered=False)
    size = float(exact(scene, scattered=True).norm() / whole.norm())
    return relative_error(simulated, whole) / size


# measured: 3.8 % of the scattered wave at 1 mm, 3.3 cells a radius, for both; the bound leaves a third more
@pytest.mark.parametrize("rigid", [True, False])
def test_scattered_wave_of_a_sphere(rigid):
    assert scattered_error(sphere_scene(rigid), 1e-3) < 0.05


@pytest.mark.parametrize("rigid", [True, False])
def test_the_error_of_a_sphere_is_of_second_order(rigid):
    scene = sphere_scene(rigid)
    coarse, fine = scattered_error(scene, 1.3e-3), scattered_error(scene, 0.65e-3)
    # Half the spacing divides the error by 4, apart from the sphere's place between the cells: measured 3.7
    # and 5.6. First order, as of staircases, would be 2.
    assert fine < coarse / 3


@pytest.mark.parametrize("rigid", [True, False])
def test_spheres_merged_into_one_mesh_are_their_union(rigid):
    material = {"rigid": True} if rigid else {"density": 100.0, "sound_speed": 340.0}
    places = (12e-3, 10.5e-3, 12e-3), (12.5e-3, 14e-3, 11e-3)
    spheres = [pv.Icosphere(radius=RADIUS, center=place, nsub=3) for place in places]
    apart = [Mesh.from_surface(sphere, **material) for sphere in spheres]
    merged = Mesh.from_surface(spheres[0].append_polydata(spheres[1]), **material)
    exact = [Sphere(place, RADIUS, **material) for place in places]
    joined, union, round_ = (
        make_propagator(small_scene(obstacles), "full", 1.2e-3).transfer_matrix()
        for obstacles in ([merged], apart, exact)
    )
    # Measured: 1e-5 and 0.4 % if rigid, 0.1 and 1 % if not. With triangles inside the union, 10 % and more.
    assert relative_error(joined, union) < 5e-3
    assert relative_error(joined, round_) < 0.02


FINE, SETTLED = 0.55e-3, 1e-3


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("family", ["plate", "slit", "corner", "needle"])
def test_what_is_thinner_than_a_cell_is_right(family, seed):
    """Measured on 200 scenes: 95 % are within 2 % at 1 mm; the finer grid errs by a fifth of that."""
    scene, _ = scene_of(family, seed)
    found, fine = (make_propagator(scene, "box", h, SETTLED).transfer_matrix() for h in (1e-3, FINE))
    assert relative_error(found, fine) < 0.02


def test_claims_hold_against_exact_series():
    """Required: no tolerance missed, 5 of 6 claims within a factor of 3; of many scenes 95 % are."""
    near = 0
    for family, seed in itertools.product(("sphere", "shell", "voxels"), range(2, 4)):
        scene, exact = scene_of(family, seed)
        propagator = make_propagator(scene, "box", None, tolerance=0.03, cache=False)
        matrix, claimed = propagator.transfer_matrix(return_error=True)
        true = relative_error(matrix, exact)
        assert true < 0.03
        near += true / 3 < claimed < 3 * true
    assert near >= 5


def test_smooth_voxels_are_nearer_to_a_ball_than_cubes():
    scene, exact = scene_of("voxels", 1)
    (mask,) = scene.obstacles
    errors = [
        relative_error(
            make_propagator(replace(scene, obstacles=(body,)), "box", 1e-3, SETTLED).transfer_matrix(), exact
        )
        for body in (mask, replace(mask, smooth=False))
    ]
    assert errors[0] < 0.02
    assert errors[1] > 2 * errors[0]


OUTER, SPACING, STEADY = 4.2e-3, 1e-3, 1e-4


def hollow_ball(wall: float) -> Mesh:
    outer, inner = (pyvista.Icosphere(radius=radius, nsub=4) for radius in (OUTER, OUTER - wall))
    triangles = [ball.faces.reshape(-1, 4)[:, 1:] for ball in (outer, inner)]
    vertices = np.concatenate([outer.points, inner.points]).astype(np.float64) + CENTER
    return Mesh.from_surface(
        (vertices, np.concatenate([triangles[0], triangles[1][:, ::-1] + len(outer.points)])), rigid=True
    )


def room(wall: float, half: float = 4e-3) -> list[Box]:
    walls = []
    for axis, sign in itertools.product(range(3), (-1, 1)):
        size, place = [2 * (half + wall)] * 3, list(CENTER)
        size[axis], place[axis] = wall, place[axis] + sign * (half + wall / 2)
        walls.append(Box(tuple(place), tuple(size), rigid=True))
    return walls


def with_points(scene: Scene, *points: tuple[float, float, float]) -> torch.Tensor:
    return torch.cat((scene.control_points, torch.tensor(points, dtype=torch.float64)))


def solid_ball():
    ball = pyvista.Icosphere(radius=OUTER, nsub=4)
    return Mesh.from_surface(
        (ball.points.astype(np.float64) + CENTER, ball.faces.reshape(-1, 4)[:, 1:]), rigid=True
    )


def mask(hollow):
    inside = np.ones((8, 8, 8), bool)
    inside[3:5, 3:5, 3:5] = not hollow
    return VoxelMask(inside, 1e-3, (8e-3,) * 3, rigid=True)


# the same geometry, up to the order of triangles
@pytest.mark.parametrize(
    ("hollow", "solid", "difference"),
    [
        (hollow_ball(0.3e-3), solid_ball(), 10 * STEADY),
        (hollow_ball(1e-3), solid_ball(), 10 * STEADY),
        (mask(True), mask(False), 1e-12),
    ],
    ids=["thin ball", "ball", "mask"],
)
def test_a_hollow_rigid_body_is_a_solid_one(hollow, solid, difference):
    matrices = [
        make_propagator(small_scene((body,)), "box", SPACING, STEADY).transfer_matrix()
        for body in (hollow, solid)
    ]
    assert relative_error(*matrices) < difference


@pytest.mark.parametrize("method", ["box", "full"])
@pytest.mark.parametrize("wall", [0.2e-3, 1.5e-3])
def test_a_closed_room_is_silent_and_told(method, wall, caplog):
    scene = small_scene(room(wall))
    propagator = make_propagator(scene, method, SPACING, 1e-3)
    points = with_points(scene, CENTER)
    matrix = propagator.transfer_matrix(points)
    assert not matrix[-1].any()
    assert (matrix[:-1].norm(dim=1) > 0).all()
    assert "enclose the point at (12.2, 11.9, 12.1) mm" in caplog.text
    assert max(run.periods for run in propagator.runs) < 100  # the empty room does not ring
    block = make_propagator(
        small_scene((Box(CENTER, (2 * (4e-3 + wall),) * 3, rigid=True),)), method, SPACING, 1e-3
    )
    # the same outer faces; next to transducers and points each is within 2.5 % of the truth at 1 mm
    assert relative_error(matrix[:-1], block.transfer_matrix(points)[:-1]) < 0.05


def test_no_run_begins_at_a_point_in_a_closed_room(caplog):
    """Points fewer than transducers, far from the walls: runs would begin at them."""
    around = small_scene(room(0.5e-3, 9e-3), extent=0.05)
    center = torch.tensor([CENTER], dtype=torch.float64)
    outside = TransducerArray([(40e-3, 40e-3, 30e-3 + 2e-3 * step) for step in range(3)], (0, 0, 1))
    scene = Scene(outside, around.medium, 40e3, around.control_points, around.obstacles, domain=around.domain)
    propagator = make_propagator(scene, "box", SPACING, 1e-3)
    assert not propagator.transfer_matrix(center).any()
    assert not propagator.runs
    assert "enclose the point" in caplog.text


def test_an_open_room_is_not_silent(caplog):
    scene = small_scene(room(0.5e-3)[1:])
    points = with_points(scene, CENTER)
    matrix = make_propagator(scene, "box", SPACING, 1e-3).transfer_matrix(points)
    assert matrix[-1].norm() > 0
    assert "enclose" not in caplog.text


def test_the_side_of_a_thin_wall_decides_not_the_nearest_cell():
    wall, half = 0.05e-3, 4e-3
    scene = small_scene(room(wall, half))
    propagator = make_propagator(scene, "box", SPACING, 1e-3)
    x, y, z = CENTER
    above = [(x, y + 0.3e-3, z + half + wall + up) for up in (0.05e-3, 0.2e-3, 0.5e-3, 0.9e-3)]
    below = [(x, y + 0.3e-3, z + half - down) for down in (0.05e-3, 0.2e-3, 0.5e-3, 0.9e-3)]
    matrix = propagator.transfer_matrix(torch.tensor([*above, *below], dtype=torch.float64))
    assert (matrix[:4].norm(dim=1) > 0).all()
    assert not matrix[4:].any()
    assert not propagator.point_errors(torch.tensor(below, dtype=torch.float64)).any()


@pytest.mark.parametrize("method", ["box", "full"])
def test_a_ball_beside_a_closed_room_opens_no_wall(method):
    """Elements beside a curved body see walls at points of a lattice, between which 0.05 mm would be lost."""
    ball = Sphere((CENTER[0] + 6.3e-3, *CENTER[1:]), 2.2e-3, rigid=True)
    scene = small_scene([*room(0.05e-3), ball])
    points = with_points(scene, CENTER)
    assert not make_propagator(scene, method, SPACING, 1e-3).transfer_matrix(points)[-1].any()


@pytest.mark.parametrize("half", [4e-3, 20e-3])
def test_a_transducer_in_a_closed_room_is_refused(half):
    """Also where its distance from the walls allows its field to be stored."""
    empty, domain = small_scene(), ((-0.02,) * 3, (0.05,) * 3)
    inside = TransducerArray([CENTER], (0, 0, 1))
    scene = Scene(inside, empty.medium, 40e3, [(0.0, 0.0, 0.045)], room(1e-3, half), domain=domain)
    with pytest.raises(ValueError, match=r"array\.positions\[0\]: .* is enclosed by rigid obstacles"):
        make_propagator(scene, "box", SPACING).transfer_matrix()


@pytest.mark.parametrize("method", ["box", "full"])
@pytest.mark.parametrize("balls", [1, 2])
def test_a_run_ends_where_a_drive_cancels(method, balls):
    """In a plane of symmetry two opposite drives leave rounding alone, which never becomes steady."""
    array = TransducerArray([(-10e-3, 0.0, -20e-3), (10e-3, 0.0, -20e-3)], (0, 0, 1))
    obstacles = [Sphere((0.0, y, 0.0), 3e-3, rigid=True) for y in (0.0, 18e-3)[:balls]]
    domain = ((-15e-3, -10e-3, -25e-3), (15e-3, 25e-3, 15e-3))
    scene = Scene(array, small_scene().medium, 40e3, [(0.0, 0.0, 10e-3)], obstacles, domain=domain)
    propagator = make_propagator(scene, method, 1.5e-3, 1e-3)
    drive = torch.tensor([1.0, -1.0], dtype=torch.complex128)
    cancelled, whole = (
        propagator.field(each, scene.control_points).abs() for each in (drive, drive.abs() + 0j)
    )
    assert (cancelled < 1e-3 * whole).all()
    assert max(run.periods for run in propagator.runs) < 100


@pytest.mark.filterwarnings("ignore::autdtorch.OverlapWarning")
def test_air_cut_from_a_rigid_cube_is_a_notch_between_plates():
    """The pressure at a point in the notch is equal to the one between plates that leave the notch free."""
    x, y, z = CENTER
    cube = Box(CENTER, (10e-3,) * 3, rigid=True)
    air = Box((x + 2e-3, y, z), (10e-3, 4e-3, 4e-3), density=1.293, sound_speed=340.0)
    plates = [Box((x - 4e-3, y, z), (2e-3, 10e-3, 10e-3), rigid=True)]
    for side in (-3.5e-3, 3.5e-3):
        plates.append(Box((x + 1e-3, y + side, z), (8e-3, 3e-3, 10e-3), rigid=True))
        plates.append(Box((x + 1e-3, y, z + side), (8e-3, 4e-3, 3e-3), rigid=True))
    scene, matrices = small_scene(), []
    points = [(x + 3.1e-3, y + 0.4e-3, z), (x + 8.3e-3, y, z)]
    for obstacles in ([cube, air], plates):
        built = Scene(scene.array, scene.medium, 40e3, points, obstacles, domain=scene.domain)
        matrices.append(make_propagator(built, "full", SPACING, STEADY).transfer_matrix())
    assert relative_error(*matrices) < 1e-3  # one body in two descriptions; measured 0
