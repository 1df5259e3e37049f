"""Phase stepping: the transfer matrix by two steps of each transducer's phase, then the best drive on it.

Popoff et al., Physical Review Letters 104 (2010) 100601, measure a transmission matrix for light with four
phases of each input against a static reference. Here the reference is the drive whose entries are stepped.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch

from autdtorch.methods.base import Method, State, Step, whole
from autdtorch.methods.gradient import STARTS, highest_drive, random_drives
from autdtorch.methods.problem import Problem, require_pressures, starts_of
from autdtorch.methods.seeds import generators_of, restored, states_of
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.validation import invalid

_TURNS = (-1 / 3, 1 / 3)  # steps of a phase
_MEAN = ("matrix", "weight")  # tensors of a search, as `_averaged` makes them
_DARK = 1e-3  # least pressure that a reference counts with, relative to the rms of the point
_LEAST_AREA = 1e-6  # of the triangle of three phases; 0 if the device has only two phases


@dataclass(frozen=True)
class PhaseStepping(Method):
    """Step the phase of one transducer after the other, and maximise on the matrix that this shows.

    Around a reference drive, the intensity at each focus is a sinusoid of a transducer's phase. Two further
    phases determine it, and so the pressure that the transducer adds to the reference's. The row of a focus
    follows up to a common phase, if no transducer is louder there than all others of the reference together.

    The first reference has random phases, or is the drive to start from. Each further round steps around the
    best drive of the matrix before, at which no focus is dark. The matrix is the mean of the rounds.

    A trial takes `rounds` * (2 M + 1) + 1 evaluations, fewer than `Identify`. A step changes little of the
    pressure, so that noise harms more: it should be 30 dB below the pressure at random phases.

    Attributes:
        rounds: >= 1.
    """

    name: ClassVar[str] = "phase_stepping"
    label: ClassVar[str] = "phase stepping"

    rounds: int = whole(1, least=1)

    def check(self, problem: Problem) -> None:
        """Check that the goal is of pressures."""
        require_pressures(problem, self.name)

    def most_evaluations(self, problem: Problem) -> int:
        """Return the evaluations of all rounds and of the last drive."""
        return self.rounds * _in_round(problem) + 1

    def most_at_once(self, problem: Problem) -> int:
        """Return the evaluations of a round."""
        return _in_round(problem)

    def numbers_kept(self, problem: Problem) -> float:
        """Add the numbers of a climb."""
        return super().numbers_kept(problem) + 2.0 * STARTS * (4 * problem.transducers + 2 * problem.foci)

    def begin(self, problem: Problem, seeds: Sequence[int]) -> Step:
        """Observe the steps around the first reference."""
        generators = generators_of(seeds)
        if (reference := starts_of(problem, len(seeds))) is None:
            reference = torch.cat([random_drives(1, problem.transducers, draws) for draws in generators])
        return Step(_stepped(problem, reference), {"generators": states_of(generators)})

    def advance(self, state: State, pressure: torch.Tensor, score: torch.Tensor) -> Step:
        """Solve for the matrix, and observe steps around its best drive, or at the end the drive alone."""
        problem, done = state.problem, state.best.history.shape[1]
        if done == self.most_evaluations(problem):
            return Step(state.drives[:, :0], {})
        generators = restored(state.search["generators"])
        searches, drives = [], []
        for trial, generator in enumerate(generators):
            # Copies: sums of a part of a tensor may round by its place in memory.
            before = {name: state.search[name][trial].clone() for name in _MEAN if name in state.search}
            played, observed = state.drives[trial].clone(), pressure[trial].clone()
            searches.append(_averaged(before, _matrix(played, observed), observed[0]))
            matrix, seen = searches[-1]["matrix"], state.best.drive[trial, None]
            drives.append(highest_drive(problem.goal, matrix, generator, seen))
        highest = torch.stack(drives)
        search = {name: torch.stack([each[name] for each in searches]) for name in _MEAN}
        last = done == self.rounds * _in_round(problem)
        asked = problem.quantise(highest)[:, None] if last else _stepped(problem, highest)
        return Step(asked, {**search, "generators": states_of(generators)})

    def _doubts(self, state: State) -> Sequence[Iterable[str]]:
        """Describe nothing: the last drive is far above all others by design."""
        return []


def _in_round(problem: Problem) -> int:
    """Return the evaluations of a round: the reference, and two of each transducer."""
    return 2 * problem.transducers + 1


def _stepped(problem: Problem, reference: torch.Tensor) -> torch.Tensor:
    """Return references (T, M), fully on, each with its steps of all phases (T, 2 M + 1, M)."""
    factors = torch.ones(_in_round(problem), problem.transducers, **COMPLEX)
    turns = 2 * math.pi * torch.tensor(_TURNS, **REAL)
    for start, factor in enumerate(torch.polar(torch.ones_like(turns), turns), 1):
        factors[start::2].fill_diagonal_(factor)
    # Trial by trial, as the rounding of a product may depend on its place in memory
    drives = torch.stack([torch.where(row == 0, 1, row.clone().sgn()) * factors for row in reference])
    drives = problem.quantise(drives)
    if (_area(*_steps(drives)).abs() < _LEAST_AREA).any():
        raise invalid("phase levels of the objective", 2, "must be 3 or more, for phase stepping")
    return drives


def _steps(drives: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the relative changes (..., M) of all entries by their first and their second step."""
    first, second = (
        drives[..., start::2, :].diagonal(dim1=-2, dim2=-1) / drives[..., 0, :] - 1 for start in (1, 2)
    )
    return first, second


def _area(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    return (first.conj() * second).imag


def _matrix(drives: torch.Tensor, pressure: torch.Tensor) -> torch.Tensor:
    """Return the matrix (P, M) that explains magnitudes (N, P) of a reference and its steps (N, M).

    A transducer adds b to the pressure a of the reference. Its step d_j changes the intensity by
    2 Re(d_j x) + t |d_j|^2, with x = a^* b and t = |b|^2. Two steps give x = x_0 - t x_1, and t follows from
    t a^2 = |x|^2. Of its two roots, the smaller one belongs to the transducer; the other one would exchange
    it with the rest of the reference.
    """
    rms = pressure.square().mean(dim=0).sqrt()
    level = torch.maximum(pressure[0], _DARK * rms).clamp_min(torch.finfo(pressure.dtype).tiny)[..., None]
    intensity = pressure.square().mT  # (P, N)
    changes = [(intensity[..., start::2] - intensity[..., :1]) / 2 for start in (1, 2)]
    first, second = _steps(drives)
    sizes = [step.abs().square() / 2 for step in (first, second)]
    area = _area(first, second)

    def solved(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
        """Return x with Re(first x) = one and Re(second x) = other."""
        return 1j * (second.conj() * one - first.conj() * other) / area

    start, slope = solved(*changes), solved(*sizes)
    least = 2 * start.abs() * slope.abs()  # without noise, the middle of the roots is no less
    middle = torch.maximum(2 * (start * slope.conj()).real + level.square(), least)
    power = 2 * start.abs().square() / (middle + (middle.square() - least.square()).sqrt()).clamp_min(1e-300)
    return (start - power * slope) / level / drives[0]


def _averaged(
    search: Mapping[str, torch.Tensor], matrix: torch.Tensor, reference: torch.Tensor
) -> dict[str, torch.Tensor]:
    """Return the mean of the matrices so far (P, M), and the weights of its rows (P, 1).

    Rows have the phases of the first round. They count by the intensity of the reference at the focus, as
    a dark one may have exchanged a transducer with the rest.
    """
    weight = reference.square()[..., None]
    if "matrix" not in search:
        return {"matrix": matrix, "weight": weight}
    mean, before = search["matrix"], search["weight"]
    turned = matrix * (matrix.conj() * mean).sum(dim=-1, keepdim=True).sgn()
    share = weight / (before + weight).clamp_min(torch.finfo(weight.dtype).tiny)
    return {"matrix": mean + share * (turned - mean), "weight": before + weight}
