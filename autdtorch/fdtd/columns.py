"""Columns of cells on which an obstacle runs through a boundary layer.

The layer repeats what it touches, so that the row of a cell does not change along the layer's normal. The
kernels stretch rows as in air, scaled to the sum of the cell's own weights: exact inside an obstacle.
What a row at a surface differs by from that is stretched here, by column, with a memory of its own. Where
layers meet, the products of their stretchings are left out of this difference.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from autdtorch.fdtd.bonds import VaryingCells
from autdtorch.fdtd.grid import Grid
from autdtorch.fdtd.kernels.contract import Columns
from autdtorch.fdtd.stencil import OFFSETS, Stencil

_ALIKE = 1e-6
"""Differences from scaled air below this, relative to a face's weight, are rounding."""


def row_scale(weight: NDArray[np.float64], stencil: Stencil) -> NDArray[np.float64]:
    """Sum of each row's weights (n, 27) over that of air's."""
    return np.asarray(weight.sum(axis=1) / stencil.total)


def scaled_cells(
    varying: VaryingCells, stencil: Stencil, grid: Grid, dtype: torch.dtype
) -> tuple[torch.Tensor, torch.Tensor]:
    """Cells of the boundary layers (k,) whose rows are not of air, and their scale (k,)."""
    places = np.stack(np.unravel_index(varying.index, grid.shape), axis=-1)
    here = ((places < np.array(grid.first)) | (places >= np.array(grid.last))).any(axis=1)
    scale = row_scale(varying.weight[here], stencil)
    return torch.from_numpy(varying.index[here]), torch.from_numpy(scale).to(dtype)


def layer_columns(
    varying: VaryingCells, stencil: Stencil, grid: Grid, factor: float, dtype: torch.dtype
) -> Columns:
    """Find the columns whose cells are not of air, by the cell half-way through the layer.

    Args:
        varying: the cells that are not of air.
        stencil: weights in air.
        grid: where the cells are.
        factor: what the weights are multiplied with for the time step.
        dtype: of the weights.
    """
    places = np.stack(np.unravel_index(varying.index, grid.shape), axis=-1)
    strides = np.array((grid.shape[1] * grid.shape[2], grid.shape[2], 1))
    ahead = np.array(OFFSETS)
    depth = np.arange(grid.layer_cells + 2)
    parts = []
    for axis in range(3):
        across = ahead[:, axis] == 1
        offset = (ahead[across] - np.eye(3, dtype=np.int64)[axis]) @ strides
        for start, inwards in ((0, 1), (grid.shape[axis] - 1, -1)):
            here = np.flatnonzero(places[:, axis] == start + inwards * (1 + grid.layer_cells // 2))
            first = varying.index[here] + (start - places[here, axis]) * strides[axis]
            index = first[:, None] + inwards * depth * strides[axis]
            rows = varying.weight[here]
            alike = row_scale(rows, stencil)[:, None] * stencil.weights[across]
            weight = rows[:, across] - alike
            used = np.abs(weight).max(axis=1, initial=0) > _ALIKE * stencil.face
            parts.append((index[used], np.broadcast_to(offset, (int(used.sum()), 9)), factor * weight[used]))
    index, offset, weight = (torch.from_numpy(np.concatenate(part)) for part in zip(*parts, strict=True))
    return Columns(index, offset, weight.to(dtype))
