"""Meshes of parts that touch, as CAD programs write assemblies: one body without seams."""

import itertools

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from small_meshes import area, box, inverted, merged, volume

from autdtorch.fdtd.assembly.edges import edges_of
from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.obstacles import Mesh

ANGLES = st.tuples(*[st.floats(-3.0, 3.0)] * 3)
PLACES = st.tuples(*[st.floats(-0.1, 0.1)] * 3)
# Coordinates up to 0.2 m in single precision, of sides of 10 mm and more: their areas and volumes err by 1e-6
ROUNDED = 1e-5


def corners_of(size):
    return np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3, indexing="ij"), -1).reshape(-1, 3) * size


def hull(points, seam, start):
    """A convex body; triangles of its seam, of a normal and an offset, are a fan around a corner of it."""
    found = ConvexHull(points)
    vertices, faces = found.points, found.simplices
    normals = np.cross(*np.moveaxis(vertices[faces[:, 1:]] - vertices[faces[:, :1]], 1, 0))
    turned = (normals * found.equations[:, :3]).sum(axis=1) < 0
    faces = np.where(turned[:, None], faces[:, ::-1], faces)
    normal, offset = seam
    on = np.abs(vertices @ normal - offset) < 1e-9
    rim = np.flatnonzero(on)
    flat = vertices[rim] - vertices[rim].mean(axis=0)
    first = flat[0] / np.linalg.norm(flat[0])
    order = rim[np.argsort(np.arctan2(flat @ np.cross(normal, first), flat @ first))]
    order = np.roll(order if vertices[~on][0] @ normal < offset else order[::-1], start)
    fan = [[order[0], *pair] for pair in itertools.pairwise(order[1:])]
    return vertices, np.vstack([faces[~on[faces].all(axis=1)], fan])


def halves(size, normal, share, starts):
    """The parts of a box that a plane cuts, between its middle and a corner."""
    corners, normal = corners_of(size), np.array(normal) / np.linalg.norm(normal)
    offset = share * np.abs(normal * size).sum() / 2
    height = (corners @ normal - offset).round(9)
    cuts = [
        (height[b] * corners[a] - height[a] * corners[b]) / (height[b] - height[a])
        for a in range(8)
        for b in range(a)
        if (corners[a] != corners[b]).sum() == 1 and height[a] * height[b] < 0
    ]
    for side, start in zip((1, -1), starts, strict=True):
        yield hull(np.vstack([corners[side * height >= 0], *cuts]), (normal, offset), start)


def placed(parts, angles, place):
    turn = rotation_matrix(angles).numpy()
    return [(vertices @ turn.T + place, faces) for vertices, faces in parts]


def read(parts, kind, folder):
    """The mesh of parts, from a file of a kind or without one."""
    vertices, faces = merged(*parts)
    if kind == "surface":
        return Mesh.from_surface((vertices, faces), rigid=True)
    path = folder / f"body.{kind}"
    if kind == "stl":
        records = np.zeros(len(faces), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
        records["corners"] = vertices[faces]
        path.write_bytes(bytes(80) + np.uint32(len(faces)).tobytes() + records.tobytes())
    else:
        head = f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\n"
        head += "".join(f"property float {axis}\n" for axis in "xyz") + f"element face {len(faces)}\n"
        rows = [f"{x:.6f} {y:.6f} {z:.6f}" for x, y, z in 1e3 * vertices]  # [mm]
        rows += [f"3 {a} {b} {c}" for a, b, c in faces]
        path.write_text(head + "property list uchar int vertex_indices\nend_header\n" + "\n".join(rows))
    return Mesh(path, scale=1e-3 if kind == "ply" else 1.0, rigid=True)


def length_of_edges(mesh):
    return sum(np.linalg.norm(edge.end - edge.begin) for edge in edges_of(mesh))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("meshes")


@given(
    size=st.tuples(*[st.floats(0.01, 0.1)] * 3),
    normal=st.sampled_from([(1.0, 0.0, 0.0), (1.0, 1.0, 0.0)])
    | st.tuples(*[st.floats(0.2, 1.0) | st.floats(-1.0, -0.2)] * 3),
    diagonal=st.booleans(),
    share=st.floats(-0.7, 0.7),
    starts=st.tuples(*[st.integers(0, 5)] * 2),
    angles=ANGLES,
    place=PLACES,
    kind=st.sampled_from(["stl", "ply", "surface"]),
)
@example(  # the seam ends at edges of 14 degrees, where an edge of the box was lost
    size=(0.0625, 0.015625, 0.09375), normal=(1.0, 1.0, 0.0), diagonal=True, share=0.0,
    starts=(0, 0), angles=(0.0, 0.0, 2.0), place=(0.0, 0.0, 0.0), kind="stl",
)  # fmt: skip
def test_parts_of_a_box_are_the_whole_box(folder, size, normal, diagonal, share, starts, angles, place, kind):
    if diagonal:  # the seam ends at edges of the box, or at three corners
        normal, share = np.sign(normal) / size, 0.0 if normal[2] == 0 else 1 / 3
    parts = placed(halves(np.array(size), normal, share, starts), angles, place)
    mesh = read(parts, kind, folder)
    a, b, c = size
    assert volume(mesh) == pytest.approx(a * b * c, rel=ROUNDED)
    assert area(mesh) == pytest.approx(2 * (a * b + b * c + c * a), rel=ROUNDED)
    assert length_of_edges(mesh) == pytest.approx(4 * (a + b + c), rel=1e-3)


@given(
    shift=st.tuples(*[st.floats(0.003, 0.03)] * 2),
    angles=ANGLES,
    place=PLACES,
    kind=st.sampled_from(["stl", "ply", "surface"]),
)
def test_boxes_that_share_part_of_a_face_are_one_body(folder, shift, angles, place, kind):
    x, y = shift
    parts = [box((0, 0, 0), (0.04, 0.05, 0.02)), box((x, y, 0.02), (0.04 + x, 0.05 + y, 0.05))]
    mesh = read(placed(parts, angles, place), kind, folder)
    assert volume(mesh) == pytest.approx(0.04 * 0.05 * 0.05, rel=ROUNDED)
    walls = 2 * (0.04 + 0.05) * 0.05
    assert area(mesh) == pytest.approx(walls + 2 * (2 * 0.04 * 0.05 - (0.04 - x) * (0.05 - y)), rel=ROUNDED)


@given(angles=ANGLES, place=PLACES, kind=st.sampled_from(["stl", "surface"]))
@settings(max_examples=10)
def test_a_bar_across_another_and_a_core_in_its_shell_are_joined(folder, angles, place, kind):
    bars = [box((0, 0.03, 0), (0.1, 0.05, 0.02)), box((0.04, 0, 0.02), (0.06, 0.1, 0.05))]
    mesh = read(placed(bars, angles, place), kind, folder)
    assert volume(mesh) == pytest.approx(1e-4, rel=ROUNDED)
    assert area(mesh) == pytest.approx(2 * 4.4e-3 + 2 * 5.6e-3 - 2 * 4e-4, rel=ROUNDED)
    core = box((0.01, 0.01, 0.01), (0.04, 0.03, 0.02))
    shell = [box((0, 0, 0), (0.05, 0.04, 0.03)), inverted(core), (core[0], np.roll(core[1], 1, axis=0))]
    mesh = read(placed(shell, angles, place), kind, folder)
    assert (len(mesh.vertices), len(mesh.faces)) == (8, 12)
    assert volume(mesh) == pytest.approx(6e-5, rel=ROUNDED)


@given(angles=ANGLES, place=PLACES, gap=st.floats(1e-5, 1e-3), kind=st.sampled_from(["stl", "surface"]))
@settings(max_examples=10)
def test_a_gap_between_parts_stays(folder, angles, place, gap, kind):
    """Gaps of 0.01 to 1 mm in bodies of 0.1 m."""
    parts = [box((0, 0, 0), (0.1, 0.08, 0.03)), box((0, 0, 0.03 + gap), (0.1, 0.08, 0.06))]
    mesh = read(placed(parts, angles, place), kind, folder)
    assert len(mesh.faces) == 24
    assert volume(mesh) == pytest.approx(0.1 * 0.08 * (0.06 - gap), rel=ROUNDED)
