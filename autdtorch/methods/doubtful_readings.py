"""Doubtful readings: outliers, ends of sensors' ranges, failed sensors, and lone scores.

`Magnitudes` says how far readings are to be believed; the other functions describe for the log what is wrong.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import torch
from scipy.special import fdtri

logger = logging.getLogger(__name__)

_GROSS = 1e-6  # chance of a magnitude of random phases to count as far above or below the others
_EQUAL = 1e-6  # relative difference of readings at the end of a sensor's range
_SATURATED = 4  # different drives that have this reading
_ENOUGH = 8  # readings below the end of a range from which on the sensor's steps are judged
_DISTINCT = 0.9  # share of these that differ, of a sensor that reads finely
_ALIKE = 0.999  # overlap of drives above which they count as one

_LONE = 3.0  # ratio of the highest score to the next one above which it may be an outlier
_COMPARED = 8  # least number of scores to compare
_BY_CHANCE = 0.999  # share of sensors of noise alone below the ratio of variances that tells a response
_RESPONSE = 4.0  # that ratio at most: few readings beyond the unknowns tell nothing of sensors above it
_CONSTANT = 1e-6  # relative deviation of constant readings
_UNEXPLAINED = 0.3  # rms residual of the fit over rms readings; noise 10 dB below them leaves 0.22
_SURPRISE = 6.0  # deviation of the last reading, in standard deviations of the noise, of an outlier
_LEAST_SURPRISE = 0.3  # its least deviation relative to the fitted pressure
_FINEST = 1e-6  # least deviation of a reading that counts, by their rms: what rounding allows
_SHOWN = 3  # outliers that are listed


@dataclass(frozen=True, eq=False)
class Magnitudes:
    """Readings, with lower limits where a sensor is at the end of its range.

    An outlier says nothing: its lower limit is 0.

    Attributes:
        value: (N, P) [Pa].
        limit: True for lower limits (N, P), bool.
        phase: of the pressures (N, P) [rad], NaN where it was not read; None if nowhere.
        deviation: of the readings (N, P) [Pa], as `Readings.deviation`; None if unknown.
    """

    value: torch.Tensor
    limit: torch.Tensor
    phase: torch.Tensor | None = None
    deviation: torch.Tensor | None = None

    @classmethod
    def of(
        cls,
        observed: torch.Tensor,
        outliers: torch.Tensor,
        highest: torch.Tensor,
        phase: torch.Tensor | None = None,
        deviation: torch.Tensor | None = None,
    ) -> Magnitudes:
        """Return readings (N, P) [Pa] without `outliers` (N, P), of sensors that end at `highest` (P,)."""
        limit = outliers | (observed >= (1 - _EQUAL) * highest)
        if deviation is not None:
            deviation = torch.where(deviation.isnan(), deviation.nanmedian(), deviation)  # of gaps
            deviation = deviation.clamp_min(_FINEST * float(observed.nan_to_num().square().mean().sqrt()))
        return cls(observed.masked_fill(outliers, 0), limit, phase, deviation)

    @property
    def stated(self) -> torch.Tensor:
        """The usual deviation of the readings, where they state theirs: the median [Pa]."""
        assert self.deviation is not None
        return self.deviation.median()

    @property
    def outliers(self) -> torch.Tensor:
        """Readings that say nothing (N, P), bool."""
        return self.limit & (self.value == 0)

    @property
    def power(self) -> torch.Tensor:
        """Mean square of each control point (P,) [Pa^2], without outliers."""
        return self.value.square().sum(dim=0) / (~self.outliers).sum(dim=0).clamp_min(1)

    def column(self, point: int) -> Magnitudes:
        """Return the readings of one control point (N, 1)."""
        return Magnitudes(self.value[:, point, None], self.limit[:, point, None])

    def rows(self, chosen: torch.Tensor | slice) -> Magnitudes:
        """Return the readings (n, P) of `chosen` drives, int64 or a slice."""
        return Magnitudes(self.value[chosen], self.limit[chosen])

    def nearest(self, magnitude: torch.Tensor) -> torch.Tensor:
        """Return the magnitudes nearest to some (N, ...) [Pa] that the readings allow."""
        if not self.limit.any():
            return self.value
        return torch.where(self.limit & (magnitude > self.value), magnitude, self.value)

    def decided(self, magnitude: torch.Tensor) -> torch.Tensor:
        """Return the readings (N, P) that constrain magnitudes (N, P) [Pa]: no lower limit that they meet."""
        return ~self.limit | (magnitude < self.value)


def gross_outliers(observed: torch.Tensor) -> torch.Tensor:
    """Return the readings (N, P), bool, that are far above or far below the others of random phases.

    Their powers are exponential. The lower half shows their mean; what the others have above it, over the
    mean, follows the distribution F of 2 and N degrees of freedom (Epstein and Sobel, Journal of the American
    Statistical Association 48 (1953) 486). A fixed ratio to the median, 4.5, counts one in 26 sets of four.
    """
    relative = observed / observed.nanmedian(dim=0).values  # whose power is 1; NaN where it is 0
    power = relative.square().sort(dim=0).values  # with gaps last
    count = (~relative.isnan()).sum(dim=0)
    half = (count + 1) // 2
    lower = power.nan_to_num() * (torch.arange(len(power), device=power.device)[:, None] < half)
    mean = (lower.sum(dim=0) + (count - half)) / half
    most = 1 + mean * half * (_GROSS ** (-1 / half) - 1)
    return (relative.square() > most) | (relative.square() < _GROSS * mean)


def range_ends(drives: torch.Tensor, observed: torch.Tensor) -> torch.Tensor:
    """Return the possible end of each sensor's range (P,) [Pa], infinite where no reading (N, P) shows it.

    There, several different drives (N, M) have the same highest reading, but not all of them. It is the end
    of the range if the sensor `reads_finely`; coarse steps make equal readings, too. NaN is a gap.
    """
    unit = drives / drives.norm(dim=1, keepdim=True).clamp_min(1e-300)
    ends = torch.full_like(observed[0], torch.inf)
    for point, column in enumerate(observed.T):
        highest = column.nan_to_num().max()
        at_end = unit[column >= (1 - _EQUAL) * highest]
        if _SATURATED <= len(at_end) < (~column.isnan()).sum():
            alike = ((at_end @ at_end.mH).abs() > _ALIKE).sum(dim=1)
            if (1 / alike).sum() >= _SATURATED:
                ends[point] = highest
    return ends


def reads_finely(observed: torch.Tensor, ends: torch.Tensor) -> torch.Tensor:
    """Return the sensors (P,), bool, with enough readings (N, P) below the `ends`, nearly all different."""
    fine = torch.zeros_like(ends, dtype=torch.bool)
    for point, column in enumerate(observed.T):
        lower = column[(column > 0) & (column < (1 - _EQUAL) * ends[point])].sort().values
        distinct = int((lower.diff() > _EQUAL * lower[1:]).sum()) + 1
        fine[point] = len(lower) >= _ENOUGH and distinct >= _DISTINCT * len(lower)
    return fine


def log_doubts(label: str, doubts: Sequence[Iterable[str]]) -> None:
    """Log in one line the doubts about the first of the trials that have any."""
    doubtful = [(trial, text) for trial, texts in enumerate(doubts) if (text := "; ".join(texts))]
    if doubtful:
        trial, text = doubtful[0]
        more = f" ({len(doubtful) - 1} more trials have doubtful readings)" if len(doubtful) > 1 else ""
        logger.warning("%s, trial %d: %s%s", label, trial, text, more)


def lone_score(history: torch.Tensor) -> Iterator[str]:
    """Describe a highest score far above all others of a trial (E,), which are -inf after its end."""
    score = history[history.isfinite()]
    if len(score) >= _COMPARED:
        second, first = score.topk(2).values.flip(0).tolist()
        if 0 < _LONE * second < first:
            which = f"the score {first:.3g} of evaluation {int(score.argmax())}, counted from 0,"
            yield f"{which} is {first / second:.3g} times the next highest: observe its drive again"


def sensor_doubts(drives: torch.Tensor, read: Magnitudes, fitted: torch.Tensor) -> Iterator[str]:
    """Describe sensors that do not respond to the array, or not in all of its range.

    Args:
        drives: (N, M).
        read: magnitudes (N, P).
        fitted: magnitudes (N, P) [Pa] by the fitted matrix.
    """
    silent = _silent(read.nearest(fitted), fitted, 2 * drives.shape[1] - 1) & _differ(drives)
    for point in range(len(silent)):
        if silent[point]:
            reads = f"control point {point} reads up to {float(read.value[:, point].max()):.3g} Pa"
            yield f"{reads}, hardly depending on the drive: has its sensor failed, or is it always saturated?"
        else:
            yield from saturation_doubts(read, point)


def saturation_doubts(read: Magnitudes, point: int) -> Iterator[str]:
    """Describe the end of the range of a point's sensor, where readings reach it."""
    at_end = read.value[(read.limit & ~read.outliers)[:, point], point]
    if len(at_end):
        reads = f"control point {point} reads {float(at_end.min()):.3g} Pa {len(at_end)} times"
        yield f"{reads}, and no more: its sensor saturates"


def _silent(observed: torch.Tensor, fitted: torch.Tensor, unknowns: int) -> torch.Tensor:
    """Return the points (P,), bool, whose fitted row of `unknowns` explains (N, P) no better than noise."""
    total = (observed - observed.mean(dim=0)).square().sum(dim=0)
    rest = (observed - fitted).square().sum(dim=0)
    constant = total <= len(observed) * (_CONSTANT * observed.amax(dim=0)).square()
    spare = len(observed) - unknowns
    if unknowns == 1 or spare < 1:  # one transducer alone makes the same magnitude at any phase
        return constant & (observed.amax(dim=0) == 0)
    ratio = min(float(fdtri(unknowns, spare, _BY_CHANCE)), _RESPONSE)  # of Fisher's F test
    return constant | ((total - rest) / unknowns < ratio * rest / spare)


def _differ(drives: torch.Tensor) -> torch.Tensor:
    """Return whether drives (N, M) differ in more than a common phase, and may make other magnitudes."""
    common = (drives @ drives[0].conj()).sgn()[:, None] * drives[0]
    return (drives - common).abs().max() > _EQUAL


def reading_doubts(
    names: Sequence[str],
    observed: torch.Tensor,
    read: Magnitudes,
    fitted: torch.Tensor,
    deviation: torch.Tensor,
    prior: bool,
) -> Iterator[str]:
    """Describe outliers, a last reading far from the fit, and a large residual of the fit.

    Args:
        names: of the N drives.
        observed: magnitudes (N, P) [Pa], outliers as they were read; NaN at gaps, which are no outliers.
        read: as they were used.
        fitted: magnitudes (N, P) [Pa] by the fitted matrix, which does not know the last readings.
        deviation: of the noise that was fitted (P,) [Pa].
        prior: whether a prior is behind the fit, which may be wrong instead.
    """
    away = (read.nearest(fitted) - fitted)[-1].abs()
    outliers = read.outliers & ~observed.isnan()
    outliers[-1] |= (away > _SURPRISE * deviation) & (away > _LEAST_SURPRISE * fitted[-1])
    places = outliers.nonzero().tolist()
    shown = [
        f"{names[row]} at control point {point} (read {float(observed[row, point]):.3g} Pa, "
        f"fitted {float(fitted[row, point]):.3g} Pa)"
        for row, point in places[:_SHOWN]
    ]
    if len(places) > _SHOWN:
        shown.append(f"{len(places) - _SHOWN} more")
    if shown:
        cause = "; the readings or the prior are wrong" if prior else ""
        yield f"outliers, counted from 0: {', '.join(shown)}{cause}"
    level, rest = float(read.power.mean().sqrt()), float(deviation.max())
    if rest > _UNEXPLAINED * level:
        yield f"the fit leaves {rest:.3g} of {level:.3g} Pa rms: the drive may be far from the best"
