"""Goals for foci beside points that stay quiet, or that are only seen; a region is points of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch

from autdtorch.objectives.bound import checked_matrix, contrast_bound, level_bound
from autdtorch.objectives.goals import WEAKEST_FOCUS, Goal, WeakestFocus
from autdtorch.utils.array_types import Array, ComplexArray
from autdtorch.utils.validation import ArrayLike, integers, invalid, positive, require_kind

# Power of the excess of quiet points by which a score in Pa is divided
_PENALTY = 2.0
# Bound of a goal with quiet points: largest excess and number of intervals, relaxations, and their least gain
_MOST_EXCESS, _INTERVALS, _MOST_RELAXATIONS, _GAIN = 8.0, 16_000, 8, 1e-3
# Least background, relative to the loudest focus: silence behind foci has no other contrast
_LEAST = 1e-10


class _BesideOthers(Goal):
    """Base of goals for some control points, the foci, beside other `points`."""

    points: Sequence[int]

    def __post_init__(self) -> None:
        accepted = "must be indices of control points, each once, at least one"
        checked = tuple(integers("points", self.points, 0, accepted))
        if not checked or len(set(checked)) < len(checked):
            raise invalid("points", self.points, accepted)
        object.__setattr__(self, "points", checked)

    def check(self, points: int) -> None:
        """Check that the indices are among the control points, and leave foci."""
        if max(self.points) >= points or len(self.points) == points:
            raise invalid(
                "points", self.points, f"must be indices from 0 to {points - 1}, and not all of them"
            )

    def wanted(self, points: int) -> Array:
        """Return 0 for the other points, and the pressures wanted at the foci."""
        wanted = np.zeros(points)
        wanted[self._foci(points)] = self._wanted_at_foci(points - len(self.points))
        return wanted

    def _wanted_at_foci(self, foci: int) -> Array:
        return np.ones(foci)

    def _foci(self, points: int) -> list[int]:
        """Return the indices of the foci among so many control points."""
        return sorted(set(range(points)).difference(self.points))

    def _parts(self, pressure: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the pressures [Pa] of the foci (..., P - K) and of the other points (..., K)."""
        return pressure[..., self._foci(pressure.shape[-1])], pressure[..., list(self.points)]

    def _rows(self, G: ArrayLike) -> tuple[ComplexArray, ComplexArray]:
        """Return the checked rows of the foci (P - K, M) and of the other points (K, M)."""
        matrix = checked_matrix(G)
        self.check(len(matrix))
        return matrix[self._foci(len(matrix))], matrix[list(self.points)]

    def _whole(self, at_foci: torch.Tensor, at_others: torch.Tensor) -> torch.Tensor:
        whole = at_foci.new_zeros(*at_foci.shape[:-1], at_foci.shape[-1] + len(self.points))
        whole[..., self._foci(whole.shape[-1])] = at_foci
        whole[..., list(self.points)] = at_others
        return whole


class _GoalBesideOthers(_BesideOthers):
    """Base of a `goal` for the foci, in their order, beside other points."""

    goal: Goal

    def __post_init__(self) -> None:
        require_kind("goal", self.goal, Goal)
        if isinstance(self.goal, _BesideOthers) and not self._takes(self.goal):
            raise invalid("goal", self.goal, "must be a goal without quiet or seen points")
        super().__post_init__()

    def _takes(self, goal: _BesideOthers) -> bool:
        return False

    @property
    def unit(self) -> str:  # type: ignore[override]
        return self.goal.unit

    @property
    def absolute(self) -> bool:  # type: ignore[override]
        return self.goal.absolute

    def check(self, points: int) -> None:
        """Check the indices, and the goal for the other points."""
        super().check(points)
        self.goal.check(points - len(self.points))

    def _wanted_at_foci(self, foci: int) -> Array:
        return self.goal.wanted(foci)


@dataclass(frozen=True)
class SeenPoints(_GoalBesideOthers):
    """A goal for some control points, while others are seen and not scored, as by a camera.

    Methods that fit the transfer matrix, `Identify` and `BayesOpt`, learn from all points.

    Attributes:
        goal: of the points that count, in their order.
        points: indices of the control points that are only seen.
    """

    name: ClassVar[str] = "seen_points"

    goal: Goal
    points: Sequence[int]

    def __call__(self, pressure: ArrayLike) -> torch.Tensor:
        """Return the score of the points that count (...)."""
        return self.goal(self._parts(self.checked(pressure))[0])

    def slope(self, pressure: torch.Tensor, smoothing: float) -> torch.Tensor:
        """Return the derivatives of the goal, 0 at points that are only seen."""
        foci, others = self._parts(pressure)
        return self._whole(self.goal.slope(foci, smoothing), torch.zeros_like(others))

    def bound(self, G: ArrayLike) -> float:
        """Return the bound of the goal; see `Goal.bound`."""
        return self.goal.bound(self._rows(G)[0])

    def worst_bound(self, matrices: ComplexArray) -> float:
        """Return the bound of the goal; see `Goal.worst_bound`."""
        return self.goal.worst_bound(matrices[:, self._foci(matrices.shape[1])])

    def _takes(self, goal: _BesideOthers) -> bool:
        return not isinstance(goal, SeenPoints)


@dataclass(frozen=True)
class QuietPoints(_GoalBesideOthers):
    """A goal for some control points, while others stay quiet: below a ratio of the weakest of the former.

    The other points are scored by `goal`. If the loudest quiet point exceeds its limit by a factor, a score
    in Pa is divided by the square of the factor; from others, twice its logarithm is subtracted. A quiet
    region is points of a plane or a sphere.

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
        super().__post_init__()
        object.__setattr__(self, "ratio", positive("ratio", self.ratio))

    def __call__(self, pressure: ArrayLike) -> torch.Tensor:
        """Return the score of the other points (...), lowered for the excess of quiet points."""
        loud, quiet = self._parts(self.checked(pressure))
        score, limit = self.goal(loud), self.ratio * loud.amin(dim=-1)
        tiny = torch.finfo(quiet.dtype).tiny
        excess = (quiet.amax(dim=-1).clamp_min(tiny) / limit.clamp_min(tiny)).log().clamp_min(0)
        if self.unit:  # a factor: a lower score must not make up for the excess
            return score * (-_PENALTY * excess * score.sgn()).exp()
        return score - _PENALTY * excess

    def slope(self, pressure: torch.Tensor, smoothing: float) -> torch.Tensor:
        """Return the derivatives of the goal and of a penalty for the smooth maximum of the excess."""
        loud, quiet = self._parts(pressure)
        tiny = torch.finfo(loud.dtype).tiny
        least = (_LEAST * loud.mean(dim=-1, keepdim=True)).clamp_min(math.sqrt(tiny))
        rise, weakest = self.goal.slope(loud, smoothing), WEAKEST_FOCUS.slope(loud, smoothing)
        limit = self.ratio * loud.amin(dim=-1, keepdim=True).maximum(least)
        excess = (quiet.clamp_min(tiny) / limit).log() / smoothing
        weights = torch.softmax(torch.cat([torch.zeros_like(limit), excess], dim=-1), dim=-1)[..., 1:]
        penalty = _PENALTY * (rise.abs() * loud).sum(dim=-1, keepdim=True)  # of the size of the score
        raised = penalty * weights.sum(dim=-1, keepdim=True) * weakest * self.ratio / limit
        return self._whole(rise + raised, -penalty * weights / quiet.clamp_min(tiny))

    def bound(self, G: ArrayLike) -> float:
        """Return the bound from a relaxation with the quiet points; see `Goal.bound`."""
        loud, quiet = self._rows(G)
        least = self.goal.bound(loud)
        if not isinstance(self.goal, WeakestFocus):
            return least
        weights = self.goal.wanted(len(loud))
        # A drive whose excess has the logarithm x has at most the level for the ratio times e^x, and
        # e^(-penalty x) times that is its score. The first rises with x and the second falls: the ends of an
        # interval bound both. The last interval has no end.
        excess = np.append(np.linspace(0, _MOST_EXCESS, _INTERVALS), math.inf)
        factor, levels, worst = np.exp(-_PENALTY * excess[:-1]), np.full(_INTERVALS, least), 0
        for _ in range(_MOST_RELAXATIONS):
            before = (levels * factor).max()
            ratio = self.ratio * weights.max() * math.exp(excess[worst])
            level, price = level_bound(loud, weights, quiet, ratio)
            left = np.ones(_INTERVALS)
            if price > 0:
                left -= price * np.expm1(2 * (excess[1:] - excess[worst]))
            levels[left > 0] = np.minimum(levels[left > 0], level / np.sqrt(left[left > 0]))
            scores = levels * factor
            worst = min(int(scores.argmax()) + 1, _INTERVALS - 1)
            if scores.max() > (1 - _GAIN) * before:
                break
        return float(scores.max())

    def worst_bound(self, matrices: ComplexArray) -> float:
        """Return the bound of the goal on all matrices, or of the first with quiet points, if lower."""
        loud = matrices[:, self._foci(matrices.shape[1])]
        return min(self.goal.worst_bound(loud), self.bound(matrices[0]))


@dataclass(frozen=True)
class Contrast(_BesideOthers):
    """The pressure of the weakest focus over the rms pressure of the background.

    Attributes:
        points: indices of the control points of the background; all others are foci.
    """

    name: ClassVar[str] = "contrast"
    unit: ClassVar[str] = ""

    points: Sequence[int]

    def __call__(self, pressure: ArrayLike) -> torch.Tensor:
        """Return the ratios (...), at most 1e10."""
        foci, background = self._parts(self.checked(pressure))
        rms = torch.linalg.vector_norm(background, dim=-1) / math.sqrt(len(self.points))
        least = (_LEAST * foci.amax(dim=-1)).clamp_min(torch.finfo(foci.dtype).tiny)
        ratio: torch.Tensor = foci.amin(dim=-1) / torch.maximum(rms, least)
        return ratio

    def slope(self, pressure: torch.Tensor, smoothing: float) -> torch.Tensor:
        """Return the derivatives of the logarithm, with a smooth minimum."""
        foci, background = self._parts(pressure)
        tiny = torch.finfo(foci.dtype).tiny
        weakest = foci.amin(dim=-1, keepdim=True).clamp_min(tiny)
        power = background.square().sum(dim=-1, keepdim=True).clamp_min(tiny)
        return self._whole(WEAKEST_FOCUS.slope(foci, smoothing) / weakest, -background / power)

    def bound(self, G: ArrayLike) -> float:
        """Return the bound, infinite where drives can silence the background; see `Goal.bound`."""
        bound = contrast_bound(*self._rows(G))
        return bound if math.isinf(bound) else min(bound, 1 / _LEAST)
