"""The fields of many sources in free space: sum_s amplitude_s e^{i k r} / r for several fields.

Waves between one place and a block of others are vectorised. The others are the points or the sources,
whichever are more. Discs are always the places. Their waves are waves of points times a sum of even waves;
next to a disc an integral along its rim is computed for each of the others. Distances and whole turns of the
phase are in double precision, the rest in the precision of the amplitudes. The order of all sums is fixed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import numpy as np
import torch
from numba import njit
from torch import Tensor

from autdtorch.fdtd.kernels.cpu_disc_waves import (
    ALSO,
    APART,
    BLOCK,
    LANES,
    NEAR,
    NUMBERS,
    SIDE,
    WAVE,
    WORK,
    X,
    Y,
    Z,
    disc_numbers,
    turn_into_disc,
)
from autdtorch.utils.apertures import Discs
from autdtorch.utils.array_types import AnyArray
from autdtorch.utils.compiled import INNER, entry
from autdtorch.utils.process import even_parts, spread
from autdtorch.utils.validation import LENGTH_TOLERANCE

_PAIRS = 400_000  # Pairs of a point and a source in a task: 3 ms; tasks of 1 ms spend a seventh on threads
_TERMS = 13  # Terms of the Taylor series; the next one is below 1e-16 for arguments up to pi / 2
_SHIFT = 1.5 * 2.0**52  # Constant that rounds to the nearest integer when added and subtracted


_SERIES = np.array(
    [
        [(-1) ** n * (2 * math.pi) ** (2 * n + 1) / math.factorial(2 * n + 1) for n in range(_TERMS)],
        [(-1) ** n * (2 * math.pi) ** (2 * n) / math.factorial(2 * n) for n in range(_TERMS)],
        [(-math.log(2)) ** n / math.factorial(n) for n in range(_TERMS)],
    ]
)  # Taylor coefficients of sin(2 pi u) / u and cos(2 pi u) in u^2, and of 2^-u in u


def _room(dtype: type) -> tuple[AnyArray, ...]:
    """Return Taylor coefficients and workspace for `_set_waves`."""
    lanes: AnyArray = np.zeros(NUMBERS * LANES, dtype)
    bits = lanes.view(np.int32 if dtype is np.float32 else np.int64)
    return _SERIES.astype(dtype), lanes, bits


@njit(**INNER)
def _terms(series, which):  # type: ignore[no-untyped-def]
    """Return coefficients as values, which the compiler knows to be constant in a loop."""
    c = series[which]
    return c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8], c[9], c[10], c[11], c[12]


@njit(**INNER)
def _series(c, y):  # type: ignore[no-untyped-def]
    high = ((((c[12] * y + c[11]) * y + c[10]) * y + c[9]) * y + c[8]) * y + c[7]
    return ((((((high * y + c[6]) * y + c[5]) * y + c[4]) * y + c[3]) * y + c[2]) * y + c[1]) * y + c[0]


@njit(**INNER)
def _set_waves(place, number, others, block, wave, disc, room):  # type: ignore[no-untyped-def]
    """Set the parts of the waves from a place, a row of a number, to those of a block of `others` (3, N)."""
    series, lanes, bits = room
    turns_per_metre, halvings_per_metre, nearest = wave
    x, y, z = place[0], place[1], place[2]
    first = np.uint64(block) * BLOCK
    for k in range(BLOCK):
        dx, dy, dz = others[X, first + k] - x, others[Y, first + k] - y, others[Z, first + k] - z
        r = math.sqrt(max(dx * dx + dy * dy + dz * dz, nearest * nearest))
        turns = r * turns_per_metre
        turns -= (turns + _SHIFT) - _SHIFT
        lanes[APART + k], lanes[NEAR + k] = r, 1 / r
        lanes[SIDE + k], lanes[WORK + k] = turns, abs(turns) - 0.25
    # with u = |t| - 1/4 of t turns: cos(2 pi t) = -sin(2 pi u) and |sin(2 pi t)| = cos(2 pi u)
    terms = _terms(series, 0)
    for k in range(BLOCK):
        u = lanes[WORK + k]
        lanes[WAVE + k] = -u * _series(terms, u * u) * lanes[NEAR + k]
    terms = _terms(series, 1)
    for k in range(BLOCK):
        size = _series(terms, lanes[WORK + k] * lanes[WORK + k])
        lanes[ALSO + k] = np.copysign(size, lanes[SIDE + k]) * lanes[NEAR + k]
    if halvings_per_metre > 0:
        digits, lowest = (23, 126) if lanes.itemsize == 4 else (52, 1022)
        terms = _terms(series, 2)
        for k in range(BLOCK):
            halvings = min(lanes[APART + k] * halvings_per_metre, float(lowest))
            whole = (halvings + _SHIFT) - _SHIFT
            bits[SIDE + k] = (lowest + 1 - int(whole)) << digits  # 2^-whole, read as a float
            lanes[WORK + k] = halvings - whole
        for k in range(BLOCK):
            size = lanes[SIDE + k] * _series(terms, lanes[WORK + k])
            lanes[WAVE + k] *= size
            lanes[ALSO + k] *= size
    table, ends, kinds = disc
    if len(table):
        turn_into_disc(place, others, first, table, ends, kinds[number], lanes)


@njit(**INNER)
def _add_waves(total, r, a, b, lanes):  # type: ignore[no-untyped-def]
    for k in range(BLOCK):
        real, imaginary = lanes[WAVE + k], lanes[ALSO + k]
        total[0, r, k] += a * real - b * imaginary
        total[1, r, k] += a * imaginary + b * real


@njit(**INNER)
def _move(total, fields, block):  # type: ignore[no-untyped-def]
    """Add the total to fields, and set it to zero; for slices numba would compile messages of shapes."""
    for part in range(2):
        for r in range(total.shape[1]):
            for k in range(BLOCK):
                fields[part, r, block, k] += total[part, r, k]
                total[part, r, k] = 0


@entry()
def _sum_at_points(points, first, last, sources, amplitude, wave, disc, room, fields):  # type: ignore[no-untyped-def]
    """Write the parts of fields (2, R, P / LANES, LANES) at the blocks `first` to `last` of points.

    The points are (3, P), the sources `_rows`, and the parts of their amplitudes (2, R, N).
    """
    runs, count = amplitude.shape[1:]
    total = np.zeros((2, runs, LANES), amplitude.dtype)
    for block in range(first, last):
        for s in range(count):
            _set_waves(sources[s], s, points, block, wave, disc, room)
            for r in range(runs):
                _add_waves(total, r, amplitude[0, r, s], amplitude[1, r, s], room[1])
            if (s + 1) % LANES == 0 or s + 1 == count:  # limits rounding
                _move(total, fields, block)


@njit(**INNER)
def _add_products(total, amplitude, r, waves):  # type: ignore[no-untyped-def]
    for block in range(waves.shape[0]):
        for k in range(BLOCK):
            total[k] += amplitude[r, block, k] * waves[block, k]


@entry()
def _sum_over_sources(points, first, last, sources, amplitude, wave, disc, room, fields):  # type: ignore[no-untyped-def]
    """Write the parts of fields (2, R, P) at the points `first` to `last`.

    The points are `_rows`, the sources (3, N), the parts of their amplitudes
    (2, R, N / LANES, LANES).
    """
    runs, blocks = amplitude.shape[1:3]
    # separate arrays, which the compiler knows not to overlap and can vectorise
    real, imaginary = np.empty((blocks, LANES), amplitude.dtype), np.empty((blocks, LANES), amplitude.dtype)
    total, less = np.empty(LANES, amplitude.dtype), np.empty(LANES, amplitude.dtype)
    for p in range(first, last):
        for block in range(blocks):
            _set_waves(points[p], p, sources, block, wave, disc, room)
            for k in range(BLOCK):
                real[block, k], imaginary[block, k] = room[1][WAVE + k], room[1][ALSO + k]
        for r in range(runs):
            total[:], less[:] = 0, 0
            _add_products(total, amplitude[0], r, real)
            _add_products(less, amplitude[1], r, imaginary)
            for k in range(BLOCK):
                fields[0, r, p] += total[k] - less[k]
            total[:] = 0
            _add_products(total, amplitude[0], r, imaginary)
            _add_products(total, amplitude[1], r, real)
            for k in range(BLOCK):
                fields[1, r, p] += total[k]


@entry()
def _write_matrix(points, first, last, sources, columns, amplitude, wave, disc, room, matrix):  # type: ignore[no-untyped-def]
    """Add the waves of sources (`_rows`) to their columns (N,) of a matrix (M, P / LANES, LANES)."""
    for block in range(first, last):
        for s in range(len(sources)):
            _set_waves(sources[s], s, points, block, wave, disc, room)
            row, lanes, a, b = matrix[columns[s], block], room[1], amplitude[s].real, amplitude[s].imag
            for k in range(BLOCK):
                real, imaginary = lanes[WAVE + k], lanes[ALSO + k]
                row[k] += complex(a * real - b * imaginary, a * imaginary + b * real)


def superposition(
    points: Tensor | Discs,
    sources: Tensor | Discs,
    amplitude: Tensor,
    wavenumber: complex,
    dtype: torch.dtype = torch.float64,
) -> Tensor:
    """Return R fields (P, R) complex128 [Pa] of N sources: sums of amplitude e^{i k r} / r.

    Amplitudes are complex (N, R) [Pa m], and `wavenumber` is k + i alpha [rad/m]. Either points or sources
    may be discs: the mean pressure over a disc, or the field of one. float32 takes half the time at an error
    of 3e-7 per wave. Threads do not change the result.
    """
    number = np.float32 if dtype == torch.float32 else np.float64
    wave = _wave(wavenumber)
    parts = (amplitude.real, amplitude.imag)
    strength = np.stack([np.ascontiguousarray(part.numpy().astype(number).T) for part in parts])
    discs = isinstance(points, Discs), isinstance(sources, Discs)
    assert not all(discs)
    disc = disc_numbers(points if discs[0] else sources, wavenumber, number)
    places, origins = _rows(points), _rows(sources)
    runs, count = strength.shape[1], len(places)
    if discs[1] or (count >= len(origins) and not discs[0]):
        columns, add = _filled(places[:, :3].T, "edge"), _sum_at_points
        fields = np.zeros((2, runs, columns.shape[1] // LANES, LANES))
        both = columns, origins
    else:
        columns, add = _filled(origins[:, :3].T, "edge"), _sum_over_sources
        fields = np.zeros((2, runs, count))
        strength = _filled(strength, "constant").reshape(2, runs, -1, LANES)
        both = places, columns
    _spread(
        lambda ends: add(both[0], *ends, both[1], strength, wave, disc, _room(number), fields),
        fields.shape[2],
        count * len(origins),
    )
    real, imaginary = fields.reshape(2, runs, -1)[:, :, :count]
    return torch.from_numpy((real + 1j * imaginary).T)


def wave_matrix(
    points: Tensor, sources: Tensor | Discs, amplitude: Tensor, columns: int, wavenumber: complex
) -> Tensor:
    """Return waves (P, columns) complex128 [Pa] at points (P, 3) [m] of N sources, amplitudes (N,) [Pa m].

    Source s adds to column s modulo `columns`; see `superposition`.
    """
    blocks = _filled(points.numpy().T, "edge")
    matrix = np.zeros((columns, blocks.shape[1] // LANES, LANES), np.complex128)
    column = np.arange(len(amplitude)) % columns
    rows, strength = _rows(sources), amplitude.numpy()
    wave, disc = _wave(wavenumber), disc_numbers(sources, wavenumber, np.float64)
    _spread(
        lambda ends: _write_matrix(
            blocks, *ends, rows, column, strength, wave, disc, _room(np.float64), matrix
        ),
        matrix.shape[1],
        len(points) * len(rows),
    )
    return torch.from_numpy(matrix).flatten(1)[:, : len(points)].mT


def _spread(function: Callable[[tuple[int, int]], None], units: int, pairs: int) -> None:
    spread(function, even_parts(units, max(1, min(units, 1 + pairs // _PAIRS))))


def _wave(wavenumber: complex) -> tuple[float, float, float]:
    """Return turns and halvings of a wave per metre, and the lower limit of the distance [m]."""
    wavenumber = complex(wavenumber)
    return wavenumber.real / (2 * math.pi), wavenumber.imag / math.log(2), LENGTH_TOLERANCE


def _rows(places: Tensor | Discs) -> AnyArray:
    """Return positions (N, 3) of points, or positions and normals (N, 6) of discs."""
    if isinstance(places, Discs):
        return torch.cat((places.centers, places.normals), dim=1).numpy()
    return np.ascontiguousarray(places.numpy())  # numba compiles again for another order


def _filled(rows: AnyArray, mode: Literal["edge", "constant"]) -> AnyArray:
    """Return rows (..., N) in whole blocks, filled up by the last entry of each or by zeros."""
    count = rows.shape[-1]
    # `np.pad` takes as long as 2000 waves; numba compiles again for another order
    filled = np.empty((*rows.shape[:-1], count + -count % LANES), rows.dtype)
    filled[..., :count] = rows
    filled[..., count:] = rows[..., -1:] if mode == "edge" else 0
    return filled
