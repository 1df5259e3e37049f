"""Gradient ascent on a goal, by a known transfer matrix.

No method that sees magnitudes only can do this on a real array. It is a baseline to compare them with.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, TypeGuard, cast

import numpy as np
import torch

from autdtorch.methods.base import Method, Problem, Step, known_matrix, starts_of
from autdtorch.methods.driver import run
from autdtorch.methods.seeds import Trials, generators_of
from autdtorch.methods.solution import Solution
from autdtorch.objectives.bound import checked_matrix
from autdtorch.objectives.goals import WEAKEST_FOCUS, scores_of, slope_of
from autdtorch.objectives.objective import Objective, Score
from autdtorch.utils.array_types import REAL
from autdtorch.utils.threads import one_library_thread
from autdtorch.utils.validation import ArrayLike, integer_at_least

# First and last value, in equal ratios between: smoothing of `Goal.slope`, and step in amplitudes
_SMOOTHING = (0.3, 1e-4)
_STEP = (0.5, 0.005)
_MOMENTUM = 0.9
_TINY = 1e-300


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

    starts: int = 32
    steps: int = 300

    def __post_init__(self) -> None:
        """Check the settings."""
        object.__setattr__(self, "starts", integer_at_least("starts", self.starts, 1))
        object.__setattr__(self, "steps", integer_at_least("steps", self.steps, 2))

    def numbers_kept(self, problem: Problem) -> float:
        """Return the numbers of all climbs."""
        return self.steps + 2.0 * self.starts * (4 * problem.transducers + 2 * problem.foci)

    def begin(self, problem: Problem, seeds: Sequence[int]) -> Step:
        """Climb, and observe the highest drive."""
        matrix = known_matrix(problem)
        starts = [random_drives(self.starts, problem.transducers, own) for own in generators_of(seeds)]
        if (given := starts_of(problem, len(seeds))) is not None:
            starts = [torch.cat([own[None], drawn[1:]]) for own, drawn in zip(given, starts, strict=True)]
        highest = [climb(problem.goal, matrix, start, self.steps) for start in starts]
        return Step(torch.stack(highest)[:, None], {})


def gradient_ascent(
    objective: Objective | ArrayLike,
    starts: int = 32,
    steps: int = 300,
    trials: Trials = 1,
    seed: int = 0,
    score: Score = WEAKEST_FOCUS,
) -> Solution:
    """Run `GradientAscent` with these settings on an objective, or on a transfer matrix; see `run`.

    Args:
        objective: one with a transfer matrix, or the transfer matrix G (P, M) [Pa] alone.
        starts: see `GradientAscent`.
        steps: see `GradientAscent`.
        trials: number of trials T, >= 1, or their numbers.
        seed: of the random choices, >= 0.
        score: function of pressures (..., P) [Pa] that is maximised.

    Returns:
        The drive that each trial chose.
    """
    method = GradientAscent(starts, steps)
    if not _is_matrix(objective):
        return run(method, cast(Objective, objective), trials, seed, score=score)
    matrix = torch.from_numpy(checked_matrix(objective, "objective"))
    points, transducers = matrix.shape
    state = method.start(Problem(transducers, points, score, transfer_matrix=matrix), seed, trials)
    pressure = (method.ask(state) @ matrix.mT).abs()
    return method.best(method.tell(state, pressure))


def _is_matrix(objective: object) -> TypeGuard[ArrayLike]:
    """Return whether this is a transfer matrix: numbers, and neither an objective nor a list of them."""
    if isinstance(objective, list | tuple):
        return not any(isinstance(entry, Objective) for entry in objective)
    return isinstance(objective, torch.Tensor | np.ndarray)


def random_drives(count: int, transducers: int, generator: torch.Generator) -> torch.Tensor:
    """Return drives (count, M) of amplitudes 1 and random phases."""
    turns = torch.rand(count, transducers, dtype=torch.float64, generator=generator, device="cpu")
    return torch.polar(torch.ones_like(turns), 2 * math.pi * turns)


@one_library_thread()
def climb(goal: Score, matrix: torch.Tensor, drive: torch.Tensor, steps: int) -> torch.Tensor:
    """Return the highest drive (M,) of the climbs of a goal from drives (S, M), on one matrix (P, M)."""
    drive = climbed(goal, matrix, drive, steps)
    return drive[scores_of(goal, _pressure(matrix, drive).abs()).argmax()]


@one_library_thread()
def climbed(goal: Score, matrix: torch.Tensor, drive: torch.Tensor, steps: int) -> torch.Tensor:
    """Return drives (S, M) after projected gradient ascents of a goal with momentum from drives (S, M).

    Each ascent is on one matrix (P, M) or on its own (S, P, M). The goal is smoothed less and less.
    """
    velocity = torch.zeros_like(drive)
    for progress in torch.linspace(0, 1, steps, **REAL).tolist():
        smoothing, step = (first * (last / first) ** progress for first, last in (_SMOOTHING, _STEP))
        pressure = _pressure(matrix, drive)
        weights = slope_of(goal, pressure.abs(), smoothing)
        slope = ((weights * pressure.sgn())[..., None] * matrix.conj()).sum(dim=-2)
        slope = slope / slope.abs().mean(dim=-1, keepdim=True).clamp_min(_TINY)
        velocity = _MOMENTUM * velocity + (1 - _MOMENTUM) * slope
        drive = drive + step * velocity
        drive = drive / drive.abs().clamp_min(1)
    return drive


def _pressure(matrix: torch.Tensor, drive: torch.Tensor) -> torch.Tensor:
    return (drive[:, None] * matrix).sum(dim=-1)
