"""Hermitian forms of the drive, such as forces and stiffnesses: certified bounds, and drives near them.

J forms share N rows of a matrix R (N, M) with weights W (J, N) of either sign: q^H A_j q = sum_n W_jn |(R
q)_n|^2. Take any a >= 0 with sum a_j = 1, and any z > 0. All drives |q_i| <= 1 satisfy

    min_j q^H A_j q <= q^H (sum a_j A_j) q <= lambda |z|^2,

with the largest eigenvalue lambda of Z^-1 (sum a_j A_j) Z^-1, Z = diag(z). The minimum of the right side over
a and z is the value of the semidefinite relaxation, as for foci (`bound`); any a and z certify a bound.
"""

from __future__ import annotations

from operator import itemgetter
from typing import TypeVar

import numpy as np
import scipy.optimize
import scipy.sparse.csgraph

from autdtorch.objectives.bound import certified, log_dual, lowest
from autdtorch.utils.array_types import Array, ComplexArray
from autdtorch.utils.process import one_library_thread

_LEAST_WEIGHT = 1e-12  # of a form, relative to its start
_RANGE = 30.0  # of log z
_ITERATIONS = 500  # of each order; hundreds of forms take milliseconds in each
_RANK = 1e-13  # Singular value below which the search leaves a combination of rows out; certificates do not
_MARGIN = 1e-12
# of the least form, relative to the mean size of all
_SMOOTHING = (1.0, 0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4)
_START = 0.9  # largest amplitude of the start of an ascent
_TINY = 1e-300

_Numbers = TypeVar("_Numbers", Array, ComplexArray)


@one_library_thread()
def forms_bound(rows: ComplexArray, weights: Array) -> float:
    """Return an upper bound on the least of J Hermitian forms over all drives of amplitudes <= 1.

    Args:
        rows: R (N, M).
        weights: W (J, N); see above. For a lower bound on a single form, take minus the bound of -W.

    Returns:
        The bound, >= 0: without sound all forms are 0. Where it is 0, no drive makes all forms positive.
    """
    scale = float(np.abs(rows).max()) or 1.0
    audible = np.abs(rows).max(axis=0) > 0
    rows = rows[:, audible] / scale
    if (np.abs(weights) @ (np.abs(rows) ** 2).sum(axis=1)).min() == 0:
        return 0.0
    mixing, basis = _factors(rows)
    forms = len(weights)
    start = np.log(np.linalg.norm(rows, axis=0)) / 2
    x = np.concatenate([np.ones(forms), start])
    limits: list[tuple[float, float | None]] = [(_LEAST_WEIGHT, None)] * forms
    limits += [(log - _RANGE, log + _RANGE) for log in start]

    def log_bound(x: Array, order: float) -> tuple[float, Array]:
        total = x[:forms].sum()
        signed = x[:forms] @ weights / total
        log, by_rows, by_log_z = log_dual(x[forms:], basis, signed, order, mixing)
        by_forms = (weights @ by_rows - signed @ by_rows) / total
        return log, np.concatenate([by_forms, by_log_z])

    x = lowest(log_bound, x, limits, _ITERATIONS)
    signed = x[:forms] @ weights / x[:forms].sum()
    return scale**2 * certified(x[forms:], rows, signed) * (1 + _MARGIN)


@one_library_thread()
def ascended(rows: ComplexArray, weights: Array, starts: ComplexArray, iterations: int = 300) -> ComplexArray:
    """Return drives (S, M) at local maxima of the least of J forms, from drives (S, M).

    L-BFGS on the smooth least form, smoothed less and less. Drives are z sin|z| / |z|: no amplitude is above
    1, and an amplitude of 1 is no end.

    Args:
        rows: R (N, M).
        weights: W (J, N).
        starts: drives to start from.
        iterations: most of each stage.
    """
    # forms of a point are sums of 9 quantities of 36 waves: factors are much smaller than rows and weights
    rows, weights = _apart(rows, weights)
    factors = *_factors(rows), *_factors(weights)
    return np.stack([_ascended(*factors, start, iterations) for start in starts])


def _ascended(
    mixing: ComplexArray,
    basis: ComplexArray,
    combining: Array,
    squares: Array,
    drive: ComplexArray,
    iterations: int,
) -> ComplexArray:
    """Return the drive of `ascended` from a drive (M,).

    Args:
        mixing: (G, N / G, n), a factor of the rows in groups, as below.
        basis: (G, n, M), the other.
        combining: (G, J / G, k), a factor of the weights.
        squares: (G, k, N / G), the other.
        drive: to start from.
        iterations: most of each stage.
    """
    count, every = len(drive), basis.reshape(-1, len(drive))
    back, back_mixing = every.conj(), mixing.conj()

    def readings_of(drive: ComplexArray) -> ComplexArray:
        values: ComplexArray = mixing @ (every @ drive).reshape(len(mixing), -1, 1)
        return values

    def forms_of(readings: ComplexArray) -> Array:
        values: Array = combining @ (squares @ np.abs(readings) ** 2)
        return values

    def smooth(x: Array, temperature: float) -> tuple[float, Array]:
        z: ComplexArray = x[:count] + 1j * x[count:]
        size = np.abs(z)
        readings = readings_of(z * np.sinc(size / np.pi))
        forms = forms_of(readings) / scale
        shares = np.exp((forms.min() - forms) / temperature)
        value = forms.min() - temperature * np.log(shares.sum())
        at_readings = ((shares / shares.sum()).mT @ combining @ squares).mT * readings
        slope = 2 / scale * ((at_readings.mT @ back_mixing).ravel() @ back)
        turn = z / np.maximum(size, _TINY)
        along = slope * turn.conj()
        slope = turn * (along.real * np.cos(size) + 1j * along.imag * np.sinc(size / np.pi))
        return -value, -np.concatenate([slope.real, slope.imag])

    def loud(drive: ComplexArray) -> tuple[float, ComplexArray]:
        drive = drive / max(float(np.abs(drive).max()), _TINY)
        return float(forms_of(readings_of(drive)).min()), drive

    amplitude = np.abs(drive)
    z = drive / np.maximum(amplitude, _TINY) * np.arcsin(np.minimum(amplitude, _START))
    highest = loud(drive)
    for smoothing in _SMOOTHING:
        drive = z * np.sinc(np.abs(z) / np.pi)
        scale = float(np.abs(forms_of(readings_of(drive))).mean()) or 1.0
        x = scipy.optimize.minimize(
            smooth,
            np.concatenate([z.real, z.imag]),
            args=(smoothing,),
            jac=True,
            method="L-BFGS-B",
            options={"maxcor": 20, "maxiter": iterations, "ftol": 1e-11, "gtol": 1e-9},
        ).x
        z = x[:count] + 1j * x[count:]
        highest = max(highest, loud(z * np.sinc(np.abs(z) / np.pi)), key=itemgetter(0))
    return highest[1]


def _apart(rows: ComplexArray, weights: Array) -> tuple[ComplexArray, Array]:
    """Return rows (G, N / G, M) and weights (G, J / G, N / G) of groups that share no form.

    The rows of each of several points are such a group. Groups of other sizes stay together as one.
    """
    links = scipy.sparse.block_array([[None, weights], [weights.T, None]])
    count, groups = scipy.sparse.csgraph.connected_components(links)
    form_group, row_group = np.split(groups, [len(weights)])
    members = np.stack([np.bincount(group, minlength=count) for group in (row_group, form_group)])
    if (members != members[:, :1]).any():
        return rows[None], weights[None]
    by_group = row_group.argsort(kind="stable").reshape(count, -1)
    forms = form_group.argsort(kind="stable").reshape(count, -1)
    return rows[by_group], weights[forms[:, :, None], by_group[:, None]]


def _factors(rows: _Numbers) -> tuple[_Numbers, _Numbers]:
    """Return factors (..., N, n) and (..., n, M) of rows (..., N, M), real or complex; n is their rank."""
    left, singular, right = np.linalg.svd(rows, full_matrices=False)
    rank = int((singular > _RANK * singular[..., :1]).sum(axis=-1).max())
    return left[..., :rank] * singular[..., None, :rank], right[..., :rank, :]
