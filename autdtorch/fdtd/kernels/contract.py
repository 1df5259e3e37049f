"""What every kernel gets and does: tensors, indices and coefficients, never a scene.

One step, from pressures `now` and `before` at two successive times to the next (all of it linear):

1. new = center now + face F + edge E + corner C - keep before, with F, E, C the sums over the 6, 12 and 8
   neighbours;
2. in the varying cells instead new = (1 + keep) now - keep before + sum_j weight_j (now_j - now);
3. in each of the six boundary layers the memory is advanced and its term added (`boundary.py`);
4. the sources are added: new += cos(w t) Re(force) + sin(w t) Im(force), times the envelope;
5. the outermost ring of cells stays zero.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch

Layer = tuple[torch.Tensor, torch.Tensor]
"""Memory of the two boundary layers of an axis, stacked (2, nx, ny, nz) low and high: psi with n + 1 half
cells and zeta with n cells along that axis, counted inwards from outside on both sides."""


@dataclass(frozen=True)
class Coefficients:
    """Everything about the medium that a kernel sees.

    Attributes:
        center: weight of the cell itself; center + 6 face + 12 edge + 8 corner = 1 + keep.
        face: weight of each of 6 neighbours.
        edge: weight of each of 12.
        corner: weight of each of 8.
        keep: weight of the pressure before, 1 in air that does not absorb and below it otherwise.
        varying_index: flat indices (n,) int64 of the varying cells.
        varying_weight: their weights (n, 27).
        layer_decay: b of the boundary layer at half cells and cells, interleaved from outside (2 L + 1,).
        layer_gain: a, likewise.
    """

    center: float
    face: float
    edge: float
    corner: float
    keep: float
    varying_index: torch.Tensor
    varying_weight: torch.Tensor
    layer_decay: torch.Tensor
    layer_gain: torch.Tensor

    @property
    def layer_cells(self) -> int:
        """Thickness of the boundary layers."""
        return len(self.layer_decay) // 2


@dataclass
class State:
    """Two pressure fields (nx, ny, nz) and the memory of the boundary layers of x, y and z."""

    now: torch.Tensor
    before: torch.Tensor
    layers: tuple[Layer, ...]


def uniform_state(
    shape: tuple[int, int, int], layer_cells: int, pressure: float, dtype: torch.dtype
) -> State:
    """A medium at rest at one pressure, on an array of `shape`."""
    layers = []
    for axis in range(3):
        half, full = [2, *shape], [2, *shape]
        half[axis + 1], full[axis + 1] = layer_cells + 1, layer_cells
        # Contiguous along y across z, along z across x and y: the long direction, in which a kernel runs.
        layers.append((_zeros(half, axis == 2, dtype), _zeros(full, axis == 2, dtype)))
    core = torch.full([cells - 2 for cells in shape], pressure, dtype=dtype)
    now = torch.nn.functional.pad(core, (1,) * 6)
    return State(now, now.clone(), tuple(layers))


def _zeros(size: list[int], swapped: bool, dtype: torch.dtype) -> torch.Tensor:
    if not swapped:
        return torch.zeros(size, dtype=dtype)
    two, x, y, z = size
    return torch.zeros((two, x, z, y), dtype=dtype).transpose(2, 3)


@dataclass(frozen=True)
class Sources:
    """Cells that are driven: flat `index` (n,) int64 without repeats, complex `force` (n,) [Pa]."""

    index: torch.Tensor
    force: torch.Tensor


@dataclass(frozen=True)
class Receivers:
    """Points that are read: flat `index` (R, n) int64 and `weight` (R, n)."""

    index: torch.Tensor
    weight: torch.Tensor


class Kernel(Protocol):
    """Advances a state by whole steps."""

    def advance(
        self,
        state: State,
        coefficients: Coefficients,
        sources: Sources,
        receivers: Receivers,
        signal: torch.Tensor,
    ) -> tuple[State, torch.Tensor]:
        """Step once per row of `signal` (steps, 2), the cosine and sine of w t times the envelope.

        Returns:
            The state afterwards, which may share memory with the one given (do not use that one again), and
            the pressure at the receivers after each step (steps, R).
        """
        ...
