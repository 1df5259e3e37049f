"""Sums of spherical waves on one core: sum_s amplitude_s e^{i k r} / r for several fields.

Waves between one place and a block of others are vectorised. The others are the points or the sources,
whichever are more. Distances and whole turns of the phase are in double precision, the rest in the
precision of the amplitudes. The order of all sums is fixed.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from autdtorch.fdtd.kernels.compiled import INNER, entry

LANES = 64  # Places in a block; their waves stay in the first-level cache
_TERMS = 13  # Terms of the Taylor series; the next one is below 1e-16 for arguments up to pi / 2
_SHIFT = 1.5 * 2.0**52  # Constant that rounds to the nearest integer when added and subtracted
_BLOCK, _X, _Y, _Z = np.uint64(LANES), np.uint64(0), np.uint64(1), np.uint64(2)  # unsigned, see cpu_sweep.py


def wave_of(wavenumber: complex, nearest: float) -> tuple[float, float, float]:
    """Return turns and halvings of a wave per metre, and the lower limit of the distance [m]."""
    return wavenumber.real / (2 * math.pi), wavenumber.imag / math.log(2), nearest


def room_for(dtype: type) -> tuple[NDArray[np.generic], ...]:
    """Return Taylor coefficients and workspace for `_waves`.

    The series are those of sin(2 pi u) / u and cos(2 pi u) in u^2, and of 2^-u in u.
    """
    turn, log = 2 * math.pi, math.log(2)
    sine = [(-1) ** n * turn ** (2 * n + 1) / math.factorial(2 * n + 1) for n in range(_TERMS)]
    cosine = [(-1) ** n * turn ** (2 * n) / math.factorial(2 * n) for n in range(_TERMS)]
    power = [(-log) ** n / math.factorial(n) for n in range(_TERMS)]
    bits = np.zeros(LANES, np.int32 if dtype is np.float32 else np.int64)
    return *np.array((sine, cosine, power), dtype), *np.zeros((5, LANES), dtype), bits, bits.view(dtype)


@njit(**INNER)
def _series(c, y):  # type: ignore[no-untyped-def]
    high = ((((c[12] * y + c[11]) * y + c[10]) * y + c[9]) * y + c[8]) * y + c[7]
    return ((((((high * y + c[6]) * y + c[5]) * y + c[4]) * y + c[3]) * y + c[2]) * y + c[1]) * y + c[0]


@njit(**INNER)
def _waves(place, others, block, wave, room):  # type: ignore[no-untyped-def]
    """Return the parts of e^{i k r} / r, from a place to those of a block of `others` (3, N)."""
    sine, cosine, power, real, imaginary, side, quarter, distance, bits, halves = room
    turns_per_metre, halvings_per_metre, nearest = wave
    x, y, z = place
    first = np.uint64(block) * _BLOCK
    for k in range(_BLOCK):
        dx, dy, dz = others[_X, first + k] - x, others[_Y, first + k] - y, others[_Z, first + k] - z
        r = math.sqrt(max(dx * dx + dy * dy + dz * dz, nearest * nearest))
        turns = r * turns_per_metre
        turns -= (turns + _SHIFT) - _SHIFT
        distance[k], side[k], quarter[k] = r, turns, abs(turns) - 0.25
    # with u = |t| - 1/4 of t turns: cos(2 pi t) = -sin(2 pi u) and |sin(2 pi t)| = cos(2 pi u)
    for k in range(_BLOCK):
        square = quarter[k] * quarter[k]
        real[k] = -quarter[k] * _series(sine, square) / distance[k]
        imaginary[k] = np.copysign(_series(cosine, square), side[k]) / distance[k]
    if halvings_per_metre == 0:
        return real, imaginary
    digits, lowest = (23, 126) if real.itemsize == 4 else (52, 1022)
    for k in range(_BLOCK):
        halvings = min(distance[k] * halvings_per_metre, float(lowest))
        whole = (halvings + _SHIFT) - _SHIFT
        bits[k] = (lowest + 1 - int(whole)) << digits  # 2^-whole, read as a float
        quarter[k] = halvings - whole
    for k in range(_BLOCK):
        size = halves[k] * _series(power, quarter[k])
        real[k] *= size
        imaginary[k] *= size
    return real, imaginary


@njit(**INNER)
def _add_waves(total, r, a, b, real, imaginary):  # type: ignore[no-untyped-def]
    for k in range(_BLOCK):
        total[0, r, k] += a * real[k] - b * imaginary[k]
        total[1, r, k] += a * imaginary[k] + b * real[k]


@entry()
def sum_at_points(points, first, last, sources, amplitude, wave, room, fields):  # type: ignore[no-untyped-def]
    """Write the parts of fields (2, R, P / LANES, LANES) at the blocks `first` to `last` of points.

    The points are (3, P), the sources (3, N), the parts of their amplitudes (2, R, N).
    """
    runs, count = amplitude.shape[1:]
    total = np.zeros((2, runs, LANES), amplitude.dtype)
    for block in range(first, last):
        for s in range(count):
            real, imaginary = _waves((sources[0, s], sources[1, s], sources[2, s]), points, block, wave, room)
            for r in range(runs):
                _add_waves(total, r, amplitude[0, r, s], amplitude[1, r, s], real, imaginary)
            if (s + 1) % LANES == 0 or s + 1 == count:  # limits rounding
                fields[:, :, block] += total
                total[:] = 0


@njit(**INNER)
def _add_products(total, amplitude, r, waves):  # type: ignore[no-untyped-def]
    for block in range(waves.shape[0]):
        for k in range(_BLOCK):
            total[k] += amplitude[r, block, k] * waves[block, k]


@entry()
def sum_over_sources(points, first, last, sources, amplitude, wave, room, fields):  # type: ignore[no-untyped-def]
    """Write the parts of fields (2, R, P) at the points `first` to `last`.

    The points are (3, P), the sources (3, N), the parts of their amplitudes (2, R, N / LANES, LANES).
    """
    runs, blocks = amplitude.shape[1:3]
    # separate arrays, which the compiler knows not to overlap and can vectorise
    real, imaginary = np.empty((blocks, LANES), amplitude.dtype), np.empty((blocks, LANES), amplitude.dtype)
    total, less = np.empty(LANES, amplitude.dtype), np.empty(LANES, amplitude.dtype)
    for p in range(first, last):
        for block in range(blocks):
            place = points[0, p], points[1, p], points[2, p]
            real[block], imaginary[block] = _waves(place, sources, block, wave, room)
        for r in range(runs):
            total[:], less[:] = 0, 0
            _add_products(total, amplitude[0], r, real)
            _add_products(less, amplitude[1], r, imaginary)
            for k in range(_BLOCK):
                fields[0, r, p] += total[k] - less[k]
            total[:] = 0
            _add_products(total, amplitude[0], r, imaginary)
            _add_products(total, amplitude[1], r, real)
            for k in range(_BLOCK):
                fields[1, r, p] += total[k]
