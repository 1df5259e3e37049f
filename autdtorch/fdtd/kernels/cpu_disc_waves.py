"""The waves of a disc at a block of places, from those of a point; see `utils.apertures.EvenWaves`."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from torch import Tensor

from autdtorch.utils.apertures import (
    RIM_DIGITS,
    RIM_LEAST,
    RIM_STRIP,
    RIM_TURNS,
    TOGETHER,
    Discs,
    even_waves,
)
from autdtorch.utils.array_types import AnyArray
from autdtorch.utils.compiled import INNER

LANES = 64
"""Places in a block; their waves stay in the first-level cache."""

# unsigned, see cpu_sweep.py
BLOCK, X, Y, Z = np.uint64(LANES), np.uint64(0), np.uint64(1), np.uint64(2)

NUMBERS = 16
"""Numbers of each place, in one array whose parts the compiler knows not to overlap."""

WAVE, ALSO, APART, NEAR, SIDE, WORK = np.arange(6, dtype=np.uint64) * BLOCK
"""Places of the first of them: the parts of the wave, its distance and the inverse, two for work."""

# 1 / r^2 and the squared cosine, Legendre polynomials and the parts of waves of two degrees, their sum
_SQUARE, _COSINE, _OLD, _NEW, _RE_OLD = np.arange(6, 11, dtype=np.uint64) * BLOCK
_RE_NEW, _IM_OLD, _IM_NEW, _RE, _IM = np.arange(11, NUMBERS, dtype=np.uint64) * BLOCK

_SMALL = 1e-5  # Phase up to which a difference of two waves is two terms of its series


def disc_numbers(places: Tensor | Discs, wavenumber: complex, number: type) -> tuple[AnyArray, ...]:
    """Return the waves of discs and the number (N,) of each disc's for `turn_into_disc`; points have none."""
    if not isinstance(places, Discs) or not len(places.centers):
        return np.zeros((0, 0, 9), number), np.zeros((0, 0, 2), number), np.zeros(0, np.int64)
    radii, kind = places.kinds()
    k = complex(wavenumber)
    first, steps, reaches, counts = even_waves(k, radii)
    with np.errstate(divide="ignore"):
        nearness = 1 / reaches
    inverse, head = 1 / k, np.zeros((len(radii), 1, 9))
    numbers = first.real, first.imag, inverse.real, inverse.imag, nearness[:, 0], radii, k.real, k.imag
    head[:, 0, :8] = np.stack(np.broadcast_arrays(*numbers), axis=1)
    table = np.concatenate((head, steps), axis=1)
    return table.astype(number), np.stack((nearness, counts), axis=2).astype(number), kind


@njit(**INNER)
def _row(table, kind, n):  # type: ignore[no-untyped-def]
    c = table[kind, n]
    return c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8]


@njit(**INNER)
def _next_wave(c, square, cosine, old, new, re_old, re_new, im_old, im_new, re, im):  # type: ignore[no-untyped-def]
    """Return the next polynomial and wave, and the sums with their product; see `EvenWaves`."""
    legendre = (c[4] * cosine - c[5]) * new - c[6] * old
    a, b = c[0] * square - c[2], c[1] * square
    re_wave, im_wave = a * re_new - b * im_new - c[3] * re_old, a * im_new + b * re_new - c[3] * im_old
    x, y = legendre * re_wave, legendre * im_wave
    return legendre, re_wave, im_wave, re + (c[7] * x - c[8] * y), im + (c[7] * y + c[8] * x)


@njit(**INNER)
def _add_degrees(table, kind, n, lanes):  # type: ignore[no-untyped-def]
    """Add the terms of three degrees, all of whose numbers stay in registers."""
    first, second, third = _row(table, kind, n), _row(table, kind, n + 1), _row(table, kind, n + 2)
    for k in range(BLOCK):
        square, cosine, re, im = lanes[_SQUARE + k], lanes[_COSINE + k], lanes[_RE + k], lanes[_IM + k]
        p, q = lanes[_OLD + k], lanes[_NEW + k]
        a, b, x, y = lanes[_RE_OLD + k], lanes[_RE_NEW + k], lanes[_IM_OLD + k], lanes[_IM_NEW + k]
        p, a, x, re, im = _next_wave(first, square, cosine, p, q, a, b, x, y, re, im)
        q, b, y, re, im = _next_wave(second, square, cosine, q, p, b, a, y, x, re, im)
        p, a, x, re, im = _next_wave(third, square, cosine, p, q, a, b, x, y, re, im)
        lanes[_OLD + k], lanes[_NEW + k], lanes[_RE + k], lanes[_IM + k] = q, p, re, im
        lanes[_RE_OLD + k], lanes[_RE_NEW + k], lanes[_IM_OLD + k], lanes[_IM_NEW + k] = b, a, y, x


@njit(**INNER)
def turn_into_disc(place, others, first, table, ends, kind, lanes):  # type: ignore[no-untyped-def]
    """Turn the waves of a point into those of a disc at a place with a normal (6,)."""
    start, also, re_inverse, im_inverse, least, radius, re_k, im_k, _ = _row(table, kind, 0)
    x, y, z = place[0], place[1], place[2]
    along_x, along_y, along_z = place[3], place[4], place[5]
    for k in range(BLOCK):
        dx, dy, dz = others[X, first + k] - x, others[Y, first + k] - y, others[Z, first + k] - z
        cosine = (dx * along_x + dy * along_y + dz * along_z) * lanes[NEAR + k]
        lanes[_COSINE + k] = cosine * cosine
    for k in range(BLOCK):
        near = min(lanes[NEAR + k], least)
        lanes[_SQUARE + k] = near * near
        lanes[_OLD + k], lanes[_NEW + k], lanes[_RE_NEW + k], lanes[_IM_NEW + k] = 0, 1, 1, 0
        lanes[_RE_OLD + k], lanes[_IM_OLD + k] = im_inverse * near - 1, -re_inverse * near
        lanes[_RE + k], lanes[_IM + k] = start, also
    most = lanes[NEAR]
    for k in range(BLOCK):
        most = max(most, lanes[NEAR + k])
    number = 0
    while number + 1 < ends.shape[1] and most <= ends[kind, number + 1, 0]:
        number += 1
    for n in range(0, int(ends[kind, number, 1]), TOGETHER):
        _add_degrees(table, kind, 1 + n, lanes)
    for k in range(BLOCK):
        re, im, a, b = lanes[WAVE + k], lanes[ALSO + k], lanes[_RE + k], lanes[_IM + k]
        lanes[WAVE + k], lanes[ALSO + k] = a * re - b * im, a * im + b * re
    if most > least:
        for k in range(BLOCK):
            if lanes[NEAR + k] > least:
                dx, dy, dz = others[X, first + k] - x, others[Y, first + k] - y, others[Z, first + k] - z
                along = dx * along_x + dy * along_y + dz * along_z
                dx, dy, dz = dx - along * along_x, dy - along * along_y, dz - along * along_z
                a, b = _along_rim(abs(along), math.sqrt(dx * dx + dy * dy + dz * dz), radius, re_k, im_k)
                lanes[WAVE + k] = im_inverse * a + re_inverse * b
                lanes[ALSO + k] = im_inverse * b - re_inverse * a


@njit(**INNER)
def _along_rim(height, offset, radius, re_k, im_k):  # type: ignore[no-untyped-def]
    """Return i k times the mean of e^{ikR} / R over a disc, by half of its rim; see `analytic.discs`."""
    ratio = math.sqrt((height**2 + (offset - radius) ** 2) / (height**2 + (offset + radius) ** 2))
    squeeze = math.sqrt(min(RIM_STRIP * max(ratio, RIM_LEAST), 1.0))
    turns = RIM_DIGITS + RIM_TURNS * re_k * min(offset, radius)
    count = 1 + int(turns / (2 * math.log((RIM_STRIP + squeeze) / (RIM_STRIP - squeeze))))
    fading = math.exp(-im_k * height)
    re_height, im_height = fading * math.cos(re_k * height), fading * math.sin(re_k * height)
    re_total = im_total = 0.0
    for j in range(count):
        angle = math.pi / 2 * (j + 0.5) / count
        sine, cosine = squeeze * math.sin(angle), math.cos(angle)
        size = sine * sine + cosine * cosine
        turned = 2 * sine * sine / size  # 1 - cos, without cancellation next to the rim
        path = (radius - offset) ** 2 + 2 * radius * offset * turned
        distance = math.sqrt(height * height + path)
        apart = path / (distance + height)
        if re_k * apart > _SMALL:
            fading = math.exp(-im_k * distance)
            re = fading * math.cos(re_k * distance) - re_height
            im = fading * math.sin(re_k * distance) - im_height
        else:
            x, y = -im_k * apart, re_k * apart
            a, b = x + (x * x - y * y) / 2, y + x * y
            re, im = a * re_height - b * im_height, a * im_height + b * re_height
        edge = (radius - offset + offset * turned) / (size * path)
        re_total, im_total = re_total + edge * re, im_total + edge * im
    factor = 2 * squeeze / (count * radius)
    return factor * re_total, factor * im_total
