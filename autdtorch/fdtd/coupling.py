"""The waves that a Huygens surface sends to another box, as matrices of low rank where they are apart.

Fields between places apart have few degrees of freedom: about the product of the two areas over the square
of wavelength times distance (Miller 2000, doi:10.1364/AO.39.001681). Both sides are split into parts, and
adaptive cross approximation (Bebendorf 2000, doi:10.1007/PL00005410) finds the freedom of each pair from
some rows and columns.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.distance import cdist
from torch import Tensor

from autdtorch.fdtd.scattered_field import ScatteredField
from autdtorch.utils.array_types import COMPLEX, AnyArray, Array, Index
from autdtorch.utils.images import Image
from autdtorch.utils.process import spread, thread_count

_ERROR = 1e-5
"""Relative error (Frobenius) at which an approximation ends: rounding in single precision."""

_FREEDOM = 10.0
"""Degrees of freedom between two parts: more make large matrices, fewer make many."""

_MOST_RANK = 120
"""Rank of a pair of parts from which all waves are summed instead; usual are 30 to 60."""

_NEAREST = 0.5
"""Distance [wavelengths] of a surface up to which all waves are summed."""

_SEVERAL = 3
"""Successive terms that must be small: a single one may be so by chance."""


class Pair(NamedTuple):
    """The waves from some cells of a surface to some points: `left` `right`."""

    points: Index  # (n,)
    sources: Index  # (m,)
    left: AnyArray  # (n, rank)
    right: AnyArray  # (rank, m)


class Coupling(NamedTuple):
    """The waves from all cells of a surface to all points, pair by pair of their parts."""

    places: int  # number of the points
    pairs: Sequence[Pair]

    def field(self, amplitude: Tensor) -> Tensor:
        """Return the fields (n, R) of amplitudes (m, R) [Pa m]."""
        values, total = amplitude.numpy(), torch.zeros((self.places, amplitude.shape[1]), **COMPLEX)
        fields = total.numpy()
        for pair in self.pairs:
            fields[pair.points] += pair.left @ (pair.right @ values[pair.sources])
        return total


def coupling_of(target: ScatteredField, source: ScatteredField, images: Sequence[Image]) -> Coupling | None:
    """Return the coupling from images of a box's Huygens surface to another box; None where one is near."""
    points, surface = target.driven.numpy(), source.surface[0]
    seen = [image.of(surface).numpy() for image in images]
    k = source.wavenumber
    wavelength = 2 * math.pi / abs(k)
    nearest = min(_nearest(points, places, wavelength) for places in seen)
    if nearest < _NEAREST * wavelength:
        return None
    edge = math.sqrt(math.sqrt(_FREEDOM) * wavelength * nearest)
    pairs = itertools.product(_parts(points, edge), _parts(surface.numpy(), edge))

    def approximated(pair: tuple[Index, Index]) -> Pair | None:
        here, there = pair
        ends = points[here].T.copy()
        starts = [(image.weight, places[there].T.copy()) for image, places in zip(images, seen, strict=True)]

        def row(number: int) -> AnyArray:
            return _sum(weight * _waves(places - ends[:, number, None], k) for weight, places in starts)

        def column(number: int) -> AnyArray:
            return _sum(weight * _waves(ends - places[:, number, None], k) for weight, places in starts)

        factors = cross_approximation(row, column, (len(here), len(there)))
        return None if factors is None else Pair(here, there, *factors)

    parts = spread(approximated, list(pairs), thread_count())
    whole = [part for part in parts if part is not None]
    return Coupling(len(points), whole) if len(whole) == len(parts) else None


def _sum(terms: Iterable[AnyArray]) -> AnyArray:
    return functools.reduce(np.add, terms)


def _waves(offsets: Array, wavenumber: complex) -> AnyArray:
    """Return e^{ikr} / r (n,) at offsets (3, n) [m]."""
    x, y, z = offsets
    distance = np.sqrt(x * x + y * y + z * z)
    size, turn = np.exp(-wavenumber.imag * distance) / distance, wavenumber.real * distance
    waves = np.empty(len(distance), complex)
    waves.real, waves.imag = size * np.cos(turn), size * np.sin(turn)
    return waves


def _nearest(points: Array, places: Array, edge: float) -> float:
    """Return a distance [m] that points (n, 3) and places (m, 3) keep, from their cubes of an edge."""
    ends = []
    for each in (points, places):
        parts = [each[index] for index in _parts(each, edge)]
        center = np.array([part.mean(axis=0) for part in parts])
        radius = [
            np.linalg.norm(part - middle, axis=1).max() for part, middle in zip(parts, center, strict=True)
        ]
        ends.append((center, np.array(radius)))
    (here, small), (there, wide) = ends
    return float((cdist(here, there) - small[:, None] - wide).min())


def _parts(places: Array, edge: float) -> list[Index]:
    """Return the indices of places (n, 3) [m] in each cube of an edge [m]."""
    number = ((places - places.min(axis=0)) / edge).astype(np.int64)
    _, cube = np.unique(number, axis=0, return_inverse=True)
    order = np.argsort(cube.ravel(), kind="stable")
    return np.split(order, np.flatnonzero(np.diff(cube.ravel()[order])) + 1)


def cross_approximation(
    row: Callable[[int], AnyArray], column: Callable[[int], AnyArray], shape: tuple[int, int]
) -> tuple[AnyArray, AnyArray] | None:
    """Return factors (n, rank) and (rank, m) of a matrix of `shape` from its rows and columns.

    Each term removes a row and a column of what is left; the next row goes through the largest entry of the
    column. The result is None if the rank is larger than `_MOST_RANK`.
    """
    most = min(_MOST_RANK, *shape)
    lefts, rights = np.zeros((most, shape[0]), complex), np.zeros((most, shape[1]), complex)
    unused, pivot, square, small = np.ones(shape[0], bool), 0, 0.0, 0
    for rank in range(most):
        unused[pivot] = False
        right = row(pivot) - lefts[:rank, pivot] @ rights[:rank]
        place = int(np.abs(right).argmax())
        if right[place] == 0:
            return np.ascontiguousarray(lefts[:rank].T), rights[:rank]
        right = right / right[place]
        left = column(place) - rights[:rank, place] @ lefts[:rank]
        lefts[rank], rights[rank] = left, right
        size = float((np.abs(left) ** 2).sum() * (np.abs(right) ** 2).sum())
        across = (lefts[:rank] @ left.conj()) * (rights[:rank] @ right.conj())
        square += size + 2 * float(across.real.sum())
        small = small + 1 if size <= _ERROR**2 * square else 0
        if small == _SEVERAL or rank + 1 == min(shape):
            return np.ascontiguousarray(lefts[: rank + 1].T), rights[: rank + 1]
        pivot = int(np.where(unused, np.abs(left), -1).argmax())
    return None
