"""Polygons of a surface, and their triangles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from autdtorch.scene.obstacles.mesh_solid import FARTHEST
from autdtorch.utils.array_types import Array, Index

_OVERLAP = 1e-9  # relative difference of the areas of a polygon and of its triangles that is rounding


class Polygons(NamedTuple):
    """Polygons of a surface, each a run of corners."""

    vertices: Array  # (V, 3)
    lengths: Index  # corners of each polygon (F,)
    corners: Index  # vertices of all polygons, one after the other (sum of lengths,)


def triangulated(polygons: Polygons) -> Index:
    """Return the triangles (T, 3) of polygons, which need not be convex, in their order.

    A polygon that is not flat is cut as its projection along its mean normal.

    Raises:
        ValueError: a polygon of less than three corners, or one that crosses itself; the message names it.
    """
    vertices, lengths, corners = polygons
    if len(short := np.flatnonzero(lengths < 3)):
        raise ValueError(f"face {short[0]} has {lengths[short[0]]} vertices; must have at least 3")
    if len(wrong := np.flatnonzero((corners < 0) | (corners >= len(vertices)))):
        face = np.searchsorted(np.cumsum(lengths), wrong[0], side="right")
        wrong_face = f"face {face} has vertex {corners[wrong[0]]}"
        raise ValueError(f"{wrong_face}; must be one of the {len(vertices)} vertices, counted from 0")
    if (lengths > 3).any() and len(far := np.flatnonzero(~(np.abs(vertices) <= FARTHEST).all(axis=1))):
        raise ValueError(f"vertex {far[0]} at {vertices[far[0]]}; must be finite, none beyond {FARTHEST:g}")
    begin = np.cumsum(lengths) - lengths
    parts, order = [], []
    for length in np.unique(lengths):
        chosen = np.flatnonzero(lengths == length)
        fans = _fans(vertices, corners[begin[chosen, None] + np.arange(length)], chosen)
        parts.append(fans.reshape(-1, 3))
        order.append(np.repeat(chosen, length - 2))
    if not parts:
        return np.zeros((0, 3), np.int64)
    return np.concatenate(parts)[np.argsort(np.concatenate(order), kind="stable")]


def _fans(vertices: Array, faces: Index, number: Index) -> Index:
    """Return the triangles (n, k - 2, 3) of polygons (n, k) of these numbers: fans of convex ones."""
    count = faces.shape[1]
    around = np.arange(1, count - 1)
    fans = np.stack(
        [np.broadcast_to(faces[:, :1], (len(faces), count - 2)), faces[:, around], faces[:, around + 1]], -1
    )
    if count == 3:
        return fans
    places = vertices[faces] - vertices[faces[:, :1]]
    normal = np.cross(places, np.roll(places, -1, axis=1)).sum(axis=1)  # twice the area (Newell)
    size = np.linalg.norm(normal, axis=1)
    ahead = np.roll(places, -1, axis=1) - places
    turns = np.einsum("nki,ni->nk", np.cross(ahead, np.roll(ahead, -1, axis=1)), normal)
    rounding = _OVERLAP * size[:, None] ** 2
    # each corner turns left, and all of them once around: a star turns twice
    fan_areas = np.einsum("nki,ni->nk", np.cross(places[:, 1:-1], places[:, 2:]), normal)
    convex = (turns >= -rounding).all(axis=1) & (fan_areas >= -rounding).all(axis=1)
    for row in np.flatnonzero(~convex):
        fans[row] = faces[row][_cut(places[row], normal[row], int(number[row]))]
    return fans


def _cut(places: Array, normal: Array, number: int) -> Index:
    """Return the triangles (k - 2, 3) of a polygon (k, 3) by its corners, around its normal."""
    from manifold3d import triangulate

    area = float(np.linalg.norm(normal))
    if area == 0:
        raise ValueError(f"face {number} crosses itself or has no area; must be a simple polygon")
    axis = normal / area
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    flat = places @ np.stack([first, np.cross(axis, first)], axis=1)
    triangles = np.asarray(triangulate([flat]), np.int64)
    one, two, three = flat[triangles].transpose(1, 0, 2)
    areas = (two - one)[:, 0] * (three - one)[:, 1] - (two - one)[:, 1] * (three - one)[:, 0]
    if (
        len(triangles) != len(places) - 2
        or abs(np.abs(areas).sum() - areas.sum()) > _OVERLAP * np.abs(areas).sum()
    ):
        raise ValueError(f"face {number} of {len(places)} vertices crosses itself; must be a simple polygon")
    return triangles
