"""Triangle meshes of simple bodies, as vertices (V, 3) and faces (F, 3)."""

import igl
import numpy as np
import torch

from autdtorch.scene.obstacles import Box
from autdtorch.utils.spatial import areas_of


def box(lower, upper):
    lower, upper = np.array(lower, float), np.array(upper, float)
    vertices, faces = Box((lower + upper) / 2, upper - lower, rigid=True).surface()
    return vertices.numpy(), faces.numpy()


def ball(center, radius, subdivisions=3):
    vertices, faces = igl.icosahedron()
    for _ in range(subdivisions):
        vertices, faces = igl.upsample(vertices, faces)
        vertices = vertices / np.linalg.norm(vertices, axis=1)[:, None]
    return radius * vertices + center, faces


def merged(*parts):
    starts = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
    faces = [faces + start for (_, faces), start in zip(parts, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def inverted(part):
    return part[0], part[1][:, ::-1]


def tube(path, radius=0.2, sides=12):
    """A closed tube along a closed curve (n, 3)."""
    ahead = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0)
    across = np.cross(ahead, (0.0, 0.0, 1.0))
    across /= np.linalg.norm(across, axis=1)[:, None]
    up = np.cross(across, ahead)
    up /= np.linalg.norm(up, axis=1)[:, None]
    turn = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    rings = path[:, None] + radius * (
        np.cos(turn)[None, :, None] * across[:, None] + np.sin(turn)[None, :, None] * up[:, None]
    )
    number = np.arange(len(path) * sides).reshape(len(path), sides)
    ahead, beside = np.roll(number, -1, axis=0), np.roll(number, -1, axis=1)
    both = np.roll(ahead, -1, axis=1)
    faces = np.concatenate(
        [np.stack(part, -1).reshape(-1, 3) for part in ((number, ahead, both), (number, both, beside))]
    )
    return rings.reshape(-1, 3), faces


def volume(mesh):
    vertices, faces = mesh.surface()
    return float(torch.linalg.det(vertices[faces] - vertices.mean(dim=0)).sum() / 6)


def area(mesh):
    vertices, faces = mesh.surface()
    return float(areas_of(vertices[faces].numpy()).sum())


CUBE = box((0, 0, 0), (1, 1, 1))
