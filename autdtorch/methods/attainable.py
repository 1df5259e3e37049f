"""The question whether any drive attains a score: a drive that does, or a certificate that none does."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from autdtorch.methods.gradient import GradientAscent
from autdtorch.methods.problem import Problem, known_matrix
from autdtorch.methods.run import run
from autdtorch.objectives.bound import checked_matrix
from autdtorch.objectives.forces import LeastForm
from autdtorch.objectives.form_cells import search_above
from autdtorch.objectives.goals import WEAKEST_FOCUS, Goal
from autdtorch.objectives.objective import GoalFunction, Objective, magnitudes
from autdtorch.utils.validation import finite_number, require_kind

_STARTS = 4, 28  # of ascents; the second where the first decide nothing, nor cells
_FEW = 4  # transducers, whose drives can be divided into cells


@dataclass(frozen=True, eq=False)
class Attainable:
    """The highest score known, and a bound on all.

    Attributes:
        least: the score asked for.
        score: the highest score that gradient ascent reaches.
        drive: with this score (M,).
        bound: no drive of amplitudes <= 1 scores above it.
    """

    least: float
    score: float
    drive: torch.Tensor
    bound: float

    @property
    def answer(self) -> bool | None:
        """True: `drive` scores above `least`. False: by `bound`, none does. None: neither is known."""
        if self.score > self.least:
            return True
        return False if self.bound <= self.least else None


def attainable(
    objective: Objective,
    least: float = 0.0,
    goal: GoalFunction = WEAKEST_FOCUS,
    seed: int = 0,
) -> Attainable:
    """Return whether a drive scores above `least`, by gradient ascent and the bound of the goal.

    For forces with up to four transducers, ascents from cells of drives, and bounds on each, decide what
    these leave open.

    Args:
        objective: with a transfer matrix, such as a `ForceObjective` of a trap.
        least: the score.
        goal: with a bound; the default gives way to a goal of the objective.
        seed: of the drives that ascents start from, >= 0.

    Raises:
        ValueError: an objective without transfer matrix, or a function that is no `Goal`.
    """
    least = finite_number("least", least)
    problem = Problem.of(objective, goal)
    require_kind("goal", problem.goal, Goal)
    assert isinstance(problem.goal, Goal)
    matrix = known_matrix(problem)
    best = Attainable(least, -math.inf, torch.zeros_like(matrix[0]), problem.goal.bound(matrix))
    for trial, starts in enumerate(_STARTS):
        solution = run(GradientAscent(starts=starts), objective, [trial], seed, goal=problem.goal)
        if (score := float(solution.score[0])) > best.score:
            best = replace(best, score=score, drive=solution.drive[0])
        if best.answer is not None:
            break
        if isinstance(problem.goal, LeastForm) and problem.transducers <= _FEW and least >= 0:
            return _by_cells(best, matrix, problem.goal)
    return best


def _by_cells(best: Attainable, matrix: torch.Tensor, goal: LeastForm) -> Attainable:
    """Return what cells of drives decide of a force, by the rows (N, M)."""
    drive, excluded = search_above(checked_matrix(matrix), goal.weights, best.least)
    if drive is not None:
        played = torch.from_numpy(drive)
        return replace(best, score=float(goal(magnitudes(matrix, played[None]))[0]), drive=played)
    return replace(best, bound=best.least) if excluded else best
