"""Columns of cells on which an obstacle runs through a boundary layer.

The layer repeats what it touches, so that the row of a cell does not change along the layer's normal. The
kernels stretch rows as in air, scaled to the sum of the cell's own weights: exact inside an obstacle.
What a row at a surface differs by from that is stretched here, by column, with a memory of its own. Where two
layers meet, the difference has a part in the product of both stretchings: columns of the one cross those of
the other there and add to what they stretch. Without it, surfaces grow.
"""

from __future__ import annotations

import itertools

import numpy as np
import torch
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.heterogeneous import HeterogeneousCells
from autdtorch.fdtd.grid import Grid
from autdtorch.fdtd.kernels.contract import Columns
from autdtorch.fdtd.stencil import OFFSETS, Stencil, flat_strides
from autdtorch.utils.arrays import Index

_ALIKE = 1e-6
"""Differences from scaled air below this, relative to a face's weight, are rounding."""

_LAYERS = tuple(itertools.product(range(3), (0, 1)))
"""The boundary layers: their axis, and 1 for the one at its upper end."""


def row_scale(weight: NDArray[np.float64], stencil: Stencil) -> NDArray[np.float64]:
    """Sum of each row's weights (n, 27) over that of air's."""
    return np.asarray(weight.sum(axis=1) / stencil.total)


def scaled_cells(
    heterogeneous: HeterogeneousCells, stencil: Stencil, grid: Grid, dtype: torch.dtype
) -> tuple[torch.Tensor, torch.Tensor]:
    """Cells of the boundary layers (k,) whose rows are not of air, and their scale (k,)."""
    here = ~grid.inside(heterogeneous.index)
    scale = row_scale(heterogeneous.weight[here], stencil)
    return torch.from_numpy(heterogeneous.index[here]), torch.from_numpy(scale).to(dtype)


def layer_columns(
    heterogeneous: HeterogeneousCells, stencil: Stencil, grid: Grid, factor: float, dtype: torch.dtype
) -> tuple[Columns, Columns, torch.Tensor]:
    """Find the columns whose cells are not of air, by the cell half-way through the layer.

    Args:
        heterogeneous: the cells that are not of air.
        stencil: weights in air.
        grid: where the cells are.
        factor: what the weights are multiplied with for the time step.
        dtype: of the weights.

    Returns:
        The columns, the crossed ones, and the places of the terms of these: see `Coefficients`.
    """
    outside = ~grid.inside(heterogeneous.index)
    index, weight = heterogeneous.index[outside], heterogeneous.weight[outside]
    rows = weight - row_scale(weight, stencil)[:, None] * stencil.weights
    places = np.stack(np.unravel_index(index, grid.shape), axis=-1)
    strides = flat_strides(grid.shape)
    ahead = np.array(OFFSETS) == 1
    middle, inside = 1 + grid.layer_cells // 2, np.arange(1, grid.layer_cells + 2)
    parts, crossed, crossings, count = [], [], [], 0
    for axis, side in _LAYERS:
        used = np.abs(rows[:, ahead[:, axis]]).max(axis=1, initial=0) > _ALIKE * stencil.face
        here = np.flatnonzero(used & (_depth(places, axis, side, grid) == middle))
        stride = (1 - 2 * side) * strides[axis]
        foot = index[here] - middle * stride
        parts.append(_columns(foot, stride, rows[here], ahead[:, axis], strides))
        crossing = np.full((2, len(here), grid.layer_cells + 2), -1)
        for other, end in _LAYERS[2 * axis + 2 :]:
            depth, sideways = _depth(places[here], other, end, grid), (1 - 2 * end) * strides[other]
            across = places[here, 3 - axis - other]
            base = np.flatnonzero(depth == middle)
            feet = (foot[base] - middle * sideways)[:, None] + inside * stride
            both = np.repeat(rows[here[base]], len(inside), axis=0)
            crossed.append(_columns(feet.ravel(), sideways, both, ahead[:, axis] & ahead[:, other], strides))
            first = np.full(grid.shape[3 - axis - other], -1)
            first[across[base]] = count + len(inside) * np.arange(len(base))
            met = (depth >= 1) & (depth <= grid.layer_cells) & (first[across] >= 0)
            crossing[0, met] = depth[met, None] - 1
            crossing[1, met, 1:] = first[across[met], None] + inside - 1
            count += len(inside) * len(base)
        crossings.append(crossing)
    depth, column = np.concatenate(crossings, axis=1)
    crossing = np.where(column < 0, grid.layer_cells * count, depth * count + column)
    return (
        _joined(parts, factor, grid, dtype),
        _joined(crossed, factor, grid, dtype),
        torch.from_numpy(crossing),
    )


Part = tuple[Index, int, NDArray[np.float64], Index]
"""Columns of one layer: their cells in the ring (m,), the step inwards, weights (m, w) and offsets (w,)."""


def _depth(places: Index, axis: int, side: int, grid: Grid) -> Index:
    """How many cells (n,) lie inwards of the ring at one end of an axis."""
    return np.asarray(grid.shape[axis] - 1 - places[:, axis] if side else places[:, axis])


def _columns(
    foot: Index, stride: int, rows: NDArray[np.float64], ahead: NDArray[np.bool_], strides: Index
) -> Part:
    """Columns from `foot` (m,) on, with what `rows` (m, 27) have in the places `ahead`, brought beside."""
    offsets = np.array(OFFSETS)[ahead]
    beside = np.where((offsets == 1).all(axis=0), 0, offsets)
    return foot, stride, rows[:, ahead], np.asarray(beside @ strides)


def _joined(parts: list[Part], factor: float, grid: Grid, dtype: torch.dtype) -> Columns:
    depth = np.arange(grid.layer_cells + 2)
    index = np.concatenate([foot[:, None] + stride * depth for foot, stride, _, _ in parts])
    offset = np.concatenate([np.broadcast_to(offset, weight.shape) for _, _, weight, offset in parts])
    weight = np.concatenate([weight for _, _, weight, _ in parts])
    return Columns(
        torch.from_numpy(index), torch.from_numpy(offset), torch.from_numpy(factor * weight).to(dtype)
    )
