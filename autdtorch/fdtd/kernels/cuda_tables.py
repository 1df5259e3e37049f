"""What the CUDA kernel steps with: the contract's tensors, on the device and in the order it reads them."""

from __future__ import annotations

from typing import NamedTuple

import torch

from autdtorch.fdtd.kernels.contract import Coefficients, Columns, Layer, Receivers, Sources, State


class Shape(NamedTuple):
    """Cells along x, y and z."""

    nx: int
    ny: int
    nz: int


class Profile(NamedTuple):
    """Recursion coefficients of the layers, with zeros up to the depth of a block of lanes."""

    decay: torch.Tensor
    gain: torch.Tensor


class Memory(NamedTuple):
    """Memory of the two layers of an axis or of columns, as in `contract.State`."""

    psi: torch.Tensor
    zeta: torch.Tensor


class Memories(NamedTuple):
    """All memory of a state."""

    x: Memory
    y: Memory
    z: Memory
    yz: Memory
    columns: Memory
    crossed: Memory


class Terms(NamedTuple):
    """What layers add to the sums across them, low layer first, both counted inwards.

    E_y p (nx, 2 L, nz), E_z p (nx, ny, 2 L) and E_y E_z p (nx, 2 L, 2 L); those of the columns, which are
    added to the pressure, and of the crossed ones (L m + 1,), with a zero at the end.
    """

    y: torch.Tensor
    z: torch.Tensor
    yz: torch.Tensor
    columns: torch.Tensor
    crossed: torch.Tensor


class Heterogeneous(NamedTuple):
    """n heterogeneous cells.

    Attributes:
        size: n.
        cell: flat index (n,).
        weight: as in the contract (27, n).
        scale: of the layers' term, 0 outside of them (n,).
        settled: room for their new pressure, but for `scale` times what the sweep will find (n,).
    """

    size: int
    cell: torch.Tensor
    weight: torch.Tensor
    scale: torch.Tensor
    settled: torch.Tensor


class ColumnTable(NamedTuple):
    """m columns: flat index (L + 2, m), offset and weight (w, m), place of what crosses them (L + 2, m)."""

    size: int
    cell: torch.Tensor
    offset: torch.Tensor
    weight: torch.Tensor
    crossing: torch.Tensor


class Settled(NamedTuple):
    """k cells that a sweep leaves wrong, ascending.

    Attributes:
        cell: flat index (k,).
        heterogeneous: place among the heterogeneous cells, -1 for others (k,).
        share: places among the columns' terms, the zero at their end included (w, k).
        closed: 1 where closed (k,).
    """

    cell: torch.Tensor
    heterogeneous: torch.Tensor
    share: torch.Tensor
    closed: torch.Tensor


class Driven(NamedTuple):
    """All cells to put right: the k of `Settled`, then those that are only driven.

    Attributes:
        settled: k.
        size: n.
        cell: flat index (n,).
        force: by each of the S signals (S, n).
    """

    settled: int
    size: int
    cell: torch.Tensor
    force: torch.Tensor


class ReceiverTable(NamedTuple):
    """R receivers: width w, flat index and weight (w, R), and room for what they record (steps, R)."""

    size: int
    width: int
    cell: torch.Tensor
    weight: torch.Tensor
    recorded: torch.Tensor


def profile_table(c: Coefficients, depths: int, device: torch.device) -> Profile:
    """The layers' profile for blocks of `depths` cells."""
    missing = 2 * depths + 1 - len(c.layer_decay)
    decay, gain = (torch.nn.functional.pad(each, (0, missing)) for each in (c.layer_decay, c.layer_gain))
    return Profile(decay.to(device), gain.to(device))


def heterogeneous_table(c: Coefficients, device: torch.device) -> Heterogeneous:
    """The heterogeneous cells; the layers' term is scaled in those of them that lie in layers."""
    index, count = c.heterogeneous_index.to(device), len(c.heterogeneous_index)
    order = torch.argsort(index)
    scale = torch.zeros(count, dtype=c.heterogeneous_weight.dtype, device=device)
    place = order[torch.searchsorted(index[order], c.layer_index.to(device))]
    scale[place] = c.layer_scale.to(device)
    weight = c.heterogeneous_weight.to(device).T.contiguous()
    return Heterogeneous(count, index.contiguous(), weight, scale, torch.zeros_like(scale))


def column_table(columns: Columns, crossing: torch.Tensor, device: torch.device) -> ColumnTable:
    """Columns, and the place (m, L + 2) among the terms of others of what is added to each cell's sum."""
    index, offset, weight, crossing = (
        each.to(device).T.contiguous() for each in (columns.index, columns.offset, columns.weight, crossing)
    )
    return ColumnTable(index.shape[1], index, offset, weight, crossing)


def settled_table(c: Coefficients, device: torch.device) -> Settled:
    """Heterogeneous cells, closed ones and those of columns, each of them once."""
    inside = c.columns.index.to(device).T[1:-1].reshape(-1)
    heterogeneous, closed = c.heterogeneous_index.to(device), c.sound_hard_index.to(device)
    cell = torch.unique(torch.cat((heterogeneous, closed, inside)))
    place = torch.full_like(cell, -1)
    place[torch.searchsorted(cell, heterogeneous)] = torch.arange(len(heterogeneous), device=device)
    shut = torch.zeros(len(cell), dtype=torch.int8, device=device)
    shut[torch.searchsorted(cell, closed)] = 1
    # the n-th of the terms that come to a cell is in row n
    taker, order = torch.sort(torch.searchsorted(cell, inside), stable=True)
    count = torch.bincount(taker, minlength=len(cell))
    nth = torch.arange(len(inside), device=device) - (count.cumsum(0) - count)[taker]
    width = int(count.max()) if len(inside) else 0
    share = torch.full((width, len(cell)), len(inside), dtype=torch.int64, device=device)
    share[nth, taker] = order
    return Settled(cell, place, share, shut)


def driven_table(sources: Sources, settled: Settled, dtype: torch.dtype, device: torch.device) -> Driven:
    """The settled cells and the driven ones, each of them once."""
    index = sources.index.to(device)
    known = torch.isin(index, settled.cell)
    cell = torch.cat((settled.cell, index[~known]))
    place = torch.searchsorted(settled.cell, index)
    place[~known] = torch.arange(len(settled.cell), len(cell), device=device)
    given = sources.force.detach().to(device, dtype)
    force = torch.zeros((given.shape[1], len(cell)), dtype=dtype, device=device)
    force[:, place] = given.T
    return Driven(len(settled.cell), len(cell), cell, force)


def receiver_table(
    receivers: Receivers, steps: int, dtype: torch.dtype, device: torch.device
) -> ReceiverTable:
    """The receivers, for runs of `steps`."""
    index, weight = receivers.index.to(device).T.contiguous(), receivers.weight.to(device).T.contiguous()
    recorded = torch.zeros((steps, index.shape[1]), dtype=dtype, device=device)
    return ReceiverTable(index.shape[1], len(index), index, weight.to(dtype), recorded)


def no_terms(shape: Shape, c: Coefficients, device: torch.device) -> Terms:
    """Room for the layers' terms."""
    cells, (nx, ny, nz) = c.layer_cells, shape
    columns, crossed = ((cells * len(each.index) + 1,) for each in (c.columns, c.crossed))
    sizes = ((nx, 2 * cells, nz), (nx, ny, 2 * cells), (nx, 2 * cells, 2 * cells), columns, crossed)
    return Terms(*(torch.zeros(size, dtype=c.layer_decay.dtype, device=device) for size in sizes))


def memories(state: State, device: torch.device) -> Memories:
    """A state's memory on the device; shared where it is there already."""

    def moved(layer: Layer) -> Memory:
        psi, zeta = layer
        return Memory(psi.to(device).contiguous(), zeta.to(device).contiguous())

    return Memories(*map(moved, (*state.layers, state.columns, state.crossed)))
