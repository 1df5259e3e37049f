"""Interfaces through the boundary layers: columns of cells along the normal of a layer.

A layer repeats the cells that it touches, so the stencil row of a cell is constant along the layer's normal.
The kernels stretch rows as in air, scaled to the sum of the cell's own weights: exact inside an obstacle. The
difference of a row at an interface from that is stretched here, by column, with a memory of its own. Where
two layers meet, the difference has a part in the product of both stretchings: columns of one layer cross
those of the other and add to their sums. Without it, waves along interfaces grow.
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
from autdtorch.utils.array_types import Array, Index

_ROUNDING = 1e-6  # Differences from scaled air below this, relative to a face's weight, are rounding
# The boundary layers: their axis, and 1 for the one at its upper end
_LAYERS = tuple(itertools.product(range(3), (0, 1)))
# Columns of one layer: cells in the ring (m,), step inwards, weights (m, w) and offsets (w,)
_Part = tuple[Index, int, Array, Index]


def row_scale(weight: Array, stencil: Stencil) -> Array:
    """Return the sums of stencil rows (n, 27), relative to air."""
    return np.asarray(weight.sum(axis=1) / stencil.total)


def layer_columns(
    cells: HeterogeneousCells, stencil: Stencil, grid: Grid, factor: float, dtype: torch.dtype
) -> tuple[Columns, Columns, torch.Tensor]:
    """Return the columns, the crossed ones and the places of their terms; see `Coefficients`."""
    outside = ~grid.inside(cells.index)
    index, weight = cells.index[outside], cells.weight[outside]
    rows = weight - row_scale(weight, stencil)[:, None] * stencil.weights
    places = np.stack(np.unravel_index(index, grid.shape), axis=-1)
    strides = flat_strides(grid.shape)
    ahead = np.array(OFFSETS) == 1
    middle, inside = 1 + grid.layer_cells // 2, np.arange(1, grid.layer_cells + 2)
    parts, crossed, crossings, count = [], [], [], 0
    for axis, side in _LAYERS:
        used = np.abs(rows[:, ahead[:, axis]]).max(axis=1, initial=0) > _ROUNDING * stencil.face
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
    columns, crossing_columns = (_joined(each, factor, grid, dtype) for each in (parts, crossed))
    return columns, crossing_columns, torch.from_numpy(crossing)


def _depth(places: Index, axis: int, side: int, grid: Grid) -> Index:
    """Return the number of cells (n,) from the ring at one end of an axis inwards."""
    return np.asarray(grid.shape[axis] - 1 - places[:, axis] if side else places[:, axis])


def _columns(foot: Index, stride: int, rows: Array, ahead: NDArray[np.bool_], strides: Index) -> _Part:
    """Return columns from `foot` (m,) on: the weights `ahead` of `rows` (m, 27), moved beside the cell."""
    offsets = np.array(OFFSETS)[ahead]
    beside = np.where((offsets == 1).all(axis=0), 0, offsets)
    return foot, stride, rows[:, ahead], np.asarray(beside @ strides)


def _joined(parts: list[_Part], factor: float, grid: Grid, dtype: torch.dtype) -> Columns:
    depth = np.arange(grid.layer_cells + 2)
    index = np.concatenate([foot[:, None] + stride * depth for foot, stride, _, _ in parts])
    offset = np.concatenate([np.broadcast_to(offset, weight.shape) for _, _, weight, offset in parts])
    weight = torch.from_numpy(factor * np.concatenate([weight for _, _, weight, _ in parts])).to(dtype)
    return Columns(torch.from_numpy(index), torch.from_numpy(offset), weight)
