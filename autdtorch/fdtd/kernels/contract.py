"""The contract of all kernels: tensors, indices and coefficients in, the next states and records out.

R runs in one medium are stepped side by side; none depends on another. A step takes the pressures `now` and
`before` at two successive times to the next; all of it is linear:

1. new = center now + face F + edge E + corner C - keep before, with F, E, C the sums over the 6, 12 and 8
   neighbours;
2. in heterogeneous cells instead new = (1 + keep) now - keep before + sum_j weight_j (now_j - now);
3. the absorbing layers (`perfectly_matched_layer.py`) add the stretching of the two neighbours' sum along
   each axis, as in air, times `layer_scale` in heterogeneous cells, and by column the difference at
   interfaces;
4. in lossy cells new += sum_j loss_j (now_j - before_j) - ground now, with the cell itself among the j;
5. the sources are added: new += sum_s signal_s force_s, of the S signals that they share;
6. the outermost ring and the sound-hard cells stay zero.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from autdtorch.utils.array_types import AnyArray, Index
from autdtorch.utils.process import cached_property
from autdtorch.utils.spatial import distinct_rows


class Layer(NamedTuple):
    """Memory of both layers of an axis (R, 2, nx, ny, nz), low first, counted inwards, or of m columns."""

    psi: Tensor  # L + 1 half cells along the axis; (R, L + 1, m)
    zeta: Tensor  # L cells; (R, L, m)


class Memory(NamedTuple):
    """Memory of the absorbing layers: of E_x, E_y and E_z, of E_y acting on E_z p, and of columns."""

    x: Layer
    y: Layer
    z: Layer
    yz: Layer  # 2 L cells along z: those of the low and of the high layer, counted inwards
    columns: Layer
    crossed: Layer


@dataclass(frozen=True)
class Columns:
    """m columns of L cells through an absorbing layer, from the ring to the first cell inside."""

    index: Tensor  # flat indices of their cells (m, L + 2) int64, from the ring inwards
    offset: Tensor  # flat offsets from a cell to w cells across the column (m, w) int64
    weight: Tensor  # differences of their weights from those of air (m, w)

    @classmethod
    def none(cls, layer_cells: int, dtype: torch.dtype, width: int = 9) -> Columns:
        """Return no columns, for layers of air."""
        index = _empty(0, layer_cells + 2, dtype=torch.int64)
        return cls(index, index[:, :1].expand(0, width), _empty(0, width, dtype=dtype))


BLOCK = 8
"""Cells of a block. Sums over a rigid hand at 1 mm take half the time that they take cell by cell, and those
at flat faces 0.6 to 0.8 of it; with 4 cells they take 10 to 40 % more, with 16 at the hand twice as much."""


class Blocks(NamedTuple):
    """N cells in B blocks, each of them in one. Others in a block have weights of zero."""

    first: Index  # flat index of the first cell of each block (B,)
    lanes: AnyArray  # its first of the N cells, and one past its last (B, 2) uint32
    slot: Index  # place of each of the N cells among the B `BLOCK` ones of all blocks (N,)
    kind: AnyArray  # number of the weights of each block (B,) uint32
    weight: AnyArray  # distinct weights by neighbour and cell (k, 27, BLOCK)

    def laid(self, values: AnyArray) -> AnyArray:
        """Return values (..., N) of the cells by their slots (..., B `BLOCK`), zero in others."""
        slots = np.zeros((*values.shape[:-1], len(self.first) * BLOCK), values.dtype)
        slots[..., self.slot] = values
        return slots


def blocks_of(index: Index, rows: AnyArray) -> Blocks:
    """Return the blocks of cells with flat indices (N,), ascending, and weights (N, 27).

    At flat faces few blocks are distinct. A block reaches no further than the last cell, and begins fewer
    than `BLOCK` cells before the first one, so that its neighbours are inside any grid with layers.
    """
    starts = np.diff(index, prepend=-2) != 1
    along = np.arange(len(index)) - np.flatnonzero(starts)[np.cumsum(starts) - 1]
    begins = along % BLOCK == 0
    block, first = np.cumsum(begins) - 1, index[begins]
    early = np.maximum(first - (index[-1:] + 1 - BLOCK), 0)
    lane = along % BLOCK + early[block]
    slot = block * BLOCK + lane
    lanes = np.stack((early, early + np.bincount(block, minlength=len(first))), axis=1)
    some, number = distinct_rows(rows)
    numbers = np.full((len(first), BLOCK), len(some))
    numbers.reshape(-1)[slot] = number
    distinct, kind = distinct_rows(numbers)
    table = np.concatenate((rows[some], np.zeros_like(rows, shape=(1, rows.shape[1]))))
    weight = np.ascontiguousarray(table[numbers[distinct]].transpose(0, 2, 1))
    return Blocks(first - early, lanes.astype(np.uint32), slot, kind.astype(np.uint32), weight)


def _empty(*shape: int, dtype: torch.dtype) -> Tensor:
    return torch.zeros(shape, dtype=dtype, device="cpu")


@dataclass(frozen=True)
class Coefficients:
    """The medium as a kernel sees it."""

    center: float  # weight of the cell itself; center + 6 face + 12 edge + 8 corner = 1 + keep
    face: float  # weight of each of 6 neighbours
    edge: float  # weight of each of 12
    corner: float  # weight of each of 8
    keep: float  # weight of the pressure before: 1 without absorption, else less
    heterogeneous_index: Tensor  # flat indices (n,) int64 of the heterogeneous cells, ascending
    heterogeneous_weight: Tensor  # their weights (n, 27)
    sound_hard_index: Tensor  # flat indices (k,) int64 of the sound-hard cells
    # b of the absorbing layer at half cells and cells, interleaved, from outside (2 L + 1,)
    layer_decay: Tensor
    layer_gain: Tensor  # a, likewise
    layer_index: Tensor  # flat indices (k,) int64 of the heterogeneous cells in the layers, ascending
    layer_scale: Tensor  # their layer terms over those of air (k,)
    columns: Columns  # interfaces through the absorbing layers
    crossed: Columns  # interfaces through two layers at once, along one of them
    # flat place, among the terms (L, n) of the `crossed`, of the term to add to the sums across each cell of
    # the columns (m, L + 2) int64; L n for none
    crossing: Tensor
    # flat indices (l,) int64 of the lossy cells, ascending, each of them heterogeneous; their rows on the
    # change of a step (l, 27), and their stiffness against silence (l,)
    loss_index: Tensor = field(default_factory=lambda: _empty(0, dtype=torch.int64))
    loss_weight: Tensor = field(default_factory=lambda: _empty(0, 27, dtype=torch.float32))
    loss_ground: Tensor = field(default_factory=lambda: _empty(0, dtype=torch.float32))
    # runs of cells behind the sound-hard ones, which need no steps: flat indices of the first cell and of one
    # past the last (g, 2) int64, ascending; none of them ends in another row or is in a layer
    idle: Tensor = field(default_factory=lambda: _empty(0, 2, dtype=torch.int64))

    @classmethod
    def of_air(cls, dtype: torch.dtype) -> Coefficients:
        """Return coefficients without heterogeneous cells and layers, for air in which nothing moves."""
        none, numbers, columns = _empty(0, dtype=torch.int64), _empty(1, dtype=dtype), Columns.none(0, dtype)
        return cls(
            0.0, 0.0, 0.0, 0.0, 0.0, none, _empty(0, 27, dtype=dtype), none, numbers, numbers,
            none, numbers[:0], columns, columns, columns.index,
        )  # fmt: skip

    @property
    def layer_cells(self) -> int:
        """Thickness of the absorbing layers."""
        return len(self.layer_decay) // 2

    @cached_property
    def heterogeneous(self) -> Blocks:
        """The heterogeneous cells in blocks."""
        return blocks_of(self.heterogeneous_index.numpy(), self.heterogeneous_weight.numpy())

    @cached_property
    def lossy(self) -> Blocks:
        """The lossy cells in blocks."""
        return blocks_of(
            self.loss_index.numpy(), self.loss_weight.to(self.heterogeneous_weight.dtype).numpy()
        )


@dataclass
class WaveState:
    """The two pressure fields (R, nx, ny, nz) of R runs, and the memory of their absorbing layers."""

    now: Tensor
    before: Tensor
    memory: Memory

    def chosen(self, runs: slice | Tensor) -> WaveState:
        """Return the state of some runs, for a slice a view."""
        memory = (Layer(*(part[runs] for part in layer)) for layer in self.memory)
        return WaveState(self.now[runs], self.before[runs], Memory(*memory))


CPU = torch.device("cpu")


def uniform_state(
    shape: tuple[int, int, int],
    coefficients: Coefficients,
    pressure: float | Tensor,
    runs: int = 1,
    device: torch.device = CPU,
) -> WaveState:
    """Return the state of rest, at a uniform pressure (R, 1, 1, 1) or of all runs, on a grid of `shape`."""
    c, cells = coefficients, coefficients.layer_cells

    def zeros(*size: int) -> Tensor:
        """Return zeros, in large pages of the CPU, which NumPy asks the system for, unlike PyTorch."""
        if device != CPU:
            return torch.zeros((runs, *size), dtype=c.layer_decay.dtype, device=device)
        numbers = np.empty((runs, *size), c.layer_decay.numpy().dtype)
        numbers.fill(0)
        return torch.from_numpy(numbers)

    def silent(*size: int, axis: int) -> Layer:
        return Layer(*(zeros(*size[:axis], along, *size[axis + 1 :]) for along in (cells + 1, cells)))

    sizes = (shape, shape, shape, (*shape[:2], 2 * cells))
    layers = (silent(2, *size, axis=axis + 1) for axis, size in zip((0, 1, 2, 1), sizes, strict=True))
    now, before = zeros(*shape), zeros(*shape)
    for pressures in (now, before):
        pressures[:, 1:-1, 1:-1, 1:-1] = pressure
    columns = (silent(0, len(each.index), axis=0) for each in (c.columns, c.crossed))
    return WaveState(now, before, Memory(*layers, *columns))


@dataclass(frozen=True)
class Sources:
    """Driven cells and their forces by S signals; a drive has cos(w t) and sin(w t), with its envelope."""

    index: Tensor  # flat indices (n,) int64, ascending, distinct; those of all runs
    # force by each signal (R, n, S) [Pa]; of a drive, real and imaginary part of the phasors
    force: Tensor

    def chosen(self, runs: slice | Tensor) -> Sources:
        """Return the sources of some runs."""
        return Sources(self.index, self.force[runs])


@dataclass(frozen=True)
class Receivers:
    """q receivers in each run: flat `index` (q, n) int64 and `weight` (q, n) of their cells."""

    index: Tensor
    weight: Tensor

    @classmethod
    def at(cls, cells: Tensor, dtype: torch.dtype) -> Receivers:
        """Return receivers at the centres of cells (q,)."""
        return cls(cells[:, None], torch.ones((len(cells), 1), dtype=dtype, device="cpu"))


class Kernel(Protocol):
    """Advances the states of runs by whole steps; by default one run at a time, on one thread."""

    device: torch.device
    """The device of states between calls; states on another one are copied."""

    def at_once(self, shape: tuple[int, int, int]) -> int:
        """Return the number of calls on a grid of `shape` that threads may make concurrently."""
        return 1

    def threads(self, shape: tuple[int, int, int]) -> int:
        """Return the number of threads of a call on a grid of `shape`, if it is made alone."""
        return 1

    def together(self, shape: tuple[int, int, int], receivers: int) -> int:
        """Return the number of runs on a grid of `shape`, with q receivers each, that a call should step."""
        return 1

    def advance(
        self, state: WaveState, c: Coefficients, sources: Sources, receivers: Receivers, signal: Tensor
    ) -> tuple[WaveState, Tensor]:
        """Step R runs once per row of `signal` (steps, S); return their new state and record (R, steps, q).

        The new state may share memory with `state`, which must not be used again. The record holds the
        pressure at the receivers after each step.
        """
