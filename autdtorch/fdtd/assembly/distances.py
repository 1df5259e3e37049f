"""Signed distances of a body where they are needed: around the surface, and in the elements that it cuts."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from autdtorch.fdtd.assembly.element import LATTICE, SUBCELLS
from autdtorch.fdtd.assembly.smooth_faces import quadratic
from autdtorch.utils.array_types import Array, Index

Measure: TypeAlias = Callable[[Array], Array]
"""Returns the signed distances (...) [cells] of places (..., 3) [cells]."""

HALF_DIAGONAL = 0.87
"""Half the diagonal of an element: a surface farther from its centre does not intersect it."""

_LARGEST = 8  # Elements along an edge of the largest blocks that are inside or outside as a whole
# Largest change of a distance over a cell: trilinear interpolation between voxels reaches the root of three
_STEEPEST = math.sqrt(3)
# Largest difference [cells] of the distances in an element from a quadratic function at which the surface is
# smooth: two faces at 6 degrees reach it. Distances at all points are then interpolated.
_SMOOTH = 0.01
# Least mean gradient of such distances: between the faces of a sheet along the grid they turn at its middle,
# which three points along an axis do not show
_STEEP = 0.9


def located(measure: Measure, lower: Index, upper: Index) -> tuple[Index, Array, Index]:
    """Return elements near a surface (n, 3), the distances (n,) of their centres, and others inside (k, 3).

    Elements are those from `lower` (3,) up to `upper` (3,). Blocks of them are halved until their surface is
    near: distances change by `_STEEPEST` over a cell at most.
    """
    size, inside = _LARGEST, [np.zeros((0, 3), np.int64)]
    places = _block(lower, np.maximum(upper - lower, 0), size)
    while True:
        far = measure(np.asarray(places + size / 2, np.float64))
        if size == 1:
            return places, far, np.concatenate(inside)
        near = np.abs(far) <= HALF_DIAGONAL + _STEEPEST * math.sqrt(3) * (size - 1) / 2
        inside.append(_parts(places[~near & (far < 0)], size, 1, upper))
        places = _parts(places[near], size, size // 2, upper)
        size //= 2


def lattice_distances(measure: Measure, first: Index) -> Array:
    """Return the distances (n, 125) at the lattice of elements, given their first cells (n, 3)."""
    halves = _at_lattice(measure, first, _HALVES)
    bent = (np.abs(halves @ _BEYOND_QUADRATIC) > _SMOOTH).any(axis=1)
    rough = np.flatnonzero(bent | (np.linalg.norm(halves @ _GRADIENT, axis=1) < _STEEP))
    distance = np.asarray(halves @ _INTERPOLATION)
    distance[rough] = _at_lattice(measure, first[rough], LATTICE)
    return distance


def _block(lower: Index, length: Index, step: int) -> Index:
    """Return the places (n, 3) of a block, `step` apart."""
    x, y, z = (low + np.arange(0, count, step) for low, count in zip(lower, length, strict=True))
    return np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)


def _parts(places: Index, size: int, step: int, upper: Index) -> Index:
    """Return the parts (n, 3) of edge `step` of blocks of edge `size`, those that begin below `upper`."""
    parts = (places[:, None] + _block(np.zeros(3, np.int64), np.full(3, size), step)).reshape(-1, 3)
    return np.asarray(parts[(parts < upper).all(axis=1)])


def _at_lattice(measure: Measure, first: Index, lattice: Array) -> Array:
    """Return the distances (n, L) at the lattice (L, 3) of elements; neighbours share places."""
    if len(first) == 0:
        return np.zeros((0, len(lattice)))
    quarters = SUBCELLS * (first - first.min(axis=0))[:, None] + (SUBCELLS * lattice).astype(np.int64)
    shape = quarters.reshape(-1, 3).max(axis=0) + 1
    index = np.ravel_multi_index(tuple(np.moveaxis(quarters, -1, 0)), tuple(shape))
    used, place = np.unique(index, return_inverse=True)
    places = np.stack(np.unravel_index(used, tuple(shape)), axis=-1) / SUBCELLS + first.min(axis=0)
    return np.asarray(measure(places)[place.reshape(index.shape)])


def _quadratic_factors(x: Array) -> Array:
    """Return the factors (n, 3) at x of the quadratic polynomial through 0, 1/2 and 1."""
    return np.stack((2 * (x - 0.5) * (x - 1), 4 * x * (1 - x), 2 * x * (x - 0.5)), axis=-1)


_HALVES = np.array(list(itertools.product((0.0, 0.5, 1.0), repeat=3)))  # (27, 3)
_X, _Y, _Z = (_quadratic_factors(x) for x in LATTICE.T)
# Values at the lattice (27, 125) of the product of quadratic polynomials through those at `_HALVES`
_INTERPOLATION = np.einsum("pi,pj,pk->ijkp", _X, _Y, _Z).reshape(27, -1)
_MONOMIALS = quadratic(_HALVES - 0.5)
_FIT = np.linalg.pinv(_MONOMIALS)
_GRADIENT = _FIT[1:4].T  # Mean gradient (27, 3) of values at `_HALVES`
# Differences (27, 27) of values at `_HALVES` from the quadratic function that fits them best
_BEYOND_QUADRATIC = np.eye(27) - _MONOMIALS @ _FIT
