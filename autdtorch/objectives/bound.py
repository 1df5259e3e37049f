"""Certified upper bounds on scores over all drives (docs/decisions/bound.md).

Let foci reach at least t w_p, with w the pressures wanted relative to each other, and quiet points at most
r t. Take any z > 0 of the M transducers, and any a, b >= 0 of the foci and the quiet points with
sum a_p w_p^2 - r^2 sum b_k = 1. All drives |q_i| <= 1 have

    t^2 <= sum a_p |(G q)_p|^2 - sum b_k |(G q)_k|^2 <= lambda |z|^2,

with lambda the largest eigenvalue of Z^-1 G^H D G Z^-1, Z = diag(z) and D = diag(a, -b). The minimum of the
right side is the value of the semidefinite relaxation, whose dual this is. If the search ends a little above
the minimum, the bound still holds.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
import scipy.optimize
from numpy.typing import NDArray

from autdtorch.utils.validation import ArrayLike, complex_tensor

#: Orders of Schatten norms that approach the largest eigenvalue, which has kinks at its minima.
_ORDERS = (4, 32, 256, 2048, 16384)

#: Smallest weight, relative to its start: no step of the search may end where all weights are 0.
_LEAST_WEIGHT = 1e-12

#: Largest price of a quiet point: where none can be quiet the search has no end. Range of log z, likewise.
_MOST_PRICE, _RANGE = 1e6, 30.0

#: Logarithm of a bound that is 0
_NOTHING = -700.0

#: Relative margin on top of the bound; rounding of the bound and of a pressure is below 1e-13.
_MARGIN = 1e-12

_Reals: TypeAlias = NDArray[np.float64]
_Complexes: TypeAlias = NDArray[np.complex128]


def focus_bound(G: ArrayLike) -> float:
    """Return an upper bound on the pressure of the weakest focus over all drives.

    Args:
        G: transfer matrix (P, M), complex [Pa].

    Returns:
        Bound [Pa] on min_p |(G q)_p| over all drives q of amplitudes <= 1, within about 1e-5 of the
        semidefinite relaxation.

    Raises:
        ValueError: not finite complex numbers, or not (P, M) with P, M >= 1.
    """
    matrix = checked_matrix(G)
    return level_bound(matrix, np.ones(len(matrix)))[0]


def checked_matrix(G: ArrayLike) -> _Complexes:
    """Return a transfer matrix (P, M) after checking it."""
    matrix = complex_tensor("G", G).detach().cpu().numpy().astype(np.complex128)
    if matrix.ndim != 2 or matrix.size == 0:
        raise ValueError(f"G: shape {matrix.shape}; must be (P, M) with P, M >= 1")
    return matrix


def level_bound(
    foci: _Complexes,
    wanted: _Reals,
    quiet: _Complexes | None = None,
    ratio: float = 1.0,
    together: bool = False,
) -> tuple[float, float]:
    """Return a bound on the level t of foci that reach t `wanted`, while quiet points stay below r t.

    Args:
        foci: their rows of the transfer matrix (P, M) [Pa].
        wanted: pressures (P,) > 0, relative to each other.
        quiet: rows of the quiet points (K, M) [Pa].
        ratio: r > 0.
        together: whether t is the root mean square of the pressures over `wanted`, not the least.

    Returns:
        The bound, and the price r^2 sum b >= 0 of the quiet points: for another ratio r e^x, the bound is
        multiplied by (1 - price (e^(2 x) - 1))^(-1/2).
    """
    foci = foci / wanted[:, None]
    silent = np.zeros((0, foci.shape[1]), np.complex128) if quiet is None else quiet / ratio
    alone = np.abs(foci).sum(axis=1)  # level that each focus reaches alone
    if alone.min() == 0:
        return 0.0, 0.0
    silent = silent / alone.min()
    silent = silent[np.abs(silent).max(axis=1) > 0]
    importance = (alone.min() / alone) ** 2  # of each focus, scaled against overflow
    rows = np.concatenate((foci / alone[:, None], silent))
    rows, count = rows[:, np.abs(rows).max(axis=0) > 0], len(foci)
    start = np.linalg.norm(rows, axis=0)
    weights = 1 / importance if together else np.ones(count)
    limits = list(zip(weights, weights, strict=True)) if together else [(_LEAST_WEIGHT, None)] * count
    log_z = np.log(start)
    limits += [(0, _MOST_PRICE)] * len(silent) + [(log - _RANGE, log + _RANGE) for log in log_z]
    x = np.concatenate([weights, np.full(len(silent), 1e-3), log_z])
    for order in _ORDERS:
        x = scipy.optimize.minimize(
            _log_bound,
            x,
            args=(rows, importance, order),
            jac=True,
            method="L-BFGS-B",
            bounds=limits,
            options={"maxcor": 40, "maxiter": 2000, "ftol": 1e-14, "gtol": 1e-10},
        ).x
    bound = alone.min() * math.exp(_log_bound(x, rows, importance, math.inf)[0]) * (1 + _MARGIN)
    return bound, float(x[count : count + len(silent)].sum())


def _log_bound(x: _Reals, rows: _Complexes, importance: _Reals, order: float) -> tuple[float, _Reals]:
    """Return the logarithm of the bound over the least of `alone`, and its gradient.

    The Schatten norm of this `order`, of the positive part, replaces the largest eigenvalue.

    Args:
        x: the weights a over `importance`, up to a factor, b, then log z (P + K + M,).
        rows: transfer matrix (P + K, M), rows of foci divided by `alone`, those of quiet points by its least.
        importance: (min(alone) / alone)^2 (P,).
        order: >= 2; infinite for the largest eigenvalue.
    """
    foci, points = len(importance), len(rows)
    weights, prices, log_z = np.split(x, [foci, points])
    z = np.exp(log_z - log_z.max())
    columns = rows / z
    # with prices b, the weights are divided by their mean and multiplied by 1 + sum b
    mean, all_prices = weights @ importance, 1 + prices.sum()
    signed = np.concatenate((weights * (all_prices / mean), -prices))
    left, singular, right = np.linalg.svd(columns, full_matrices=False)
    values, vectors = np.linalg.eigh((singular[:, None] * (left.conj().T * signed) @ left) * singular)
    if values[-1] <= 0:  # no level is left
        return _NOTHING, np.zeros_like(x)
    positive = np.maximum(values, 0)
    ratios = positive / positive[-1]
    norm = np.linalg.norm(ratios, order)
    log_bound = (np.log(positive[-1] * norm) + 2 * np.log(np.linalg.norm(z))) / 2

    # Derivative of the logarithm by the eigenvalues
    growth = (ratios / norm) ** (order - 1) / (positive[-1] * norm) / 2
    at_points = np.abs((left * singular) @ vectors) ** 2 @ growth
    at_transducers = np.abs(right.T @ vectors.conj()) ** 2 @ (growth * values)
    slope_weights = (at_points[:foci] - importance * (weights @ at_points[:foci]) / mean) * all_prices / mean
    slope_prices = weights @ at_points[:foci] / mean - at_points[foci:]
    slope_log_z = z**2 / np.sum(z**2) - 2 * at_transducers
    return float(log_bound), np.concatenate([slope_weights, slope_prices, slope_log_z])
