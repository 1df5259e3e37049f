"""Shares of the materials in the parts of an element, from signed distances at its lattice."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from autdtorch.fdtd.assembly.element import FAR, PAIRS, SUBCELLS, VERTICES
from autdtorch.utils.array_types import Array, Index

_FROM, _TO = VERTICES[PAIRS[:, 0], None], VERTICES[PAIRS[:, 1], None]
_ALONG = SUBCELLS * _FROM + np.arange(SUBCELLS + 1)[:, None] * (_TO - _FROM)
# Indices in the lattice of the points along the line between each pair of vertices (28, 5)
_LINES = np.ravel_multi_index(tuple(np.moveaxis(_ALONG, -1, 0)), (SUBCELLS + 1,) * 3)


def distance_to_material(distance: Array, material: Index, inner: Index) -> Array:
    """Return the signed distance (n, 125) to the region of material `inner` (n,), cut by later bodies."""
    level = np.broadcast_to(np.where(inner == 0, -FAR, FAR)[:, None], distance.shape[1:])
    for far, number in zip(distance, material, strict=True):
        same = (inner == number)[:, None]
        level = np.where(same, np.minimum(level, far), np.maximum(level, -far))
    return level


def subcell_means(values: Array) -> Array:
    """Return the means (n, 64) of lattice values (n, 125) over the corners of each sub-cell."""
    return np.asarray(_over_subcells(values)[0])


def volume_coverage(distance: Array) -> Array:
    """Return the share of each sub-cell (..., 64) inside a body: exact for axis-aligned faces."""
    mean, *slopes = _over_subcells(distance)
    width = np.abs(slopes).sum(axis=0)
    return np.asarray(np.clip(0.5 - mean / np.maximum(width, 1e-12), 0, 1))


def _over_subcells(values: Array) -> Array:
    """Return means (4, ..., 64) over the corners of sub-cells: of lattice values (..., 125) and slopes."""
    found = [values.reshape(*values.shape[:-1], *(SUBCELLS + 1,) * 3)]
    for axis in (-3, -2, -1):
        ends = [np.moveaxis(each, axis, 0) for each in found]
        means = [np.moveaxis((each[:-1] + each[1:]) / 2, 0, axis) for each in ends]
        found = [*means, np.moveaxis(ends[0][1:] - ends[0][:-1], 0, axis)]
    return np.stack(found).reshape(4, *values.shape[:-1], SUBCELLS**3)


def line_coverage(distance: Array) -> Array:
    """Return the share inside a body of each quarter of the lines between vertices (..., 112)."""
    ends = distance[..., _LINES]
    low = np.minimum(ends[..., :-1], ends[..., 1:])
    high = np.maximum(ends[..., :-1], ends[..., 1:])
    share = np.clip(-low / np.maximum(high - low, 1e-12), 0, 1)
    return np.asarray(share.reshape(*distance.shape[:-1], -1))


def shares(coverage: Callable[[Array], Array], distance: Array, material: Index, count: int) -> Array:
    """Return the share of each material (n, q, count) in the q parts that `coverage` divides an element into.

    Touching bodies, with distances (K, n, 125) [cells], leave no air between them: their union decides its
    share.
    """
    covered = coverage(distance)
    share = np.zeros((*covered.shape[1:], count))
    for cover, number in zip(covered, material, strict=True):
        share *= 1 - cover[..., None]
        share[..., number] += cover
    solid = share.sum(axis=2)
    union = covered[0] if len(covered) == 1 else coverage(distance.min(axis=0))
    share *= np.divide(union, solid, out=np.zeros_like(solid), where=solid > 0)[..., None]
    share[..., 0] += 1 - union
    return share
