"""The fields of many sources in free space: sum_s amplitude_s e^{i k r} / r for several fields.

Waves between one place and a block of others are vectorised. The others are the points or the sources,
whichever are more. Discs are always the places, and their waves have a factor. Distances and whole turns
of the phase are in double precision, the rest in the precision of the amplitudes. The order of all sums is
fixed.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import torch
from numba import njit
from torch import Tensor

from autdtorch.fdtd.kernels.compiled import INNER, entry
from autdtorch.utils.apertures import PATTERN_TERMS, Discs
from autdtorch.utils.array_types import COMPLEX, AnyArray
from autdtorch.utils.process import even_parts, spread
from autdtorch.utils.validation import LENGTH_TOLERANCE

_PAIRS = 100_000  # Pairs of a point and a source in a task: less than a millisecond
_LANES = 64  # Places in a block; their waves stay in the first-level cache
_TERMS = PATTERN_TERMS  # Terms of the Taylor series; the next one is below 1e-16 for arguments up to pi / 2
_SHIFT = 1.5 * 2.0**52  # Constant that rounds to the nearest integer when added and subtracted
_BLOCK, _X, _Y, _Z = np.uint64(_LANES), np.uint64(0), np.uint64(1), np.uint64(2)  # unsigned, see cpu_sweep.py


def _room(dtype: type) -> tuple[AnyArray, ...]:
    """Return Taylor coefficients and workspace for `_waves`.

    The series are those of sin(2 pi u) / u and cos(2 pi u) in u^2, and of 2^-u in u.
    """
    turn, log = 2 * math.pi, math.log(2)
    sine = [(-1) ** n * turn ** (2 * n + 1) / math.factorial(2 * n + 1) for n in range(_TERMS)]
    cosine = [(-1) ** n * turn ** (2 * n) / math.factorial(2 * n) for n in range(_TERMS)]
    power = [(-log) ** n / math.factorial(n) for n in range(_TERMS)]
    bits = np.zeros(_LANES, np.int32 if dtype is np.float32 else np.int64)
    return *np.array((sine, cosine, power), dtype), *np.zeros((9, _LANES), dtype), bits, bits.view(dtype)


@njit(**INNER)
def _terms(c):  # type: ignore[no-untyped-def]
    """Return coefficients as values, which the compiler knows to be constant in a loop."""
    return c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8], c[9], c[10], c[11], c[12]


@njit(**INNER)
def _series(c, y):  # type: ignore[no-untyped-def]
    high = ((((c[12] * y + c[11]) * y + c[10]) * y + c[9]) * y + c[8]) * y + c[7]
    return ((((((high * y + c[6]) * y + c[5]) * y + c[4]) * y + c[3]) * y + c[2]) * y + c[1]) * y + c[0]


@njit(**INNER)
def _directed(place, others, first, pattern, real, imaginary, distance, room):  # type: ignore[no-untyped-def]
    """Multiply waves by the pattern (orders, 2, terms) of a disc at a place with a normal (6,)."""
    a, b, nearness, sine_squared = room
    x, y, z = place[0], place[1], place[2]
    along_x, along_y, along_z = place[3], place[4], place[5]
    for k in range(_BLOCK):
        dx, dy, dz = others[_X, first + k] - x, others[_Y, first + k] - y, others[_Z, first + k] - z
        near = 1 / distance[k]
        cosine = (dx * along_x + dy * along_y + dz * along_z) * near
        a[k], b[k], nearness[k], sine_squared[k] = 0, 0, near, 1 - cosine * cosine
    for order in range(pattern.shape[0] - 1, -1, -1):  # outside: inner loops alone are vectorised
        real_terms, imaginary_terms = _terms(pattern[order, 0]), _terms(pattern[order, 1])
        for k in range(_BLOCK):
            a[k] = a[k] * nearness[k] + _series(real_terms, sine_squared[k])
        for k in range(_BLOCK):
            b[k] = b[k] * nearness[k] + _series(imaginary_terms, sine_squared[k])
    for k in range(_BLOCK):
        re, im = real[k], imaginary[k]
        real[k], imaginary[k] = a[k] * re - b[k] * im, a[k] * im + b[k] * re


@njit(**INNER)
def _waves(place, others, block, wave, pattern, room):  # type: ignore[no-untyped-def]
    """Return the parts of e^{i k r} / r, from a place (6,) to those of a block of `others` (3, N)."""
    sine, cosine, power, real, imaginary, side, quarter, distance, a, b, near, slope, bits, halves = room
    turns_per_metre, halvings_per_metre, nearest = wave
    x, y, z = place[0], place[1], place[2]
    first = np.uint64(block) * _BLOCK
    for k in range(_BLOCK):
        dx, dy, dz = others[_X, first + k] - x, others[_Y, first + k] - y, others[_Z, first + k] - z
        r = math.sqrt(max(dx * dx + dy * dy + dz * dz, nearest * nearest))
        turns = r * turns_per_metre
        turns -= (turns + _SHIFT) - _SHIFT
        distance[k], side[k], quarter[k] = r, turns, abs(turns) - 0.25
    # with u = |t| - 1/4 of t turns: cos(2 pi t) = -sin(2 pi u) and |sin(2 pi t)| = cos(2 pi u)
    sine_terms, cosine_terms, power_terms = _terms(sine), _terms(cosine), _terms(power)
    for k in range(_BLOCK):
        real[k] = -quarter[k] * _series(sine_terms, quarter[k] * quarter[k]) / distance[k]
    for k in range(_BLOCK):
        size = _series(cosine_terms, quarter[k] * quarter[k])
        imaginary[k] = np.copysign(size, side[k]) / distance[k]
    if halvings_per_metre > 0:
        digits, lowest = (23, 126) if real.itemsize == 4 else (52, 1022)
        for k in range(_BLOCK):
            halvings = min(distance[k] * halvings_per_metre, float(lowest))
            whole = (halvings + _SHIFT) - _SHIFT
            bits[k] = (lowest + 1 - int(whole)) << digits  # 2^-whole, read as a float
            quarter[k] = halvings - whole
        for k in range(_BLOCK):
            size = halves[k] * _series(power_terms, quarter[k])
            real[k] *= size
            imaginary[k] *= size
    if len(pattern):
        _directed(place, others, first, pattern, real, imaginary, distance, (a, b, near, slope))
    return real, imaginary


@njit(**INNER)
def _add_waves(total, r, a, b, real, imaginary):  # type: ignore[no-untyped-def]
    for k in range(_BLOCK):
        total[0, r, k] += a * real[k] - b * imaginary[k]
        total[1, r, k] += a * imaginary[k] + b * real[k]


@entry()
def _sum_at_points(points, first, last, sources, amplitude, wave, pattern, room, fields):  # type: ignore[no-untyped-def]
    """Write the parts of fields (2, R, P / _LANES, _LANES) at the blocks `first` to `last` of points.

    The points are (3, P), the sources with normals (N, 6), the parts of their amplitudes (2, R, N).
    """
    runs, count = amplitude.shape[1:]
    total = np.zeros((2, runs, _LANES), amplitude.dtype)
    for block in range(first, last):
        for s in range(count):
            real, imaginary = _waves(sources[s], points, block, wave, pattern, room)
            for r in range(runs):
                _add_waves(total, r, amplitude[0, r, s], amplitude[1, r, s], real, imaginary)
            if (s + 1) % _LANES == 0 or s + 1 == count:  # limits rounding
                fields[:, :, block] += total
                total[:] = 0


@njit(**INNER)
def _add_products(total, amplitude, r, waves):  # type: ignore[no-untyped-def]
    for block in range(waves.shape[0]):
        for k in range(_BLOCK):
            total[k] += amplitude[r, block, k] * waves[block, k]


@entry()
def _sum_over_sources(points, first, last, sources, amplitude, wave, pattern, room, fields):  # type: ignore[no-untyped-def]
    """Write the parts of fields (2, R, P) at the points `first` to `last`.

    The points with normals are (P, 6), the sources (3, N), the parts of their amplitudes
    (2, R, N / _LANES, _LANES).
    """
    runs, blocks = amplitude.shape[1:3]
    # separate arrays, which the compiler knows not to overlap and can vectorise
    real, imaginary = np.empty((blocks, _LANES), amplitude.dtype), np.empty((blocks, _LANES), amplitude.dtype)
    total, less = np.empty(_LANES, amplitude.dtype), np.empty(_LANES, amplitude.dtype)
    for p in range(first, last):
        for block in range(blocks):
            real[block], imaginary[block] = _waves(points[p], sources, block, wave, pattern, room)
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


def superposition(
    points: Tensor | Discs,
    sources: Tensor | Discs,
    amplitude: Tensor,
    wavenumber: complex,
    nearest: float = 0.0,
    dtype: torch.dtype = torch.float64,
) -> Tensor:
    """Return R fields (P, R) complex128 [Pa] of N sources: sums of amplitude e^{i k r} / r.

    Amplitudes are complex (N, R) [Pa m], `wavenumber` is k + i alpha [rad/m] and `nearest` the lower limit of
    the distance [m]. Either points or sources may be discs, far from the others: the mean pressure over a
    disc, or the field of one. float32 takes half the time at an error of 3e-7 per wave. Threads do not change
    the result.
    """
    if isinstance(points, Discs):
        fields = torch.zeros((len(points.radii), amplitude.shape[1]), **COMPLEX)
        for index, some in points.of_equal_radius():
            fields[index] = _superposed(some, sources, amplitude, wavenumber, nearest, dtype)
        return fields
    if isinstance(sources, Discs):
        groups = sources.of_equal_radius()
        parts = [
            _superposed(points, some, amplitude[index], wavenumber, nearest, dtype) for index, some in groups
        ]
        return torch.stack(parts).sum(dim=0)
    return _superposed(points, sources, amplitude, wavenumber, nearest, dtype)


def _superposed(
    points: Tensor | Discs,
    sources: Tensor | Discs,
    amplitude: Tensor,
    wavenumber: complex,
    nearest: float,
    dtype: torch.dtype,
) -> Tensor:
    """Return the sum of `superposition` for discs of equal radius."""
    number = np.float32 if dtype == torch.float32 else np.float64
    wavenumber = complex(wavenumber)
    # turns and halvings of a wave per metre
    wave = wavenumber.real / (2 * math.pi), wavenumber.imag / math.log(2), max(nearest, LENGTH_TOLERANCE)
    parts = (amplitude.real, amplitude.imag)
    strength = np.stack([np.ascontiguousarray(part.numpy().astype(number).T) for part in parts])
    (places, receiving), (origins, radiating) = (_rows(each, wavenumber) for each in (points, sources))
    pattern = np.concatenate((receiving, radiating)).astype(number)
    runs, count = strength.shape[1], len(places)
    if len(radiating) or (count >= len(origins) and not len(receiving)):
        columns, add = _filled(places[:, :3].T, "edge"), _sum_at_points
        fields = np.zeros((2, runs, columns.shape[1] // _LANES, _LANES))
        both = columns, origins
    else:
        columns, add = _filled(origins[:, :3].T, "edge"), _sum_over_sources
        fields = np.zeros((2, runs, count))
        strength = _filled(strength, "constant").reshape(2, runs, -1, _LANES)
        both = places, columns
    units = fields.shape[2]
    pieces = max(1, min(units, 1 + count * len(origins) // _PAIRS))
    spread(
        lambda ends: add(both[0], *ends, both[1], strength, wave, pattern, _room(number), fields),
        even_parts(units, pieces),
    )
    real, imaginary = fields.reshape(2, runs, -1)[:, :, :count]
    return torch.from_numpy((real + 1j * imaginary).T)


def _rows(places: Tensor | Discs, wavenumber: complex) -> tuple[AnyArray, AnyArray]:
    """Return positions and normals (N, 6), and the pattern of discs; points have none."""
    if isinstance(places, Discs):
        return torch.cat((places.centers, places.normals), dim=1).numpy(), places.pattern(wavenumber)
    return np.pad(places.numpy(), ((0, 0), (0, 3))), np.zeros((0, 2, PATTERN_TERMS))


def _filled(rows: AnyArray, mode: Literal["edge", "constant"]) -> AnyArray:
    """Pad rows (..., N) to whole blocks by their last entry or by zeros."""
    return np.pad(rows, (*((0, 0),) * (rows.ndim - 1), (0, -rows.shape[-1] % _LANES)), mode)
