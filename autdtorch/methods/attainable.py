"""The question whether any drive attains a score: a drive that does, or a certificate that none does."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from autdtorch.methods.gradient import GradientAscent
from autdtorch.methods.problem import Problem, known_matrix
from autdtorch.methods.run import run
from autdtorch.objectives.goals import WEAKEST_FOCUS, Goal
from autdtorch.objectives.objective import GoalFunction, Objective
from autdtorch.utils.validation import finite_number, require_kind

_STARTS = 4, 32  # of ascents; more where the first decide nothing


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
    bound = problem.goal.bound(known_matrix(problem))
    for starts in _STARTS:
        solution = run(GradientAscent(starts=starts), objective, seed=seed, goal=problem.goal)
        best = Attainable(least, float(solution.score[0]), solution.drive[0], bound)
        if best.answer is not None:
            break
    return best
