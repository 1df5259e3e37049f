import copy
import io
import math
import pickle

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from small_scenes import small_scene

from autdtorch.scene.geometry import Plane, circle_points, plane_basis, sphere_points

# Unit vectors are products of a few roundings of numbers up to 1.
ROUNDING = 1e-14

vectors = hnp.arrays(float, 3, elements=st.floats(-2, 2))


@st.composite
def normals(draw):
    normal = draw(vectors)
    assume(np.linalg.norm(normal) > 1e-6)
    return normal


@pytest.mark.parametrize(
    ("normal", "u", "v"),
    [
        ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
        ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
        ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    ],
)
def test_axes_give_the_following_axes(normal, u, v):
    found_u, found_v = plane_basis(normal)
    assert found_u.tolist() == list(u)
    assert found_v.tolist() == list(v)


@given(normal=normals())
def test_basis_is_orthonormal_and_right_handed(normal):
    u, v = plane_basis(normal)
    n = torch.from_numpy(normal / np.linalg.norm(normal))
    torch.testing.assert_close(torch.linalg.cross(u, v), n, rtol=0, atol=ROUNDING)
    basis = torch.stack([u, v, n])
    torch.testing.assert_close(basis @ basis.T, torch.eye(3).double(), rtol=0, atol=ROUNDING)


@given(
    center=vectors,
    radius=st.floats(1e-3, 1),
    count=st.integers(1, 12),
    normal=normals(),
    angle=st.floats(-6, 6),
)
def test_circle_points_are_even_on_the_circle_and_in_its_plane(center, radius, count, normal, angle):
    offsets = circle_points(center, radius, count, normal, angle) - torch.from_numpy(center)
    n = torch.from_numpy(normal / np.linalg.norm(normal))
    assert offsets.shape == (count, 3)
    radii = torch.full((count,), radius, dtype=torch.float64)
    torch.testing.assert_close(offsets.norm(dim=-1), radii, rtol=0, atol=ROUNDING)
    torch.testing.assert_close(offsets @ n, torch.zeros(count).double(), rtol=0, atol=ROUNDING)
    neighbour = offsets.roll(-1, dims=0)
    cosine = (offsets * neighbour).sum(dim=-1) / radius**2
    # Offsets are differences of coordinates up to 2 m: relative to the least radius of 1 mm, 1e-12.
    even = torch.full((count,), math.cos(2 * math.pi / count), dtype=torch.float64)
    torch.testing.assert_close(cosine, even, rtol=0, atol=1e-11)


def test_circle_goes_from_u_towards_v():
    points = circle_points((80e-3, 50e-3, 50e-3), 30e-3, 4, (1, 0, 0))
    expected = [[80, 80, 50], [80, 50, 80], [80, 20, 50], [80, 50, 20]]
    # Decimal millimetres are not exact in binary, nor is cos(pi / 2) zero.
    torch.testing.assert_close(1e3 * points, torch.tensor(expected).double(), rtol=1e-14, atol=0)
    quarter = circle_points((80e-3, 50e-3, 50e-3), 30e-3, 4, (1, 0, 0), angle=math.pi / 2)
    torch.testing.assert_close(quarter, points.roll(-1, dims=0), rtol=0, atol=ROUNDING)


def test_plane_points_are_the_centres_of_its_cells_and_corners_span_its_size():
    plane = Plane(center=(80e-3, 50e-3, 50e-3), normal=(1, 0, 0), size=(40e-3, 20e-3))
    points = 1e3 * plane.points(spacing=10e-3)
    assert points.shape == (4, 2, 3)
    torch.testing.assert_close(points[:, 0, 1], torch.tensor([35, 45, 55, 65]).double(), rtol=1e-14, atol=0)
    torch.testing.assert_close(points[0, :, 2], torch.tensor([45, 55]).double(), rtol=1e-14, atol=0)
    assert (points[..., 0] == 80).all()
    corners = Plane(center=(0.5, 0.5, 0.0), normal=(0, 0, 2), size=(1.0, 0.5)).corners
    assert corners.tolist() == [[0.0, 0.25, 0.0], [0.0, 0.75, 0.0], [1.0, 0.25, 0.0], [1.0, 0.75, 0.0]]
    assert Plane([0, 0, 0], [2, 0, 0], [1, 1]) == Plane((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0))


@given(normal=normals(), center=vectors, spacing=st.floats(0.03, 1))
def test_plane_points_fill_the_plane_symmetrically(normal, center, spacing):
    plane = Plane(center, normal, size=(0.3, 0.1))
    points = plane.points(spacing)
    assert points.shape[:2] == (max(1, round(0.3 / spacing)), max(1, round(0.1 / spacing)))
    torch.testing.assert_close(points.mean(dim=(0, 1)), torch.from_numpy(center), rtol=0, atol=ROUNDING)
    u, v = plane.basis
    offsets = points - torch.from_numpy(center)
    assert (offsets @ u).abs().max() < 0.15
    assert (offsets @ v).abs().max() < 0.05


@pytest.mark.parametrize("name", ["positions", "normals", "control_points"])
def test_numpy_takes_the_coordinates_of_a_scene_as_its_own(name):
    """PyTorch's tensors make NumPy 2 warn, and warnings are errors here."""
    scene = small_scene()
    tensor = scene.control_points if name == "control_points" else getattr(scene.array, name)
    for array, shared in (
        (np.array(tensor), False),
        (np.array(tensor, copy=False), True),
        (np.asarray(tensor), True),
        (np.array(tensor, dtype=np.float32), False),
    ):
        assert np.array_equal(array, tensor.numpy().astype(array.dtype))
        assert np.shares_memory(array, tensor.numpy()) is shared
    with pytest.raises(ValueError, match="copy"):
        np.array(tensor, dtype=np.float32, copy=False)
    assert type(tensor + 0) is torch.Tensor
    for other in (copy.deepcopy(tensor), pickle.loads(pickle.dumps(tensor)), stored(tensor)):
        assert torch.equal(other, tensor)
        assert not np.shares_memory(other.numpy(), tensor.numpy())


def stored(tensor):
    file = io.BytesIO()
    torch.save(tensor, file)
    file.seek(0)
    return torch.load(file)


@pytest.mark.parametrize("count", [1, 2, 7, 200])
def test_sphere_points_are_even_on_the_sphere(count):
    offsets = sphere_points((1e-2, 2e-2, 3e-2), 5e-3, count) - torch.tensor(
        [1e-2, 2e-2, 3e-2], dtype=torch.float64
    )
    assert offsets.norm(dim=1).tolist() == pytest.approx([5e-3] * count, rel=1e-12)
    if count == 200:
        # A hexagonal lattice of as many points has distances of 1.07 times the root of the area of each.
        apart = torch.pdist(offsets).min() / (5e-3 * math.sqrt(4 * math.pi / count))
        assert 0.8 < apart < 1.08
        assert offsets.mean(dim=0).norm() < 0.01 * 5e-3
