"""Trends of the gain: a bench whose readings fall or rise with time, as transducers or a sensor warm up."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.special import stdtrit

from autdtorch.methods.base import State
from autdtorch.methods.doubtful_readings import Magnitudes
from autdtorch.methods.matrix_fit import MatrixFit
from autdtorch.methods.matrix_posterior import MatrixPosterior
from autdtorch.methods.problem import Problem
from autdtorch.objectives.goals import scores_of, scores_pressures
from autdtorch.utils.array_types import REAL, Array
from autdtorch.utils.text import in_digits

_BY_CHANCE = 1e-4  # share of steady benches that one test may take for drifting ones; a search makes many
_LEAST = 0.01  # change of the gain that matters
_LEAST_IN_STEP = 0.003  # the same, between the readings of a step
_MEMORY = 0.7  # weight of a step's readings in the next step's trend
_SPANNED = 1e-9  # eigenvalue, relative to the largest, above which a form of the readings is in their span
_SHOWN = 60  # readings for which the trend of steps is described
_LARGEST = 50.0  # change of ln gain that is described, lest its exponential overflow
_ADVICE = "let the bench warm up, and run again"


class GainTrend(NamedTuple):
    """A trend of the gain of all readings, linear in their number.

    Attributes:
        change: ln of the gain at the last reading over that at the first.
        deviation: standard deviation of the change.
        freedom: degrees of freedom of the deviation.
    """

    change: float
    deviation: float
    freedom: float

    @property
    def is_seen(self) -> bool:
        """True if the change matters and is not by chance."""
        return abs(self.change) > max(_LEAST, float(_quantile(self.freedom)) * self.deviation)

    def doubts(self) -> Iterator[str]:
        """Describe a trend that is seen."""
        if self.is_seen:
            yield f"{_described(self.change, self.deviation)} from the first to the last: {_ADVICE}"


def trends_of(fits: Sequence[MatrixFit], drives: torch.Tensor) -> torch.Tensor:
    """Return the `GainTrend` of each of T trials (T, 3), whose drives (T, N, M) were fitted."""
    pairs = zip(fits, drives, strict=True)
    trends = [trend_of_fit(fit.posterior, played.clone(), fit.read) for fit, played in pairs]
    return torch.tensor(trends, **REAL)


def trend_of_fit(posterior: MatrixPosterior, drives: torch.Tensor, read: Magnitudes) -> GainTrend:
    """Return the trend of magnitudes (N, P), in their order, that a fit to them leaves.

    It is the generalised least-squares estimate: whatever the unknown matrix explains as well is no trend.
    The deviation grows with the scatter of the drives around the trend, beyond the noise of single readings,
    as the readings of a drive may share an error.
    """
    count = len(drives)
    if count < 4:
        return GainTrend(0.0, torch.inf, 1.0)
    line = posterior.linearised(drives, read)
    time = torch.linspace(-0.5, 0.5, count, **REAL).repeat(len(line.drives) // count)
    slope = time[:, None] * (line.turns * (line.drives @ posterior.matrix.T)).real
    weight = line.covariance.solved(slope)
    information = float((slope * weight).sum())
    if not information > 0:
        return GainTrend(0.0, torch.inf, 1.0)
    change = float((slope * line.left / line.noise).sum()) / information
    off = slope * (line.left / line.noise - change * weight)
    scatter = off.sum(dim=1).reshape(-1, count).sum(dim=0).square().sum()
    expected = (slope.square() * line.shares / line.noise).sum()
    deviation = (max(1.0, float(scatter / expected)) / information) ** 0.5
    return GainTrend(change, deviation, min(count - 2.0, max(1.0, float(line.unexplained))))


def steadied(
    problem: Problem,
    search: Mapping[str, torch.Tensor],
    drives: torch.Tensor,
    pressure: torch.Tensor,
    score: torch.Tensor,
) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
    """Return a search with the trend of its steps, and scores without the trend once it is seen.

    The drives of a step span few dimensions, so that their intensities are few quadratic forms. What these
    do not explain is noise and the trend. Scores become those of the last reading's gain.

    Args:
        problem: of the trials.
        search: of L trials; ``trend`` (L, 5) sums over steps, ``drifting`` (L,) steps since it was seen.
        drives: of the step (L, B, M).
        pressure: magnitudes (L, B, P) [Pa] that were read for them.
        score: of these (L, B).
    """
    drifting = search.get("drifting", torch.zeros(len(score), dtype=torch.int64, device="cpu"))
    sums = search.get("trend", torch.zeros(len(score), 5, **REAL))
    if scores_pressures(problem.goal):
        count = drives.shape[1]
        sums = _sums_of_step(problem.quantise(drives), pressure, sums)
        rate, deviation, freedom = _rates(sums)
        least = (torch.from_numpy(_quantile(freedom.numpy())) * deviation).clamp_min(_LEAST_IN_STEP / count)
        drifting = drifting + ((drifting > 0) | (rate.abs() > least))
        if (drifting > 0).any():
            gain = (rate[:, None] * torch.arange(1 - count, 1, device="cpu")).exp()
            steady = scores_of(problem.goal, pressure / gain[..., None])
            score = torch.where((drifting > 0)[:, None], steady, score)
    return {**search, "trend": sums, "drifting": drifting}, score


def step_doubts(state: State) -> list[Iterable[str]]:
    """Describe the trends of the gain, of all T trials, in the step that shows them first."""
    doubts: list[Iterable[str]] = [() for _ in state.seeds]
    if "drifting" in state.search:
        for row in torch.nonzero(state.search["drifting"] == 1)[:, 0].tolist():
            rate, deviation, _ = _rates(state.search["trend"][row, None])
            change = _described(_SHOWN * float(rate), _SHOWN * float(deviation))
            text = f"{change} in {_SHOWN} readings, so that older ones no longer count: {_ADVICE}"
            doubts[int(state.trials[row])] = [text]
    return doubts


def _sums_of_step(drives: torch.Tensor, pressure: torch.Tensor, before: torch.Tensor) -> torch.Tensor:
    """Return sums (L, 5) with the intensities of a step, after those before.

    They are of the trend, its information, the remainder of a point, the freedom, and the scatter of drives.
    """
    forms = (drives @ drives.mH).abs().square()  # Overlaps of q q^H: the covariance of intensities
    sizes, vectors = torch.linalg.eigh(forms)
    unexplained = sizes <= _SPANNED * sizes[:, -1:]
    others = vectors * unexplained[:, None]
    rest = others @ others.mT
    intensity = pressure.square()
    level = intensity.mean(dim=1, keepdim=True).clamp_min(torch.finfo(pressure.dtype).tiny)
    late = torch.arange(drives.shape[1], **REAL) - (drives.shape[1] - 1) / 2
    left = rest @ (intensity / level.sqrt())  # The noise of an intensity grows with its root
    slope = rest @ (2 * late[:, None] * (intensity / level.sqrt() - left))
    products = slope * left, slope.square(), left.square() / pressure.shape[-1]
    freedom = unexplained.sum(dim=1).to(pressure.dtype)  # of drives: points may share their errors
    parts = [product.sum(dim=(1, 2)) for product in products]
    sums = _MEMORY * before + torch.stack([*parts, freedom, torch.zeros_like(freedom)], dim=1)
    rate = _rates(sums)[0][:, None, None]
    sums[:, 4] += (slope * (left - rate * slope)).sum(dim=2).square().sum(dim=1)
    return sums


def _rates(sums: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the changes of ln gain by a reading, their deviations and their freedom (L,), of sums (L, 5).

    The deviation is by the scatter of single drives, if larger than by all readings: one may be an outlier.
    """
    trend, information, remainder, freedom, scatter = sums.unbind(dim=1)
    tiny = torch.finfo(sums.dtype).tiny
    rate = trend / information.clamp_min(tiny)
    freedom = freedom - 1
    variance = remainder / freedom.clamp_min(1)
    deviation = (variance * information).maximum(scatter).sqrt() / information.clamp_min(tiny)
    return rate, deviation.masked_fill((freedom < 1) | (information <= tiny), torch.inf), freedom


def _quantile(freedom: Array | float) -> Array:
    """Return the deviations beyond which trends of some degrees of freedom are not by chance."""
    return np.asarray(stdtrit(np.maximum(freedom, 1.0), 1 - _BY_CHANCE / 2))


def _described(change: float, deviation: float) -> str:
    way = "fall" if change < 0 else "rise"
    gain = math.exp(min(change, _LARGEST))
    percent, error = in_digits(100 * abs(gain - 1), 2), in_digits(100 * gain * deviation, 1)
    return f"the readings {way} by {percent} +- {error} %"
