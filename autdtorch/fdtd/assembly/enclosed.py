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
    places = np.flatnonzero(free[touched])
    number[touched[places]] = count + 1 + np.arange(len(places))
    one, other = _connections(coupling, touched, places, free, shape)
    size = count + 1 + len(places)
    ends = number[one], number[other]
    _, connected = connected_components(coo_array((np.ones(len(one)), ends), (size, size)), directed=False)
    inner = np.zeros(shape, bool)
    inner[1:-1, 1:-1, 1:-1] = True
    rim = inner & ~np.pad(inner[2:-2, 2:-2, 2:-2], 2)
    outside = np.unique(connected[number[rim.ravel() & free]])
    reached = np.isin(connected[number], outside)
    return np.flatnonzero(free & inner.ravel() & ~reached)


def _connections(
    coupling: Array, touched: Index, places: Index, free: NDArray[np.bool_], shape: tuple[int, int, int]
) -> tuple[Index, Index]:
    """Return the pairs of cells (k,) and (k,) between which sound passes, of the touched ones at `places`."""
    size = np.abs(coupling)
    row, neighbour = size.sum(axis=1), touched[places, None] + flat_offsets(shape)
    place = np.searchsorted(touched, neighbour).clip(max=len(touched) - 1)
    theirs = np.where(touched[place] == neighbour, row[place], np.inf)
    passes = (size[places] > _CLOSED * np.minimum(row[places, None], theirs)) & free[neighbour]
    first, offset = np.nonzero(passes)
    return touched[places[first]], neighbour[first, offset]
