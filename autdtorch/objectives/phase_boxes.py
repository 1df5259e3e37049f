"""An upper bound on the weakest focus over all drives, by branch and bound over the phases of the foci.

Let the phases of some foci's pressures be within d_p < pi / 2 of psi_p. Then Re(e^(-i psi_p) p_p) >=
cos(d_p) |p_p|. With any a >= 0 of these foci, all drives of amplitudes <= 1 satisfy two inequalities.

    t sum a_p cos(d_p) <= Re sum a_p e^(-i psi_p) (G q)_p <= sum_m |sum_p a_p e^(-i psi_p) G_pm|.

Here t is the least |p_p|, of rows over the wanted pressures. Boxes that together contain all phases bound t
by the largest of their right sides. The box with the largest is divided, along the phase of its weakest
focus. Foci that decide nothing keep any phase: many foci are no obstacle where their rows are much alike, as
those of several scenes are.

The drive with the phases of the last sum attains a level. The search ends where no box is above the highest
level by more than a tolerance, or with its work; the bound holds at any time.
"""

from __future__ import annotations

import heapq
import itertools
import math

import numpy as np

from autdtorch.utils.array_types import Array, ComplexArray, Index

_TOLERANCE = 3e-3  # Relative distance of the bound to the highest level attained
_SMALLEST = 0.02  # Half edge [rad] of phases that are not divided: less would lower a bound by 1 - cos, 2e-4
_ANY = math.pi  # Half edge of a phase without a range
_PARTS = 3  # of the circle of a phase at its first division; more than 2, for a cosine > 0
_AT_ONCE = 256  # Boxes divided together
_MOST_NUMBERS = 1e7  # of open boxes and foci: 240 MB
_BOX_WORK = 60  # of a box, beside foci and transducers
_ITERATIONS = 10  # of the weights a, which begin at the weights of the box that was divided
_LEAST_WEIGHT = 0.3  # of a focus whose phase is divided, over the largest
_STEP, _MOMENTUM = 2.0, 0.6  # of the logarithms of the weights
_SLOPES = (-3.0, 1.0)  # Range of relative slopes
_LARGEST_STEP = 2.0  # of the logarithm of a weight
_TINY = 1e-300
_MARGIN = 1e-12
"""Relative margin on top of a bound; rounding of the bound and of a pressure is below 1e-13."""


def phase_bound(rows: ComplexArray, known: float, work: float) -> float:
    """Return a bound on the level that all foci reach, at most a known one.

    Args:
        rows: of the transfer matrix (P, M), over the pressures wanted; none is 0.
        known: a bound that holds.
        work: most products of boxes, foci, transducers and iterations; 4e8 take about a second.
    """
    alone = np.abs(rows).sum(axis=1)
    least_weights = _LEAST_WEIGHT * (alone.min() / alone) ** 2
    boxes, limits = _whole(alone), np.full(1, known)
    heap, number, attained, done = list[tuple[float, int, int, Array]](), itertools.count(), 0.0, 0.0
    while True:
        bounds, weakest, level = _bounded(rows, boxes)
        bounds = np.minimum(bounds, limits)
        attained = max(attained, level)
        limit = attained * (1 + _TOLERANCE)
        divided = (bounds > limit) & (weakest >= 0)
        done = max(done, float(bounds[~divided].max(initial=0.0)))
        for box in np.flatnonzero(divided):
            # a copy, as a view would hold all boxes of its part in memory
            heapq.heappush(heap, (-bounds[box], next(number), weakest[box], boxes[box].copy()))
        highest = max(done, -heap[0][0]) if heap else done
        if work <= 0 or highest <= max(done, limit) or len(heap) * len(rows) > _MOST_NUMBERS:
            return min(known, highest * (1 + _MARGIN))
        taken = [heapq.heappop(heap) for _ in range(min(_AT_ONCE, len(heap)))]
        foci = [focus for _, _, focus, _ in taken]
        boxes, origin = _divided(np.stack([box for *_, box in taken]), foci, least_weights)
        limits = -np.array([bound for bound, *_ in taken])[origin]
        ranged = np.count_nonzero((boxes[:, 1] < _ANY).any(axis=0))
        work -= len(boxes) * (ranged * rows.shape[1] + _BOX_WORK) * _ITERATIONS


def _whole(alone: Array) -> Array:
    """Return the box (1, 3, P) of all phases, for the levels of foci alone (P,).

    The phase of the weakest focus is 0: a common phase changes nothing. Of each focus, a box has the centre
    and half of its edge [rad], and the weight a.
    """
    weakest = np.arange(len(alone)) == alone.argmin()
    return np.stack([np.zeros(len(alone)), np.where(weakest, 0.0, _ANY), weakest])[None]


def _bounded(rows: ComplexArray, boxes: Array) -> tuple[Array, Array, float]:
    """Return bounds (B,) on the level, the weakest foci (B,), and the highest level that a drive attains.

    The boxes (B, 3, P) get the weights of their bounds. A focus is -1 where no phase is to be divided.
    """
    centres, halves, weights = boxes.swapaxes(0, 1)
    ranged = np.flatnonzero((halves < _ANY).any(axis=0))
    some, cosine = rows[ranged], np.where(halves < _ANY, np.cos(halves), 1.0)[:, ranged]
    turn, weight = np.exp(-1j * centres[:, ranged]), weights[:, ranged]
    least, best, drive, speed = np.full(len(turn), np.inf), weight, np.zeros(1), np.zeros(1)
    for number in range(_ITERATIONS):
        sums = (weight * turn) @ some
        size = np.abs(sums)
        bounds = size.sum(axis=1) / (weight * cosine).sum(axis=1)
        lower = bounds < least
        least, best = np.where(lower, bounds, least), np.where(lower[:, None], weight, best)
        loudest = sums.conj() / np.maximum(size, _TINY)
        drive = drive + (loudest - drive) * (2 / (number + 2))  # later ones count more in the mean
        # the weight of a focus grows as much as its pressure is below the bound
        missing = 1 - (turn * (loudest @ some.T)).real / (cosine * bounds[:, None] + _TINY)
        speed = _MOMENTUM * speed + missing.clip(*_SLOPES)
        weight = weight * np.exp((_STEP / (2 + number) * speed).clip(-_LARGEST_STEP, _LARGEST_STEP))
        weight = weight / weight.max(axis=1, keepdims=True)
    weights[:, ranged] = best
    level = np.abs(drive / np.maximum(np.abs(drive), _TINY) @ rows.T).min(axis=1).max()
    pressure = np.where(halves > _SMALLEST, np.abs(drive @ rows.T), np.inf)
    focus = np.where(np.isinf(pressure.min(axis=1)), -1, pressure.argmin(axis=1))
    return least, focus, float(level)


def _divided(boxes: Array, focus: list[int], least_weights: Array) -> tuple[Array, Index]:
    """Return the parts (N, 3, P) of boxes (B, 3, P) along the phase of a focus each, and their boxes (N,).

    Args:
        boxes: to divide.
        focus: (B,).
        least_weights: of foci (P,) whose phases are divided, over the largest.
    """
    half = boxes[np.arange(len(boxes)), 1, focus]
    count = np.where(half < _ANY, 2, _PARTS)
    origin = np.repeat(np.arange(len(boxes)), count)
    part = np.arange(len(origin)) - np.repeat(np.cumsum(count) - count, count)
    parts, along = boxes[origin], (np.arange(len(origin)), slice(None), np.array(focus)[origin])
    centres, halves, weights = parts[along].T
    halves = halves / count[origin]
    centres = centres - half[origin] + halves * (2 * part + 1)
    weights = np.maximum(weights, least_weights[along[2]] * parts[:, 2].max(axis=1))
    parts[along] = np.stack([centres, halves, weights], axis=1)
    return parts, origin
