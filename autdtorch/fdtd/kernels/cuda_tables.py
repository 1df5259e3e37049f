"""Tables of the CUDA kernel: the contract's tensors, on the device and in the order of reading."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from autdtorch.fdtd.kernels.contract import Coefficients, Columns, Receivers, Sources


class Cells(NamedTuple):
    """Number of cells along x, y and z."""

    nx: int
    ny: int
    nz: int


class Profile(NamedTuple):
    """Recursion coefficients of the layers, zero-padded to the depth of a block of lanes."""

    decay: Tensor
    gain: Tensor


class Terms(NamedTuple):
    """Terms that layers add to the sums across them, low layer first, both counted inwards."""

    y: Tensor  # E_y p (nx, 2 L, nz)
    z: Tensor  # E_z p (nx, ny, 2 L)
    yz: Tensor  # E_y E_z p (nx, 2 L, 2 L)
    columns: Tensor  # added to the pressure (L m + 1,), with a zero at the end
    crossed: Tensor  # likewise, added to the columns


class Heterogeneous(NamedTuple):
    """n heterogeneous cells."""

    size: int
    cell: Tensor  # flat index (n,)
    weight: Tensor  # stencil rows (27, n)
    scale: Tensor  # of the layers' term, 0 outside of them (n,)
    settled: Tensor  # workspace: new pressure less `scale` times the result of the sweep (n,)
    loss: Tensor  # rows on the change of a step, and ground (28, n); none (0, n) without losses


class ColumnTable(NamedTuple):
    """m columns."""

    size: int
    cell: Tensor  # flat index (L + 2, m)
    offset: Tensor  # (w, m)
    weight: Tensor  # (w, m)
    crossing: Tensor  # place of the terms that cross them (L + 2, m)


class Settled(NamedTuple):
    """k cells that a sweep leaves wrong, ascending."""

    cell: Tensor  # flat index (k,)
    heterogeneous: Tensor  # place among the heterogeneous cells, -1 for others (k,)
    share: Tensor  # places among the columns' terms, including the zero at their end (w, k)
    sound_hard: Tensor  # 1 where sound-hard (k,)


class Driven(NamedTuple):
    """n cells to correct: the k of `Settled`, then those that are only driven."""

    settled: int  # k
    size: int  # n
    cell: Tensor  # flat index (n,)
    force: Tensor  # by each of the S signals (S, n)


class ReceiverTable(NamedTuple):
    """R receivers of w cells each."""

    size: int  # R
    width: int  # w
    cell: Tensor  # flat index (w, R)
    weight: Tensor  # (w, R)
    recorded: Tensor  # record (steps, R)


def heterogeneous_table(c: Coefficients, device: torch.device) -> Heterogeneous:
    """Return the heterogeneous cells, with the scale of the layers' term in those in layers."""
    index, count = c.heterogeneous_index.to(device), len(c.heterogeneous_index)
    scale = torch.zeros(count, dtype=c.heterogeneous_weight.dtype, device=device)
    scale[torch.searchsorted(index, c.layer_index.to(device))] = c.layer_scale.to(device)
    weight = c.heterogeneous_weight.to(device).T.contiguous()
    loss = weight.new_zeros((28 if len(c.loss_index) else 0, count))
    place = torch.searchsorted(index, c.loss_index.to(device).contiguous())
    loss[:, place] = torch.cat((c.loss_weight.T, c.loss_ground[None])).to(weight)[: len(loss)]
    return Heterogeneous(count, index.contiguous(), weight, scale, torch.zeros_like(scale), loss)


def column_table(columns: Columns, crossing: Tensor, device: torch.device) -> ColumnTable:
    """Return columns, with the places (m, L + 2) of the terms to add to each cell's sum."""
    index, offset, weight, crossing = (
        each.to(device).T.contiguous() for each in (columns.index, columns.offset, columns.weight, crossing)
    )
    return ColumnTable(index.shape[1], index, offset, weight, crossing)


def settled_table(c: Coefficients, device: torch.device) -> Settled:
    """Return heterogeneous cells, sound-hard cells and those of columns, each once."""
    inside = c.columns.index.to(device).T[1:-1].reshape(-1)
    heterogeneous, sound_hard = c.heterogeneous_index.to(device), c.sound_hard_index.to(device)
    cell = torch.unique(torch.cat((heterogeneous, sound_hard, inside)))
    place = torch.full_like(cell, -1)
    place[torch.searchsorted(cell, heterogeneous)] = torch.arange(len(heterogeneous), device=device)
    hard = torch.zeros(len(cell), dtype=torch.int8, device=device)
    hard[torch.searchsorted(cell, sound_hard)] = 1
    # the n-th of the terms that come to a cell is in row n
    taker, order = torch.sort(torch.searchsorted(cell, inside), stable=True)
    count = torch.bincount(taker, minlength=len(cell))
    nth = torch.arange(len(inside), device=device) - (count.cumsum(0) - count)[taker]
    width = int(count.max()) if len(inside) else 0
    share = torch.full((width, len(cell)), len(inside), dtype=torch.int64, device=device)
    share[nth, taker] = order
    return Settled(cell, place, share, hard)


def driven_table(sources: Sources, settled: Settled, dtype: torch.dtype, device: torch.device) -> Driven:
    """Return the settled cells and the driven ones, each once."""
    index = sources.index.to(device)
    listed = torch.isin(index, settled.cell)
    cell = torch.cat((settled.cell, index[~listed]))
    place = torch.searchsorted(settled.cell, index)
    place[~listed] = torch.arange(len(settled.cell), len(cell), device=device)
    of_sources = sources.force.detach().to(device, dtype)
    force = torch.zeros((of_sources.shape[1], len(cell)), dtype=dtype, device=device)
    force[:, place] = of_sources.T
    return Driven(len(settled.cell), len(cell), cell, force)


def receiver_table(
    receivers: Receivers, steps: int, dtype: torch.dtype, device: torch.device
) -> ReceiverTable:
    """Return the receivers, for calls of `steps`."""
    index, weight = receivers.index.to(device).T.contiguous(), receivers.weight.to(device).T.contiguous()
    recorded = torch.zeros((steps, index.shape[1]), dtype=dtype, device=device)
    return ReceiverTable(index.shape[1], len(index), index, weight.to(dtype), recorded)


def no_terms(shape: Cells, c: Coefficients, device: torch.device) -> Terms:
    """Return workspace for the layers' terms."""
    cells, (nx, ny, nz) = c.layer_cells, shape
    columns, crossed = ((cells * len(each.index) + 1,) for each in (c.columns, c.crossed))
    sizes = ((nx, 2 * cells, nz), (nx, ny, 2 * cells), (nx, 2 * cells, 2 * cells), columns, crossed)
    return Terms(*(torch.zeros(size, dtype=c.layer_decay.dtype, device=device) for size in sizes))
