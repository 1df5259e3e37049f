"""Acquisition functions of all trials, and the search for the points where they are largest."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import torch
from botorch.utils.probability.utils import log_phi, ndtr, phi
from botorch.utils.safe_math import log1mexp, log_fatplus

from autdtorch.methods.bayes.gaussian_process import Processes
from autdtorch.methods.seeds import uniform
from autdtorch.objectives.goals import WeakestFocus, differentiable_scores
from autdtorch.objectives.objective import GoalFunction

Value = Callable[[torch.Tensor], torch.Tensor]
"""A function of points (T, C, D) that gives values (T, C), each of its point alone."""


class Effort(NamedTuple):
    """The effort of a search: numbers of points to compare, of climbs, and of evaluations of each climb."""

    candidates: int
    starts: int
    steps: int


_SCORE_EFFORT = Effort(candidates=128, starts=2, steps=20)
_FOCUS_EFFORT = Effort(candidates=256, starts=8, steps=60)
_NEAR_EFFORT = Effort(candidates=16, starts=2, steps=10)  # where a good start is known
_SAMPLES = 32  # of the foci, over which the improvement of a goal is averaged
_SMOOTH_MINIMUM = 1e-2  # temperature of the smooth minimum, in rms pressures of the strongest focus
_SMOOTH_IMPROVEMENT = 1e-3  # temperature of the smooth improvement, likewise
_LEAST_INTENSITY = 1e-6  # in such pressures, squared
_SUFFICIENT = 1e-4  # share of the predicted rise that a step of a climb must reach
_LARGEST_GROWTH = 4  # of the step's length, where the slope does not bend
_TAIL = -1e6  # scaled improvement below which its logarithm follows its asymptote


class Acquisition(Protocol):
    """The rule that chooses the next points.

    Attributes:
        best: index of the best point of each trial (T,).
    """

    best: torch.Tensor

    def next_points(self, generators: Sequence[torch.Generator], last: bool) -> torch.Tensor:
        """Return the points (T, D) to observe next; `last` if nothing is observed after them."""
        ...


class ScoreAcquisition:
    """The (log) expected improvement of a score that one process models.

    It has the formulas of BoTorch's `ExpectedImprovement` and `LogExpectedImprovement`, which take points one
    by one.
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
            return log_improvement(scaled) + deviation.log()
        return deviation * improvement(scaled)


class FocusAcquisition:
    """The log expected improvement of a goal over processes of the intensities of the foci.

    The foci are sampled independently. As in BoTorch's `qLogExpectedImprovement`, minimum and improvement are
    smooth, so that the logarithm has a slope everywhere.
    """

    def __init__(
        self,
        processes: Processes,
        points: torch.Tensor,
        goal: GoalFunction,
        start: torch.Tensor | None = None,
    ) -> None:
        """Compare with the highest posterior mean at the points (T, N, D); `start` (T, D) may be better."""
        self._start = start
        self._processes, self._points, self._goal = processes, points, goal
        self._unit = processes.scale.amax(dim=-1, keepdim=True).sqrt()
        self._normal = _normal_samples(processes.scale.shape[-1]).to(processes.scale)
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
        return gain.logsumexp(dim=-1) - math.log(_SAMPLES)

    def _scored(self, intensity: torch.Tensor) -> torch.Tensor:
        """Return the goal (T, ...) of intensities (T, ..., P), in units of pressure."""
        unit = self._unit.reshape(-1, *(1,) * (intensity.ndim - 1))
        pressure = (intensity / unit.square()).clamp_min(_LEAST_INTENSITY).sqrt()
        if isinstance(self._goal, WeakestFocus):
            return -_SMOOTH_MINIMUM * (self._goal.levels(pressure) / -_SMOOTH_MINIMUM).logsumexp(dim=-1)
        pressure = unit * pressure
        lost = ~pressure.isfinite()  # where a search left the range of the process
        score = differentiable_scores(self._goal, pressure.masked_fill(lost, 0)) / unit[..., 0]
        return score.masked_fill(lost.any(dim=-1), torch.nan)


def improvement(scaled: torch.Tensor) -> torch.Tensor:
    """Return the expected improvement phi(u) + u Phi(u) of a standard normal score over -u."""
    gain: torch.Tensor = phi(scaled) + scaled * ndtr(scaled)
    return gain


def log_improvement(scaled: torch.Tensor) -> torch.Tensor:
    """Return the logarithm of `improvement`, which has a value and a slope for all float64 numbers.

    Below -1 it is log phi(u) + log(1 - |u| Phi(u) / phi(u)), with Phi by the scaled complementary error
    function (Ament et al. 2023).
    """
    near, far = scaled.masked_fill(scaled < -1, -1), scaled.masked_fill(scaled > -1, -1)
    bounded = far.masked_fill(far < _TAIL, _TAIL)
    ratio = (torch.special.erfcx(-(2**-0.5) * bounded) * bounded.abs()).log() + math.log(math.pi / 2) / 2
    tail = log_phi(scaled) + torch.where(scaled > _TAIL, log1mexp(ratio), -2 * far.abs().log())
    return torch.where(scaled > -1, improvement(near).log(), tail)


def _chosen(points: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    return points[torch.arange(len(points), device=index.device), index]


def _normal_samples(foci: int) -> torch.Tensor:
    """Return samples (S, P) of the standard normal distribution, spread evenly by a Sobol sequence."""
    sequence = torch.quasirandom.SobolEngine(foci, scramble=True, seed=0)  # type: ignore[no-untyped-call]
    uniform = sequence.draw(_SAMPLES, dtype=torch.float64)
    normal: torch.Tensor = torch.special.ndtri(uniform.clamp(1e-6, 1 - 1e-6))
    return normal


def candidates(best: torch.Tensor, generators: Sequence[torch.Generator], count: int) -> torch.Tensor:
    """Return points (T, count, D): half of them anywhere, half at all distances around the best (T, D)."""
    points = []
    for point, generator in zip(best.cpu(), generators, strict=True):  # numbers of the CPU, on any device
        anywhere, near = uniform(generator, 2, count // 2, len(point))
        # Normally distributed steps; their lengths are spread evenly in logarithm, from 0.001 to 0.3.
        scale = 10 ** (-3 + 2.5 * uniform(generator, len(near), 1))
        steps = scale * torch.randn(near.shape, dtype=torch.float64, generator=generator, device="cpu")
        points.append(torch.cat([anywhere, point + steps]))
    return torch.stack(points).to(best)


def highest(
    value: Value, points: torch.Tensor, effort: Effort, reach: torch.Tensor, periodic: bool
) -> torch.Tensor:
    """Return the highest point (T, D) that climbs from the best of the points (T, C, D) find.

    The climbs are spectral projected gradients (Birgin, Martinez and Raydan 2000) within [0, 1], or without
    bounds where the points are periodic.

    Args:
        value: is climbed.
        points: in turns.
        effort: of the climbs.
        reach: length [turns] over which the value varies (T,).
        periodic: whether the points are.
    """
    if not periodic:
        points = points.clamp(0, 1)
    with torch.no_grad():
        order = value(points).topk(effort.starts, dim=1).indices
    point = points.gather(1, order[..., None].expand(-1, -1, points.shape[-1]))
    height, slope = _with_slope(value, point)
    rate = 0.1 * reach[:, None, None] / slope.norm(dim=-1, keepdim=True).clamp_min(1e-300)
    share = torch.ones_like(rate)
    move = _projected(point + rate * slope, periodic) - point
    for _ in range(effort.steps):
        step = share * move
        there, steeper = _with_slope(value, point + step)
        gain, rise = (there - height)[..., None], (step * slope).sum(dim=-1, keepdim=True)
        rises = gain >= _SUFFICIENT * rise
        bend = (step * (slope - steeper)).sum(dim=-1, keepdim=True)
        longer = torch.where(bend > 0, step.square().sum(dim=-1, keepdim=True) / bend, _LARGEST_GROWTH * rate)
        # Where the value does not rise enough: the top of the parabola through both ends of the step.
        shorter = (0.5 * rise / (rise - gain).clamp_min(1e-300)).clamp(0.1, 0.5)
        point = torch.where(rises, point + step, point)
        height, slope = torch.where(rises[..., 0], there, height), torch.where(rises, steeper, slope)
        rate = torch.where(rises, longer, rate)
        move = torch.where(rises, _projected(point + rate * slope, periodic) - point, move)
        share = torch.where(rises, 1.0, share * shorter)
    best = _chosen(point, height.argmax(dim=1))
    return best % 1 if periodic else best


def _with_slope(value: Value, point: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    point = point.detach().requires_grad_(True)
    height = value(point)
    (slope,) = torch.autograd.grad(height.sum(), point)
    return height.detach(), slope


def _projected(point: torch.Tensor, periodic: bool) -> torch.Tensor:
    return point if periodic else point.clamp(0, 1)
