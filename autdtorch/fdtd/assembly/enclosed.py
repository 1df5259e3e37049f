"""Cells of air that sound-hard bodies enclose: no sound reaches them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from autdtorch.fdtd.stencil import flat_offsets
from autdtorch.utils.array_types import Array, Index

# Coupling relative to all of a cell's, up to which nothing passes: a thin sound-hard body leaves less than
# 1e-5, and a heavy fluid more, relative to all of its own
_CLOSED = 1e-4


def enclosed_cells(
    coupling: Array, touched: Index, hard: NDArray[np.bool_], shape: tuple[int, int, int]
) -> Index:
    """Return the flat indices of cells that are not connected with the outermost ones.

    `coupling` (n, 27) is that of the `touched` cells (n,); all others are connected with the six beside them,
    unless they are sound-hard.
    """
    free = ~hard
    uniform = free.copy()
    uniform[touched] = False
    regions, count = label(uniform.reshape(shape))
    number = regions.ravel().astype(np.int64)  # of each connected region of uniform cells, from 1 on
    own = np.flatnonzero(free[touched])
    number[touched[own]] = count + 1 + np.arange(len(own))
    one, other = _connections(coupling, touched, own, free, shape)
    size = count + 1 + len(own)
    ends = number[one], number[other]
    _, part = connected_components(coo_array((np.ones(len(one)), ends), (size, size)), directed=False)
    inner = np.zeros(shape, bool)
    inner[1:-1, 1:-1, 1:-1] = True
    rim = inner & ~np.pad(inner[2:-2, 2:-2, 2:-2], 2)
    outside = np.unique(part[number[rim.ravel() & free]])
    reached = np.isin(part[number], outside)
    return np.flatnonzero(free & inner.ravel() & ~reached)


def _connections(
    coupling: Array, touched: Index, own: Index, free: NDArray[np.bool_], shape: tuple[int, int, int]
) -> tuple[Index, Index]:
    """Return the pairs of cells (k,) and (k,) between which sound passes, of the touched ones `own`."""
    size = np.abs(coupling)
    row, neighbour = size.sum(axis=1), touched[own, None] + flat_offsets(shape)
    place = np.searchsorted(touched, neighbour).clip(max=len(touched) - 1)
    theirs = np.where(touched[place] == neighbour, row[place], np.inf)
    passes = (size[own] > _CLOSED * np.minimum(row[own, None], theirs)) & free[neighbour]
    first, offset = np.nonzero(passes)
    return touched[own[first]], neighbour[first, offset]
