"""Neighbours of cells: between which sound passes, and which cells rigid bodies enclose."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from autdtorch.fdtd.stencil import flat_offsets
from autdtorch.utils.array_types import AnyArray, Array, Index
from autdtorch.utils.spatial import connected_parts, places_among

GridShape = tuple[int, int, int]
_TOGETHER = 50_000  # Cells whose neighbours are looked at together
# Coupling of two cells, relative to the sum of either, up to which nothing passes: 1e-5 or less through a
# thin rigid body, and more through a heavy fluid. Slivers have the sum of a cell of the densest fluid.
_BLOCKED = 1e-4


def neighbours(index: Index, shape: GridShape) -> Index:
    """Return flat indices (n, 27) of cells and their neighbours."""
    return np.asarray(index[:, None] + flat_offsets(shape), np.int64)


def in_parts(rows: AnyArray) -> list[AnyArray]:
    """Return rows in parts, which take little memory each."""
    return np.array_split(rows, 1 + len(rows) // _TOGETHER)


def enclosed_cells(
    coupling: Array,
    touched: Index,
    hard: NDArray[np.bool_],
    shape: GridShape,
    usual: float,
    sources: Array | None = None,
) -> Index:
    """Return the flat indices of cells that are not connected with the outermost ones.

    Outermost cells in several parts count where they are connected with `sources`, positions (M, 3) [cells].
    The `touched` cells (n,) have `coupling` (n, 27), whose sum is at least `usual` but in slivers. All others
    are connected with the six beside them, unless they are rigid.
    """
    free = ~hard
    uniform = free.copy()
    uniform[touched] = False
    regions, count = label(uniform.reshape(shape))
    number = regions.ravel()  # of each connected region of uniform cells, from 1 on; 32 bits
    places = np.flatnonzero(free[touched])
    number[touched[places]] = count + 1 + np.arange(len(places))
    one, other = _connections(coupling, touched, places, free, shape, usual)
    size = count + 1 + len(places)
    connected = connected_parts((number[one], number[other]), size)
    inner = np.zeros(shape, bool)
    inner[1:-1, 1:-1, 1:-1] = True
    rim = inner & ~np.pad(inner[2:-2, 2:-2, 2:-2], 2)
    outside = np.zeros(size, bool)
    outside[connected[number[rim.ravel() & free]]] = True
    if sources is not None and len(sources) and outside.sum() > 1:  # a wall parts the grid
        beside = flat_index(corners_around(sources), shape)
        reached = np.zeros(size, bool)
        reached[connected[number[beside[free[beside]]]]] = True
        outside &= reached
    return np.flatnonzero(free & inner.ravel() & ~outside[connected][number])


def corners_around(points: Array) -> Index:
    """Return the eight cells (N, 8, 3) around positions (N, 3) [cells]."""
    corners = np.indices((2, 2, 2)).reshape(3, 8).T
    return np.asarray(np.floor(points).astype(np.int64)[:, None] + corners, np.int64)


def flat_index(cells: Index, shape: GridShape) -> Index:
    """Return flat indices (...) of cells (..., 3); of those outside the grid, of the nearest cells."""
    inside = cells.clip(0, np.array(shape) - 1)
    return np.asarray(np.ravel_multi_index(tuple(np.moveaxis(inside, -1, 0)), shape), np.int64)


def _connections(
    coupling: Array, touched: Index, places: Index, free: NDArray[np.bool_], shape: GridShape, usual: float
) -> tuple[Index, Index]:
    """Return the pairs of cells (k,) and (k,) between which sound passes, of the touched ones at `places`."""
    row = np.concatenate([np.abs(part).sum(axis=1) for part in in_parts(coupling)]).clip(min=usual)
    place_of = places_among(touched, math.prod(shape))
    pairs = []
    for part in in_parts(places):
        neighbour = neighbours(touched[part], shape)
        place = place_of[neighbour]
        theirs = np.where(touched[place] == neighbour, row[place], np.inf)
        passes = np.abs(coupling[part]) > _BLOCKED * np.minimum(row[part, None], theirs)
        first, offset = np.nonzero(passes & free[neighbour])
        pairs.append((touched[part[first]], neighbour[first, offset]))
    one, other = (np.concatenate(ends) for ends in zip(*pairs, strict=True))
    return one, other
