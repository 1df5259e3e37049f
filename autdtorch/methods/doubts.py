"""Doubtful readings: lone scores, those that a fitted matrix contradicts, and dead or saturated sensors."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Sequence

import torch

from autdtorch.methods.magnitudes import Magnitudes

logger = logging.getLogger(__name__)

_LONE = 3.0  # ratio of the highest score to the next one above which it may be an outlier
_COMPARED = 8  # scores from which on this is looked at
_RESPONSE = 2.0  # variance that a row explains, each unknown, over that of the rest; 1 for noise alone
_CONSTANT = 1e-6  # relative deviation of readings that are all the same
_UNEXPLAINED = 0.3  # rms of what the fit leaves, in rms readings; noise 10 dB below them leaves 0.22
_SURPRISE = 6.0  # standard deviations of the noise, and
_LEAST_SURPRISE = 0.3  # of the fitted pressure, by which the last reading must be off to be an outlier
_SHOWN = 3  # outliers that are listed


def log_doubts(label: str, doubts: Sequence[Iterable[str]]) -> None:
    """Log in one line what is doubtful about the first of the trials that have doubtful readings."""
    doubtful = [(trial, text) for trial, own in enumerate(doubts) if (text := "; ".join(own))]
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
    """Describe sensors that do not hear the array, or not all of it.

    Args:
        drives: (N, M).
        read: magnitudes (N, P).
        fitted: magnitudes (N, P) [Pa] that the fitted matrix gives.
    """
    silent = _silent(read.nearest(fitted), fitted, 2 * drives.shape[1] - 1)
    at_end = read.limit & ~read.outliers
    for point, column in enumerate(read.value.T):
        if silent[point]:
            reads = f"control point {point} reads up to {float(column.max()):.3g} Pa"
            yield f"{reads}, hardly depending on the drive: is its sensor dead, or always saturated?"
        elif at_end[:, point].any():
            count, end = int(at_end[:, point].sum()), float(column[at_end[:, point]].min())
            yield f"control point {point} reads {end:.3g} Pa {count} times, and no more: its sensor saturates"


def _silent(observed: torch.Tensor, fitted: torch.Tensor, unknowns: int) -> torch.Tensor:
    """Return for which points (P,) a row of some `unknowns` explains no more of (N, P) than of noise."""
    total = (observed - observed.mean(dim=0)).square().sum(dim=0)
    rest = (observed - fitted).square().sum(dim=0)
    constant = total <= len(observed) * (_CONSTANT * observed.amax(dim=0)).square()
    spare = len(observed) - unknowns
    if unknowns == 1 or spare < 1:  # one transducer alone makes the same magnitude at any phase
        return constant & (observed.amax(dim=0) == 0)
    return constant | ((total - rest) / unknowns < _RESPONSE * rest / spare)


def reading_doubts(
    observed: torch.Tensor,
    read: Magnitudes,
    fitted: torch.Tensor,
    deviation: torch.Tensor,
    prior: bool,
) -> Iterator[str]:
    """Describe readings that the fit left out, a fit that leaves much, and a last reading far from it.

    Args:
        observed: magnitudes (N, P) [Pa], outliers as they were read.
        read: as they were used.
        fitted: magnitudes (N, P) [Pa] that the fitted matrix gives; it does not know the last readings.
        deviation: of the noise that was fitted (P,) [Pa].
        prior: whether a prior is behind the fit, which may be wrong instead.
    """
    away = (read.nearest(fitted) - fitted)[-1].abs()
    surprise = (away > _SURPRISE * deviation) & (away > _LEAST_SURPRISE * fitted[-1])
    outliers = read.outliers
    outliers[-1] |= surprise
    places = outliers.nonzero().tolist()
    shown = [
        f"evaluation {row} at control point {point} (read {float(observed[row, point]):.3g} Pa, "
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
