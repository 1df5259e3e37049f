"""Goals: scores of pressure magnitudes, which methods maximise, with gradients and upper bounds."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

from autdtorch.objectives.bound import checked_matrix, level_bound
from autdtorch.objectives.objective import Score, checked_pressure, weakest_focus
from autdtorch.utils.array_types import Array
from autdtorch.utils.validation import ArrayLike, integers, invalid, positive, real_tensor, require_kind

# Times that a score falls by its size where quiet points exceed their limit by a factor of e
_PENALTY = 2.0
# Bound of a goal with quiet points: intervals of the excess, relaxations for ratios, and their least gain
_INTERVALS, _MOST_RELAXATIONS, _GAIN = 500, 8, 1e-3


@dataclass(frozen=True)
class Goal(ABC):
    """Base of all goals: a function of pressures (..., P) [Pa] that gives scores (...) to maximise.

    A goal of one's own is a frozen dataclass with `__call__`; gradient and bound are optional. Methods take
    any function of pressures, too.

    Attributes:
        name: of the goal in configs, results and figures; of the class where it has none.
        unit: of the scores, "" for numbers.
    """

    name: ClassVar[str]
    unit: ClassVar[str] = "Pa"

    def __init_subclass__(cls) -> None:
        """Name a goal without a name after its class."""
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

    def check(self, points: int) -> None:  # noqa: B027 - many goals take any number of points
        """Check the goal against the number of control points; `ValueError` where it does not fit."""

    def checked(self, pressure: ArrayLike) -> torch.Tensor:
        """Return pressures (..., P) [Pa] after checking them, and that the goal has as many points."""
        found = checked_pressure(pressure)
        self.check(found.shape[-1])
        return found


@dataclass(frozen=True)
class WeakestFocus(Goal):
    """The pressure of the weakest focus, min_p |p_p| / w_p [Pa]: the paper's goal.

    Attributes:
        weights: pressures w (P,) > 0 wanted relative to each other; None for all alike.
    """

    name: ClassVar[str] = "weakest_focus"

    weights: Sequence[float] | None = None

    def __post_init__(self) -> None:
        """Check the weights."""
        if self.weights is not None:
            object.__setattr__(self, "weights", _positive("weights", self.weights))

    def __call__(self, pressure: ArrayLike) -> torch.Tensor:
        """Return the smallest magnitude over weight (...) [Pa]."""
        return self.levels(self.checked(pressure)).amin(dim=-1)

    def slope(self, pressure: torch.Tensor, smoothing: float) -> torch.Tensor:
        """Return those of the smooth minimum -T log sum_p exp(-|p_p| / (w_p T))."""
        levels = self.levels(pressure)
        hardness = 1 / (smoothing * levels.mean(dim=-1, keepdim=True)).clamp_min(
            torch.finfo(levels.dtype).tiny
        )
        return self.levels(torch.softmax(-levels * hardness, dim=-1))

    def bound(self, G: ArrayLike) -> float:
        """Return the bound of a semidefinite relaxation [Pa]; see `Goal.bound`."""
        matrix = checked_matrix(G)
        self.check(len(matrix))
        return level_bound(matrix, self.wanted(len(matrix)))[0]

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

    targets: Sequence[float]

    def __post_init__(self) -> None:
        """Check the targets."""
        object.__setattr__(self, "targets", _positive("targets", self.targets, "Pa"))

    def __call__(self, pressure: ArrayLike) -> torch.Tensor:
        """Return minus the rms deviation (...), relative to the targets."""
        deviation = self._deviation(self.checked(pressure))
        total: torch.Tensor = torch.linalg.vector_norm(deviation, dim=-1)
        return -total / math.sqrt(len(self.targets))

    def slope(self, pressure: torch.Tensor, smoothing: float) -> torch.Tensor:
        """Return those of minus half the sum of squares."""
        return -self._deviation(pressure) / pressure.new_tensor(self.targets)

    def bound(self, G: ArrayLike) -> float:
        """Return the bound from the largest share of the targets that all can reach; see `Goal.bound`."""
        matrix = checked_matrix(G)
        self.check(len(matrix))
        share, _ = level_bound(matrix, np.array(self.targets))
        return min(0.0, share - 1) / math.sqrt(len(matrix))

    def check(self, points: int) -> None:
        """Check the number of targets."""
        _require_count("targets", self.targets, points)

    def _deviation(self, pressure: torch.Tensor) -> torch.Tensor:
        return pressure / pressure.new_tensor(self.targets) - 1


@dataclass(frozen=True)
class QuietPoints(Goal):
    """A goal for some control points, while others stay quiet: below a ratio of the weakest of the former.

    The other points are scored by `goal`. A penalty is subtracted for the loudest quiet point: twice the
    logarithm of its excess, times the score of a goal in Pa. A quiet region is points of a plane or a sphere.

    Attributes:
        goal: of the points that are not quiet, in their order.
        points: indices of the quiet control points.
        ratio: largest pressure of a quiet point, relative to the weakest other point, > 0; 10^(-30/20) for
            30 dB.
    """

    name: ClassVar[str] = "quiet_points"

    goal: Goal
    points: Sequence[int]
    ratio: float

    def __post_init__(self) -> None:
        """Check the fields."""
        require_kind("goal", self.goal, Goal)
        if isinstance(self.goal, QuietPoints):
            raise invalid("goal", self.goal, "must be a goal without quiet points of its own")
        accepted = "must be indices of control points, each once, at least one"
        points = tuple(integers("points", self.points, 0, accepted))
        if not points or len(set(points)) < len(points):
            raise invalid("points", points, accepted)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "ratio", positive("ratio", self.ratio))

    @property
    def unit(self) -> str:  # type: ignore[override]
        """The unit of the goal."""
        return self.goal.unit

    def __call__(self, pressure: ArrayLike) -> torch.Tensor:
        """Return the score of the loud points (...), less the penalty."""
        loud, quiet = self.parts(self.checked(pressure))
        score, limit = self.goal(loud), self.ratio * loud.amin(dim=-1)
        tiny = torch.finfo(quiet.dtype).tiny
        excess = (quiet.amax(dim=-1).clamp_min(tiny) / limit.clamp_min(tiny)).log().clamp_min(0)
        return score - _PENALTY * excess * (score.abs() if self.unit else 1)

    def slope(self, pressure: torch.Tensor, smoothing: float) -> torch.Tensor:
        """Return those of the goal, less a quadratic penalty for quiet points: more with less smoothing."""
        loud, quiet = self.parts(pressure)
        limit = self.ratio * loud.amin(dim=-1, keepdim=True).clamp_min(torch.finfo(loud.dtype).tiny)
        slope = torch.zeros_like(pressure)
        own = self.goal.slope(loud, smoothing)
        over = (quiet / limit - 1).clamp_min(0) / smoothing
        slope[..., self.others(pressure.shape[-1])] = own
        slope[..., list(self.points)] = -own.abs().sum(dim=-1, keepdim=True) * over
        return slope

    def parts(self, pressure: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the pressures [Pa] of the other points (..., P - K) and of the quiet ones (..., K)."""
        return pressure[..., self.others(pressure.shape[-1])], pressure[..., list(self.points)]

    def others(self, points: int) -> list[int]:
        """Return the indices of the points that are not quiet, of so many in all."""
        return [point for point in range(points) if point not in self.points]

    def bound(self, G: ArrayLike) -> float:
        """Return the bound from a relaxation with the quiet points; see `Goal.bound`."""
        matrix = checked_matrix(G)
        self.check(len(matrix))
        loud, quiet = (part.mT.numpy() for part in self.parts(torch.from_numpy(matrix).mT))
        least = self.goal.bound(loud)
        if not isinstance(self.goal, WeakestFocus):
            return least
        weights = self.goal.wanted(len(loud))
        # A drive of excess x has at most the level for the ratio times e^x, and 1 - penalty x times that is
        # its score. The first rises with x and the second falls: the ends of an interval bound both.
        excess = np.linspace(0, 1 / _PENALTY, _INTERVALS + 1)
        levels, worst = np.full(_INTERVALS, least), 0
        for _ in range(_MOST_RELAXATIONS):
            before = (levels * (1 - _PENALTY * excess[:-1])).max()
            ratio = self.ratio * weights.max() * math.exp(excess[worst])
            level, price = level_bound(loud, weights, quiet, ratio)
            left = 1 - price * np.expm1(2 * (excess[1:] - excess[worst]))
            levels[left > 0] = np.minimum(levels[left > 0], level / np.sqrt(left[left > 0]))
            scores = levels * (1 - _PENALTY * excess[:-1])
            worst = int(scores.argmax()) + 1
            if scores.max() > (1 - _GAIN) * before:
                break
        return float(scores.max())

    def check(self, points: int) -> None:
        """Check the indices, and the goal for the other points."""
        if max(self.points) >= points or len(self.points) == points:
            accepted = f"must be indices from 0 to {points - 1}, and not all of them"
            raise invalid("points", self.points, accepted)
        self.goal.check(points - len(self.points))


WEAKEST_FOCUS = WeakestFocus()
"""The paper's goal."""


def goal_of(score: Score) -> Score:
    """Return the goal that a function is, or the function."""
    return WEAKEST_FOCUS if score is weakest_focus else score


def slope_of(goal: Score, pressure: torch.Tensor, smoothing: float) -> torch.Tensor:
    """Return the derivatives (..., P) of a goal or of any function of magnitudes; see `Goal.slope`."""
    return goal.slope(pressure, smoothing) if isinstance(goal, Goal) else derivative(goal, pressure)


def derivative(goal: Score, pressure: torch.Tensor) -> torch.Tensor:
    """Return the derivatives (..., P) of scores by magnitudes (..., P), by automatic differentiation."""
    with torch.enable_grad():
        magnitude = pressure.detach().requires_grad_()
        found = torch.autograd.grad(goal(magnitude).sum(), magnitude, allow_unused=True)[0]
    return torch.zeros_like(pressure) if found is None else found


def _positive(name: str, values: object, unit: str = "") -> tuple[float, ...]:
    checked = real_tensor(name, values, unit)
    if checked.ndim != 1 or not len(checked) or checked.min() <= 0:
        raise invalid(name, values, "must be numbers > 0, one for each control point", unit)
    return tuple(checked.tolist())


def _require_count(name: str, values: Sequence[float] | None, points: int) -> None:
    if values is not None and len(values) != points:
        raise invalid(name, values, f"must be {points} numbers, one for each control point")
