"""The phases of an objective as a test problem of BoTorch."""

from __future__ import annotations

import warnings

import torch
from botorch.test_functions.base import BaseTestProblem

from autdtorch.methods.phase_points import drives_at, require_transducer
from autdtorch.objectives.goals import WEAKEST_FOCUS
from autdtorch.objectives.objective import GoalFunction, Objective, observe_drives, require_objective
from autdtorch.objectives.scenarios import observed_goal
from autdtorch.utils.hints import renamed_keywords
from autdtorch.utils.validation import boolean, integer_at_least, not_negative, real_tensor, require_callable


class FocusProblem(BaseTestProblem):
    """The score of an objective over the phases of its transducers, for loops written with BoTorch.

    A point holds the phases in turns, from 0 to 1, of all transducers but one, whose phase stays 0; all are
    fully on. ``problem(X)`` gives the scores (...) of points (..., M - 1), to be maximised, and
    ``problem.drives(X)`` their drives (..., M), to save or to play.
    """

    num_objectives = 1
    _is_minimization_by_default = False

    @renamed_keywords(score="goal")
    def __init__(
        self,
        objective: Objective,
        fixed_transducer: int = 0,
        goal: GoalFunction = WEAKEST_FOCUS,
        noise_std: float | None = None,
        negate: bool = False,
    ) -> None:
        """Make the problem.

        Args:
            objective: is evaluated; each point is an evaluation.
            fixed_transducer: index of the transducer whose phase stays 0.
            goal: function of pressures (..., P) [Pa] that gives the scores (...).
            noise_std: standard deviation of noise that is added to scores [Pa].
            negate: whether scores are negated, for loops that minimise.

        Raises:
            ValueError: an argument of another kind or out of range.
        """
        require_objective(objective)
        require_callable("goal", goal)
        transducers = len(objective.scene.array)
        fixed_transducer = integer_at_least("fixed_transducer", fixed_transducer, 0)
        require_transducer(fixed_transducer, transducers)
        if noise_std is not None:
            noise_std = not_negative("noise_std", noise_std, "Pa")
        negate = boolean("negate", negate)
        self.dim = transducers - 1
        self._bounds = [(0.0, 1.0)] * self.dim
        self.continuous_inds = list(range(self.dim))
        super().__init__(noise_std, negate)
        self.objective, (self.goal, _) = objective, observed_goal(objective, goal)
        self.fixed_transducer = fixed_transducer

    @property
    def score(self) -> GoalFunction:
        """The goal, by its name of version 0.1."""
        warnings.warn("FocusProblem.score is now FocusProblem.goal", DeprecationWarning, stacklevel=2)
        return self.goal

    def drives(self, X: torch.Tensor) -> torch.Tensor:
        """Return the drives (..., M) of points (..., M - 1).

        Raises:
            ValueError: points that are no finite numbers, or of another shape.
        """
        X = real_tensor("X", X, "turns").detach()
        if X.ndim == 0 or X.shape[-1] != self.dim or X.numel() == 0:
            raise ValueError(f"X: shape {tuple(X.shape)}; must be (..., {self.dim}), not empty")
        return drives_at(X, self.fixed_transducer)

    def pressures(self, X: torch.Tensor) -> torch.Tensor:
        """Return the pressures (..., P) [Pa] at points (..., M - 1).

        Raises:
            ValueError: points that are no finite numbers, or of another shape.
        """
        return observe_drives(self.objective, self.drives(X), self.dim + 1)

    def _evaluate_true(self, X: torch.Tensor) -> torch.Tensor:
        return self.goal(self.pressures(X)).to(X)
