"""Cells of air that sound-hard bodies enclose: no sound reaches them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from autdtorch.fdtd.region import Shape
from autdtorch.fdtd.stencil import flat_offsets
from autdtorch.utils.array_types import Array, Index

# Coupling relative to all of a cell's, up to which nothing passes: a thin sound-hard body leaves less than
# 1e-5, and a heavy fluid more, relative to all of its own
_CLOSED = 1e-4
# Steps from a place to a cell beside it, and the distance [cells] at which a wall is met
_STEPS, _TOUCHING = 60, 1e-3


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
    number = regions.ravel()  # of each connected region of uniform cells, from 1 on; 32 bits
    places = np.flatnonzero(free[touched])
    number[touched[places]] = count + 1 + np.arange(len(places))
    one, other = _connections(coupling, touched, places, free, shape)
    size = count + 1 + len(places)
    ends = number[one], number[other]
    _, connected = connected_components(coo_array((np.ones(len(one)), ends), (size, size)), directed=False)
    inner = np.zeros(shape, bool)
    inner[1:-1, 1:-1, 1:-1] = True
    rim = inner & ~np.pad(inner[2:-2, 2:-2, 2:-2], 2)
    outside = np.zeros(size, bool)
    outside[connected[number[rim.ravel() & free]]] = True
    return np.flatnonzero(free & inner.ravel() & ~outside[connected][number])


def sees(begin: Array, end: Array, walls: Sequence[Shape], spacing: float) -> NDArray[np.bool_]:
    """Return whether no wall is between places (..., 3) and cells beside them (..., 3) [m] of `spacing` [m].

    Nothing is nearer to a place than its distance: each step goes so far.
    """
    begin, end = np.broadcast_arrays(begin, end)
    length = np.linalg.norm(end - begin, axis=-1)
    gone, blocked = np.zeros(length.shape), np.zeros(length.shape, bool)
    for _ in range(_STEPS):
        share = np.divide(gone, length, out=np.ones_like(gone), where=length > 0)
        places = torch.from_numpy(begin + share[..., None] * (end - begin))
        distance = torch.stack([wall.signed_distance(places) for wall in walls]).amin(dim=0).numpy()
        blocked |= (distance < _TOUCHING * spacing) & (gone < length)
        gone = np.minimum(gone + np.maximum(distance, _TOUCHING * spacing), length)
    return ~blocked


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
