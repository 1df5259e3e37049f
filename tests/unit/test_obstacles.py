"""Obstacles of every kind: inside, distance and surface agree with each other and with exact solutions."""

import math
import pickle
from dataclasses import replace

import igl
import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.obstacles import Box, Cylinder, Mesh, Sphere, VoxelMask
from autdtorch.scene.obstacles.moving import at_rest, circumscribed, moved
from autdtorch.scene.obstacles.voxel_surface import ThinError, VoxelSurface

CENTER, TURN = (0.4, -0.2, 0.1), (0.5, -0.3, 2.0)
BOX = Box(CENTER, (1.0, 0.6, 0.4), rotation=TURN, rigid=True)
SPHERE = Sphere(CENTER, 0.7, rigid=True)
CYLINDER = Cylinder(CENTER, 0.5, 1.2, axis=(1, -2, 0.5), rigid=True)
PRIMITIVES = pytest.mark.parametrize("shape", [BOX, SPHERE, CYLINDER], ids=lambda shape: type(shape).__name__)

# The 48 x 24 facets of a sphere reach 3.75 degrees each way: this share of the radius inside at most.
SAGITTA = 1 - math.cos(math.radians(math.hypot(3.75, 3.75)))


def saved(folder, name, vertices, faces):
    igl.write_triangle_mesh(str(folder / name), np.asarray(vertices), np.ascontiguousarray(faces))
    return folder / name


def cloud(count=2000, spread=1.5, seed=0):
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * spread


def volume(vertices, faces):
    return float(torch.linalg.det(vertices[faces]).sum() / 6)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("meshes")


@pytest.fixture(scope="module")
def box_mesh(folder):
    return Mesh(saved(folder, "box.obj", *Box(CENTER, (1.0, 0.6, 0.4), rigid=True).surface()), rigid=True)


@PRIMITIVES
@given(st.tuples(*[st.floats(-2, 2)] * 3))
def test_the_gradient_leads_back_to_the_nearest_point_of_the_surface(shape, point):
    # Outside a convex body the distance has a gradient everywhere: of length 1, away from the nearest point.
    points = torch.tensor([point], dtype=torch.float64, requires_grad=True)
    distance = shape.signed_distance(points)
    assume(distance.item() > 1e-3)
    (gradient,) = torch.autograd.grad(distance.sum(), points)
    assert torch.linalg.vector_norm(gradient).item() == pytest.approx(1.0, abs=1e-12)
    nearest = points.detach() - distance.detach()[:, None] * gradient
    assert shape.signed_distance(nearest).abs().item() < 1e-11  # rounding, 1e-14, over the shortest distance


@PRIMITIVES
def test_distance_inside_is_that_to_the_nearest_of_many_points_of_the_surface(shape):
    inside = cloud(4000, 0.4)[shape.contains(cloud(4000, 0.4))]
    vertices, faces = shape.surface()
    weights = torch.distributions.Dirichlet(torch.ones(3, dtype=torch.float64))
    torch.manual_seed(0)
    corners = vertices[faces].repeat(max(1, 40000 // len(faces)), 1, 1)
    surface = (weights.sample((len(corners),))[..., None] * corners).sum(dim=1)
    nearest = torch.cdist(inside[:200], surface).amin(dim=1)
    # The samples are some 0.02 apart, and facets up to 0.5 % of the radius inside.
    torch.testing.assert_close(-shape.signed_distance(inside[:200]), nearest, rtol=0, atol=0.02)


@PRIMITIVES
def test_inside_is_where_the_distance_is_negative(shape):
    points = cloud()
    distance = shape.signed_distance(points)
    assert torch.equal(shape.contains(points), distance < 0)
    assert shape.contains(points[distance < 0.1], margin=0.1).all()
    assert shape.signed_distance(points.reshape(20, 100, 3)).shape == (20, 100)
    assert shape.signed_distance(np.zeros((0, 3))).shape == (0,)


@PRIMITIVES
def test_surface_is_on_the_obstacle_and_spans_its_bounding_box(shape):
    vertices, faces = shape.surface()
    on_edges = vertices[faces].roll(1, dims=1).lerp(vertices[faces], 0.5).reshape(-1, 3)
    assert shape.signed_distance(vertices).abs().max() < 1e-14
    assert shape.signed_distance(on_edges).max() < 1e-14  # convex: chords are inside
    lower, upper = vertices.new_tensor(shape.lower), vertices.new_tensor(shape.upper)
    assert (vertices >= lower - 1e-14).all()
    assert (vertices <= upper + 1e-14).all()
    # Corners of a 48-gon miss the outermost point of a circle by at most 1 - cos(3.75 degrees) of the radius.
    slack = 0.7 * (1 - math.cos(math.radians(3.75)))
    torch.testing.assert_close(vertices.amin(dim=0), lower, rtol=0, atol=slack)
    torch.testing.assert_close(vertices.amax(dim=0), upper, rtol=0, atol=slack)


def test_surfaces_enclose_the_volume_and_face_outwards(box_mesh):
    assert volume(*BOX.surface()) == pytest.approx(0.24, rel=1e-12)
    assert volume(*box_mesh.surface()) == pytest.approx(0.24, rel=1e-12)
    polygon = 24 * math.sin(math.radians(7.5)) / math.pi  # area of the 48-gon over the area of its circle
    assert volume(*CYLINDER.surface()) == pytest.approx(math.pi * 0.5**2 * 1.2 * polygon, rel=1e-12)
    assert volume(*SPHERE.surface()) == pytest.approx(4 / 3 * math.pi * 0.7**3, rel=3 * SAGITTA)
    mask = np.random.default_rng(0).random((5, 4, 3)) < 0.5
    cubes = VoxelMask(mask, 0.5, smooth=False, rigid=True)
    assert volume(*cubes.surface()) == pytest.approx(mask.sum() * 0.5**3, rel=1e-12)
    smooth = VoxelMask(mask, 0.5, rigid=True)
    assert volume(*smooth.surface()) == pytest.approx(mask.sum() * 0.5**3, rel=1e-6)  # found in steps


def test_rotations_are_about_fixed_axes_x_first():
    x, y, z = torch.eye(3, dtype=torch.float64)
    quarter = math.pi / 2
    torch.testing.assert_close(rotation_matrix((0, 0, quarter)) @ x, y)
    torch.testing.assert_close(rotation_matrix((quarter, 0, 0)) @ y, z)
    torch.testing.assert_close(rotation_matrix((0, quarter, 0)) @ z, x)
    # y to z about x, and there it stays
    torch.testing.assert_close(rotation_matrix((quarter, 0, quarter)) @ y, z)


@pytest.mark.parametrize("suffix", ["obj", "ply", "STL"])
def test_mesh_of_a_sphere_is_nearly_the_sphere(folder, suffix):
    # libigl writes STL as text, in double precision; it takes the format from the suffix in lower case.
    path = saved(folder, f"sphere.{suffix.lower()}", *SPHERE.surface())
    mesh = Mesh(path.rename(path.with_suffix(f".{suffix}")), rigid=True)
    assert len(mesh.vertices) == 2 + 23 * 48
    points = cloud()
    off = mesh.signed_distance(points) - SPHERE.signed_distance(points)
    assert off.min() > -1e-5  # facets are inside the sphere; the file rounds
    assert off.max() < 0.7 * SAGITTA + 1e-5


def test_meshes_and_masks_are_equal_by_content(folder, box_mesh):
    again = Mesh(saved(folder, "copy.obj", *box_mesh.surface()), rigid=True)
    assert again == box_mesh
    assert hash(again) == hash(box_mesh)
    assert Mesh(again.path, scale=2.0, rigid=True) != box_mesh
    assert Mesh(again.path, density=1.0, sound_speed=1.0) != box_mesh
    mask = np.ones((2, 2, 2), bool)
    assert VoxelMask(mask, 1.0, rigid=True) == VoxelMask(torch.tensor(mask), 1.0, rigid=True)
    voxels = VoxelMask(mask, 1.0, rigid=True)
    mask[0, 0, 0] = False
    assert VoxelMask(mask, 1.0, rigid=True) != voxels
    assert voxels.mask.all()  # its own copy
    with pytest.raises(ValueError, match="read-only"):
        voxels.mask[0, 0, 0] = False


def test_mesh_and_mask_survive_pickling_without_their_files(folder, box_mesh):
    path = saved(folder, "gone.obj", *box_mesh.surface())
    mesh = Mesh(path, rigid=True)
    mesh.signed_distance(cloud())  # its search structures are left out
    packed = pickle.dumps((mesh, VoxelMask(np.ones((2, 3, 4), bool), 0.1, smooth=False, rigid=True)))
    path.unlink()
    mesh, voxels = pickle.loads(packed)
    torch.testing.assert_close(mesh.signed_distance(cloud()), box_mesh.signed_distance(cloud()))
    assert voxels.upper == pytest.approx((0.2, 0.3, 0.4))


def test_a_mesh_is_moved_rescaled_and_changed_without_its_file(folder, box_mesh):
    path = saved(folder, "read_once.obj", *box_mesh.surface())
    mesh = Mesh(path, density=1.0, sound_speed=1.0)
    path.unlink()
    moved = replace(mesh, scale=2.0, offset=(1.0, 0.0, 0.0), density=3.0)
    expected = 2 * mesh.vertices + torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(moved.vertices, expected, rtol=1e-14, atol=0)
    assert (moved.path, moved.density) == (str(path), 3.0)
    with pytest.raises(ValueError, match=r"Mesh\.path: .*nowhere\.obj"):
        replace(mesh, path="nowhere.obj")


def test_voxels_that_fill_a_box_are_that_box():
    spacing, mask = 0.05, np.zeros((14, 12, 16), bool)
    mask[2:12, 3:9, 4:8] = True
    voxels = VoxelMask(mask, spacing, origin=(1.0, 2.0, 3.0), smooth=False, rigid=True)
    box = Box((1.35, 2.3, 3.3), (0.5, 0.3, 0.2), rigid=True)
    assert (voxels.lower, voxels.upper) == (pytest.approx(box.lower), pytest.approx(box.upper))
    points = torch.tensor(box.center, dtype=torch.float64) + cloud(4000, 0.3)
    assert torch.equal(voxels.contains(points), box.contains(points))
    # Farthest off at a corner, between 8 voxels: 1 in the body and, outside, 3 off its faces, 3 off its
    # edges and 1 off its corner.
    off = voxels.signed_distance(points) - box.signed_distance(points)
    assert off.abs().max() < (-0.5 + 3 * 0.5 + 3 * 0.5**0.5 + 0.75**0.5) / 8 * spacing
    middle = torch.tensor([1.35, 2.3, 0], dtype=torch.float64)
    along = middle + torch.linspace(3.33, 3.6, 50, dtype=torch.float64)[:, None] * torch.tensor([0, 0, 1.0])
    torch.testing.assert_close(voxels.signed_distance(along), box.signed_distance(along), rtol=0, atol=1e-12)


ANGLES = st.tuples(*[st.floats(-3, 3)] * 3)


@given(ANGLES, ANGLES)
def test_obstacles_move_as_one_body(first, second):
    """Distances of points that move along stay, and the body at rest does not depend on the pose."""
    bodies, points = (
        (BOX, SPHERE, CYLINDER, replace(BOX, center=(1.0, 1.0, 0.0), rotation=(0.1, 0.2, 0.3))),
        cloud(50),
    )
    offset, turn = torch.tensor([0.3, -0.1, 0.2], dtype=torch.float64), rotation_matrix(second)
    middle, _ = circumscribed(bodies)
    found = moved(bodies, offset, second)
    places = (points - middle) @ turn.T + middle + offset
    for one, other in zip(bodies, found, strict=True):
        # places are rounded to 1e-14 m, angles to 1e-12
        assert torch.allclose(one.signed_distance(points), other.signed_distance(places), rtol=0, atol=1e-9)
    assert torch.allclose(circumscribed(found)[0], middle + offset, rtol=0, atol=1e-9)
    assert circumscribed(found)[1] == pytest.approx(circumscribed(bodies)[1], abs=1e-9)
    rests = [at_rest(each)[0] for each in (found, moved(bodies, offset, first))]
    centers = [torch.tensor([one.center for one in rest], dtype=torch.float64) for rest in rests]
    apart = [center - center[:1] for center in centers]
    assert torch.allclose(*apart, rtol=0, atol=1e-9)


def test_what_cannot_be_moved_is_named():
    voxels = VoxelMask(np.ones((2, 2, 2), bool), 1e-3, rigid=True)
    still = moved((voxels,), torch.ones(3).double(), (0.0, 0.0, 0.0))
    assert still[0].origin == (1.0, 1.0, 1.0)
    with pytest.raises(ValueError, match="rotation: 'VoxelMask'; must be"):
        moved((voxels,), torch.ones(3).double(), (0.1, 0.0, 0.0))


def ball_of_voxels(edges, radius=4.3e-3, center=(0.3e-3, -0.2e-3, 0.1e-3)):
    """A mask of a ball, its spacing, and its origin."""
    count = [math.ceil(2 * radius / edge) + 3 for edge in edges]
    lower = np.array(center) - np.array(edges) * np.array(count) / 2
    places = np.stack(np.meshgrid(*[np.arange(n) + 0.5 for n in count], indexing="ij"), axis=-1)
    distance = np.linalg.norm(places * edges + lower - center, axis=-1) - radius
    return distance, tuple(edges), tuple(lower.tolist())


@pytest.mark.parametrize("edges", [(0.7e-3,) * 3, (0.5e-3, 0.7e-3, 1e-3)])
def test_the_surface_of_a_mask_is_that_of_the_ball_it_samples(edges):
    distance, spacing, origin = ball_of_voxels(edges)
    voxels = VoxelMask(distance < 0, spacing, origin, rigid=True)
    vertices, _ = voxels.surface()
    off = Sphere((0.3e-3, -0.2e-3, 0.1e-3), 4.3e-3, rigid=True).signed_distance(vertices)
    # voxels are known to half an edge; their average over many to far less
    assert float(off.abs().max()) < 0.4 * max(edges)
    assert float((off**2).mean().sqrt()) < 0.12 * max(edges)
    assert volume(*voxels.surface()) == pytest.approx((distance < 0).sum() * np.prod(edges), rel=1e-6)
    assert 0 < voxels.uncertainty < 0.1 * max(edges)


def test_grey_values_have_their_surface_between_voxels():
    distance, spacing, origin = ball_of_voxels((0.7e-3,) * 3)
    voxels = VoxelMask(-distance, spacing, origin, level=0.0, rigid=True)
    vertices, _ = voxels.surface()
    off = Sphere((0.3e-3, -0.2e-3, 0.1e-3), 4.3e-3, rigid=True).signed_distance(vertices)
    assert float(off.abs().max()) < 0.03 * 0.7e-3  # a sphere is flat to 0.7^2 / (8 * 4.3) of a voxel
    with pytest.raises(ValueError, match=r"VoxelMask\.level: 1.0; must be below the largest grey value"):
        VoxelMask(-distance, spacing, origin, level=1.0, rigid=True)
    with pytest.raises(ValueError, match="grey values need a level"):
        VoxelMask(np.arange(27, dtype=np.uint8).reshape(3, 3, 3), 1e-3, rigid=True)


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.4, 0.3, 0.2)])
def test_corners_of_a_box_are_not_rounded_by_more_than_a_voxel(turn):
    box, edge = Box((0.0, 0.0, 0.0), (9.6e-3, 7.2e-3, 8.4e-3), turn, rigid=True), 0.6e-3
    count = 28
    places = torch.from_numpy(np.stack(np.meshgrid(*[np.arange(count) + 0.5] * 3, indexing="ij"), axis=-1))
    points = edge * (places - count / 2).reshape(-1, 3)
    mask = box.contains(points).reshape((count,) * 3).numpy()
    voxels = VoxelMask(mask, edge, (-edge * count / 2,) * 3, rigid=True)
    vertices, _ = voxels.surface()
    off = box.signed_distance(vertices)
    assert float((off**2).mean().sqrt()) < 0.2 * edge
    corners = rotation_matrix(turn) @ (torch.tensor(box.size, dtype=torch.float64) / 2)
    assert float((vertices - corners).norm(dim=1).min()) < edge


def test_an_image_of_pyvista_is_read_with_its_spacing_and_origin():
    import pyvista

    distance, spacing, origin = ball_of_voxels((0.5e-3, 0.7e-3, 1e-3))
    given = VoxelMask(distance < 0, spacing, origin, rigid=True)
    image = pyvista.ImageData(
        dimensions=[n + 1 for n in distance.shape],
        spacing=[1e3 * x for x in spacing],
        origin=[1e3 * x for x in origin],
    )
    image.cell_data["label"] = 7 * (distance < 0).astype(np.uint8).ravel(order="F")
    read = VoxelMask.from_image(image, scale=1e-3, rigid=True)
    assert np.array_equal(read.mask, given.mask)
    assert (read.spacing, read.origin) == (pytest.approx(given.spacing), pytest.approx(given.origin))
    with pytest.raises(ValueError, match="must be an array of the image; it has label"):
        VoxelMask.from_image(image, "other", rigid=True)


def test_cavities_of_masks_and_meshes_are_filled():
    mask = np.ones((5, 5, 5), bool)
    mask[2, 2, 2] = False
    hollow = VoxelMask(mask, 1e-3, rigid=True)
    assert hollow.filled().mask.all()
    solid = hollow.filled()
    assert solid.filled() is solid


@settings(max_examples=4)
@given(
    st.sampled_from(["ball", "sheet", "rod"]),
    st.floats(2.0, 7.0),
    st.sampled_from(["nothing", "hole", "tab", "specks"]),
    st.integers(0, 2**31),
)
def test_a_surface_has_the_voxels_on_their_sides_or_says_so(kind, size, more, seed):
    """Centres lie at most 0.25 voxels beyond it, except for lost ones: at most as many as were changed."""
    random, count = np.random.default_rng(seed), 20
    places = np.moveaxis(np.indices((count,) * 3), 0, -1) - (count - 1) / 2 + random.uniform(-0.5, 0.5, 3)
    turned = np.abs(places @ rotation_matrix(random.uniform(-3, 3, 3).tolist()).numpy())
    half = {"sheet": (size, size, 1.0), "rod": (size, 1.2, 1.2)}.get(kind)
    mask = np.linalg.norm(places, axis=-1) < size if half is None else (turned < half).all(axis=-1)
    body, place = mask.copy(), tuple(np.argwhere(mask)[random.integers(mask.sum())])
    if more == "hole":
        mask[place] = False
    elif more == "tab":
        mask[place[0], place[1] : place[1] + 2, 2:18] = True
    elif more == "specks":
        mask ^= random.random(mask.shape) < 2e-3
    try:
        surface = VoxelSurface(mask, np.ones(3), None)
    except ThinError:
        assume(False)
    inside = surface.distance(np.argwhere(np.ones_like(mask)) + 0.5)
    assert (np.where(mask.ravel(), inside, -inside) > 0.25).sum() <= surface.lost
    assert surface.lost <= (mask ^ body).sum()


def test_voxels_that_vanish_when_smoothed_stay_cubes_and_full_masks_reach_to_their_faces(caplog):
    for unit in (1e-3, 1.0, 1e3):
        voxels = VoxelMask(unit * np.ones((6, 5, 4)), 1e-3, level=0.5 * unit, rigid=True)
        assert (*voxels.lower, *voxels.upper) == pytest.approx((0, 0, 0, 6e-3, 5e-3, 4e-3))
    mask = np.zeros((3, 3, 3), bool)
    mask[1, 1, 1] = True
    voxels = VoxelMask(mask, (1e-3, 2e-3, 1e-3), rigid=True)
    assert voxels.lower == pytest.approx((1e-3, 2e-3, 1e-3))
    assert "too thin to be smooth" in caplog.text
    assert voxels.uncertainty > 0.2e-3
