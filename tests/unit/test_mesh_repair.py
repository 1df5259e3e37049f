"""Scans and exports with faults: `repair=True` makes a body of them, and says what it did."""

import itertools
import logging

import igl
import numpy as np
import pytest
import torch
from small_meshes import CUBE, ball, inverted, merged, tube, volume

from autdtorch.scene.obstacles import Mesh

BALL = ball(np.zeros(3), 1.0, 3)
SHEET = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
PARTS = {"cube": CUBE, "ball": BALL}


def rods() -> tuple[np.ndarray, np.ndarray]:
    """A palm and fingers, open at the wrist, as a depth camera leaves a hand."""
    axis = np.linspace(-1.6, 1.6, 48)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    distance = np.hypot(np.hypot(x / 1.2, (y + 0.4) / 1.2), z / 0.5) - 0.5
    for place in (-0.4, 0.0, 0.4):
        along = np.clip(y, 0, 1.2)
        distance = np.minimum(distance, np.sqrt((x - place) ** 2 + (y - along) ** 2 + z**2) - 0.16)
    wrist = np.sqrt(x**2 + (y - np.clip(y, -3, -0.8)) ** 2 + z**2) - 0.3
    places = np.stack([x, y, z], axis=-1).transpose(2, 1, 0, 3).reshape(-1, 3)
    field = np.minimum(distance, wrist).transpose(2, 1, 0).ravel()
    vertices, faces, _ = igl.marching_cubes(field, places, 48, 48, 48, 0.0)
    return vertices, faces[:, ::-1]


def apart(part, noise, random):
    vertices = part[0][part[1]].reshape(-1, 3)
    moved = vertices + noise * random.uniform(-1, 1, vertices.shape)
    return moved, np.arange(len(vertices)).reshape(-1, 3)


def turned(part, share, random):
    faces = part[1].copy()
    some = np.arange(len(faces)) < max(1, share * len(faces))
    random.shuffle(some)
    faces[some] = faces[some, ::-1]
    return part[0], faces


def with_holes(part, count, random):
    return part[0], np.delete(part[1], random.choice(len(part[1]), count, replace=False), axis=0)


def with_strays(part, count, random):
    places = random.uniform(2, 3, (count, 1, 3)) + 0.01 * random.normal(size=(count, 3, 3))
    return merged(part, (places.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)))


def doubled(part, count, random):
    return part[0], np.vstack([part[1], part[1][random.choice(len(part[1]), count)]])


def split(part, count, _):
    vertices, faces = part
    for number in range(count):
        a, b, c = faces[number]
        new = len(vertices)
        vertices = np.vstack([vertices, (vertices[a] + vertices[b]) / 2])
        faces = np.vstack([faces[:number], [[a, new, c]], faces[number + 1 :], [[new, b, c]]])
    return vertices, faces


FAULTS = {
    "joined": [(apart, size) for size in (3e-5, 1e-4, 3e-4)],
    "turned": [(turned, size) for size in (0.01, 0.2, 0.45)],
    "closed": [(with_holes, size) for size in (1, 2)] + [(split, size) for size in (1, 2, 3)],
    "stray": [(with_strays, size) for size in (1, 5, 30)],
    "twice": [(doubled, size) for size in (1, 4, 12)],
}
CASES = [
    (said, *fault, part)
    for said, faults in FAULTS.items()
    for fault, part in itertools.product(faults, PARTS)
]


@pytest.mark.parametrize(("said", "fault", "size", "part"), CASES)
def test_a_fault_is_mended_and_said(said, fault, size, part, caplog):
    surface = fault(PARTS[part], size, np.random.default_rng(1))
    with pytest.raises(ValueError, match="repair=True may mend it"):
        Mesh.from_surface(surface, rigid=True)
    mesh = Mesh.from_surface(surface, repair=True, rigid=True)
    assert said in caplog.text
    assert volume(mesh) == pytest.approx(volume(Mesh.from_surface(PARTS[part], rigid=True)), rel=0.01)
    edge = Mesh.from_surface(mesh.surface(), rigid=True)  # whole now
    assert torch.equal(edge.faces, mesh.faces)


def test_what_is_right_stays_as_it_is_and_parts_inside_out_become_their_union(caplog):
    with caplog.at_level(logging.DEBUG):
        mesh = Mesh.from_surface(BALL, repair=True, rigid=True)
    assert "repaired" not in caplog.text
    assert mesh == Mesh.from_surface(BALL, rigid=True)
    other = ball(np.array([0.7, 0.0, 0.0]), 1.0, 3)
    right, wrong = (
        Mesh.from_surface(merged(BALL, part), repair=True, rigid=True) for part in (other, inverted(other))
    )
    assert volume(wrong) == pytest.approx(volume(right), rel=1e-6)


def test_a_scan_of_a_hand_becomes_a_body_in_one_call(caplog):
    """Open at the wrist, with holes, turned triangles and strays: the volume within 1 % of the capped one."""
    random, whole = np.random.default_rng(0), rods()
    capped = Mesh.from_surface(whole, repair=True, rigid=True)
    scan = with_strays(turned(with_holes(whole, 12, random), 0.1, random), 20, random)
    mesh = Mesh.from_surface(scan, repair=True, rigid=True)
    assert all(said in caplog.text for said in ("stray", "turned", "closed "))
    assert volume(mesh) == pytest.approx(volume(capped), rel=0.01)
    assert mesh.contains([[0.0, -0.4, 0.0], [0.4, 1.1, 0.0], [0.0, -1.4, 0.0]]).all()
    assert not mesh.contains([[0.2, 1.0, 0.0], [0.0, -0.4, 0.9], [2.5, 2.5, 2.5]]).any()


def test_a_surface_that_crosses_itself_is_made_anew(caplog):
    turn = np.linspace(0, 2 * np.pi, 61)[:-1] + 0.02
    path = np.stack([2 * np.sin(turn), np.sin(2 * turn), 0 * turn], axis=1)
    mesh = Mesh.from_surface(tube(path), repair=True, rigid=True)
    assert "made the surface anew" in caplog.text
    assert mesh.contains(path).all()
    length = np.linalg.norm(np.diff(path, axis=0, append=path[:1]), axis=1).sum()
    around = np.pi * 0.2**2 * length
    assert 0.9 * around < volume(mesh) < around  # less what both strands share
    # As smooth as the tube, whose sides turn by 30 degrees; those of steps would be along the axes
    vertices, faces = mesh.surface()
    corners = vertices[faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    middle = corners.mean(dim=1).numpy()
    nearest = path[np.linalg.norm(middle[:, None] - path, axis=2).argmin(axis=1)]
    ahead = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1)[:, None]
    along = ahead[np.linalg.norm(middle[:, None] - path, axis=2).argmin(axis=1)]
    outwards = middle - nearest
    outwards -= (outwards * along).sum(axis=1)[:, None] * along
    cosine = (normals.numpy() * outwards).sum(axis=1) / np.linalg.norm(outwards, axis=1)
    assert cosine.sum() > 0.95 * float(normals.norm(dim=1).sum())


@pytest.mark.parametrize(
    ("surface", "reason"),
    [
        ((SHEET, np.array([[0, 1, 2], [0, 2, 3]])), "100%"),
        ((BALL[0], BALL[1][BALL[0][BALL[1]].mean(axis=1)[:, 2] > 0]), "of all area; must be at most 30%"),
    ],
    ids=["a sheet", "half a ball"],
)
def test_what_would_be_guessed_is_refused(surface, reason):
    with pytest.raises(ValueError, match=reason):
        Mesh.from_surface(surface, repair=True, rigid=True)
