"""A goal scored in each of several scenes, and the one score of all."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal, TypeAlias

import numpy as np
import torch

from autdtorch.objectives.bound import checked_matrix
from autdtorch.objectives.goals import Goal, scores_pressures, slope_of
from autdtorch.objectives.objective import GoalFunction
from autdtorch.utils.array_types import Array
from autdtorch.utils.validation import (
    ArrayLike,
    finite_number,
    integer_at_least,
    invalid,
    require_callable,
    require_one_of,
)

By: TypeAlias = Literal["worst", "mean"] | float
"""The score of several scenes: the worst or the mean, or a quantile, such as 0.1 for the score that 90 % of
the scenes exceed."""


@dataclass(frozen=True)
class OverScenes(Goal):
    """A goal in several scenes: the worst, the mean or a quantile of its scores.

    The pressures are those of all scenes, one scene after the other, as `Scenarios` observe them.

    Attributes:
        goal: of each scene.
        scenes: number of scenes S, >= 1.
        by: "worst", "mean", or a quantile in (0, 1): the k-th lowest score, k = ceil(by S).
    """

    name: ClassVar[str] = "over_scenes"

    goal: GoalFunction
    scenes: int
    by: By = "worst"

    def __post_init__(self) -> None:
        require_callable("goal", self.goal)
        object.__setattr__(self, "scenes", integer_at_least("scenes", self.scenes, 1))
        object.__setattr__(self, "by", checked_by(self.by))

    @property
    def unit(self) -> str:  # type: ignore[override]
        """The unit of the goal."""
        return self.goal.unit if isinstance(self.goal, Goal) else ""

    @property
    def absolute(self) -> bool:  # type: ignore[override]
        """True if the goal wants pressures in Pa."""
        return isinstance(self.goal, Goal) and self.goal.absolute

    @property
    def of_pressures(self) -> bool:  # type: ignore[override]
        """False if the goal scores other readings."""
        return scores_pressures(self.goal)

    def __call__(self, pressure: ArrayLike) -> torch.Tensor:
        """Return the score (...) of pressures (..., S P) [Pa]."""
        return self.joined(self.by_scene(pressure))

    def by_scene(self, pressure: ArrayLike) -> torch.Tensor:
        """Return the scores (..., S) of each scene for pressures (..., S P) [Pa]."""
        return self.goal(self._apart(self.checked(pressure)))

    def joined(self, scores: torch.Tensor) -> torch.Tensor:
        """Return the score (...) of all scenes for their scores (..., S)."""
        if self.by == "mean":
            return scores.mean(dim=-1)
        return scores.kthvalue(self._rank, dim=-1).values

    def slope(self, pressure: torch.Tensor, smoothing: float) -> torch.Tensor:
        """Return the derivatives (..., S P): of each scene's goal, in proportion to the scene's weight.

        The weights for the worst scene are those of a smooth minimum. For a quantile, scenes of about its
        score have weight. For the mean all scenes have the same weight, and each climbs what its goal climbs:
        with targets, ascent ends at the least mean square of the deviations; with contrasts, at the highest
        mean logarithm.
        """
        apart = self._apart(pressure)
        slope, scores = slope_of(self.goal, apart, smoothing), self.goal(apart)
        if self.by == "mean":
            return slope.flatten(-2) / self.scenes
        spread = (smoothing * scores.abs().mean(dim=-1, keepdim=True)).clamp_min(_TINY)
        away = scores - self.joined(scores)[..., None]
        weights = torch.softmax(-(away if self.by == "worst" else away.abs()) / spread, dim=-1)
        return (weights[..., None] * slope).flatten(-2)

    def bound(self, G: ArrayLike) -> float:
        """Return a bound for the matrix (S P, M) of all scenes; see `Goal.bound`.

        A mean or quantile of scores is at most the mean or quantile of the scenes' bounds. The worst has the
        bound of the goal on all scenes together.
        """
        if not isinstance(self.goal, Goal):
            return math.inf
        matrix = checked_matrix(G)
        self.check(len(matrix))
        matrices = matrix.reshape(self.scenes, -1, matrix.shape[1])
        if self.by == "worst":
            return self.goal.worst_bound(matrices)
        bounds = torch.from_numpy(np.array([self.goal.bound(each) for each in matrices]))
        return float(self.joined(bounds))

    def wanted(self, points: int) -> Array:
        """Return the pressures (S P,) wanted: those of the goal in each scene."""
        if not isinstance(self.goal, Goal):
            return np.ones(points)
        return np.tile(self.goal.wanted(points // self.scenes), self.scenes)

    def check(self, points: int) -> None:
        """Check the number of pressures of all scenes, and the goal for those of one."""
        if points % self.scenes:
            raise invalid("scenes", self.scenes, f"must divide the {points} pressures of all scenes")
        if isinstance(self.goal, Goal):
            self.goal.check(points // self.scenes)

    @property
    def _rank(self) -> int:
        """The place of the score among those of all scenes, 1 for the lowest."""
        return 1 if isinstance(self.by, str) else max(1, math.ceil(self.by * self.scenes * (1 - _ROUNDING)))

    def _apart(self, pressure: torch.Tensor) -> torch.Tensor:
        return pressure.reshape(*pressure.shape[:-1], self.scenes, pressure.shape[-1] // self.scenes)


_TINY = 1e-300
_ROUNDING = 1e-12  # of the product of quantile and scenes: 7 % of 100 scenes are 7


def checked_by(by: object) -> By:
    """Return how the scores of scenes are joined, after checking it."""
    if isinstance(by, str):
        return require_one_of("by", by, ("worst", "mean"))  # type: ignore[return-value]
    quantile = finite_number("by", by)
    if not 0 < quantile < 1:
        raise invalid("by", by, 'must be "worst", "mean", or a quantile above 0 and below 1')
    return quantile
