"""Goals: scores of pressure magnitudes, which methods maximise, with gradients and upper bounds."""

from __future__ import annotations

import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

from autdtorch.objectives.bound import checked_matrix, joint_bound, least_bound, level_bound
from autdtorch.objectives.objective import GoalFunction, checked_pressure, weakest_focus
from autdtorch.utils.array_types import Array, ComplexArray
from autdtorch.utils.validation import ArrayLike, invalid, real_tensor


@dataclass(frozen=True)
class Goal(ABC):
    """Base of all goals: a function of pressures (..., P) [Pa] that gives scores (...) to maximise.

    A user's goal is a frozen dataclass with `__call__`; gradient and bound are optional. Methods take
    any function of pressures, too.

    Attributes:
        name: of the goal in configs, results and figures; of the class where it has none.
        unit: of the scores, "" for numbers.
        absolute: whether `wanted` gives pressures in Pa.
        of_pressures: whether it scores pressures at control points, and no other readings, such as forces.
    """

    name: ClassVar[str]
    unit: ClassVar[str] = "Pa"
    absolute: ClassVar[bool] = False
    of_pressures: ClassVar[bool] = True

    def __init_subclass__(cls) -> None:
        """Name a goal without a name after its class, unless its base derives names from values."""
        if not isinstance(getattr(cls, "name", None), property):
            cls.name = cls.__dict__.get("name", cls.__name__)

    @abstractmethod
    def __call__(self, pressure: ArrayLike) -> torch.Tensor:
        """Return the scores (...) of pressure magnitudes (..., P) [Pa]."""

    def slope(self, pressure: torch.Tensor, smoothing: float) -> torch.Tensor:
        """Return derivatives (..., P) of the score by the magnitudes, smoothed over a share of the mean.

        Args:
            pressure: magnitudes (..., P) [Pa].
            smoothing: differences of pressures, relative to their mean, over which minima are smoothed.
        """
        return derivative(self, pressure)

    def bound(self, G: ArrayLike) -> float:
        """Return an upper bound on the score over all drives of amplitudes <= 1, infinite if none is known.

        Args:
            G: transfer matrix (P, M), complex [Pa].

        Raises:
            ValueError: not finite complex numbers, not (P, M), or another number of points than the goal's.
        """
        return math.inf

    def worst_bound(self, matrices: ComplexArray) -> float:
        """Return an upper bound on the lowest of the scores that a drive has with matrices (S, P, M) [Pa].

        By default the least of their bounds.
        """
        return min(self.bound(matrix) for matrix in matrices)

    def wanted(self, points: int) -> Array:
        """Return the pressures (P,) wanted, relative to each other, or in Pa if `absolute`: 1 for each."""
        return np.ones(points)

    def check(self, points: int) -> None:  # noqa: B027 - many goals take any number of points
        """Check the goal against the number of control points; `ValueError` where it does not fit."""

    def checked(self, pressure: ArrayLike) -> torch.Tensor:
        """Return pressures (..., P) [Pa] after checking them, and that the goal has as many points."""
        pressure = checked_pressure(pressure)
        self.check(pressure.shape[-1])
        return pressure


@dataclass(frozen=True)
class WeakestFocus(Goal):
    """The pressure of the weakest focus, min_p |p_p| / w_p [Pa]: the paper's goal.

    Attributes:
        weights: pressures w (P,) > 0 wanted relative to each other; None for all alike.
    """

    name: ClassVar[str] = "weakest_focus"

    weights: Sequence[float] | None = None

    def __post_init__(self) -> None:
        if self.weights is not None:
            object.__setattr__(self, "weights", _positive("weights", self.weights))

    def __call__(self, pressure: ArrayLike) -> torch.Tensor:
        """Return the smallest magnitude over weight (...) [Pa]."""
        return self.levels(self.checked(pressure)).amin(dim=-1)

    def slope(self, pressure: torch.Tensor, smoothing: float) -> torch.Tensor:
        """Return the derivatives of the smooth minimum -T log sum_p exp(-|p_p| / (w_p T))."""
        levels = self.levels(pressure)
        temperature = (smoothing * levels.mean(dim=-1, keepdim=True)).clamp_min(
            torch.finfo(levels.dtype).tiny
        )
        return self.levels(torch.softmax(levels / -temperature, dim=-1))

    def bound(self, G: ArrayLike) -> float:
        """Return the bound [Pa], for few foci nearly attained; see `Goal.bound`."""
        matrix = checked_matrix(G)
        self.check(len(matrix))
        return least_bound(matrix, self.wanted(len(matrix)))

    def worst_bound(self, matrices: ComplexArray) -> float:
        """Return the bound [Pa] on the foci of all matrices together; see `Goal.worst_bound`."""
        return joint_bound(matrices, self.wanted(matrices.shape[1]))

    def check(self, points: int) -> None:
        """Check the number of weights."""
        _require_count("weights", self.weights, points)

    def wanted(self, points: int) -> Array:
        """Return the pressures (P,) wanted relative to each other, 1 without weights."""
        return np.ones(points) if self.weights is None else np.array(self.weights)

    def levels(self, pressure: torch.Tensor) -> torch.Tensor:
        """Return pressures (..., P) [Pa] over their weights."""
        return pressure if self.weights is None else pressure / pressure.new_tensor(self.weights)


@dataclass(frozen=True)
class MeanPressure(Goal):
    """The mean pressure of the control points [Pa]."""

    name: ClassVar[str] = "mean_pressure"

    def __call__(self, pressure: ArrayLike) -> torch.Tensor:
        """Return the mean magnitude (...) [Pa]."""
        return self.checked(pressure).mean(dim=-1)

    def slope(self, pressure: torch.Tensor, smoothing: float) -> torch.Tensor:
        """Return equal derivatives."""
        return torch.full_like(pressure, 1 / pressure.shape[-1])

    def bound(self, G: ArrayLike) -> float:
        """Return the bound [Pa] by the root mean square of points that sound reaches; see `Goal.bound`."""
        matrix = checked_matrix(G)
        reached = matrix[np.abs(matrix).max(axis=1) > 0]
        if len(reached) == 0:
            return 0.0
        level, _ = level_bound(reached, np.ones(len(reached)), together=True)
        return level * len(reached) / len(matrix)


@dataclass(frozen=True)
class TargetPressures(Goal):
    """A pressure for each control point: the score is minus the rms of the relative deviations.

    Attributes:
        targets: (P,) > 0 [Pa].
    """

    name: ClassVar[str] = "target_pressures"
    unit: ClassVar[str] = ""
    absolute: ClassVar[bool] = True

    targets: Sequence[float]

    def __post_init__(self) -> None:
        object.__setattr__(self, "targets", _positive("targets", self.targets, "Pa"))

    def __call__(self, pressure: ArrayLike) -> torch.Tensor:
        """Return minus the rms deviation (...), relative to the targets."""
        deviation = self._deviation(self.checked(pressure))
        total: torch.Tensor = torch.linalg.vector_norm(deviation, dim=-1)
        return -total / math.sqrt(len(self.targets))

    def slope(self, pressure: torch.Tensor, smoothing: float) -> torch.Tensor:
        """Return the derivatives of minus half the sum of squares."""
        return -self._deviation(pressure) / pressure.new_tensor(self.targets)

    def bound(self, G: ArrayLike) -> float:
        """Return the bound from the largest share of the targets that all can reach; see `Goal.bound`."""
        matrix = checked_matrix(G)
        self.check(len(matrix))
        return self.worst_bound(matrix[None])

    def worst_bound(self, matrices: ComplexArray) -> float:
        """Return the bound from the share of the targets that all reach together; see `Goal.worst_bound`."""
        share = joint_bound(matrices, self.wanted(matrices.shape[1]))
        return min(0.0, share - 1) / math.sqrt(matrices.shape[1])

    def wanted(self, points: int) -> Array:
        """Return the targets (P,) [Pa]."""
        return np.array(self.targets)

    def check(self, points: int) -> None:
        """Check the number of targets."""
        _require_count("targets", self.targets, points)

    def _deviation(self, pressure: torch.Tensor) -> torch.Tensor:
        return pressure / pressure.new_tensor(self.targets) - 1


WEAKEST_FOCUS = WeakestFocus()
"""The paper's goal."""


def goal_of(function: GoalFunction) -> GoalFunction:
    """Return the `Goal` that is a function, where there is one, or the function."""
    # the name in the package is decorated when it is first used, which may be after this import
    return WEAKEST_FOCUS if inspect.unwrap(function) is inspect.unwrap(weakest_focus) else function


def scores_pressures(goal: GoalFunction) -> bool:
    """Return whether a goal scores pressures at control points, as functions do, and no other readings."""
    return not isinstance(goal, Goal) or goal.of_pressures


def scores_of(goal: GoalFunction, pressure: torch.Tensor) -> torch.Tensor:
    """Return the scores (...) of a goal or any function for magnitudes (..., P), after checking them.

    They are on the CPU, without a gradient. The function gets a copy, which it may change.
    """
    return _checked_scores(goal, pressure).detach().cpu()


def _checked_scores(goal: GoalFunction, pressure: torch.Tensor) -> torch.Tensor:
    score = real_tensor("score", goal(pressure.clone()))
    if score.shape != pressure.shape[:-1]:
        accepted = f"must be {tuple(pressure.shape[:-1])}, one number for each drive"
        raise ValueError(f"score: shape {tuple(score.shape)}; {accepted}")
    return score


def differentiable_scores(goal: GoalFunction, pressure: torch.Tensor) -> torch.Tensor:
    """Return the scores of magnitudes that require a gradient, with it; `ValueError` where they have none."""
    accepted = "must be differentiable by PyTorch, for a method that climbs it"
    try:
        score = _checked_scores(goal, pressure)
    except RuntimeError as error:  # of PyTorch, such as for a conversion to NumPy
        raise invalid("goal", goal, f"{accepted} ({error})") from error
    if pressure.requires_grad and not score.requires_grad:
        raise invalid("goal", goal, accepted)
    return score


def slope_of(goal: GoalFunction, pressure: torch.Tensor, smoothing: float) -> torch.Tensor:
    """Return the derivatives (..., P) of a goal or of any function of magnitudes; see `Goal.slope`."""
    return goal.slope(pressure, smoothing) if isinstance(goal, Goal) else derivative(goal, pressure)


def derivative(goal: GoalFunction, pressure: torch.Tensor) -> torch.Tensor:
    """Return the derivatives (..., P) of scores by magnitudes (..., P), by automatic differentiation."""
    with torch.enable_grad():
        magnitude = pressure.detach().requires_grad_()
        score = differentiable_scores(goal, magnitude)
        slope = torch.autograd.grad(score.sum(), magnitude, allow_unused=True)[0]
    return torch.zeros_like(pressure) if slope is None else slope


def _positive(name: str, values: object, unit: str = "") -> tuple[float, ...]:
    checked = real_tensor(name, values, unit)
    if checked.ndim != 1 or not len(checked) or checked.min() <= 0:
        raise invalid(name, values, "must be numbers > 0, one for each control point", unit)
    return tuple(checked.tolist())


def _require_count(name: str, values: Sequence[float] | None, points: int) -> None:
    if values is not None and len(values) != points:
        raise invalid(name, values, f"must be {points} numbers, one for each control point")
