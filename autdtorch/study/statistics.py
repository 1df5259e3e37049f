"""Statistics over trials: confidence intervals, and the gap of a method to the certified bound."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy import stats

from autdtorch.study.results import MethodResult

CONFIDENCE = 0.95
# Fewest trials for an interval: of 5, even the full range covers the median with only 1 - 2 / 2^5 < 95 %.
FEWEST_TRIALS = 6
NEAR_BOUND = 0.9  # a score of at least this share of the bound is near it
_RESAMPLES = 4999
_SEED = 0


@dataclass(frozen=True)
class Interval:
    """A number with its confidence interval, infinite if it is unknown and empty if the number is exact."""

    value: float
    low: float = -math.inf
    high: float = math.inf

    def __format__(self, form: str) -> str:
        """Return "1.23 [1.10, 1.35]" in a form of numbers, or the number alone without an interval."""
        value, low, high = (format(number, form) for number in (self.value, self.low, self.high))
        return f"{value} [{low}, {high}]" if self.low < self.high < math.inf else value

    def mapped(self, function: Callable[[float], float]) -> Interval:
        """Return the interval of a monotone function of the number."""
        low, high = sorted((function(self.low), function(self.high)))
        return Interval(function(self.value), low, high)


def bootstrap(
    *samples: torch.Tensor | float,
    average: Callable[..., Any] = np.mean,
    combine: Callable[..., Any] = lambda average: average,
) -> Interval:
    """Return an average over trials, or a combination of averages, with its bootstrap interval.

    The interval is the expanded percentile interval of Hesterberg, "What teachers should know about the
    bootstrap", The American Statistician 69 (2015) 371, which is not too narrow for few trials. It is
    unknown if a sample has fewer than `FEWEST_TRIALS`. Equal data give equal intervals.

    Args:
        samples: values of independent trials (T,), resampled independently; a plain number is exact.
        average: NumPy's mean or median.
        combine: elementwise function of the averages, one argument for each sample.
    """
    drawn = [sample.numpy() for sample in samples if isinstance(sample, torch.Tensor)]

    def statistic(*resampled: Any, axis: int = -1) -> Any:
        averages = iter([average(values, axis=axis) for values in resampled])
        return combine(*(next(averages) if isinstance(part, torch.Tensor) else part for part in samples))

    value = float(statistic(*drawn))
    if not drawn:
        return Interval(value, value, value)
    trials = min(len(values) for values in drawn)
    if trials < FEWEST_TRIALS:
        return Interval(value)
    student = stats.t.ppf((1 + CONFIDENCE) / 2, trials - 1)
    expanded = 1 - 2 * stats.norm.sf(math.sqrt(trials / (trials - 1)) * student)
    settings: Any = {"n_resamples": _RESAMPLES, "vectorized": True, "method": "percentile"}
    rng = np.random.default_rng(_SEED)
    interval = stats.bootstrap(drawn, statistic, confidence_level=expanded, rng=rng, **settings)
    return Interval(value, *map(float, interval.confidence_interval))


def share_interval(successes: torch.Tensor) -> Interval:
    """Return the share of successful trials (T,) with Wilson's interval: a bootstrap is certain of 0 or 1."""
    interval = stats.binomtest(int(successes.sum()), len(successes)).proportion_ci(
        CONFIDENCE, method="wilson"
    )
    return Interval(float(successes.double().mean()), float(interval.low), float(interval.high))


@dataclass(frozen=True, eq=False)
class BoundGap:
    """The distance of a method's score from the certified bound."""

    score: Interval  # median over the trials
    gap: Interval  # 1 - score / bound; bound - score where scores are no shares of it
    evaluations: torch.Tensor  # of each trial until it was near the bound (T,), float64; inf if never


def has_shares(bound: float) -> bool:
    """Return whether scores are shares of the bound: it is known, and above 0."""
    return 0 < bound < math.inf


def bound_gap(method: MethodResult, bound: float) -> BoundGap:
    """Return the gap of a method to the upper bound on the score; infinite if no bound is known."""
    score = bootstrap(method.solution.score, average=np.median)
    gap = Interval(math.inf)
    if math.isfinite(bound):
        gap = score.mapped(lambda value: 1 - value / bound if has_shares(bound) else bound - value)
    near = (method.solution.history >= NEAR_BOUND * bound) & has_shares(bound)
    first = near.int().argmax(dim=1).double() + 1
    return BoundGap(score, gap, torch.where(near.any(dim=1), first, torch.inf))
