"""Polygons and lines of pictures, cut at the domain and at reflectors."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from autdtorch.scene.geometry import plane_basis
from autdtorch.scene.reflectors import Reflector
from autdtorch.utils.array_types import Array
from autdtorch.utils.validation import LENGTH_TOLERANCE, Vector


def clipped(corners: Array, lower: Vector, upper: Vector, reflectors: Iterable[Reflector] = ()) -> Array:
    """Clip a convex polygon or a line (K, 3) [m] to a box and to the space in front of reflectors.

    Return L >= 0 corners (L, 3). A clipped line may run back to its start.
    """
    for inwards, corner in ((1.0, lower), (-1.0, upper)):
        for axis in range(3):
            corners = _cut(corners, inwards * (corners[:, axis] - corner[axis]))
    for one in reflectors:
        corners = _cut(corners, (corners - np.array(one.point)) @ np.array(one.normal))
    return corners


def _cut(corners: Array, height: Array) -> Array:
    """Return the part of a polygon (K, 3) where the height (K,) is >= 0 (Sutherland & Hodgman 1974)."""
    height = np.where(np.abs(height) < LENGTH_TOLERANCE, 0.0, height)  # a panel may be the domain's edge
    inside = []
    for here, there in enumerate(np.roll(np.arange(len(corners)), -1)):
        if height[here] >= 0:
            inside.append(corners[here])
        if height[here] * height[there] < 0:
            share = height[here] / (height[here] - height[there])
            inside.append(corners[here] + share * (corners[there] - corners[here]))
    return np.array(inside).reshape(-1, 3)


def parts_of_reflectors(reflectors: Sequence[Reflector], domain: tuple[Vector, Vector]) -> list[Array]:
    """Return the corners (K, 3) [m] of each reflector's part in a domain and in front of the others."""
    lower, upper = (np.array(corner) for corner in domain)
    parts = []
    for one in reflectors:
        normal, middle = np.array(one.normal), (lower + upper) / 2
        middle = middle - (middle - np.array(one.point)) @ normal * normal
        u, v = (float(np.linalg.norm(upper - lower)) * axis.numpy() for axis in plane_basis(one.normal))
        corners = middle + np.array([u + v, v - u, -u - v, u - v])
        parts.append(clipped(corners, *domain, [other for other in reflectors if other is not one]))
    return parts
