"""Distances from meshes are exact, whatever the triangles and the order of the points."""

import numpy as np
import pytest
import pyvista
import torch

import autdtorch as at
from autdtorch.scene.obstacles.mesh_distance import MeshDistance

ROUNDING = 1e-13  # of coordinates of size 1, a hundred times what is measured
SLENDER = {"cube": (1.0, 1.0, 1.0), "sheet": (1.0, 1.0, 1e-5), "needle": (1e-5, 1e-5, 1.0)}


def points_around(extents: tuple[float, float, float], count: int = 500) -> torch.Tensor:
    """Return points of all distances from a cuboid: in and around it, next to its faces and its edges."""
    random = np.random.default_rng(0)
    whole = random.uniform(-1, 1, (count, 3))
    beside = random.uniform(-0.5, 0.5, (count, 3))
    for axis in (0, 1):
        beside[axis * count // 2 :, axis] = random.choice((-0.5, 0.5), count - axis * count // 2)
    beside = beside * extents + random.choice((1e-9, 1e-6, 1e-3), (count, 1)) * random.normal(size=(count, 3))
    return torch.from_numpy(np.concatenate((whole, beside)))


@pytest.mark.parametrize("extents", SLENDER.values(), ids=SLENDER)
def test_distances_from_cuboids_are_exact(extents):
    box = at.Box((0, 0, 0), extents, rigid=True)
    vertices, faces = (part.numpy() for part in box.surface())
    points = points_around(extents)
    distance = MeshDistance(vertices, faces)(points.numpy())
    np.testing.assert_allclose(distance, box.signed_distance(points), rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("offset", [(1.0, 1.0, 0.0), (1.0, 1.0, 1.0)], ids=["edge", "corner"])
def test_bodies_that_touch_have_the_distance_of_the_nearer_one(offset):
    boxes = at.Box((0, 0, 0), (1, 1, 1), rigid=True), at.Box(offset, (1, 1, 1), rigid=True)
    surfaces = [[part.numpy() for part in box.surface()] for box in boxes]
    vertices = np.concatenate([vertices for vertices, _ in surfaces])
    mesh = at.Mesh.from_surface((vertices, np.concatenate([surfaces[0][1], 8 + surfaces[1][1]])), rigid=True)
    points = points_around((1.0, 1.0, 1.0)) + torch.tensor(offset) / 2
    nearer = torch.minimum(*(box.signed_distance(points) for box in boxes))
    torch.testing.assert_close(mesh.signed_distance(points), nearer, rtol=0, atol=ROUNDING)


def test_the_order_of_the_points_does_not_matter():
    mesh = pyvista.Icosphere(nsub=4)
    mesh.points = mesh.points * (1 + 0.5 * np.sin(5 * mesh.points[:, :1]))
    distance = MeshDistance(np.asarray(mesh.points, np.float64), mesh.regular_faces.astype(np.int64))
    along = np.linspace(-1.5, 1.5, 20)
    points = np.stack(np.meshgrid(along, along, along, indexing="ij"), axis=-1).reshape(-1, 3)
    order = np.random.default_rng(0).permutation(len(points))
    alone = np.concatenate([distance(point[None]) for point in points[:50]])
    together = distance(points)
    np.testing.assert_allclose(distance(points[order]), together[order], rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(alone, together[:50], rtol=0, atol=ROUNDING)


def test_no_points_have_no_distances():
    box = at.Box((0, 0, 0), (1, 1, 1), rigid=True)
    assert MeshDistance(*(part.numpy() for part in box.surface()))(np.zeros((0, 3))).shape == (0,)


WEDGE = [[0, 1, 2], [3, 5, 4], [0, 3, 4], [0, 4, 1], [0, 2, 5], [1, 4, 5], [1, 5, 2]]  # and 0, 5, 3


@pytest.mark.parametrize("height", [0.0, 1e-13, 1e-9])
def test_slivers_that_rounding_has_turned_over_leave_points_outside(height):
    corners = [(x, y, z) for z in (0.0, 1.0) for x, y in ((0.0, 0.0), (1.0, 0.05), (1.0, -0.05))]
    vertices = np.array([*corners, (-height, 0.3 * height, 0.4)])  # one at the edge, for the lower face alone
    wedge = MeshDistance(vertices[:6], np.array([*WEDGE, [0, 5, 3]]))
    divided = MeshDistance(vertices, np.array([*WEDGE, [3, 6, 5], [6, 0, 5], [3, 0, 6]]))
    points = np.random.default_rng(0).uniform(-0.3, 1.3, (2000, 3)) * (1.0, 0.3, 1.0)
    np.testing.assert_allclose(divided(points), wedge(points), rtol=0, atol=2 * height + ROUNDING)


def test_slivers_that_single_precision_has_turned_over_far_from_the_origin_leave_points_outside():
    corners = [(x, y, z) for z in (0.0, 1.0) for x, y in ((0.0, 0.0), (1.0, 0.05), (1.0, -0.05))]
    wedge = MeshDistance(np.array(corners), np.array([*WEDGE, [0, 5, 3]]))
    random = np.random.default_rng(0)
    points = random.uniform(-0.3, 1.3, (500, 3)) * (1.0, 0.3, 1.0)
    for share in random.uniform(0.1, 0.9, 20):
        turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
        turn *= np.linalg.det(turn)
        vertices = np.array([*corners, (0.0, 0.0, share)]) @ turn.T + 100
        rounded = vertices.astype(np.float32).astype(np.float64)
        divided = MeshDistance(rounded, np.array([*WEDGE, [3, 6, 5], [6, 0, 5], [3, 0, 6]]))
        # vertices are off by up to 4e-6 along each axis
        np.testing.assert_allclose(divided(points @ turn.T + 100), wedge(points), rtol=0, atol=2e-5)


@pytest.mark.parametrize("height", [1e-15, 1e-12, 1e-9, 1e-6])
def test_points_on_slivers_are_as_near_as_their_sides(height):
    random = np.random.default_rng(0)
    first, second, aside = random.normal(size=(3, 50, 3))
    third = first + random.uniform(size=(50, 1)) * (second - first) + height * aside
    corners = np.stack((first, second, third), axis=1)
    points = (random.dirichlet((1, 1, 1), 50)[:, :, None] * corners).sum(axis=1)
    distance = MeshDistance(corners.reshape(-1, 3), np.arange(150).reshape(-1, 3))(points)
    assert np.abs(distance).max() < height + ROUNDING
