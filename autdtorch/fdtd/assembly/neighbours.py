"""Neighbours of cells: between which sound passes, and which cells rigid bodies enclose."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from autdtorch.fdtd.interpolation import GridShape
from autdtorch.fdtd.stencil import flat_offsets
from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.spatial import places_among

# Coupling of two cells, relative to the sum of either, up to which nothing passes: 1e-5 or less through a
# thin rigid body, and more through a heavy fluid. Slivers have the sum of a cell of the densest fluid.
_BLOCKED = 1e-4


def neighbours(index: Index, shape: GridShape) -> Index:
    """Return flat indices (n, 27) of cells and their neighbours."""
    return np.asarray(index[:, None] + flat_offsets(shape), np.int64)


def with_neighbours(index: Index, shape: GridShape) -> NDArray[np.bool_]:
    """Return a mask (nx, ny, nz) of cells `index` (n,) and all their neighbours; none is outermost."""
    cells = np.zeros(shape, bool)
    cells.ravel()[index] = True
    for axis in range(3):
        near = np.moveaxis(cells, axis, 0)
        cells = cells.copy()
        around = np.moveaxis(cells, axis, 0)
        around[1:] |= near[:-1]
        around[:-1] |= near[1:]
    return cells


def inner_cells(cells: NDArray[np.bool_]) -> Index:
    """Return the flat indices (n,) of the cells of a mask (nx, ny, nz) that are not outermost."""
    inside = np.zeros_like(cells)
    inside[1:-1, 1:-1, 1:-1] = cells[1:-1, 1:-1, 1:-1]
    return np.flatnonzero(inside)


def enclosed_cells(
    coupling: Array,
    row: Array,
    touched: Index,
    hard: NDArray[np.bool_],
    shape: GridShape,
    usual: float,
    sources: Array | None = None,
) -> Index:
    """Return the flat indices of cells that are not connected with the outermost ones.

    Outermost cells in several parts count where they are connected with `sources`, positions (M, 3) [cells].
    The `touched` cells (n,) have `coupling` (n, 27), whose sum `row` (n,) is at least `usual` but in slivers.
    All others are connected with the six beside them, unless they are rigid.
    """
    from autdtorch.fdtd.assembly.cell_kernels import join_cells  # loads numba

    free = ~hard
    uniform = free.copy()
    uniform[touched] = False
    regions, count = label(uniform.reshape(shape))
    number = regions.ravel()  # of each connected region of uniform cells, from 1 on; 32 bits
    number[touched] = count + 1 + np.arange(len(touched))
    connected = np.arange(count + 1 + len(touched), dtype=np.int32)
    place, least = places_among(touched, len(free)), _BLOCKED * row.clip(min=usual)
    join_cells(touched, coupling, least, place, free, number, flat_offsets(shape), connected)
    rim = np.zeros(shape, bool)
    rim[1:-1, 1:-1, 1:-1], rim[2:-2, 2:-2, 2:-2] = True, False
    outside = np.zeros(len(connected), bool)
    outside[connected[number[rim.ravel() & free]]] = True
    if sources is not None and len(sources) and outside.sum() > 1:  # a wall parts the grid
        beside = flat_index(corners_around(sources), shape)
        reached = np.zeros(len(connected), bool)
        reached[connected[number[beside[free[beside]]]]] = True
        outside &= reached
    return inner_cells((free & ~outside[connected][number]).reshape(shape))


def corners_around(points: Array) -> Index:
    """Return the eight cells (N, 8, 3) around positions (N, 3) [cells]."""
    corners = np.indices((2, 2, 2)).reshape(3, 8).T
    return np.asarray(np.floor(points).astype(np.int64)[:, None] + corners, np.int64)


def flat_index(cells: Index, shape: GridShape) -> Index:
    """Return flat indices (...) of cells (..., 3); of those outside the grid, of the nearest cells."""
    inside = cells.clip(0, np.array(shape) - 1)
    return np.asarray(np.ravel_multi_index(tuple(np.moveaxis(inside, -1, 0)), shape), np.int64)
