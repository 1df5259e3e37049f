"""Columns of cells on which an obstacle runs through a boundary layer.

The layer repeats what it touches, so that the row of a cell does not change along the layer's normal. The
kernels stretch the sum of the two neighbours along that normal as in air; what the row's weights differ from
those of air by is stretched here, by column, with a memory of its own. Where layers meet, the products of
their stretchings are left out of this difference.
"""

from __future__ import annotations

import numpy as np
import torch

from autdtorch.fdtd.bonds import VaryingCells
from autdtorch.fdtd.grid import Grid
from autdtorch.fdtd.kernels.contract import Columns
from autdtorch.fdtd.stencil import OFFSETS, Stencil


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
            weight = varying.weight[here][:, across] - stencil.weights[across]
            parts.append((index, np.broadcast_to(offset, (len(here), 9)), factor * weight))
    index, offset, weight = (torch.from_numpy(np.concatenate(part)) for part in zip(*parts, strict=True))
    return Columns(index, offset, weight.to(dtype))
