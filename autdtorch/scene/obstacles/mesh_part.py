"""A closed part of a mesh, and how messages show its place."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.spatial import areas_of


class Part(NamedTuple):
    """A closed surface whose triangles are joined by edges."""

    vertices: Array  # (V, 3)
    faces: Index  # (F, 3)
    volume: float  # negative if it is inside out
    area: float


def part_of(vertices: Array, faces: Index) -> Part:
    """Return the surface of faces, with the vertices that they use."""
    used, index = np.unique(faces, return_inverse=True)
    corners, index = vertices[used], index.reshape(-1, 3)
    centred = corners[index] - corners.mean(axis=0)
    return Part(corners, index, float(np.linalg.det(centred).sum() / 6), float(areas_of(centred).sum()))


def with_three(faces: Index) -> Index:
    """Leave out triangles with two equal corners."""
    return np.asarray(faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)])


def without_sheets(faces: Index, label: Index | int = 0) -> Index:
    """Leave out pairs of opposite triangles of one part: a fin, or a wall, which encloses nothing."""
    corners = np.column_stack((np.sort(faces, axis=1), np.broadcast_to(label, len(faces))))
    order = np.lexsort(corners.T)
    place = np.empty(len(faces), np.int64)
    place[order] = np.cumsum(np.diff(corners[order], axis=0, prepend=-1).any(axis=1)) - 1
    # the corners of a triangle descend once, those of an opposite one twice
    turn = np.where((faces > np.roll(faces, -1, axis=1)).sum(axis=1) == 1, 1, -1)
    return np.asarray(faces[np.bincount(place, weights=turn)[place] != 0])


def winding_number(vertices: Array, faces: Index, points: Array) -> Array:
    """Return how often a closed surface winds around points (N,), to 1 % (Barill et al. 2018)."""
    import igl

    lower, upper = vertices.min(axis=0), vertices.max(axis=0)
    within = ((points >= lower) & (points <= upper)).all(axis=1)
    winding = np.zeros(len(points))
    if within.any():
        middle, extent = (lower + upper) / 2, extent_of(vertices)  # libigl computes in single precision
        around = np.ascontiguousarray((vertices - middle) / extent)
        winding[within] = igl.fast_winding_number(around, faces, (points[within] - middle) / extent)
    return winding


def extent_of(vertices: Array) -> float:
    """Return the longest side of the bounding box of vertices (V, 3)."""
    return float(np.ptp(vertices, axis=0).max())


def place_of(point: Array) -> str:
    """Return a point (3,) as messages show it."""
    return f"({', '.join(f'{entry:.6g}' for entry in point)})"


def box_of(points: Array) -> str:
    """Return the bounding box of points (N, 3) as messages show it."""
    return f"the space from {place_of(points.min(axis=0))} to {place_of(points.max(axis=0))}"
