"""The question whether any drive attains a score: a drive that does, or a certificate that none does."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from autdtorch.methods.gradient import GradientAscent
from autdtorch.methods.problem import Problem, known_matrix
from autdtorch.methods.run import run
from autdtorch.objectives.bound import checked_matrix
from autdtorch.objectives.forces import LeastForm
from autdtorch.objectives.form_cells import no_drive_above
from autdtorch.objectives.goals import WEAKEST_FOCUS, Goal
from autdtorch.objectives.objective import GoalFunction, Objective
from autdtorch.utils.validation import finite_number, require_kind

_STARTS = 4, 28  # of ascents; the second where the first decide nothing
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

    For forces with up to four transducers, cells of drives decide what these leave open.

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
    bound, best = problem.goal.bound(matrix), None
    for trial, starts in enumerate(_STARTS):
        solution = run(GradientAscent(starts=starts), objective, [trial], seed, goal=problem.goal)
        score = float(solution.score[0])
        if best is None or score > best.score:
            best = Attainable(least, score, solution.drive[0], bound)
        if best.answer is not None:
            return best
    assert best is not None
    if (
        isinstance(problem.goal, LeastForm)
        and problem.transducers <= _FEW
        and least >= 0
        and no_drive_above(checked_matrix(matrix), problem.goal.weights, least)
    ):
        return replace(best, bound=least)
    return best
