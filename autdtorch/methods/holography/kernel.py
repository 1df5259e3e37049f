"""Holography on CPUs, in numba: the algorithms of `algorithms.py`, for blocks of sets at once.

A block packs the matrices of several sets entry by entry, one set a lane, so that every operation is one on
vectors. Its matrices stay in the cache through all iterations. Each iteration reads them once, a few
transducers at a time. Arrays are flat with unsigned indices, real and imaginary parts apart. The order of all
sums is fixed.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from numba import njit

from autdtorch.fdtd.kernels import cpu_intrinsics
from autdtorch.fdtd.kernels.cpu_intrinsics import VECTOR, add_conjugate_products, add_products
from autdtorch.methods.holography.algorithms import GOLDEN, TINY, UNREACHED, weight_change
from autdtorch.utils.compiled import INNER, entry
from autdtorch.utils.process import even_parts, spread, thread_count

_GROUP = np.uint64(4)  # Transducers whose entries are read twice while they are in the nearest cache
_TASKS = 4  # Tasks a thread, so that none waits long for another
_NAMES = ("gs", "wgs", "wgs_drives", "gs_pat")
_GS, _WGS, _WGS_DRIVES, _GS_PAT = range(4)  # places in `_NAMES`
_INTRINSICS = Path(cpu_intrinsics.__file__).parent

_weight_change = njit(**INNER)(weight_change)


def solved(
    matrix: torch.Tensor, wanted: torch.Tensor, algorithm: str, iterations: int, free: bool
) -> torch.Tensor:
    """Return drives (B, M) of matrices (B, P, M) and wanted pressures (B, P), on the CPU."""
    count, _, transducers = matrix.shape
    entries = torch.view_as_real(matrix.contiguous().resolve_conj()).numpy()
    drive = np.empty((count, transducers, 2), entries.dtype)
    targets, naive = np.ascontiguousarray(wanted.numpy()), algorithm == "naive"
    units = count if naive else -(-count * entries.itemsize // VECTOR)
    parts = even_parts(units, min(units, _TASKS * thread_count()))
    if naive:  # too quick to be packed
        spread(lambda ends: _back_propagate(entries, targets, *ends, free, drive), parts)
    else:
        number = _NAMES.index(algorithm)
        spread(lambda ends: _solve(entries, targets, *ends, number, iterations, free, drive), parts)
    return torch.view_as_complex(torch.from_numpy(drive))


@entry(_INTRINSICS)
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
def _place(p, m, points):  # type: ignore[no-untyped-def]
    """Return the place of an entry in packed matrices: groups of transducers, in each point by point."""
    return (m // _GROUP * points + p) * _GROUP + m % _GROUP


@njit(**INNER)
def _pack(matrix, wanted, first, points, transducers, lanes, a, b, t, begin):  # type: ignore[no-untyped-def]
    """Copy the sets from `first` on, of flat arrays, to lanes; lanes beyond the last set repeat it."""
    one, two = np.uint64(1), np.uint64(2)
    last = np.uint64(len(wanted)) // points - one
    for lane in range(lanes):
        number = min(first + lane, last)
        begin[lane] = two * points * transducers * number
        for p in range(points):
            t[p * lanes + lane] = wanted[number * points + p]
    for p in range(points):
        for m in range(transducers):
            to, at = _place(p, m, points) * lanes, two * (p * transducers + m)
            for lane in range(lanes):
                a[to + lane] = matrix[begin[lane] + at]
                b[to + lane] = matrix[begin[lane] + at + one]


@njit(**INNER)
def _fill(target, value):  # type: ignore[no-untyped-def]
    """Set all numbers to a value; for slices numba would compile messages of shapes."""
    for k in range(np.uint64(len(target))):
        target[k] = value


@njit(**INNER)
def _copy(source, target):  # type: ignore[no-untyped-def]
    """Copy numbers one by one, likewise."""
    for k in range(np.uint64(len(source))):
        target[k] = source[k]


@njit(**INNER)
def _begin(y, w, points, lanes):  # type: ignore[no-untyped-def]
    """Set pressures y + i w (P,) to 1 with the first phases of "wgs"."""
    one = np.uint64(1)
    for p in range(points):
        phase = 2 * math.pi * (np.float64(p * (p + one) // np.uint64(2)) * GOLDEN % 1.0)
        for k in range(p * lanes, (p + one) * lanes):
            y[k], w[k] = math.cos(phase), math.sin(phase)


@njit(**INNER)
def _imposed(y, w, weight, r, s):  # type: ignore[no-untyped-def]
    """Set r + i s to the pressures y + i w with the sizes `weight`."""
    tiny = y.dtype.type(TINY)
    for k in range(np.uint64(len(y))):
        factor = weight[k] / max(math.sqrt(y[k] * y[k] + w[k] * w[k]), tiny)
        r[k] = y[k] * factor
        s[k] = w[k] * factor


@njit(**INNER)
def _add_pressures(a, b, x, z, y, w, first, points, lanes):  # type: ignore[no-untyped-def]
    """Add those of a group of drives x + i z, from `first` on, to pressures y + i w (P,)."""
    for p in range(points):
        at = _place(p, first, points) * lanes
        add_products(y, w, p * lanes, a, b, at, lanes, x, z, first * lanes, lanes, _GROUP)


@njit(**INNER)
def _turned(a, b, r, s, x, z, y, w, largest, points, transducers, lanes, free):  # type: ignore[no-untyped-def]
    """Set drives x + i z (M,) = (a + i b)^H (r + i s) and pressures y + i w (P,) = (a + i b) (x + i z).

    Drives have the amplitude 1, or are over their largest if `free`.
    """
    zero, tiny, step = np.uint64(0), x.dtype.type(TINY), _GROUP * lanes
    for array in (x, z, y, w):
        _fill(array, 0)
    _fill(largest, tiny)
    for first in range(zero, transducers, _GROUP):
        for m in range(first, first + _GROUP):
            at = _place(zero, m, points) * lanes
            add_conjugate_products(x, z, m * lanes, a, b, at, step, r, s, zero, lanes, points)
        for k in range(first * lanes, first * lanes + step):
            size = max(math.sqrt(x[k] * x[k] + z[k] * z[k]), tiny)
            if free:
                largest[k % lanes] = max(largest[k % lanes], size)
            else:
                x[k] /= size
                z[k] /= size
        _add_pressures(a, b, x, z, y, w, first, points, lanes)
    if free:
        for array in (x, z, y, w):
            for k in range(np.uint64(len(array))):
                array[k] /= largest[k % lanes]


@njit(**INNER)
def _turned_at_points(c, d, r, s, y, w, points, lanes):  # type: ignore[no-untyped-def]
    """Set pressures y + i w (P,) = (c + i d) (r + i s)."""
    _fill(y, 0)
    _fill(w, 0)
    for p in range(points):
        at = p * points * lanes
        add_products(y, w, p * lanes, c, d, at, lanes, r, s, np.uint64(0), lanes, points)


@njit(**INNER)
def _reweighted(y, w, t, change, weight, share, top, level, points, lanes):  # type: ignore[no-untyped-def]
    """Raise weights (P,) of low present over wanted pressure, and divide them by the largest.

    The `level` of each set is set to its lowest share.
    """
    one, tiny, least = y.dtype.type(1), y.dtype.type(TINY), y.dtype.type(UNREACHED)
    _fill(top, tiny)
    _fill(level, np.inf)
    for p in range(points):
        for lane in range(lanes):
            k = p * lanes + lane
            size = math.sqrt(y[k] * y[k] + w[k] * w[k])
            share[k] = size / t[k] if t[k] > 0 else 0
            top[lane] = max(top[lane], share[k])
    for p in range(points):
        for lane in range(lanes):
            k = p * lanes + lane
            reached = share[k] if share[k] > least * top[lane] else top[lane]
            level[lane] = min(level[lane], reached)
            weight[k] *= one + change * (top[lane] / reached - one)
    _fill(top, tiny)
    for p in range(points):
        for lane in range(lanes):
            top[lane] = max(top[lane], weight[p * lanes + lane])
    for p in range(points):
        for lane in range(lanes):
            weight[p * lanes + lane] /= top[lane]


@njit(**INNER)
def _store_best(r, s, level, highest, r_best, s_best, points, lanes):  # type: ignore[no-untyped-def]
    """Store the imposed pressures of the sets whose level is their highest so far."""
    for lane in range(lanes):
        if level[lane] > highest[lane]:
            highest[lane] = level[lane]
            for k in range(lane, points * lanes, lanes):
                r_best[k], s_best[k] = r[k], s[k]


@njit(**INNER)
def _products(a, b, c, d, points, transducers, lanes):  # type: ignore[no-untyped-def]
    """Set c + i d (P, P) to (a + i b) (a + i b)^H over its largest entry."""
    _fill(c, 0)
    _fill(d, 0)
    one = np.uint64(1)
    for first in range(np.uint64(0), transducers, _GROUP):
        for p in range(points):
            of = _place(p, first, points) * lanes
            for q in range(p + one):
                to, at = (p * points + q) * lanes, _place(q, first, points) * lanes
                add_conjugate_products(c, d, to, a, b, at, lanes, a, b, of, lanes, _GROUP)
    for lane in range(lanes):  # against overflow: the largest entry is on the diagonal
        largest = c.dtype.type(TINY)
        for p in range(points):
            largest = max(largest, c[p * (points + one) * lanes + lane])
        for p in range(points):
            for q in range(p + one):
                k, mirrored = (p * points + q) * lanes + lane, (q * points + p) * lanes + lane
                c[k] /= largest
                d[k] /= largest
                c[mirrored], d[mirrored] = c[k], d[k] if p == q else -d[k]


@entry(_INTRINSICS)
def _solve(matrix, wanted, first, last, algorithm, iterations, free, drive):  # type: ignore[no-untyped-def]
    """Write the drives (B, M, 2) of the blocks `first` to `last` of matrices (B, P, M, 2).

    The algorithm is a place in `_NAMES`.
    """
    points, count, kind = np.uint64(matrix.shape[1]), np.uint64(matrix.shape[2]), matrix.dtype
    lanes = np.uint64(VECTOR // matrix.itemsize)
    transducers = (count + _GROUP - np.uint64(1)) // _GROUP * _GROUP  # those added have no pressure
    weighted = algorithm in (_WGS, _WGS_DRIVES)
    at_points = algorithm == _GS_PAT or (algorithm == _WGS and points <= np.uint64(2) * count)
    entries, drives, places = points * transducers * lanes, transducers * lanes, points * lanes
    squares = points * places if at_points else np.uint64(1)
    a, b = np.zeros(entries, kind), np.zeros(entries, kind)
    c, d = np.empty(squares, kind), np.empty(squares, kind)
    x, z = np.empty(drives, kind), np.empty(drives, kind)
    y, w, r, s = (
        np.empty(places, kind),
        np.empty(places, kind),
        np.empty(places, kind),
        np.empty(places, kind),
    )
    t, weight, share = np.empty(places, kind), np.empty(places, kind), np.empty(places, kind)
    r_best, s_best = np.empty(places, kind), np.empty(places, kind)
    level, highest, top = np.empty(lanes, kind), np.empty(lanes, kind), np.empty(lanes, kind)
    flat, targets, begin = matrix.reshape(-1), wanted.reshape(-1), np.empty(lanes, np.uint64)
    for block in range(first, last):
        _pack(flat, targets, np.uint64(block) * lanes, points, count, lanes, a, b, t, begin)
        if algorithm == _GS:
            _fill(x, 1)
            _fill(z, 0)
            _fill(y, 0)
            _fill(w, 0)
            for m in range(np.uint64(0), transducers, _GROUP):
                _add_pressures(a, b, x, z, y, w, m, points, lanes)
        elif algorithm == _GS_PAT:
            _copy(t, y)
            _fill(w, 0)
        else:
            _begin(y, w, points, lanes)
        if at_points:
            _products(a, b, c, d, points, transducers, lanes)
        for with_drives in range(0 if at_points else 1, 1 if algorithm == _GS_PAT else 2):
            _copy(t, weight)
            _fill(highest, 0)
            _fill(r_best, np.nan)  # stays so where a matrix is not finite
            for number in range(iterations):
                _imposed(y, w, weight, r, s)
                if with_drives:
                    _turned(a, b, r, s, x, z, y, w, top, points, transducers, lanes, free)
                else:
                    _turned_at_points(c, d, r, s, y, w, points, lanes)
                if weighted:
                    change = kind.type(_weight_change(number, iterations))
                    _reweighted(y, w, t, change, weight, share, top, level, points, lanes)
                    _store_best(r, s, level, highest, r_best, s_best, points, lanes)
        if algorithm == _GS_PAT:
            for k in range(places):
                factor = t[k] * t[k] / max(y[k] * y[k] + w[k] * w[k], kind.type(TINY))
                r_best[k], s_best[k] = y[k] * factor, w[k] * factor
        if algorithm != _GS:
            _turned(a, b, r_best, s_best, x, z, y, w, top, points, transducers, lanes, free)
        for lane in range(lanes):
            place = np.uint64(block) * lanes + lane
            if place < np.uint64(len(matrix)):
                out = drive[place].reshape(-1)
                for m in range(count):
                    out[m + m] = x[m * lanes + lane]
                    out[m + m + np.uint64(1)] = z[m * lanes + lane]
