"""Bounds on the level of a few foci, by branch and bound over the phases of their pressures.

Let the phases of the pressures of foci be within d_p of psi_p. Then Re(e^(-i psi_p) p_p) >= cos(d_p) |p_p|,
and with any a >= 0 all drives of amplitudes <= 1 have

    t sum a_p cos(d_p) <= Re sum a_p e^(-i psi_p) (G q)_p <= sum_m |sum_p a_p e^(-i psi_p) G_pm|,

where t is the least |p_p|, of rows over the wanted pressures. Boxes that together contain all phases bound t
by the largest of their right sides. The drive with the phases of the last sum attains a level; boxes within a
tolerance of the highest one are not divided.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from autdtorch.utils.array_types import Array, ComplexArray

_MOST_FOCI = 6  # With more, boxes are too many
_TOLERANCE = 3e-3  # Relative distance of the bound to the highest level found
_PARTS = 3  # of the circle of each phase in the beginning; more than 2, for a cosine > 0
_MOST_WORK = 3e8  # Products of boxes, foci, transducers and iterations: about half a second
_OWN_WORK = 60  # of a box, beside foci and transducers
_MOST_BOXES = 50_000  # at once
_ITERATIONS = 8  # of the weights a, which begin at those of the box that was divided
_LARGEST_STEP = 2.0  # of the logarithm of a weight
MARGIN = 1e-12
"""Relative margin on top of a bound; rounding of the bound and of a pressure is below 1e-13."""


class _Boxes(NamedTuple):
    """Boxes of phases: centres (B, P) [rad], half of their edges (B, P) [rad], and weights a (B, P)."""

    centres: Array
    halves: Array
    weights: Array


def phase_bound(foci: ComplexArray, wanted: Array, known: float) -> float:
    """Return a bound on the level t of foci that reach t `wanted`, at most the one that is known.

    Args:
        foci: their rows of the transfer matrix (P, M) [Pa].
        wanted: pressures (P,) > 0, relative to each other.
        known: a bound that holds.
    """
    if len(foci) > _MOST_FOCI:
        return known
    rows = foci / wanted[:, None]
    alone = np.abs(rows).sum(axis=1)  # level that each focus reaches alone
    if alone.min() == 0:
        return known
    boxes, work = _whole((alone.min() / alone) ** 2), float((rows.size + _OWN_WORK) * _ITERATIONS)
    attained, done, left = 0.0, 0.0, _MOST_WORK / work
    while len(boxes.centres):
        left -= len(boxes.centres)
        if left < 0 or len(boxes.centres) > _MOST_BOXES:
            return known
        bounds, weights, level = _bounded(rows, boxes)
        attained = max(attained, level)
        open_ = np.minimum(bounds, known) > attained * (1 + _TOLERANCE)
        done = max(done, bounds[~open_].max(initial=0.0))
        boxes = _divided(_Boxes(boxes.centres[open_], boxes.halves[open_], weights[open_]))
    return min(known, done * (1 + MARGIN))


def _whole(weights: Array) -> _Boxes:
    """Return boxes that contain all phases, with first weights (P,).

    The phase of the first focus is 0: a common phase changes nothing.
    """
    foci, half = len(weights), math.pi / _PARTS
    along = half * (2 * np.arange(_PARTS) + 1)
    centres = np.stack(np.meshgrid(0.0, *[along] * (foci - 1), indexing="ij"), axis=-1).reshape(-1, foci)
    halves = np.full_like(centres, half)
    halves[:, 0] = 0
    return _Boxes(centres, halves, np.tile(weights, (len(centres), 1)))


def _bounded(rows: ComplexArray, boxes: _Boxes) -> tuple[Array, Array, float]:
    """Return the least bounds (B,) that iterations find, their weights (B, P), and the highest level."""
    turn, cosine, weights = np.exp(-1j * boxes.centres), np.cos(boxes.halves), boxes.weights
    least, best, attained = np.full(len(turn), np.inf), weights, 0.0
    for number in range(_ITERATIONS):
        sums = (weights * turn) @ rows
        size = np.abs(sums)
        bounds = size.sum(axis=1) / (weights * cosine).sum(axis=1)
        lower = bounds < least
        least, best = np.where(lower, bounds, least), np.where(lower[:, None], weights, best)
        pressure = (sums.conj() / np.maximum(size, np.finfo(np.float64).tiny)) @ rows.T
        attained = max(attained, float(np.abs(pressure).min(axis=1).max()))
        # the weight of a focus grows as much as its pressure is below the bound
        missing = 1 - (turn * pressure).real / (cosine * bounds[:, None])
        weights = weights * np.exp((4 / (2 + number) * missing).clip(-_LARGEST_STEP, _LARGEST_STEP))
        weights = weights / weights.max(axis=1, keepdims=True)
    return least, best, attained


def _divided(boxes: _Boxes) -> _Boxes:
    """Return the halves of boxes, divided across their longest edge.

    The weights are no guide: a focus has a small weight as long as its edge is long.
    """
    each = np.arange(len(boxes.centres))
    longest = boxes.halves.argmax(axis=1)
    halves = boxes.halves.copy()
    halves[each, longest] /= 2
    centres = np.concatenate([boxes.centres, boxes.centres])
    centres[each, longest] -= halves[each, longest]
    centres[len(each) + each, longest] += halves[each, longest]
    return _Boxes(centres, np.concatenate([halves, halves]), np.concatenate([boxes.weights, boxes.weights]))
