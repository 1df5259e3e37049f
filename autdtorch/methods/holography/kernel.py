"""Holography on CPUs, in numba: the algorithms of `algorithms.py`, for blocks of sets at once.

A block packs the matrices of `_LANES` sets entry by entry, so that every operation is one on vectors, and its
matrices stay in the cache through all iterations. Arrays are flat with unsigned indices, real and imaginary
parts apart, and made in one function, so that the compiler knows that they do not overlap. The order of all
sums is fixed.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from numba import njit

from autdtorch.fdtd.kernels.compiled import INNER, entry
from autdtorch.methods.holography.algorithms import DAMPING, TINY, UNREACHED
from autdtorch.utils.process import even_parts, spread, thread_count

_LANES = np.uint64(16)  # Sets of a block
_TASKS = 4  # Tasks a thread, so that none waits long for another
_NAMES = ("gs", "wgs", "gs_pat")
_GS, _WGS, _GS_PAT = range(3)  # places in `_NAMES`
_HERE = Path(__file__).parent


def solved(
    matrix: torch.Tensor, wanted: torch.Tensor, algorithm: str, iterations: int, free: bool
) -> torch.Tensor:
    """Return drives (B, M) of matrices (B, P, M) and wanted pressures (B, P), on the CPU."""
    count, _, transducers = matrix.shape
    entries = torch.view_as_real(matrix.contiguous().resolve_conj()).numpy()
    drive = np.empty((count, transducers, 2), entries.dtype)
    targets, naive = np.ascontiguousarray(wanted.numpy()), algorithm == "naive"
    units = count if naive else -(-count // int(_LANES))
    parts = even_parts(units, min(units, _TASKS * thread_count()))
    if naive:  # too quick to be packed
        spread(lambda ends: _back_propagate(entries, targets, *ends, free, drive), parts)
    else:
        number = _NAMES.index(algorithm)
        spread(lambda ends: _solve(entries, targets, *ends, number, iterations, free, drive), parts)
    return torch.view_as_complex(torch.from_numpy(drive))


@entry(_HERE)
def _back_propagate(matrix, wanted, first, last, free, drive):  # type: ignore[no-untyped-def]
    """Write the drives (B, M, 2) of the sets `first` to `last` of matrices (B, P, M, 2)."""
    points, transducers = matrix.shape[1:3]
    tiny = matrix.dtype.type(TINY)
    for n in range(first, last):
        out, rows = drive[n].reshape(-1), matrix[n].reshape(points, -1)
        out[:] = 0
        for p in range(points):
            row, size = rows[p], wanted[n, p]
            for k in range(len(out)):
                out[k] += size * row[k]
        largest = tiny
        for m in range(transducers if free else 0):
            largest = max(largest, math.sqrt(out[2 * m] ** 2 + out[2 * m + 1] ** 2))
        for m in range(transducers):
            real, imaginary = out[2 * m], out[2 * m + 1]
            size = largest if free else max(math.sqrt(real * real + imaginary * imaginary), tiny)
            out[2 * m], out[2 * m + 1] = real / size, -imaginary / size


@njit(**INNER)
def _copy(source, target):  # type: ignore[no-untyped-def]
    """Copy numbers one by one; for slices numba would compile messages of shapes."""
    for k in range(np.uint64(len(source))):
        target[k] = source[k]


@njit(**INNER)
def _pack(matrix, wanted, first, points, transducers, a, b, t, begin):  # type: ignore[no-untyped-def]
    """Copy the sets from `first` on, of flat arrays, to lanes; lanes beyond the last set repeat it."""
    one, two, entries = np.uint64(1), np.uint64(2), points * transducers
    last = np.uint64(len(wanted)) // points - one
    for lane in range(_LANES):
        number = min(first + lane, last)
        begin[lane] = two * entries * number
        for p in range(points):
            t[p * _LANES + lane] = wanted[number * points + p]
    for n in range(entries):
        to, at = n * _LANES, two * n
        for lane in range(_LANES):
            a[to + lane] = matrix[begin[lane] + at]
            b[to + lane] = matrix[begin[lane] + at + one]


@njit(**INNER)
def _forward(a, b, x, z, y, w, points, transducers):  # type: ignore[no-untyped-def]
    """Set pressures y + i w (P,) = (a + i b) (x + i z), for drives (M,)."""
    for k in range(points * _LANES):
        y[k], w[k] = 0, 0
    for p in range(points):
        out = p * _LANES
        for m in range(transducers):
            at, of = (p * transducers + m) * _LANES, m * _LANES
            for k in range(_LANES):
                y[out + k] += a[at + k] * x[of + k] - b[at + k] * z[of + k]
                w[out + k] += a[at + k] * z[of + k] + b[at + k] * x[of + k]


@njit(**INNER)
def _back(a, b, y, w, x, z, size, points, transducers, free):  # type: ignore[no-untyped-def]
    """Set drives x + i z (M,) = (a + i b)^H (y + i w), of amplitude 1, or over their largest if `free`."""
    count = transducers * _LANES
    for k in range(count):
        x[k], z[k] = 0, 0
    for p in range(points):
        of = p * _LANES
        for m in range(transducers):
            at, out = (p * transducers + m) * _LANES, m * _LANES
            for k in range(_LANES):
                x[out + k] += a[at + k] * y[of + k] + b[at + k] * w[of + k]
                z[out + k] += a[at + k] * w[of + k] - b[at + k] * y[of + k]
    tiny = x.dtype.type(TINY)
    for k in range(count):
        size[k] = max(math.sqrt(x[k] * x[k] + z[k] * z[k]), tiny)
    if free:
        for m in range(np.uint64(1), transducers):
            for k in range(_LANES):
                size[k] = max(size[k], size[m * _LANES + k])
        for k in range(_LANES, count):
            size[k] = size[k % _LANES]
    for k in range(count):
        x[k] /= size[k]
        z[k] /= size[k]


@njit(**INNER)
def _imposed(y, w, weight, count):  # type: ignore[no-untyped-def]
    """Give pressures y + i w the sizes `weight`."""
    tiny = y.dtype.type(TINY)
    for k in range(count):
        factor = weight[k] / max(math.sqrt(y[k] * y[k] + w[k] * w[k]), tiny)
        y[k] *= factor
        w[k] *= factor


@njit(**INNER)
def _reweighted(y, w, t, weight, level, count):  # type: ignore[no-untyped-def]
    """Multiply weights (P,) by a power of wanted over present pressure, and divide them by the largest.

    The `level` of each set is set to its lowest present over wanted pressure.
    """
    tiny, share = y.dtype.type(TINY), y.dtype.type(UNREACHED)
    for lane in range(_LANES):
        loudest, level[lane] = tiny, np.inf
        for k in range(lane, count, _LANES):
            loudest = max(loudest, math.sqrt(y[k] * y[k] + w[k] * w[k]))
        largest = tiny
        for k in range(lane, count, _LANES):
            size = math.sqrt(y[k] * y[k] + w[k] * w[k])
            size = size if size > share * loudest else loudest
            if t[k] > 0:
                level[lane] = min(level[lane], size / t[k])
            weight[k] *= (t[k] / size) ** y.dtype.type(DAMPING)
        for k in range(lane, count, _LANES):
            largest = max(largest, weight[k])
        for k in range(lane, count, _LANES):
            weight[k] /= largest


@njit(**INNER)
def _store_best(x, z, level, highest, x_best, z_best, transducers):  # type: ignore[no-untyped-def]
    """Store the drives of the sets whose level is their highest so far."""
    for lane in range(_LANES):
        if level[lane] > highest[lane]:
            highest[lane] = level[lane]
            for k in range(lane, transducers * _LANES, _LANES):
                x_best[k], z_best[k] = x[k], z[k]


@njit(**INNER)
def _products(a, b, c, d, points, transducers):  # type: ignore[no-untyped-def]
    """Set c + i d (P, P) = (a + i b) (a + i b)^H."""
    for k in range(points * points * _LANES):
        c[k], d[k] = 0, 0
    for p in range(points):
        for q in range(p + np.uint64(1)):
            out, mirrored = (p * points + q) * _LANES, (q * points + p) * _LANES
            for m in range(transducers):
                at, of = (p * transducers + m) * _LANES, (q * transducers + m) * _LANES
                for k in range(_LANES):
                    c[out + k] += a[at + k] * a[of + k] + b[at + k] * b[of + k]
                    d[out + k] += b[at + k] * a[of + k] - a[at + k] * b[of + k]
            for k in range(_LANES):
                c[mirrored + k] = c[out + k]
                d[mirrored + k] = d[out + k] if p == q else -d[out + k]
    for lane in range(_LANES):  # against overflow: the largest entry is on the diagonal
        largest = c.dtype.type(TINY)
        for p in range(points):
            largest = max(largest, c[(p * points + p) * _LANES + lane])
        for k in range(lane, points * points * _LANES, _LANES):
            c[k] /= largest
            d[k] /= largest


@entry(_HERE)
def _solve(matrix, wanted, first, last, algorithm, iterations, free, drive):  # type: ignore[no-untyped-def]
    """Write the drives (B, M, 2) of the blocks `first` to `last` of matrices (B, P, M, 2).

    The algorithm is a place in `_NAMES`.
    """
    points, transducers, kind = np.uint64(matrix.shape[1]), np.uint64(matrix.shape[2]), matrix.dtype
    count, entries = points * _LANES, points * transducers * _LANES
    a, b = np.empty(entries, kind), np.empty(entries, kind)
    drives, squares = transducers * _LANES, points * count if algorithm == _GS_PAT else np.uint64(1)
    x, z, size = np.empty(drives, kind), np.empty(drives, kind), np.empty(drives, kind)
    y, w, v, u = np.empty(count, kind), np.empty(count, kind), np.empty(count, kind), np.empty(count, kind)
    t, weight = np.empty(count, kind), np.empty(count, kind)
    x_best, z_best = np.empty(drives, kind), np.empty(drives, kind)
    level, highest = np.empty(_LANES, kind), np.empty(_LANES, kind)
    c, d = np.empty(squares, kind), np.empty(squares, kind)
    flat, targets, begin = matrix.reshape(-1), wanted.reshape(-1), np.empty(_LANES, np.uint64)
    for block in range(first, last):
        _pack(flat, targets, np.uint64(block) * _LANES, points, transducers, a, b, t, begin)
        if algorithm == _GS_PAT:
            _products(a, b, c, d, points, transducers)
            _copy(t, y)
            w[:] = 0
            for _ in range(iterations):
                _imposed(y, w, t, count)
                _copy(y, v)
                _copy(w, u)
                _forward(c, d, v, u, y, w, points, points)
            for k in range(count):
                factor = t[k] * t[k] / max(y[k] * y[k] + w[k] * w[k], kind.type(TINY))
                y[k] *= factor
                w[k] *= factor
            _back(a, b, y, w, x, z, size, points, transducers, free)
        else:
            x[:], z[:] = 1, 0
            _copy(t, weight)
            highest[:] = 0
            x_best[:], z_best[:] = np.nan, np.nan  # stays so where a matrix is not finite
            _forward(a, b, x, z, y, w, points, transducers)
            for _ in range(iterations):
                _imposed(y, w, weight, count)
                _back(a, b, y, w, x, z, size, points, transducers, free)
                _forward(a, b, x, z, y, w, points, transducers)
                if algorithm == _WGS:
                    _reweighted(y, w, t, weight, level, count)
                    _store_best(x, z, level, highest, x_best, z_best, transducers)
            if algorithm == _WGS:
                _copy(x_best, x)
                _copy(z_best, z)
        for lane in range(_LANES):
            number = np.uint64(block) * _LANES + lane
            if number < np.uint64(len(matrix)):
                out = drive[number].reshape(-1)
                for m in range(transducers):
                    out[m + m] = x[m * _LANES + lane]
                    out[m + m + np.uint64(1)] = z[m * _LANES + lane]
