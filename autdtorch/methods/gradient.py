"""Gradient ascent on a goal, by a known transfer matrix.

No method that sees magnitudes only can do this on a real array. It is a baseline to compare them with.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch

from autdtorch.methods.base import Method, Step, whole
from autdtorch.methods.problem import Problem, known_matrix, starts_of
from autdtorch.methods.seeds import generators_of, uniform
from autdtorch.objectives.forces import LeastForm
from autdtorch.objectives.goals import scores_of, slope_of
from autdtorch.objectives.objective import GoalFunction
from autdtorch.utils.array_types import REAL
from autdtorch.utils.process import one_library_thread

# First and last value, in equal ratios between: smoothing of `Goal.slope`, and step in amplitudes
_SMOOTHING = (0.3, 1e-4)
_STEP = (0.5, 0.005)
_MOMENTUM = 0.9
_TINY = 1e-300

STARTS = 16
"""Number of random drives from which `highest_drive` climbs."""

_STEPS_FROM_ANYWHERE = 300


@dataclass(frozen=True)
class GradientAscent(Method):
    """Climb the goal over all drives of amplitudes <= 1, by the transfer matrix of the problem.

    A trial climbs from `starts` drives of random phases and observes the highest: one evaluation. With 16
    transducers that is nearly always the global maximum, to 1e-4; a few hundred need more `steps`. Where the
    problem has a drive to start from, it is the first of these.

    The matrix is the simulated one. Under perturbations, and on a bench, the drive is the best of the
    simulation, not of what is observed.

    Attributes:
        starts: number of drives that a trial starts from, >= 1.
        steps: of each climb, >= 2.
    """

    name: ClassVar[str] = "gradient_ascent"
    label: ClassVar[str] = "gradient ascent"

    starts: int = whole(32, least=1)
    steps: int = whole(300, least=2)

    def check(self, problem: Problem) -> None:
        """Check that the problem has a transfer matrix."""
        known_matrix(problem)

    def numbers_kept(self, problem: Problem) -> float:
        """Return the numbers of all climbs."""
        return self.steps + 2.0 * self.starts * (4 * problem.transducers + 2 * problem.foci)

    def begin(self, problem: Problem, seeds: Sequence[int]) -> Step:
        """Climb, and observe the highest drive."""
        matrix = known_matrix(problem)
        starts = [random_drives(self.starts, problem.transducers, draws) for draws in generators_of(seeds)]
        if (known := starts_of(problem, len(seeds))) is not None:
            starts = [torch.cat([drive[None], drawn[1:]]) for drive, drawn in zip(known, starts, strict=True)]
        highest = [climb(problem.goal, matrix, drives, self.steps) for drives in starts]
        return Step(torch.stack(highest)[:, None], {})


def random_drives(count: int, transducers: int, generator: torch.Generator) -> torch.Tensor:
    """Return drives (count, M) of amplitudes 1 and random phases."""
    turns = uniform(generator, count, transducers)
    return torch.polar(torch.ones_like(turns), 2 * math.pi * turns)


@one_library_thread()
def climb(goal: GoalFunction, matrix: torch.Tensor, drive: torch.Tensor, steps: int) -> torch.Tensor:
    """Return the highest drive (M,) of the climbs of a goal from drives (S, M), on one matrix (P, M)."""
    if isinstance(goal, LeastForm):
        drive = goal.climbed(matrix, drive, steps)
    else:
        drive = climbed(goal, matrix, drive, steps)
    return drive[scores_of(goal, _product(drive, matrix.mT).abs()).argmax()]


@one_library_thread()
def climbed(goal: GoalFunction, matrix: torch.Tensor, drive: torch.Tensor, steps: int) -> torch.Tensor:
    """Return drives (S, M) after projected gradient ascents of a goal with momentum from drives (S, M).

    All ascents are on one matrix (P, M), or each is on one of (S, P, M). The goal is smoothed less and less.
    """
    back, velocity = matrix.conj_physical(), torch.zeros_like(drive)
    for progress in torch.linspace(0, 1, steps, **REAL).tolist():
        smoothing, step = (first * (last / first) ** progress for first, last in (_SMOOTHING, _STEP))
        pressure = _product(drive, matrix.mT)
        weights = slope_of(goal, pressure.abs(), smoothing)
        slope = _product(weights * pressure.sgn(), back)
        slope = slope / slope.abs().mean(dim=-1, keepdim=True).clamp_min(_TINY)
        velocity = slope.lerp(velocity, _MOMENTUM)
        drive = drive.add(velocity, alpha=step)
        drive = drive / drive.abs().clamp_min(1)
    return drive


def highest_drive(
    goal: GoalFunction, matrix: torch.Tensor, generator: torch.Generator, seen: torch.Tensor | None = None
) -> torch.Tensor:
    """Return the best drive (M,) of a matrix (P, M) by climbs from random drives.

    Another climb begins at the best of the drives `seen` (N, M), if there are any.
    """
    starts = random_drives(STARTS, matrix.shape[1], generator)
    if seen is not None:
        best = scores_of(goal, (seen @ matrix.T).abs()).argmax()
        starts = torch.cat([seen[best][None], starts])
    return climb(goal, matrix, starts, _STEPS_FROM_ANYWHERE)


def _product(vectors: torch.Tensor, matrix: torch.Tensor) -> torch.Tensor:
    """Return vectors (S, n) times one matrix (n, m), or each times its own of (S, n, m)."""
    return (vectors[:, None] @ matrix)[:, 0]
