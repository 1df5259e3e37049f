"""Distances from a surface on the grid: the elements near it, and values at the points of these."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from autdtorch.fdtd.assembly.reference_element import LATTICE, SUBCELLS
from autdtorch.fdtd.assembly.smooth_faces import quadratic
from autdtorch.fdtd.stencil import flat_strides, places_of
from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.spatial import distinct_cells, places_among

# Returns the signed distances (...) [cells] of places (..., 3) [cells]
Measure: TypeAlias = Callable[[Array], Array]

# Half the diagonal of an element: a surface farther from its centre does not intersect it
HALF_DIAGONAL = 0.87

_LARGEST = 8  # Elements along an edge of the largest blocks that are inside or outside as a whole
# Largest change of a distance over a cell: trilinear interpolation between voxels reaches the root of three
_STEEPEST = math.sqrt(3)
# Largest difference [cells] of the distances in an element from a quadratic function at which the surface is
# smooth: two faces at 6 degrees reach it. Distances at all points are then interpolated.
_SMOOTH = 0.01
# Least mean gradient of such distances. Between the faces of a sheet along the grid they turn at its middle,
# which three points along an axis do not show.
_STEEP = 0.9


def near_surface(measure: Measure, lower: Index, upper: Index) -> tuple[Index, Array, Index]:
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
    """Return the distances (n, 125) at the lattice of elements, by their first cells (n, 3)."""
    halves = _at_lattice(measure, first, 2)
    bent = (np.abs(halves @ _BEYOND_QUADRATIC) > _SMOOTH).any(axis=1)
    rough = np.flatnonzero(bent | (np.linalg.norm(halves @ _GRADIENT, axis=1) < _STEEP))
    distance = np.asarray(halves @ _INTERPOLATION)
    distance[rough] = _at_lattice(measure, first[rough], SUBCELLS)
    return distance


def _block(lower: Index, length: Index, step: int) -> Index:
    """Return the places (n, 3) of a block, `step` apart."""
    x, y, z = (low + np.arange(0, count, step) for low, count in zip(lower, length, strict=True))
    return np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)


def _parts(places: Index, size: int, step: int, upper: Index) -> Index:
    """Return the parts (n, 3) of edge `step` of blocks of edge `size`, those that begin below `upper`."""
    parts = (places[:, None] + _block(np.zeros(3, np.int64), np.full(3, size), step)).reshape(-1, 3)
    return np.asarray(parts[(parts < upper).all(axis=1)])


def _at_lattice(measure: Measure, first: Index, steps: int) -> Array:
    """Return the distances (n, (steps + 1)^3) at the points of elements `1 / steps` apart.

    Elements share points. Points in a cell are measured one after the other, as meshes find near places more
    quickly.
    """
    points = np.array(list(np.ndindex((steps + 1,) * 3)))
    low, among = first.min(axis=0, initial=np.iinfo(np.int64).max), (steps,) * 3
    cells, within = np.divmod(points, steps)
    shape = tuple((np.ptp(first, axis=0) + 2).tolist()) if len(first) else (0,) * 3
    cell = ((first - low) @ flat_strides(shape))[:, None] + cells @ flat_strides(shape)
    used = distinct_cells(cell, math.prod(shape))
    point = steps**3 * places_among(used, math.prod(shape))[cell] + within @ flat_strides(among)
    distinct = distinct_cells(point, steps**3 * len(used))
    cell, within = np.divmod(distinct, steps**3)
    places = low + places_of(used[cell], shape) + places_of(within, among) / steps
    return np.asarray(measure(places)[places_among(distinct, steps**3 * len(used))[point]])


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
