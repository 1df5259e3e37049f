"""Resonances that ring in runs, and the error of a steady state by their displacement on a grid.

Each rings at a complex frequency p, and has a part of the steady state in proportion to 1 / (p - w) at the
drive's frequency w. Grids shift p. Where that is far beyond its width, grids differ little, as on none of
them much is left of a narrow resonance, and are wrong together if it is next to w. Two grids tell the shift.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from autdtorch.utils.array_types import ComplexArray

MOST_RESONANCES = 8
"""Most resonances that a result counts."""

_WIDEST, _FARTHEST = 0.03, 0.12  # Width and distance from the drive's frequency that count, relative to it
_NOISE = 1e-5  # Singular values relative to the largest, below which they are rounding
_CHANNELS = 16  # Most directions of the steps that are fitted
_FEWEST_STEPS = 7  # Shorter runs end without any that is narrow
# Windows of the steps, and shorter ones that have to tell a resonance too, up to a distance relative to the
# drive's frequency. What a fit makes of large plates, which ring at many frequencies at once, moves by 0.008
# to 0.02; resonances of balls move by up to 0.002
_WINDOW, _SHORTER, _UNSURE = 2 / 3, 1 / 2, 0.004
# The shift of a frequency falls as this power of the spacing: next to exact ones of four slow balls, as 2.1
# to 3.3. If it falls more slowly, two grids tell less than all of it.
_POWER = 3.0
_SAME = 0.2  # Distance in half widths up to which two runs have told one resonance
# Resonances of two grids that are the same one: most that it moves, relative to the drive's frequency, and
# ratios of widths and of excitations
_MOVED, _ALIKE_WIDTH, _ALIKE_EXCITED = 0.06, 2.0, 4.0
# A resonance changes at most so many times as much from a grid to the next as the steady state, as others
# cancel its change. Fits of fields that are no sum of resonances, as between facing surfaces, have up to 70
_MOST_CANCELLED = 3.0
# Usual shift on a grid, relative to the cube of a cell in wavelengths: of bodies in air 0.3 to 5 measured, of
# slow fluids 8 to 36
_USUAL_SHIFT = 10.0


class Resonance(NamedTuple):
    """A resonance next to the frequency of the drive.

    Attributes:
        offset: the difference of its complex frequency and the drive's, over the drive's; the imaginary part
            is minus half the width of the resonance.
        strength: the norm of its part of the steady state, relative to the norm of the whole.
    """

    offset: complex
    strength: float

    @property
    def excited(self) -> float:
        """The strength times the offset, which does not depend on the offset."""
        return self.strength * abs(self.offset)


def offsets_of(products: ComplexArray, interval: float, share: float = _WINDOW) -> ComplexArray:
    """Return the offsets of what rings in sequences, from their steps; see `Resonance`.

    `products` (n, n) are those of each step with each conjugated one, summed over sequences, and `interval`
    is the time between two [periods]. The steps of windows, each a `share` of them, that are shifted in time
    span a space that a shift multiplies by exp(-i (p - w) t): its eigenvalues tell p (ESPRIT, Roy and
    Kailath 1989).
    """
    count = len(products)
    if count < _FEWEST_STEPS or not np.isfinite(products).all() or not products.any():
        return np.zeros(0, np.complex128)
    squares, directions = np.linalg.eigh(products)
    squares, directions = squares[-_CHANNELS:], directions[:, -_CHANNELS:]
    steps = directions * np.sqrt(squares.clip(min=0))
    windows = sliding_window_view(steps, int(count * share), axis=0)
    basis, sizes, _ = np.linalg.svd(windows.reshape(-1, windows.shape[-1]).T, full_matrices=False)
    basis = basis[:, : min(int((sizes > _NOISE * sizes[0]).sum()), len(basis) - 2)]
    factors = np.linalg.eigvals(np.linalg.lstsq(basis[:-1], basis[1:])[0])
    factors = factors[factors != 0]
    return np.asarray(1j * np.log(factors) / (2 * math.pi * interval), np.complex128)


def parts_of(offsets: ComplexArray, count: int, interval: float) -> ComplexArray:
    """Return the weights (j, n) of n values, `interval` [periods] apart, of the first's parts by offsets."""
    times = np.arange(count) * interval
    ringing = np.exp(-2j * math.pi * np.outer(times, offsets))
    constant = np.ones((count, 1), np.complex128)
    return np.asarray(np.linalg.pinv(np.hstack([constant, ringing]), rcond=1e-10)[1:], np.complex128)


def are_resonances(offsets: ComplexArray, products: ComplexArray, interval: float) -> np.ndarray:
    """Return which offsets (j,) are narrow, near the drive's frequency, and told by shorter windows too.

    `products` and `interval` are those of `offsets_of`.
    """
    near = (offsets.imag < 0) & (offsets.imag > -_WIDEST) & (abs(offsets) < _FARTHEST)
    if not near.any():
        return np.asarray(near)
    others = offsets_of(products, interval, _SHORTER)
    moved = abs(offsets[:, None] - others).min(axis=1, initial=math.inf)
    return np.asarray(near & (moved < _UNSURE))


def merged(runs: Sequence[Sequence[Resonance]]) -> tuple[Resonance, ...]:
    """Return the resonances of all runs together, at most `MOST_RESONANCES`.

    They are those that would be the strongest at the frequency of the drive.
    """
    rung = sorted(itertools.chain.from_iterable(runs), key=lambda each: each.excited / each.offset.imag)
    together: list[Resonance] = []
    for each in rung:
        part = each.strength / math.sqrt(len(runs))
        places = [n for n, other in enumerate(together) if _differ_little(each.offset, other.offset)]
        if places:
            other = together[places[0]]
            together[places[0]] = other._replace(strength=math.hypot(other.strength, part))
        else:
            together.append(Resonance(each.offset, part))
    return tuple(together[:MOST_RESONANCES])


def as_numbers(resonances: Sequence[Resonance]) -> list[float]:
    """Return resonances as numbers for a file, as many in any case."""
    numbers = np.zeros((MOST_RESONANCES, 3))
    for row, each in zip(numbers, resonances, strict=False):
        row[:] = each.offset.real, each.offset.imag, each.strength
    return [float(number) for number in numbers.flat]


def of_numbers(numbers: Sequence[float]) -> tuple[Resonance, ...]:
    """Return the resonances of numbers; see `as_numbers`."""
    rows = zip(*[iter(numbers)] * 3, strict=True)
    return tuple(Resonance(complex(real, imaginary), part) for real, imaginary, part in rows if part)


def displacement_error(
    resonances: Sequence[Resonance],
    others: Sequence[Resonance],
    ratio: float,
    spacing: float,
    change: float,
) -> float:
    """Return the relative error of a steady state by the shift of its resonances on a grid.

    `spacing` is the edge of the grid's cells [wavelengths]. `others` are those on another grid, whose spacing
    is larger by a `ratio`, and whose steady state differs by a relative `change`: what resonances change is
    not far more. One without any like it there has moved too far to tell: its shift is taken to be between
    none and twice the usual one, towards the drive's frequency.
    """
    squares = 0.0
    for here in resonances:
        alike = [other for other in others if _are_alike(here, other)]
        if alike:
            nearest = min(alike, key=lambda other: abs(other.offset - here.offset))
            shift = (here.offset - nearest.offset).real / (ratio**_POWER - 1)
            seen = here.strength * abs(1 - here.offset / nearest.offset)
            share = min(1.0, _MOST_CANCELLED * change / seen) if seen else 1.0
            squares += (share * here.strength * shift / abs(here.offset + shift)) ** 2
        elif not any(_may_be_same(here, other) for other in others):
            squares += here.strength**2 * _mean_square(here.offset, 2 * _USUAL_SHIFT * spacing**_POWER)
    return math.sqrt(squares)


def _mean_square(offset: complex, most: float) -> float:
    """Return the mean of |s / (d + s)|^2 for an offset d, over shifts s towards no offset of up to `most`."""
    distance, half = abs(offset.real), -offset.imag
    rest = most - distance
    turned = math.atan(rest / half) + math.atan(distance / half)
    grown = math.log((rest**2 + half**2) / abs(offset) ** 2)
    return 1 + (distance * grown + (distance**2 - half**2) / half * turned) / most


def _are_alike(one: Resonance, other: Resonance) -> bool:
    excited = math.log(one.excited / other.excited)
    return _may_be_same(one, other) and abs(excited) < math.log(_ALIKE_EXCITED)


def _may_be_same(one: Resonance, other: Resonance) -> bool:
    width = math.log(one.offset.imag / other.offset.imag)
    return abs(width) < math.log(_ALIKE_WIDTH) and abs(one.offset - other.offset) < _MOVED


def _differ_little(one: complex, other: complex) -> bool:
    return abs(one - other) < _SAME * abs(other.imag)
