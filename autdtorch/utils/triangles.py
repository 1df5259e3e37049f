"""Triangles in space."""

from __future__ import annotations

import numpy as np

from autdtorch.utils.array_types import Array, Index


def doubled_normals(corners: Array) -> Array:
    """Return the outward normals (T, 3) of triangles with `corners` (T, 3, 3), of twice their area."""
    first, second, third = np.moveaxis(corners, 1, 0)
    return np.asarray(np.cross(second - first, third - first))


def sides_of(triangles: Index) -> Index:
    """Return the vertices (3 T, 2) of the sides of triangles (T, 3): the first of each, then the others."""
    return np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])


def areas_of(corners: Array) -> Array:
    """Return the areas (T,) of triangles with `corners` (T, 3, 3)."""
    return np.asarray(np.linalg.norm(doubled_normals(corners), axis=1) / 2)


def paired_sides(triangles: Index) -> Index:
    """Return the numbers (n, 2), in `sides_of`, of the sides that just two triangles share."""
    sides = np.sort(sides_of(triangles), axis=1)
    _, edge, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(edge.reshape(-1), kind="stable")
    return np.asarray(order[np.repeat(count == 2, count)].reshape(-1, 2))


def mean_thickness(vertices: Array, triangles: Index) -> float:
    """Return twice the volume over the area of a closed surface, vertices (V, 3), triangles (T, 3)."""
    corners = vertices[triangles] - vertices.mean(axis=0)
    area = areas_of(corners).sum()
    return float(2 * abs(np.linalg.det(corners).sum() / 6) / area)


def extents(vertices: Array) -> Array:
    """Return the extents (3,) of vertices (V, 3) along their principal axes, the largest first."""
    centered = vertices - vertices.mean(axis=0)
    _, _, axes = np.linalg.svd(centered, full_matrices=False)
    return np.sort(np.ptp(centered @ axes.T, axis=0))[::-1]
