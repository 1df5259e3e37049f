"""Acquisition functions of all trials, and the points where they are largest."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch

from autdtorch.methods.bayes.climb import Effort, candidates, highest
from autdtorch.methods.bayes.packages import ei_helper, fatmin, log_ei_helper, log_fatplus, logmeanexp
from autdtorch.methods.bayes.processes import Processes
from autdtorch.objectives.goals import WeakestFocus, differentiable_scores
from autdtorch.objectives.objective import Score

_SCORE_EFFORT = Effort(candidates=128, starts=2, steps=20)
_FOCUS_EFFORT = Effort(candidates=256, starts=8, steps=60)
_NEAR_EFFORT = Effort(candidates=16, starts=2, steps=10)  # where a good start is known
_SAMPLES = 32  # of the foci, over which the improvement of a goal is averaged
_SMOOTH_MINIMUM = 1e-2  # temperature of the smooth minimum, and
_SMOOTH_IMPROVEMENT = 1e-3  # of the smooth improvement, both in rms pressures of the strongest focus
_LEAST_INTENSITY = 1e-6  # in such pressures, squared


class Acquisition(Protocol):
    """What is observed next, and what is best so far.

    Attributes:
        best: index of the best point of each trial (T,).
    """

    best: torch.Tensor

    def next_points(self, generators: Sequence[torch.Generator], last: bool) -> torch.Tensor:
        """Return the points (T, D) to observe next; `last` if nothing is observed after them."""
        ...


class ScoreAcquisition:
    """The (log) expected improvement of a score that one process models.

    The formulas are those of BoTorch's `ExpectedImprovement` and `LogExpectedImprovement`, which take points
    one by one.
    """

    def __init__(self, processes: Processes, points: torch.Tensor, score: torch.Tensor, log: bool) -> None:
        """Compare with the best of the scores (T, N, 1) at points (T, N, D)."""
        self.best = score[..., 0].argmax(dim=1)
        self._highest = score[..., 0].amax(dim=1, keepdim=True)
        self._processes, self._points, self._log = processes, points, log

    def next_points(self, generators: Sequence[torch.Generator], last: bool) -> torch.Tensor:
        """Return the points (T, D) of the largest expected improvement."""
        start = candidates(_chosen(self._points, self.best), generators, _SCORE_EFFORT.candidates)
        return highest(self.value, start, _SCORE_EFFORT, self._processes.reach, self._processes.periodic)

    def value(self, points: torch.Tensor) -> torch.Tensor:
        """Return the improvement (T, C) at points (T, C, D)."""
        mean, deviation = (of[..., 0] for of in self._processes.at(points))
        scaled = (mean - self._highest) / deviation
        if self._log:
            return log_ei_helper(scaled) + deviation.log()
        gain: torch.Tensor = deviation * ei_helper(scaled)
        return gain


class FocusAcquisition:
    """The log expected improvement of a goal over processes of the intensities of the foci.

    The foci are sampled independently. As in BoTorch's `qLogExpectedImprovement`, minimum and improvement are
    smooth, so that the logarithm has a slope everywhere.
    """

    def __init__(
        self, processes: Processes, points: torch.Tensor, goal: Score, start: torch.Tensor | None = None
    ) -> None:
        """Compare with the highest posterior mean at the points (T, N, D); `start` (T, D) may be better."""
        self._start = start
        self._processes, self._points, self._goal = processes, points, goal
        self._unit = processes.scale.amax(dim=-1, keepdim=True).sqrt()
        self._normal = _normal_samples(processes.scale.shape[-1])
        with torch.no_grad():
            expected = self.expected(points)
        self.best = expected.argmax(dim=1)
        self._highest = expected.amax(dim=1)[:, None, None]

    def next_points(self, generators: Sequence[torch.Generator], last: bool) -> torch.Tensor:
        """Return the points (T, D) of the largest expected improvement, or of the largest mean at last."""
        best = _chosen(self._points, self.best)
        effort = _FOCUS_EFFORT if self._start is None else _NEAR_EFFORT
        known = [best] if self._start is None else [best, self._start]
        start = torch.cat([torch.stack(known, dim=1), candidates(best, generators, effort.candidates)], dim=1)
        value = self.expected if last else self.value
        return highest(value, start, effort, self._processes.reach, self._processes.periodic)

    def expected(self, points: torch.Tensor) -> torch.Tensor:
        """Return the goal (T, C) of the mean intensities at points (T, C, D)."""
        return self._scored(self._processes.at(points).mean)

    def value(self, points: torch.Tensor) -> torch.Tensor:
        """Return the log improvement (T, C) at points (T, C, D)."""
        mean, deviation = self._processes.at(points)
        samples = mean[..., None, :] + deviation[..., None, :] * self._normal
        gain = log_fatplus(self._scored(samples) - self._highest, tau=_SMOOTH_IMPROVEMENT)
        mean_gain: torch.Tensor = logmeanexp(gain, dim=-1)
        return mean_gain

    def _scored(self, intensity: torch.Tensor) -> torch.Tensor:
        """Return the goal (T, ...) of intensities (T, ..., P), in units of pressure."""
        unit = self._unit.reshape(-1, *(1,) * (intensity.ndim - 1))
        pressure = (intensity / unit.square()).clamp_min(_LEAST_INTENSITY).sqrt()
        if isinstance(self._goal, WeakestFocus):
            minimum: torch.Tensor = fatmin(self._goal.levels(pressure), dim=-1, tau=_SMOOTH_MINIMUM)
            return minimum
        pressure = unit * pressure
        lost = ~pressure.isfinite()  # where a search left what the process can calculate
        score = differentiable_scores(self._goal, pressure.masked_fill(lost, 0)) / unit[..., 0]
        return score.masked_fill(lost.any(dim=-1), torch.nan)


def _chosen(points: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    return points[torch.arange(len(points), device="cpu"), index]


def _normal_samples(foci: int) -> torch.Tensor:
    """Return samples (S, P) of the standard normal distribution, spread evenly by a Sobol sequence."""
    sequence = torch.quasirandom.SobolEngine(foci, scramble=True, seed=0)  # type: ignore[no-untyped-call]
    uniform = sequence.draw(_SAMPLES, dtype=torch.float64)
    normal: torch.Tensor = torch.special.ndtri(uniform.clamp(1e-6, 1 - 1e-6))
    return normal
