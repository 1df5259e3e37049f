"""Signed distances to meshes, and where the solver asks for them."""

from dataclasses import replace

import igl
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from autdtorch.fdtd.assembly.element import LATTICE
from autdtorch.fdtd.assembly.elements import HALF_DIAGONAL, lattice_distances, near_surface
from autdtorch.scene.obstacles import Box, Mesh, Sphere
from autdtorch.scene.obstacles.mesh import MeshDistance

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


def test_parts_that_touch_at_an_edge_know_their_insides():
    vertices, faces = (part.numpy() for part in CUBOID.surface())
    beside = vertices + np.array([2.0, 3.0, 0.0])
    mesh = Mesh.from_surface(
        (np.concatenate((vertices, beside)), np.concatenate((faces, faces + 8))), rigid=True
    )
    points = np.random.default_rng(1).uniform(-3, 6, (2000, 3))
    bodies = [CUBOID, replace(CUBOID, center=(2.0, 3.0, 0.0))]
    nearest = torch.stack([body.signed_distance(points) for body in bodies]).amin(dim=0)
    assert torch.allclose(mesh.signed_distance(points), nearest, rtol=0, atol=1e-12)


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
