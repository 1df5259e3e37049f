"""Translations of spherical waves on CPUs, in numba, for a vector of poses at a time.

A column of waves passes all factors of a translation while it is in the nearest cache, the real parts of a
wave before its imaginary ones. Arrays are flat with unsigned indices. The order of all sums is fixed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numba import njit

from autdtorch.fdtd.kernels import cpu_intrinsics
from autdtorch.fdtd.kernels.cpu_intrinsics import add_conjugate_products, add_products, set_to_multiples
from autdtorch.utils.compiled import INNER, entry

LANES = 8
"""Poses in a vector; see `VECTOR`."""

_LANES, _PAIR = np.uint64(LANES), np.uint64(2 * LANES)
_INTRINSICS = Path(cpu_intrinsics.__file__).parent
_ZERO, _ONE, _TWO = np.uint64(0), np.uint64(1), np.uint64(2)


@entry(_INTRINSICS)
def translate(waves, turns, shifts, quarters, out):  # type: ignore[no-untyped-def]
    """Write regular waves (N, B, R, 2) of outgoing ones (K, B, R, 2), of real and imaginary parts.

    Args:
        waves: the outgoing ones.
        turns: e^(-i m angle) of five turns about z (2, 5, M + 1, P), in the order in which waves take them,
            real and imaginary parts. P is B in whole vectors, or one vector for all.
        shifts: along z (2, C, P), of all orders m >= 0, rows and columns.
        quarters: parts of the quarter turns of all degrees, flat.
        out: the regular ones.
    """
    poses, columns, padded = np.uint64(waves.shape[1]), np.uint64(waves.shape[2]), np.uint64(shifts.shape[2])
    degree, more = np.uint64(np.sqrt(len(waves)) - 0.5), np.uint64(np.sqrt(len(out)) - 0.5)
    source, target, signs = waves.reshape(-1), out.reshape(-1), np.array([1.0, 1.0, -1.0, 1.0])
    a, b = shifts[0].reshape(-1), shifts[1].reshape(-1)
    cosine, sine = turns[0].reshape(-1), turns[1].reshape(-1)
    turn, size = np.uint64(turns.shape[2]) * padded, np.uint64(max(len(waves), len(out))) * _PAIR
    x, y, z = np.empty(size), np.empty(size), np.empty(_TWO * np.uint64(turns.shape[2] + 1) * _PAIR)
    u, v, w = x[_LANES:], y[_LANES:], z[_LANES:]
    for first in range(_ZERO, poses, _LANES):
        lane = first % padded
        for column in range(columns):
            for n in range(np.uint64(len(waves))):
                for k in range(_LANES):
                    pose = first + k if first + k < poses else poses - _ONE
                    at = _TWO * ((n * poses + pose) * columns + column)
                    x[n * _PAIR + k], u[n * _PAIR + k] = source[at], source[at + _ONE]
            _turn_about_z(x, u, y, v, cosine, sine, lane, padded, degree)
            _quarter_turn(y, x, quarters, signs, z, degree)
            _turn_about_z(x, u, y, v, cosine, sine, lane + turn, padded, degree)
            _quarter_turn(y, x, quarters, signs, z, degree)
            _turn_about_z(x, u, y, v, cosine, sine, lane + _TWO * turn, padded, degree)
            _shift(y, z, w, x, u, a, b, lane, padded, signs, degree, more)
            _quarter_turn(x, y, quarters, signs, z, more)
            _turn_about_z(y, v, x, u, cosine, sine, lane + np.uint64(3) * turn, padded, more)
            _quarter_turn(x, y, quarters, signs, z, more)
            _turn_about_z(y, v, x, u, cosine, sine, lane + np.uint64(4) * turn, padded, more)
            for n in range(np.uint64(len(out))):
                for k in range(min(_LANES, poses - first)):
                    at = _TWO * ((n * poses + first + k) * columns + column)
                    target[at], target[at + _ONE] = x[n * _PAIR + k], u[n * _PAIR + k]


@njit(**INNER)
def _turn_about_z(x, u, y, v, cosine, sine, at, step, degree):  # type: ignore[no-untyped-def]
    """Set y + i v to waves x + i u of the orders m times the turn's number m, conjugate for m < 0."""
    for n in range((degree + _ONE) * (degree + _ONE) * _PAIR):
        y[n] = 0
    for n in range(degree + _ONE):
        for m in range(n + _ONE):
            up, down, number = (n * n + n + m) * _PAIR, (n * n + n - m) * _PAIR, at + m * step
            add_products(y, v, up, cosine, sine, number, _ZERO, x, u, up, _ZERO, _ONE)
            if m:
                add_conjugate_products(y, v, down, cosine, sine, number, _ZERO, x, u, down, _ZERO, _ONE)


@njit(**INNER)
def _quarter_turn(x, y, quarters, signs, z, degree):  # type: ignore[no-untyped-def]
    """Set y to a quarter turn of x about y, by sums and differences z of opposite orders; see `quarters`."""
    begin = _ZERO
    for n in range(degree + _ONE):
        size, middle, evens = n + _ONE, n * n + n, n // _TWO + _ONE
        even, odd = _TWO * size * _PAIR, (_TWO * size + _ONE) * _PAIR
        for column in range(size):
            order = n - _TWO * column if column < evens else n - _ONE - _TWO * (column - evens)
            of, stride = (middle - order) * _PAIR, _TWO * order * _PAIR
            set_to_multiples(z, column * _PAIR, signs, _ZERO, x, of, stride, _TWO)
            set_to_multiples(z, (size + column) * _PAIR, signs, _TWO, x, of, stride, _TWO)
        for m in range(_ZERO, size):
            side = (n + m) % _TWO * size * _PAIR
            set_to_multiples(z, even, quarters, begin, z, side, _PAIR, evens)
            set_to_multiples(z, odd, quarters, begin + evens, z, side + evens * _PAIR, _PAIR, size - evens)
            set_to_multiples(y, (middle + m) * _PAIR, signs, _ZERO, z, even, _PAIR, _TWO)
            if m:
                set_to_multiples(y, (middle - m) * _PAIR, signs, _TWO, z, odd, _ZERO - _PAIR, _TWO)
            begin += size


@njit(**INNER)
def _shift(y, z, w, x, u, a, b, at, step, signs, degree, more):  # type: ignore[no-untyped-def]
    """Set x + i u to waves y after a shift a + i b along z, order by order; z + i w is for work."""
    for n in range((more + _ONE) * (more + _ONE) * _PAIR):
        x[n] = 0  # also orders above those of the waves
    for m in range(min(degree, more) + _ONE):
        rows, others = more + _ONE - m, degree + _ONE - m
        for side in range(_ONE if m == _ZERO else _TWO):
            aside = _ZERO - m if side else m
            for n in range(others):
                of = ((m + n) * (m + n + _ONE) + aside) * _PAIR
                set_to_multiples(z, n * _PAIR, signs, _ZERO, y, of, _ZERO, _ONE)
            for n in range(rows):
                to = ((m + n) * (m + n + _ONE) + aside) * _PAIR
                number = at + n * others * step
                add_products(x, u, to, a, b, number, step, z, w, _ZERO, _PAIR, others)
        at += rows * others * step
