"""The waves that a Huygens surface sends to another box, as matrices of low rank where they are apart.

Fields between places apart have few degrees of freedom: about the product of the two areas over the square
of wavelength times distance (Miller 2000, doi:10.1364/AO.39.001681). Both sides are split into parts, and
adaptive cross approximation (Bebendorf 2000, doi:10.1007/PL00005410) finds the freedom of each pair from
some rows and columns, a block of them at a time.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.linalg import lu, solve_triangular
from scipy.spatial.distance import cdist
from torch import Tensor

from autdtorch.fdtd.scattered_field import ScatteredField
from autdtorch.utils.array_types import COMPLEX, AnyArray, Array, Index
from autdtorch.utils.mirror_images import Image
from autdtorch.utils.process import spread, thread_count

_ERROR = 1e-5
"""Relative error (Frobenius) at which an approximation ends: rounding in single precision."""

_FREEDOM = 10.0
"""Degrees of freedom between two parts: more make large matrices, fewer make many."""

_MOST_RANK, _MOST_SIDES = 120, 4
"""Rank of a pair of parts from which all waves are summed instead; usual are 30 to 60. Images may surround a
box: then it is several times as large."""

_NEAREST = 0.5
"""Distance [wavelengths] of a surface or an image of it up to which all waves are summed."""

_RATIO = 4.0
"""Ratio of the distances of images whose waves are summed in one matrix."""

_BLOCK, _SEVERAL = 8, 3
"""Rows and columns that are computed at once, and the terms of them that must be small in the end: a single
one may be so by chance. Larger blocks take fewer calls and more waves."""

_USUAL_RANK = 55
"""Usual rank of a pair of parts, for estimates."""


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
    rest: Sequence[Image]  # images of the surface too near for that, whose waves are to be added

    def field(self, amplitude: Tensor) -> Tensor:
        """Return the fields (n, R) of amplitudes (m, R) [Pa m], without those of the `rest`."""
        total = torch.zeros((self.places, amplitude.shape[1]), **COMPLEX)
        fields, kind = total.numpy(), self.pairs[0].right.dtype if self.pairs else np.complex128
        values = amplitude.numpy().astype(kind)
        for pair in self.pairs:
            fields[pair.points] += pair.left @ (pair.right @ values[pair.sources])
        return total


def coupling_of(target: ScatteredField, source: ScatteredField, images: Sequence[Image]) -> Coupling:
    """Return the coupling from images of a box's Huygens surface to another box.

    Images at similar distances are one matrix: the farther, the fewer degrees of freedom it has.
    """
    points, surface, k = target.driven, source.radiating, source.wavenumber
    kind = np.complex64 if target.assembly.dtype == torch.float32 else np.complex128
    wavelength = 2 * math.pi / abs(k)
    if not len(points):  # obstacles of air
        return Coupling(0, (), ())
    here, there = _balls(points.numpy(), wavelength), _balls(surface.numpy(), wavelength)
    pairs: list[Pair] = []
    rest: list[Image] = []
    levels: dict[int, list[tuple[float, Image]]] = {}
    for image in images:
        gap = _gap(here, (image.of(there[0]), there[1]))
        if gap < _NEAREST * wavelength:
            rest.append(image)
        else:
            levels.setdefault(int(math.log(gap / wavelength / _NEAREST, _RATIO)), []).append((gap, image))
    for level in levels.values():
        nearest, alike = min(gap for gap, _ in level), [image for _, image in level]
        approximated = _pairs(points, surface, alike, _edge(nearest, wavelength), k, kind)
        pairs += approximated or ()
        rest += () if approximated else alike
    return Coupling(len(points), pairs, rest)


def usual_numbers(cells: int, spacing: float, gap: float, wavelength: float) -> float:
    """Return about how many numbers the matrices of waves to a box from an image of it have.

    Its Huygens surface has so many cells of a spacing [m], and is two of them thick; as many are driven. The
    image is at a distance `gap` [m]; nearer ones have no matrices.
    """
    if gap < _NEAREST * wavelength:
        return 0.0
    parts = max(1.0, cells / 2 * (spacing / _edge(gap, wavelength)) ** 2)
    return min(2 * _USUAL_RANK * parts, cells) * cells


def _edge(gap: float, wavelength: float) -> float:
    """Return the edge [m] of parts that few degrees of freedom couple over a distance `gap` [m]."""
    return math.sqrt(math.sqrt(_FREEDOM) * wavelength * gap)


def _pairs(
    points: Tensor, surface: Tensor, images: Sequence[Image], edge: float, wavenumber: complex, kind: type
) -> list[Pair] | None:
    """Return the waves from images of a surface to points, by parts of an edge; None if of too high rank.

    Their numbers are of a `kind`: a run applies them every block, in the time that memory takes.
    """
    from autdtorch.fdtd.kernels.cpu_waves import wave_matrix  # loads numba

    weights = torch.tensor([image.weight for image in images], **COMPLEX)
    matrices = torch.stack([image.matrix for image in images])
    offsets = torch.stack([image.offset for image in images])[:, None]
    most = _MOST_RANK * min(len(images), _MOST_SIDES)

    def waves(places: Tensor, images: Tensor) -> AnyArray:  # (n, 3) from images (i, b, 3) of places: (n, b)
        amplitude = weights.repeat_interleave(images.shape[1])
        return wave_matrix(places, images.flatten(0, 1), amplitude, images.shape[1], wavenumber).numpy()

    def approximated(pair: tuple[Index, Index]) -> Pair | None:
        ends, starts = points[pair[0]], surface[pair[1]]

        def rows(numbers: Index) -> AnyArray:  # distances to an image are those from the place that it is of
            return waves(starts, (ends[numbers] - offsets) @ matrices).T

        def columns(numbers: Index) -> AnyArray:
            return waves(ends, starts[numbers] @ matrices.mT + offsets)

        factors = cross_approximation(rows, columns, (len(ends), len(starts)), most)
        return None if factors is None else Pair(*pair, *(factor.astype(kind) for factor in factors))

    parts = itertools.product(_parts(points.numpy(), edge), _parts(surface.numpy(), edge))
    pairs = spread(approximated, list(parts), thread_count())
    whole = [pair for pair in pairs if pair is not None]
    return whole if len(whole) == len(pairs) else None


def _balls(places: Array, edge: float) -> tuple[Tensor, Array]:
    """Return centres (c, 3) and radii (c,) [m] of balls around places (n, 3), a ball for each cube."""
    parts = [places[index] for index in _parts(places, edge)]
    center = np.array([part.mean(axis=0) for part in parts])
    radius = [np.linalg.norm(part - middle, axis=1).max() for part, middle in zip(parts, center, strict=True)]
    return torch.from_numpy(center), np.array(radius)


def _gap(these: tuple[Tensor, Array], those: tuple[Tensor, Array]) -> float:
    """Return the smallest distance [m] between two sets of balls."""
    (here, small), (there, wide) = these, those
    return float((cdist(here.numpy(), there.numpy()) - small[:, None] - wide).min())


def _parts(places: Array, edge: float) -> list[Index]:
    """Return the indices of places (n, 3) [m] in each cube of an edge [m]."""
    number = ((places - places.min(axis=0)) / edge).astype(np.int64)
    _, cube = np.unique(number, axis=0, return_inverse=True)
    order = np.argsort(cube.ravel(), kind="stable")
    return np.split(order, np.flatnonzero(np.diff(cube.ravel()[order])) + 1)


def cross_approximation(
    rows: Callable[[Index], AnyArray], columns: Callable[[Index], AnyArray], shape: tuple[int, int], most: int
) -> tuple[AnyArray, AnyArray] | None:
    """Return factors (n, rank) and (rank, m) of a matrix of `shape` from blocks of its rows and columns.

    The terms of a block remove its rows from what is left of the matrix, and the columns of their pivots. The
    next rows are the pivots of these columns. The result is None if the rank is larger than `most`.
    """
    lefts, rights = np.zeros((shape[0], 0), complex), np.zeros((0, shape[1]), complex)
    row = np.linspace(0, shape[0] - 1, min(_BLOCK, shape[0])).astype(int)
    unused, square = np.ones(shape[0]), 0.0
    for _ in range(0, most, _BLOCK):
        unused[row] = 0
        column, right = _eliminated((rows(row) - lefts[row] @ rights).T)
        left = columns(column) - lefts @ rights[:, column]
        left = solve_triangular(right[column], left.T, lower=True, unit_diagonal=True, check_finite=False).T
        lefts, rights = np.hstack((lefts, left)), np.vstack((rights, right.T))
        products = (left.conj().T @ lefts) * (rights @ right.conj()).T  # of the new terms with all
        among = products[:, -len(column) :].real
        square += 2 * float(products.real.sum()) - float(among.sum())
        if among.diagonal()[-_SEVERAL:].max() <= _ERROR**2 * square or len(rights) >= min(shape):
            return lefts, rights
        row, _ = _eliminated(left * unused[:, None])
    return None


def _eliminated(matrix: AnyArray) -> tuple[Index, AnyArray]:
    """Return the pivots (k,) of columns (n, k) in turn, by rows, and the columns (n, k) in units of them.

    They are the largest entries of what Gaussian elimination leaves of each column.
    """
    order, lower, _ = lu(matrix, p_indices=True, check_finite=False)
    return np.argsort(order)[: lower.shape[1]], lower[order]
