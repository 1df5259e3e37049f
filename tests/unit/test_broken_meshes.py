"""Meshes with faults, which become the solid they stand for or are refused; signed distances to meshes."""

from dataclasses import replace

import igl
import numpy as np
import pytest
import pyvista as pv
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from small_meshes import CUBE, ball, box, inverted, merged, tube, volume

from autdtorch.fdtd.assembly.edges import edges_of
from autdtorch.fdtd.assembly.near_surface import HALF_DIAGONAL, lattice_distances, near_surface
from autdtorch.fdtd.assembly.reference_element import LATTICE
from autdtorch.scene.obstacles import Box, Mesh, Sphere, VoxelMask
from autdtorch.scene.obstacles.mesh_distance import MeshDistance


def solid(lower, upper):
    return Box((np.array(lower) + upper) / 2, np.array(upper, float) - lower, rigid=True)


def with_faces(part, change):
    return part[0], np.array(change(part[1].tolist()))


def figure_eight():
    turn = np.linspace(0, 2 * np.pi, 61)[:-1] + 0.02
    return tube(np.stack([2 * np.sin(turn), np.sin(2 * turn), 0 * turn], axis=1))


def moebius():
    turn = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    out = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)
    along = np.cos(turn / 2)[:, None] * out + np.sin(turn / 2)[:, None] * np.array([0.0, 0.0, 1.0])
    vertices = np.concatenate([2 * out - 0.5 * along, 2 * out + 0.5 * along])
    faces = []
    for here in range(40):
        last = here == 39
        below, above = here, here + 40
        right, top = (40, 0) if last else (here + 1, here + 41)
        faces += [[below, right, top], [below, top, above]]
    return vertices, np.array(faces)


FAR = box((3, 0, 0), (4, 1, 1))


def split_edge(close):
    """A cube with a vertex amid an edge of one triangle, open or closed by a collinear triangle."""
    vertices, faces = CUBE
    first, second, third = faces[0]
    middle = (vertices[first] + vertices[second]) / 2
    rest = [[first, 8, third], [8, second, third]] + ([[first, second, 8]] if close else [])
    return np.vstack([vertices, middle]), np.vstack([faces[1:], rest])


def fin(double):
    """A cube with a triangle of no thickness inside, along a diagonal."""
    faces = CUBE[1].tolist()
    extra = [[0, 1, 7], [0, 7, 1]] if double else [[0, 1, 7]]
    return CUBE[0], np.array(faces + extra)


ONE, OTHER = ((0, 0, 0), (1, 1, 1)), ((0.5, 0.25, 0.25), (2, 0.75, 0.75))
FLUSH = ((0.5, 0, 0), (1.5, 1, 1))
SHARED_EDGE = ((1, 1, 0), (2, 2, 1))
SHARED_FACE = ((1, 0, 0), (2, 1, 1))
SHARED_VERTEX = ((1, 1, 1), (2, 2, 2))
INNER = ((0.25, 0.25, 0.25), (0.75, 0.75, 0.75))
SMALL = ((0.25, 0.25, 1.0), (0.75, 0.75, 2.0))  # stands on the cube, without common vertices

EIGHT = figure_eight()
SHEET = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
SHAFT = ((0.4, 0.4, -1.0), (0.6, 0.6, 2.0))  # through the cube and its cavity

RIGHT = {  # vertices and triangles, the boxes that they stand for, and their volume
    "inside out": (inverted(CUBE), [ONE], 1.0),
    "vertices of no triangle": ((np.vstack([CUBE[0], [[9.0, 9.0, 9.0]]]), CUBE[1]), [ONE], 1.0),
    "separate vertices": ((CUBE[0][CUBE[1]].reshape(-1, 3), np.arange(36).reshape(12, 3)), [ONE], 1.0),
    "a triangle of one point": (with_faces(CUBE, lambda faces: [*faces, [3, 3, 3]]), [ONE], 1.0),
    "a triangle of two points": (with_faces(CUBE, lambda faces: [*faces, [3, 4, 3]]), [ONE], 1.0),
    "a triangle of collinear points": (split_edge(close=True), [ONE], 1.0),
    "a fin of two sides": (fin(double=True), [ONE], 1.0),
    "a fin outside": ((np.vstack([CUBE[0], [[2.0, 0, 0]]]), [*CUBE[1], [0, 1, 8], [0, 8, 1]]), [ONE], 1.0),
    "every triangle twice": ((CUBE[0], np.repeat(CUBE[1], 2, axis=0)), [ONE], 1.0),
    "a part twice": (merged(CUBE, CUBE), [ONE], 1.0),
    "parts apart": (merged(CUBE, FAR), [ONE, ((3, 0, 0), (4, 1, 1))], 2.0),
    "overlapping cubes": (merged(CUBE, box(*OTHER)), [ONE, OTHER], 1.25),
    "overlapping flush cubes": (merged(CUBE, box(*FLUSH)), [ONE, FLUSH], 1.5),
    "three overlapping cubes": (merged(CUBE, box(*FLUSH), box(*OTHER)), [ONE, FLUSH, OTHER], 1.625),
    "cubes with a common edge": (merged(CUBE, box(*SHARED_EDGE)), [ONE, SHARED_EDGE], 2.0),
    "cubes with a common vertex": (merged(CUBE, box(*SHARED_VERTEX)), [ONE, SHARED_VERTEX], 2.0),
    "cubes with a common face": (merged(CUBE, box(*SHARED_FACE)), [ONE, SHARED_FACE], 2.0),
    "cubes that touch": (merged(CUBE, box(*SMALL)), [ONE, SMALL], 1.25),
    "a part within another": (merged(CUBE, box(*INNER)), [ONE], 1.0),
    "huge coordinates": ((1e45 * CUBE[0], CUBE[1]), [((0, 0, 0), (1e45,) * 3)], 1e135),
    "tiny and far away": ((1e-6 * CUBE[0] + 1.0, CUBE[1]), [((1, 1, 1), (1 + 1e-6,) * 3)], 1e-18),
    "quadrilaterals": (pv.Cube(center=(0.5, 0.5, 0.5)), [ONE], 1.0),
}

REFUSED = {  # vertices and triangles, the reason, the place
    "a hole": (with_faces(CUBE, lambda faces: faces[2:]), "watertight", "(0, 0, 0) to (0, 0, 1)"),
    "a missing triangle": (with_faces(FAR, lambda faces: faces[1:]), "watertight", "(3, 0, 0) to (3, 0, 1)"),
    "a triangle turned over": (
        with_faces(FAR, lambda faces: [faces[0][::-1], *faces[1:]]), "turned over", "(3, 0, 0) to (3, 0, 1)",
    ),
    "one triangle twice": (
        with_faces(FAR, lambda faces: [faces[0], *faces]), "watertight", "(3, 0, 0) to (3, 0, 1)",
    ),
    "a T-junction": (split_edge(close=False), "watertight", "(0, 0, 0) to (0, 0, 0.5)"),
    "a fin of one side": (fin(double=False), "watertight", "(0, 0, 0) to (0, 0, 1)"),
    "a Moebius strip": (moebius(), "watertight", "(-2.01412, -0.319006, -0.498459)"),
    "a part inside out": (
        merged(CUBE, inverted(box((3, 0, 0), (3.5, 0.5, 0.5)))), "inside out", "(3, 0, 0) to (3.5, 0.5, 0.5)",
    ),
    "a cavity that leaves its body": (
        merged(box((0, 0, 0), (2, 2, 2)), inverted(box((0.5, 0.5, 0.5), (2.25, 1, 1)))),
        "inside out", "(2, 0.5, 0.5) to (2.25, 1, 1)",
    ),
    "a tube in the shape of an eight": (EIGHT, "crosses itself", "0.141131, 0.173205)"),
    "a vertex that is not a number": (
        (np.vstack([CUBE[0][:-1], [[np.nan, 1, 1]]]), CUBE[1]), "finite", "vertices[7, 0]",
    ),
    "a vertex too far away": ((1e60 * CUBE[0], CUBE[1]), "1e+50", "vertex 1 at (0, 0, 1e+60)"),
    "an index too large": ((CUBE[0], [*CUBE[1], [0, 1, 8]]), "8 vertices", "triangle 12 of vertices 0, 1, 8"),
    "an index below 0": ((CUBE[0], [*CUBE[1], [0, 1, -1]]), "8 vertices", "triangle 12 of vertices 0, 1, -1"),
    "an index beyond all": ((CUBE[0], [*CUBE[1], [0, 1, 1e300]]), "8 vertices", "triangle 12 of vertices"),
    "an index between two": ((CUBE[0], CUBE[1] + 0.5), "whole numbers", "Mesh.surface"),
    "two sides of a sheet": (
        (SHEET, [[0, 1, 2], [0, 2, 1]]), "must enclose a volume", "(0, 0, 0) to (1, 1, 0)",
    ),
    "two sides of a sheet, cut in different ways": (
        (SHEET, [[0, 1, 2], [0, 2, 3], [1, 0, 3], [1, 3, 2]]), "volume", "(0, 0, 0) to (1, 1, 0)",
    ),
    "no triangles": ((CUBE[0], np.zeros((0, 3))), "triangles", "(0, 3)"),
    "faces of four vertices": ((CUBE[0], np.zeros((6, 4))), "triangles", "(6, 4)"),
    "no pair": (CUBE[0], "PyVista", "Mesh.surface"),
}  # fmt: skip


def points_around(mesh, count=4000):
    lower, upper = torch.tensor([mesh.lower, mesh.upper], dtype=torch.float64)
    share = torch.from_numpy(np.random.default_rng(0).uniform(-0.3, 1.3, (count, 3)))
    return lower + share * (upper - lower).max()


@pytest.mark.parametrize("name", RIGHT)
def test_a_fault_that_leaves_one_solid_is_mended(name):
    surface, boxes, expected = RIGHT[name]
    mesh = Mesh.from_surface(surface, rigid=True)
    assert volume(mesh) == pytest.approx(expected, rel=1e-9)
    corners = np.array(boxes)
    assert mesh.lower == pytest.approx(corners[:, 0].min(axis=0))
    assert mesh.upper == pytest.approx(corners[:, 1].max(axis=0))
    points = points_around(mesh)
    exact = torch.stack([solid(*each).signed_distance(points) for each in boxes]).amin(dim=0)
    off = (mesh.signed_distance(points) - exact) / max(np.subtract(mesh.upper, mesh.lower))
    outside = exact > 0
    assert off[outside].abs().max() < 1e-9
    assert off[~outside].max() < 1e-9  # a union is deeper than each of its parts
    assert torch.equal(mesh.signed_distance(points) > 0, outside)


@pytest.mark.parametrize("noise", [3e-16, 1e-9, 1e-7, 3e-6])
def test_vertices_that_differ_by_rounding_are_one(noise):
    corners = CUBE[0][CUBE[1]].reshape(-1, 3)
    moved = corners + noise * np.random.default_rng(0).uniform(-1, 1, corners.shape)
    mesh = Mesh.from_surface((moved, np.arange(36).reshape(12, 3)), rigid=True)
    assert len(mesh.vertices) == 8
    assert volume(mesh) == pytest.approx(1, abs=6 * noise)


NO_TRIANGLES = [
    name for name in REFUSED if name.startswith(("an index", "a vertex", "no triangles", "faces of"))
]


@pytest.mark.parametrize(
    ("name", "repair"), [*((name, False) for name in REFUSED), *((name, True) for name in NO_TRIANGLES)]
)
def test_another_fault_is_refused_with_its_reason_and_its_place(name, repair):
    surface, reason, place = REFUSED[name]
    with pytest.raises(ValueError, match=r"^Mesh\.surface: ") as caught:
        Mesh.from_surface(surface, rigid=True, repair=repair)
    assert reason in str(caught.value)
    assert place in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_cavity_stays_one_and_parts_may_lie_in_it_and_cross_it():
    hollow = [box((0, 0, 0), (1, 1, 1)), inverted(box((0.1, 0.1, 0.1), (0.9, 0.9, 0.9)))]
    assert volume(Mesh.from_surface(merged(*hollow), rigid=True)) == pytest.approx(1 - 0.512)
    filled = Mesh.from_surface(merged(*hollow, box(*INNER)), rigid=True)
    assert volume(filled) == pytest.approx(1 - 0.512 + 0.125)
    inside = filled.contains([[0.5, 0.5, 0.5], [0.15, 0.5, 0.5], [0.05, 0.5, 0.5]])
    assert inside.tolist() == [True, False, True]
    crossed = Mesh.from_surface(merged(*hollow, box(*SHAFT)), rigid=True)
    assert volume(crossed) == pytest.approx(1 - 0.512 + 0.04 * (2 + 0.8))
    inside = crossed.contains([[0.5, 0.5, 0.5], [0.2, 0.5, 0.5], [0.5, 0.5, -0.9]])
    assert inside.tolist() == [True, False, True]


def test_merged_spheres_have_the_surface_of_their_union():
    centers, radius = (np.zeros(3), np.array([0.9, 0.1, 0.05])), 1.0
    mesh = Mesh.from_surface(merged(*(ball(center, radius, 4) for center in centers)), rigid=True)
    points = points_around(mesh)
    exact = torch.stack([Sphere(tuple(c), radius, rigid=True).signed_distance(points) for c in centers])
    exact = exact.amin(dim=0)
    outside = exact > 0
    off = mesh.signed_distance(points) - exact
    assert off[outside].abs().max() < 3e-3  # facets are up to 0.26 % inside the sphere
    assert off[~outside].max() < 3e-3
    vertices = mesh.vertices
    inside = torch.stack([Sphere(tuple(c), radius, rigid=True).signed_distance(vertices) for c in centers])
    assert inside.amin(dim=0).min() > -3e-3  # no triangle of one sphere within the other


def test_the_edges_of_overlapping_parts_are_those_of_their_union():
    for surface, length in ((merged(CUBE, box(*FLUSH)), 14.0), (merged(CUBE, CUBE), 12.0), (CUBE, 12.0)):
        edges = edges_of(Mesh.from_surface(surface, rigid=True))
        assert sum(np.linalg.norm(edge.end - edge.begin) for edge in edges) == pytest.approx(length)


def test_parts_that_touch_at_edges_and_sharp_edges_keep_their_insides():
    # A face of voxels is one of four at an edge, which belong together in two ways.
    for seed in range(8):
        mask = np.random.default_rng(seed).random((4, 4, 4)) < 0.5
        voxels = VoxelMask(mask, 1.0, smooth=False, rigid=True)
        mesh = Mesh.from_surface(voxels.surface(), rigid=True)
        points = points_around(mesh, 1000)
        assert torch.equal(mesh.contains(points), voxels.contains(points))
    # Pseudonormals of its four triangles take some of these points for inside.
    for seed in range(40):
        random = np.random.default_rng(seed)
        corners = random.normal(size=(4, 3))
        faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        points = random.normal(size=(2000, 3))
        shares = np.linalg.solve((corners[1:] - corners[0]).T, (points - corners[0]).T)
        inside = (shares > 0).all(axis=0) & (shares.sum(axis=0) < 1)
        assert (Mesh.from_surface((corners, faces), rigid=True).contains(points).numpy() == inside).all()


def test_more_crossings_than_a_union_can_take_are_refused():
    random = np.random.default_rng(0)
    corners = random.normal(size=(1000, 4, 3))
    inverted = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
    corners[inverted] = corners[inverted][:, [1, 0, 2, 3]]
    faces = 4 * np.arange(1000)[:, None, None] + np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    with pytest.raises(ValueError, match=r"fewer places"):
        Mesh.from_surface((corners.reshape(-1, 3), faces.reshape(-1, 3)), rigid=True)


def test_a_pyvista_surface_is_that_of_its_arrays():
    sphere = pv.Sphere(radius=0.7, center=(1, 2, 3))
    mesh = Mesh.from_surface(sphere, scale=2.0, offset=(1, 0, 0), rigid=True)
    assert mesh == Mesh.from_surface((sphere.points, sphere.regular_faces), 2.0, (1, 0, 0), rigid=True)
    assert volume(mesh) == pytest.approx(8 * sphere.volume, rel=1e-6)
    assert mesh.path == ""


CUBOID = Box((0, 0, 0), (2.0, 3.0, 1.0), rigid=True)


def star(random):
    """Return vertices and triangles of a body with sharp points and deep folds around the origin."""
    vertices = random.normal(size=(40, 3))
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    faces = ConvexHull(vertices).simplices.astype(np.int64)
    corners = vertices[faces]
    faces[np.linalg.det(corners) < 0] = faces[np.linalg.det(corners) < 0][:, ::-1]
    return vertices * random.uniform(0.15, 1.5, (40, 1)), faces


@settings(max_examples=30)
@given(st.integers(0, 10**6))
def test_normals_and_winding_numbers_agree_on_the_inside(seed):
    random = np.random.default_rng(seed)
    vertices, faces = star(random)
    points = random.uniform(-1.5, 1.5, (500, 3))
    distance, winding = MeshDistance(vertices, faces)(points), igl.winding_number(vertices, faces, points)
    assert ((distance < 0) == (winding > 0.5)).all()


@given(
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.floats(1e-3, 1e3),
    st.integers(0, 10**6),
)
def test_a_moved_mesh_is_as_far_as_the_body_itself(offset, rotation, scale, seed):
    points = torch.from_numpy(np.random.default_rng(seed).uniform(-4, 4, (50, 3))) + torch.tensor(offset)
    vertices, faces = CUBOID.surface()
    mesh = Mesh.from_surface((vertices / scale, faces), rigid=True)
    mesh = replace(mesh, scale=scale, offset=offset, rotation=rotation)
    body = Box(offset, CUBOID.size, rotation, rigid=True)
    # both are exact; rounding of coordinates up to 10
    assert torch.allclose(mesh.signed_distance(points), body.signed_distance(points), rtol=0, atol=1e-12)


BODIES = {
    "sphere": Sphere((17.3, 15.1, 16.2), 9.4, rigid=True),
    "plate": Box((16.2, 15.7, 16.1), (25.0, 0.6, 22.0), (0.3, 0.1, 0.2), rigid=True),
    "cube": Box((16.2, 15.7, 16.1), (13.0, 12.0, 11.0), (0.5, 0.4, 0.3), rigid=True),
}


@pytest.mark.parametrize("body", BODIES.values(), ids=BODIES.keys())
def test_no_element_is_missed_and_distances_at_its_lattice_are_right(body):
    def measure(cells):
        return body.signed_distance(cells).numpy()

    near, far, inside = near_surface(measure, np.array([1, 0, 2]), np.array([33, 31, 30]))
    every = np.stack(np.meshgrid(np.arange(1, 33), np.arange(31), np.arange(2, 30), indexing="ij"), -1)
    every = every.reshape(-1, 3)
    exact = measure(every + 0.5)
    assert np.allclose(far, measure(near + 0.5))

    def places(cells):
        return set(map(tuple, cells.tolist()))

    assert places(every[np.abs(exact) < HALF_DIAGONAL]) <= places(near)
    assert places(every[exact < 0]) == places(near[far < 0]) | places(inside)
    assert len(near) < len(every) / 2
    first = near[np.abs(far) < HALF_DIAGONAL]
    found, right = lattice_distances(measure, first), measure(first[:, None] + LATTICE)
    # where a quadratic function fits to 0.01 cells, distances are interpolated
    assert np.abs(found - right).max() < 0.02
