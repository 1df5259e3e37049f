"""The algorithms of holography by their definitions, in PyTorch; `kernel.py` has them in numba for CPUs.

G are the matrices (..., P, M), t the wanted pressures (..., P) and q the drives (..., M); sgn(x) = x / |x|,
like products by *, is taken entry by entry:

- "naive": q = sgn(G^H t), back-propagation;
- "gs": p = t * sgn(G q), q = sgn(G^H p) in turns (Gerchberg and Saxton 1972), iterative back-propagation of
  Marzo and Drinkwater (2019), doi:10.1073/pnas.1813047115;
- "wgs": p = b * sgn(G q), q = sgn(G^H p) in turns. After each, b is multiplied by 1 + c (s / r - 1) and
  divided by its largest entry; r = |G q| / t are the shares, s is their largest. Di Leonardo, Ianni and
  Ruocco (2007), doi:10.1364/OE.15.001913, have c = 1, with which close foci change places for ever. Here c
  grows from 0, so that phases of foci settle before weights, and falls to 0 in the end. As many iterations
  before, with q = G^H p, choose the phases of p that begin: at points alone, p = b * sgn(G G^H p), they are
  cheap, and end in the same phases from most first guesses. The result is the q of the highest weakest share;
- "gs_pat": p = G G^H (t * sgn(p)) in turns, and in the end q = sgn(G^H (t^2 * p / |p|^2)) (Martinez Plasencia
  et al. 2020), doi:10.1145/3386569.3392492;
- "diff_pat": Adam on the phases, from those of "wgs", for the least sum of (|p| - t)^2 (Fushimi, Yamamoto and
  Ochiai 2021), doi:10.1038/s41598-021-91880-2.

With free amplitudes, drives are divided by their largest entry in place of sgn.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Literal, TypeAlias

import torch

Algorithm: TypeAlias = Literal["naive", "gs", "wgs", "gs_pat", "diff_pat"]
Project: TypeAlias = Callable[[torch.Tensor], torch.Tensor]

TINY = 1e-30
GOLDEN = (math.sqrt(5) - 1) / 2
"""Golden ratio: multiples of it, modulo 1, are spread evenly."""

UNREACHED = 1e-6
"""Pressure, relative to the loudest point, below which a point gets no more weight."""

_RATES = 0.1, 0.001  # first and last step of Adam [rad, or amplitudes]
_MOMENTS = 0.9, 0.99  # shares of the old means of gradients and their squares in the new ones


def within_largest(drive: torch.Tensor) -> torch.Tensor:
    """Return drives (..., M, 1) over the largest amplitude of each."""
    return drive / drive.abs().amax(dim=-2, keepdim=True).clamp_min(TINY)


def _naive(matrix: torch.Tensor, wanted: torch.Tensor, iterations: int, project: Project) -> torch.Tensor:
    return project(matrix.mH @ wanted.to(matrix.dtype))


def _in_turns(matrix: torch.Tensor, wanted: torch.Tensor, iterations: int, project: Project) -> torch.Tensor:
    back, drive = matrix.mH.resolve_conj(), torch.ones_like(matrix[..., :1, :]).mT
    for _ in range(iterations):
        drive = project(back @ (wanted * (matrix @ drive).sgn()))
    return drive


def weight_change(number: int, iterations: int) -> float:
    """Return c of the iteration `number` of "wgs"."""
    progress = (number + 0.5) / iterations
    return min(1.0, 2 * progress, 4 * (1 - progress))


def _weighted(
    matrix: torch.Tensor, wanted: torch.Tensor, iterations: int, project: Project, at_points: bool = True
) -> torch.Tensor:
    number = torch.arange(matrix.shape[-2], device=matrix.device)
    turns = (number * (number + 1) // 2).double() * GOLDEN % 1  # of any two foci, in no simple relation
    pressure = torch.polar(torch.ones_like(turns), 2 * math.pi * turns)[:, None].to(matrix.dtype)
    if at_points and matrix.shape[-2] <= 2 * matrix.shape[-1]:  # otherwise they take longer
        both = _products(matrix)
        pressure, _ = _reweighting(pressure, wanted, iterations, lambda imposed: both @ imposed)
    back = matrix.mH.resolve_conj()
    _, best = _reweighting(pressure, wanted, iterations, lambda imposed: matrix @ project(back @ imposed))
    return project(back @ best)


def _reweighting(
    pressure: torch.Tensor, wanted: torch.Tensor, iterations: int, turned: Project
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the last pressures (..., P, 1), and the imposed ones of the highest weakest pressure."""
    weights, best, highest = wanted, wanted * pressure.sgn(), torch.zeros_like(wanted[..., :1, :])
    for number in range(iterations):
        imposed = weights * pressure.sgn()
        pressure = turned(imposed)
        share = torch.where(wanted > 0, pressure.abs() / wanted, 0)
        top = share.amax(dim=-2, keepdim=True).clamp_min(TINY)
        # the weight of a point that no transducer reaches would outgrow all others
        share = torch.where(share > UNREACHED * top, share, top)
        level = share.amin(dim=-2, keepdim=True)
        worse = level <= highest  # not where a matrix is not finite, which is refused later
        best, highest = torch.where(worse, best, imposed), torch.maximum(level, highest)
        weights = weights * (1 + weight_change(number, iterations) * (top / share - 1))
        weights = weights / weights.amax(dim=-2, keepdim=True)
    return pressure, best


def _products(matrix: torch.Tensor) -> torch.Tensor:
    """Return G G^H (..., P, P) over its largest entry, against overflow."""
    both = matrix @ matrix.mH
    return both / both.abs().amax(dim=(-2, -1), keepdim=True).clamp_min(TINY)


def _at_points(matrix: torch.Tensor, wanted: torch.Tensor, iterations: int, project: Project) -> torch.Tensor:
    both, pressure = _products(matrix), wanted.to(matrix.dtype)
    for _ in range(iterations):
        pressure = both @ (wanted * pressure.sgn())
    return project(matrix.mH @ (wanted.square() * pressure.sgn() / pressure.abs().clamp_min(TINY)))


SOLVERS: dict[str, Callable[[torch.Tensor, torch.Tensor, int, Project], torch.Tensor]] = {
    "naive": _naive,
    "gs": _in_turns,
    "wgs": _weighted,
    "gs_pat": _at_points,
    "wgs_drives": functools.partial(_weighted, at_points=False),  # of further starts; users do not ask for it
}
"""The algorithms by name: functions of matrices (..., P, M), wanted pressures (..., P, 1), iterations and
`torch.sgn` or `within_largest`."""


def descent(
    matrix: torch.Tensor, wanted: torch.Tensor, drive: torch.Tensor, iterations: int, free: bool
) -> torch.Tensor:
    """Return drives (..., M, 1) with the least sum of (|p| - t)^2 that Adam finds from drives (..., M, 1)."""
    phase, size, back = drive.angle(), drive.abs(), matrix.mH.resolve_conj()
    means, squares = torch.zeros_like(drive), torch.zeros_like(drive)
    for step in range(1, iterations + 1):
        drive = torch.polar(size, phase)
        pressure = matrix @ drive
        flow = (back @ ((pressure.abs() - wanted) * pressure.sgn())).conj() * drive.sgn()
        # by the amplitude, and by the phase times the amplitude
        slope = torch.complex(flow.real, -flow.imag * size)
        means = _MOMENTS[0] * means + (1 - _MOMENTS[0]) * slope
        square = torch.complex(slope.real.square(), slope.imag.square())
        squares = _MOMENTS[1] * squares + (1 - _MOMENTS[1]) * square
        rate = _RATES[0] * (_RATES[1] / _RATES[0]) ** (step / iterations)
        mean, spread = means / (1 - _MOMENTS[0] ** step), squares / (1 - _MOMENTS[1] ** step)
        phase = phase - rate * mean.imag / (spread.imag.sqrt() + TINY)
        if free:
            size = (size - rate * mean.real / (spread.real.sqrt() + TINY)).clamp(0, 1)
    return torch.polar(size, phase)
