"""Losses in the time step: damping that is exact at the drive's frequency and stable at all others.

A cell has the mass m and the damping coefficients g and c (`assembly/losses.py`), and air absorbs by D a
step. Let s = p - p-. A step solves

    m (p+ - 2 p + p-) + (m D + d) (p+ - p-) = C sum_j [k_ij (p_j - p_i) + e_ij (s_j - s_i)].

The phase of a step at the drive's frequency is theta. Then g is exact for d = g tan(theta / 2) / symbol. For
e = c / sin(theta), c is exact with a stiffness k that is less by c tan(theta / 2). The damping e of the
coupling is late by half a step. The scheme is stable for 0 <= k, 0 <= 2 d + e and C (k + 2 e) <= 4 m as
forms: the second is what passive means, and the third limits the time step.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from autdtorch.fdtd.assembly.heterogeneous import HeterogeneousCells
from autdtorch.fdtd.assembly.losses import LARGEST_TANGENT
from autdtorch.fdtd.stability import fewest_steps, largest_eigenvalue
from autdtorch.fdtd.stencil import Stencil

_TRIALS = 8  # Largest number of time steps that are tried


class SteppedCells(NamedTuple):
    """Cells at a time step; `loss` and `ground` contain the time factor, the others do not."""

    weight: Tensor  # stencil rows (n, 27)
    mass: Tensor  # masses with which sources and adjoint runs count (n,)
    loss: Tensor  # rows of the lossy cells on the change of a step (l, 27)
    ground: Tensor  # their stiffness against silence (l,)


def at_time_step(
    cells: HeterogeneousCells, stencil: Stencil, steps_per_period: float
) -> tuple[HeterogeneousCells, Tensor, Tensor]:
    """Return the cells with rows and masses at a time step, and `loss` and `ground` of `SteppedCells`."""
    rows, losses = (torch.from_numpy(part) for part in (cells.weight, cells.loss))
    masses, place = torch.from_numpy(cells.mass), torch.from_numpy(cells.lossy)
    weight, mass, loss, ground = stepped_cells(rows, masses, place, losses, stencil, steps_per_period)
    return replace(cells, weight=weight.numpy(), mass=mass.numpy()), loss, ground


def stepped_cells(
    weight: Tensor, mass: Tensor, place: Tensor, losses: Tensor, stencil: Stencil, steps_per_period: float
) -> SteppedCells:
    """Return cells with rows (n, 27) and mass (n,), lossy ones at `place` (l,), at a time step.

    `losses` (l, 29) are as in `HeterogeneousCells`. Differentiable by all but the place.
    """
    if not len(place):
        return SteppedCells(weight, mass, losses[:, :27], losses[:, 28])
    turn = 2 * math.pi / steps_per_period
    tangent, of_air = math.tan(turn / 2), stencil.damping(steps_per_period)
    factor = stencil.time_factor(steps_per_period) / (1 + of_air)
    coupling, damped, ground = losses[:, :27], losses[:, 27], losses[:, 28]
    lost = tangent / stencil.symbol * damped
    before, here = mass[place], mass[place] + lost / (1 + of_air)
    whole = mass.index_add(0, place, lost / (1 + of_air))
    rows = (weight[place] * before[:, None] - tangent * coupling) / here[:, None]
    late = factor / math.sin(turn) * coupling / here[:, None]
    keep = (before * (1 - of_air) - lost) / (before * (1 + of_air) + lost)
    middle = keep - (1 - of_air) / (1 + of_air) - late.sum(dim=1)
    loss = late.index_add(1, torch.tensor([13], dtype=torch.int64, device="cpu"), middle[:, None])
    return SteppedCells(weight.index_copy(0, place, rows), whole, loss, factor * ground / here)


def fewest_stable_steps(cells: HeterogeneousCells, stencil: Stencil, shape: tuple[int, int, int]) -> float:
    """Return steps per period at which cells are stable, close to the limit.

    The limit depends on the steps per period N itself, as damping counts by cot(pi / N).
    """
    largest = largest_eigenvalue(cells.index, cells.weight, stencil, shape, cells.largest)
    fewest = fewest_steps(stencil, largest)
    lossy, coupling, ground = cells.lossy, cells.loss[:, :27], cells.loss[:, 28]
    if not (coupling.any() or ground.any()):
        return fewest
    steps = max(fewest, math.pi / math.atan(LARGEST_TANGENT / max(cells.tangent, 1e-9)))
    damped = coupling / cells.mass[lossy, None]
    for _ in range(_TRIALS):
        rows = cells.weight.copy()
        rows[lossy] += damped / math.tan(math.pi / steps)
        rows[lossy, 13] = ground / cells.mass[lossy]
        needed = fewest_steps(stencil, largest_eigenvalue(cells.index, rows, stencil, shape))
        if needed <= steps:
            break
        steps = needed**2 / steps
    return steps
