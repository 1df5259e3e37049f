"""The contract of all kernels: tensors, indices and coefficients in, the next state and records out.

A step takes the pressures `now` and `before` at two successive times to the next; all of it is linear:

1. new = center now + face F + edge E + corner C - keep before, with F, E, C the sums over the 6, 12 and 8
   neighbours;
2. in heterogeneous cells instead new = (1 + keep) now - keep before + sum_j weight_j (now_j - now); 3. the
boundary layers add the stretching of the two neighbours' sum along each axis (`boundary.py`), as in air,
times
   `layer_scale` in heterogeneous cells, and by column the difference at interfaces (`layer_columns.py`);
4. the sources are added: new += sum_s signal_s force_s, of the S signals that they share;
5. the outermost ring and the sound-hard cells stay zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch

Layer = tuple[torch.Tensor, torch.Tensor]
"""Memory of the two boundary layers of an axis, (2, nx, ny, nz) low and high: psi with L + 1 half cells and
zeta with L cells along that axis, counted inwards on both sides."""


@dataclass(frozen=True)
class Columns:
    """m columns of L cells through a boundary layer, from the ring to the first cell inside.

    Attributes:
        index: flat indices of their cells (m, L + 2) int64, from the ring inwards.
        offset: flat offsets from a cell to w cells across the column (m, w) int64.
        weight: differences of their weights from those of air (m, w).
    """

    index: torch.Tensor
    offset: torch.Tensor
    weight: torch.Tensor

    @classmethod
    def none(cls, layer_cells: int, dtype: torch.dtype, width: int = 9) -> Columns:
        """Return no columns, for layers of air."""
        index, offset = (
            torch.zeros((0, cells), dtype=torch.int64, device="cpu") for cells in (layer_cells + 2, width)
        )
        return cls(index, offset, torch.zeros((0, width), dtype=dtype, device="cpu"))


@dataclass(frozen=True)
class Coefficients:
    """The medium as a kernel sees it.

    Attributes:
        center: weight of the cell itself; center + 6 face + 12 edge + 8 corner = 1 + keep.
        face: weight of each of 6 neighbours.
        edge: weight of each of 12.
        corner: weight of each of 8.
        keep: weight of the pressure before: 1 without absorption, else less.
        heterogeneous_index: flat indices (n,) int64 of the heterogeneous cells, ascending.
        heterogeneous_weight: their weights (n, 27).
        sound_hard_index: flat indices (k,) int64 of the sound-hard cells.
        layer_decay: b of the boundary layer at half cells and cells, interleaved, from outside (2 L + 1,).
        layer_gain: a, likewise.
        layer_index: flat indices (k,) int64 of the heterogeneous cells in the layers, ascending.
        layer_scale: their layer terms over those of air (k,).
        columns: interfaces through the boundary layers.
        crossed: interfaces through two layers at once, along one of them.
        crossing: flat place, among the terms (L, n) of the `crossed`, of the term to add to the sums across
            each cell of the columns (m, L + 2) int64; L n for none.
    """

    center: float
    face: float
    edge: float
    corner: float
    keep: float
    heterogeneous_index: torch.Tensor
    heterogeneous_weight: torch.Tensor
    sound_hard_index: torch.Tensor
    layer_decay: torch.Tensor
    layer_gain: torch.Tensor
    layer_index: torch.Tensor
    layer_scale: torch.Tensor
    columns: Columns
    crossed: Columns
    crossing: torch.Tensor

    @property
    def layer_cells(self) -> int:
        """Thickness of the boundary layers."""
        return len(self.layer_decay) // 2


@dataclass
class State:
    """Two pressure fields (nx, ny, nz) and the memory of the boundary layers.

    `layers` belong to E_x, E_y and E_z, and to E_y acting on E_z p. The last has 2 L cells along z: those of
    the low and of the high layer, counted inwards. `columns` have psi (L + 1, m) and zeta (L, m), and so have
    `crossed`.
    """

    now: torch.Tensor
    before: torch.Tensor
    layers: tuple[Layer, ...]
    columns: Layer
    crossed: Layer


def uniform_state(shape: tuple[int, int, int], coefficients: Coefficients, pressure: float) -> State:
    """Return the state of rest at a uniform pressure on a grid of `shape`."""
    dtype, layer_cells = coefficients.layer_decay.dtype, coefficients.layer_cells
    layers = []
    sizes = (shape, shape, shape, (*shape[:2], 2 * layer_cells))
    for axis, size in zip((0, 1, 2, 1), sizes, strict=True):
        half, full = [2, *size], [2, *size]
        half[axis + 1], full[axis + 1] = layer_cells + 1, layer_cells
        layers.append(
            (torch.zeros(half, dtype=dtype, device="cpu"), torch.zeros(full, dtype=dtype, device="cpu"))
        )
    core = torch.full([cells - 2 for cells in shape], pressure, dtype=dtype, device="cpu")
    now = torch.nn.functional.pad(core, (1,) * 6)
    columns, crossed = (
        (
            torch.zeros((layer_cells + 1, count), dtype=dtype, device="cpu"),
            torch.zeros((layer_cells, count), dtype=dtype, device="cpu"),
        )
        for count in (len(coefficients.columns.index), len(coefficients.crossed.index))
    )
    return State(now, now.clone(), tuple(layers), columns, crossed)


@dataclass(frozen=True)
class Sources:
    """Driven cells and their forces by S signals; a drive has two, cos(w t) and sin(w t), with its envelope.

    Attributes:
        index: flat indices (n,) int64, ascending, distinct.
        force: force by each signal (n, S) [Pa]; of a drive, real and imaginary part of the phasors.
    """

    index: torch.Tensor
    force: torch.Tensor


@dataclass(frozen=True)
class Receivers:
    """R receivers: flat `index` (R, n) int64 and `weight` (R, n) of their cells."""

    index: torch.Tensor
    weight: torch.Tensor


class Kernel(Protocol):
    """Advances a state by whole steps."""

    def at_once(self, shape: tuple[int, int, int]) -> int:
        """Return the number of runs on a grid of `shape` that threads may step concurrently."""
        ...

    def advance(
        self,
        state: State,
        coefficients: Coefficients,
        sources: Sources,
        receivers: Receivers,
        signal: torch.Tensor,
    ) -> tuple[State, torch.Tensor]:
        """Step once per row of `signal` (steps, S), the signals of the sources.

        Returns:
            The new state, which may share memory with the one given, and the pressure at the receivers after
            each step (steps, R). Do not use the given state again.
        """
        ...
