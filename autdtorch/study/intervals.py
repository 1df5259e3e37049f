"""Confidence intervals of what is averaged over trials."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy import stats

CONFIDENCE = 0.95

FEWEST_TRIALS = 6
"""With fewer, not even the range of the trials covers their median with 95 %: 1 - 2 / 2^5 is less."""

_RESAMPLES = 4999
_SEED = 0


@dataclass(frozen=True)
class Interval:
    """A number and its confidence interval.

    Attributes:
        value: the number.
        low: lower end; -inf where nothing is known.
        high: upper end; inf where nothing is known.
    """

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        """As "1.23 [1.10, 1.35]"; the number alone where it is exact or its interval unknown."""
        if self.low == self.high and self.value.is_integer():
            return f"{self:.0f}"
        known = self.low < self.high < math.inf
        shown = (self.value, self.low, self.high) if known else (self.value,)
        largest = max(abs(number) for number in shown)
        digits = max(0, 2 - math.floor(math.log10(largest))) if largest else 0
        return f"{self:.{digits}f}"

    def __format__(self, form: str) -> str:
        """The same, each number in the given form."""
        if not form:
            return str(self)
        value, low, high = (format(number, form) for number in (self.value, self.low, self.high))
        return f"{value} [{low}, {high}]" if self.low < self.high < math.inf else value

    @classmethod
    def exact(cls, value: float) -> Interval:
        """A number that is known exactly."""
        return cls(value, value, value)

    @classmethod
    def unknown(cls, value: float) -> Interval:
        """A number of which nothing else is known."""
        return cls(value, -math.inf, math.inf)

    def mapped(self, function: Callable[[float], float]) -> Interval:
        """The interval of a monotone function of the number."""
        low, high = sorted((function(self.low), function(self.high)))
        return Interval(function(self.value), low, high)


def _same(average: Any) -> Any:
    return average


def bootstrap(
    *samples: torch.Tensor | float,
    average: Callable[..., Any] = np.mean,
    combine: Callable[..., Any] = _same,
) -> Interval:
    """The interval of averages over trials, or of a combination of them, by resampling the trials.

    Percentiles of the resampled averages, their level raised so that few trials do not give too narrow an
    interval: Hesterberg, "What teachers should know about the bootstrap", The American Statistician
    69 (2015) 371 (expanded percentile interval). The same data always give the same interval.

    Args:
        samples: values of independent trials (T,), each sample drawn apart from the others; a number is known
            exactly. A sample of fewer than `FEWEST_TRIALS` gives an unknown interval.
        average: NumPy's mean or median.
        combine: of one average a sample, elementwise.
    """
    drawn = [sample.numpy() for sample in samples if isinstance(sample, torch.Tensor)]

    def statistic(*resampled: Any, axis: int = -1) -> Any:
        averages = iter([average(values, axis=axis) for values in resampled])
        return combine(*(next(averages) if isinstance(part, torch.Tensor) else part for part in samples))

    value = float(statistic(*drawn))
    if not drawn:
        return Interval.exact(value)
    trials = min(len(values) for values in drawn)
    if trials < FEWEST_TRIALS:
        return Interval.unknown(value)
    student = stats.t.ppf((1 + CONFIDENCE) / 2, trials - 1)
    level = 1 - 2 * stats.norm.sf(math.sqrt(trials / (trials - 1)) * student)
    found = stats.bootstrap(
        drawn,
        statistic,
        n_resamples=_RESAMPLES,
        vectorized=True,
        confidence_level=level,
        method="percentile",
        rng=np.random.default_rng(_SEED),
    ).confidence_interval
    return Interval(value, float(found.low), float(found.high))


def share_interval(successes: torch.Tensor) -> Interval:
    """Share of the trials (T,) in which something is so, with Wilson's interval.

    Resampling would take a share of 0 or 1 as certain.
    """
    found = stats.binomtest(int(successes.sum()), len(successes)).proportion_ci(CONFIDENCE, method="wilson")
    return Interval(float(successes.double().mean()), float(found.low), float(found.high))
