"""Certified upper bounds on scores over all drives (docs/decisions/bound.md).

**Relaxation.** Let foci reach at least t w_p, with w the pressures wanted relative to each other, and quiet
points at most r t. Take any z > 0 of the M transducers, and any a, b >= 0 of the foci and the quiet points
with sum a_p w_p^2 - r^2 sum b_k = 1. All drives |q_i| <= 1 satisfy two inequalities.

    t^2 <= sum a_p |(G q)_p|^2 - sum b_k |(G q)_k|^2 <= lambda |z|^2.

Here lambda is the largest eigenvalue of Z^-1 G^H D G Z^-1, Z = diag(z) and D = diag(a, -b). The minimum
of the right side is the value of the semidefinite relaxation, whose dual this is. If the search ends a little
above the minimum, the bound still holds.

Branch and bound over the phases of the foci (`phase_boxes`) starts from this bound, and lowers it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeAlias

import numpy as np
import scipy.optimize

from autdtorch.objectives.phase_boxes import phase_bound
from autdtorch.utils.array_types import Array, ComplexArray
from autdtorch.utils.process import one_library_thread
from autdtorch.utils.validation import ArrayLike, complex_tensor, positive

LogBound: TypeAlias = Callable[[Array, float], tuple[float, Array]]

#: Orders of Schatten norms that approach the largest eigenvalue, which has kinks at its minima.
_ORDERS = (4, 32, 256, 2048, 16384)
_ITERATIONS = 2000  # of each order

#: Smallest weight, relative to its start: no step of the search may end where all weights are 0.
_LEAST_WEIGHT = 1e-12

#: Largest price of a quiet point: where none can be quiet the search has no end. Range of log z, likewise.
_MOST_PRICE, _RANGE = 1e6, 30.0

#: Logarithm of a bound that is 0
_NOTHING = -700.0

#: Ranges of log z to certify: where prices let some z vanish, rounding takes more than the range gains.
_RANGES = (2 * _RANGE, 16.0, 12.0, 8.0, 6.0, 4.0, 2.0)

#: Rounding of an entry of the matrix whose eigenvalues are taken, over the number of its rows
_ROUNDING = 10 * float(np.finfo(np.float64).eps)

#: Smallest singular value of a background, relative to the largest, and the margin for its rounding.
_LEAST_SINGULAR, _SINGULAR_MARGIN = 1e-8, 1e-6

_FEW = 6  # Foci that branch and bound nearly always brings to the highest level
_WORK_FEW = 3e8  # of branch and bound (`phase_bound`) for few foci: half a second
_WORK = 4e3  # for more, over P M min(P, M): with the most, at most half of the relaxation's time
_MOST_WORK = 1e8
_MOST_JOINT = 48  # Foci of several matrices; more of them take long, and lower a bound by less than 1 %
_MARGIN = 1e-12
"""Relative margin on top of a bound; rounding of the bound and of a pressure is below 1e-13."""


def focus_bound(G: ArrayLike, effort: float = 1.0) -> float:
    """Return an upper bound on the pressure of the weakest focus over all drives.

    Args:
        G: transfer matrix (P, M), complex [Pa]. Several, one below the other, bound the weakest focus of all.
        effort: of branch and bound, in its usual time: a fraction of a second. Where the bound is not nearly
            attained, more lowers it.

    Returns:
        Bound [Pa] on min_p |(G q)_p| over all drives q of amplitudes <= 1. For up to four foci, and
        mostly for five or six, it is within 0.3 % of the highest attainable pressure; otherwise it is the
        value of a semidefinite relaxation or less.

    Raises:
        ValueError: not finite complex numbers, not (P, M) with P, M >= 1, or no effort > 0.
    """
    matrix = checked_matrix(G)
    return least_bound(matrix, np.ones(len(matrix)), positive("effort", effort))


@one_library_thread()
def least_bound(foci: ComplexArray, wanted: Array, effort: float = 1.0) -> float:
    """Return a bound on the level t of foci (P, M) that reach t `wanted` (P,)."""
    return _lowered(level_bound(foci, wanted)[0], foci / wanted[:, None], effort)


@one_library_thread()
def joint_bound(matrices: ComplexArray, wanted: Array, effort: float = 1.0) -> float:
    """Return a bound on the level t of foci that reach t `wanted` (P,) with each of matrices (S, P, M).

    Of many foci, those that reach the least alone decide the relaxation: a bound on some of them holds for
    all. Few foci of one scene have the closer bound where scenes are much alike.
    """
    if len(matrices) == 1:
        return least_bound(matrices[0], wanted, effort)
    rows = (matrices / wanted[:, None]).reshape(-1, matrices.shape[-1])
    alone = np.abs(rows).sum(axis=1)
    least = np.sort(np.argsort(alone, kind="stable")[:_MOST_JOINT])
    bound, _ = level_bound(rows[least], np.ones(len(least)))
    if len(wanted) <= _FEW:
        bound = min(bound, least_bound(matrices[alone.argmin() // len(wanted)], wanted, effort))
    return _lowered(bound, rows, effort)


def _lowered(bound: float, rows: ComplexArray, effort: float) -> float:
    """Return a bound on the level of rows (P, M), lowered by branch and bound."""
    if bound == 0:
        return 0.0
    rows = rows[:, rows.any(axis=0)]  # a failed transducer takes no work
    foci, transducers = min(len(rows), _MOST_JOINT), rows.shape[1]
    work = min(_WORK * foci * transducers * min(foci, transducers), _MOST_WORK)
    work = work if len(rows) > _FEW else _WORK_FEW
    return float(phase_bound(rows, bound, effort * work))


def checked_matrix(G: ArrayLike, name: str = "G") -> ComplexArray:
    """Return a transfer matrix (P, M), called `name` in messages, after checking it."""
    matrix = complex_tensor(name, G).detach().cpu().numpy().astype(np.complex128)
    if matrix.ndim != 2 or matrix.size == 0:
        raise ValueError(f"{name}: shape {matrix.shape}; must be (P, M) with P, M >= 1")
    return matrix


@one_library_thread()
def level_bound(
    foci: ComplexArray,
    wanted: Array,
    quiet: ComplexArray | None = None,
    ratio: float = 1.0,
    together: bool = False,
    norm: bool = False,
) -> tuple[float, float]:
    """Return a bound on the level t of foci that reach t `wanted`, while quiet points stay below r t.

    Args:
        foci: their rows of the transfer matrix (P, M) [Pa].
        wanted: pressures (P,) > 0, relative to each other.
        quiet: rows of the quiet points (K, M) [Pa].
        ratio: r > 0.
        together: whether t is the root mean square of the pressures over `wanted`, not the least.
        norm: whether drives have the norm 1, instead of amplitudes up to 1.

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
    log_z, wide = (np.zeros(len(start)), 0.0) if norm else (np.log(start), _RANGE)
    limits += [(0, _MOST_PRICE)] * len(silent) + [(log - wide, log + wide) for log in log_z]
    x = np.concatenate([weights, np.full(len(silent), 1e-3), log_z])
    x = lowest(partial(_log_bound, rows=rows, importance=importance), x, limits, _ITERATIONS)
    square = certified(x[len(rows) :], rows, _signed(x, rows, importance))
    bound = alone.min() * math.sqrt(square) * (1 + _MARGIN)
    if norm:  # |z|^2 is the number of transducers
        bound /= math.sqrt(len(start))
    return float(bound), float(x[count : count + len(silent)].sum())


def lowest(
    log_bound: LogBound, x: Array, limits: Sequence[tuple[float, float | None]], iterations: int
) -> Array:
    """Return the place of the lowest bound, by orders of the norm of `log_dual` that rise.

    Args:
        log_bound: of x (n,) and an order, returns the logarithm and its gradient (n,).
        x: to start from (n,).
        limits: of each entry.
        iterations: most of each order.
    """
    for order in _ORDERS:
        x = scipy.optimize.minimize(
            log_bound,
            x,
            args=(order,),
            jac=True,
            method="L-BFGS-B",
            bounds=limits,
            options={"maxcor": 80, "maxiter": iterations, "ftol": 1e-14, "gtol": 1e-10},
        ).x
    return x


def contrast_bound(foci: ComplexArray, background: ComplexArray) -> float:
    """Return a bound on the weakest focus over the rms pressure of the background, of any drive.

    With background rows B = U S V^H, the drive q = V S^-1 x has a background of the norm |x|.

    Args:
        foci: their rows of the transfer matrix (P, M) [Pa].
        background: rows of its points (K, M) [Pa].

    Returns:
        The bound; infinite where B has a rank below M, for drives can silence the background then.
    """
    audible = (np.abs(foci).max(axis=0) > 0) | (np.abs(background).max(axis=0) > 0)
    foci, background = foci[:, audible], background[:, audible]
    if not audible.any():
        return 0.0
    _, singular, right = np.linalg.svd(background, full_matrices=False)
    if len(background) < foci.shape[1] or singular[-1] <= _LEAST_SINGULAR * singular[0]:
        return math.inf
    rows = foci @ (right.conj().T / singular)
    level, _ = level_bound(rows, np.ones(len(rows)), norm=True)
    return level * math.sqrt(len(background)) * (1 + _SINGULAR_MARGIN)


def certified(log_z: Array, rows: ComplexArray, signed: Array) -> float:
    """Return lambda |z|^2 of rows (N, M) with weights (N,) of either sign, in spite of rounding.

    The dual of the relaxation: an upper bound on sum signed_n |(rows q)_n|^2 over all drives |q_i| <= 1. It
    is 0 if the weights leave no drive above 0.
    """
    bounds = []
    for width in _RANGES:
        z = np.exp(log_z - log_z.max()).clip(math.exp(-width))
        # scaled before, as the SVD errs in proportion to its norm
        scaled = np.sqrt(np.abs(signed))[:, None] * (rows / z)
        left, singular, _ = np.linalg.svd(scaled, full_matrices=False)
        signs = left.conj().T * np.sign(signed)
        largest = np.linalg.eigvalsh((singular[:, None] * signs @ left) * singular)[-1]
        rounding = _ROUNDING * len(rows) * (np.abs(scaled) ** 2).sum()
        bounds.append(max(largest + rounding, 0.0) * np.sum(z**2))
    return float(min(bounds))


def log_dual(
    log_z: Array, rows: ComplexArray, signed: Array, order: float, mixing: ComplexArray | None = None
) -> tuple[float, Array, Array]:
    """Return the logarithm of lambda |z|^2, and its derivatives by the weights and by log z.

    The Schatten norm of this `order`, of the positive part, replaces the largest eigenvalue lambda.

    Args:
        log_z: of the transducers (M,).
        rows: (N, M).
        signed: their weights (N,), of either sign.
        order: >= 2.
        mixing: (N, n), if the rows are its product with `rows` (n, M).
    """
    z = np.exp(log_z - log_z.max())
    orthonormal, triangle = np.linalg.qr((rows / z).T)  # in a third of an SVD's time
    factor = triangle.T if mixing is None else mixing @ triangle.T
    values, vectors = np.linalg.eigh((factor.conj().T * signed) @ factor)
    if values[-1] <= 0:  # no level is left
        return 2 * _NOTHING, np.zeros_like(signed), np.zeros_like(z)
    positive = np.maximum(values, 0)
    ratios = positive / positive[-1]
    norm = np.linalg.norm(ratios, order)
    # Derivative of the logarithm by the eigenvalues
    growth = (ratios / norm) ** (order - 1) / (positive[-1] * norm)
    at_points = np.abs(factor @ vectors) ** 2 @ growth
    at_transducers = np.abs(orthonormal @ vectors.conj()) ** 2 @ (growth * values)
    log = float(np.log(positive[-1] * norm) + np.log(np.sum(z**2)))
    return log, at_points, 2 * (z**2 / np.sum(z**2) - at_transducers)


def _signed(x: Array, rows: ComplexArray, importance: Array) -> Array:
    """Return the signed weights of all points; see `_log_bound`."""
    weights, prices, _ = np.split(x, [len(importance), len(rows)])
    # with prices b, the weights are divided by their mean and multiplied by 1 + sum b
    factor = (1 + prices.sum()) / (weights @ importance)
    return np.concatenate((weights * factor, -prices))


def _log_bound(x: Array, order: float, rows: ComplexArray, importance: Array) -> tuple[float, Array]:
    """Return the logarithm of the bound over the least of `alone`, and its gradient; see `log_dual`.

    Args:
        x: the weights a over `importance`, up to a factor, b, then log z (P + K + M,).
        order: >= 2.
        rows: transfer matrix (P + K, M), rows of foci divided by `alone`, those of quiet points by its least.
        importance: (min(alone) / alone)^2 (P,).
    """
    foci = len(importance)
    log, at_points, slope_log_z = log_dual(x[len(rows) :], rows, _signed(x, rows, importance), order)
    weights, all_prices = x[:foci], 1 + x[foci : len(rows)].sum()
    mean = weights @ importance
    slope_weights = (at_points[:foci] - importance * (weights @ at_points[:foci]) / mean) * all_prices / mean
    slope_prices = weights @ at_points[:foci] / mean - at_points[foci:]
    return log / 2, np.concatenate([slope_weights, slope_prices, slope_log_z]) / 2
