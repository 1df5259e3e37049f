"""The stability limit of leapfrog on an assembled region.

A step p_new = 2 p - p_old - C A p, with (A p)_i = sum_j w_ij (p_i - p_j), is stable for C lambda <= 4. Here
lambda is the largest eigenvalue of A. Stencil rows are w_ij = K_ij / m_i with symmetric coupling K, of either
sign, and masses m. A therefore has the eigenvalues of the symmetric matrix with -sign(w_ij) sqrt(w_ij w_ji)
off its diagonal, which needs the rows alone.
"""

from __future__ import annotations

import itertools
import logging
import math
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigvalsh_tridiagonal
from scipy.sparse import csr_array

from autdtorch.fdtd.stencil import Stencil, flat_offsets, places_of
from autdtorch.utils.array_types import Array, Index

logger = logging.getLogger(__name__)

CLOSE = 1.03  # A bound within this factor of an attained value is used as it is: 1.5 % of the time step
# Factor on the iterated eigenvalue, which costs 0.5 % of the time step. Iteration approaches from below:
# after 60 steps it is off by up to 2e-4, and with a rim of one cell by 3e-4 (cubes of density ratio 1e-3 to
# 1e4, speed ratio 0.3 to 4).
MARGIN = 1.01
# Most heterogeneous cells for the iteration, which takes about five seconds; beyond, the bound decides
MOST_CELLS = 1_000_000
# Least share of the largest time step. A longer step needs blocks of more periods, and a run ends with a
# whole block: nothing is gained.
LONG_ENOUGH = 0.97
_LANCZOS_STEPS = 60
# Bodies of more cells are shortened to so many planes that repeat each other. A mode that is bound to a face
# or an edge is as high on a part of it: with 32 planes, eigenvalues of five bodies fell by up to 0.13 %.
_LARGE, _REPEATS = 20_000, 32
_TOGETHER = 50_000  # Cells whose neighbours are looked at together
_ROUNDING = 1e-9  # Stencil rows within this of air's are those of air; most rows of maps are


def largest_eigenvalue(index: Index, weight: Array, stencil: Stencil, shape: tuple[int, int, int]) -> float:
    """Return an upper bound of the largest eigenvalue of the operator.

    It is the larger one of uniform air, and of the heterogeneous cells `index` (n,), ascending, with a rim of
    one cell. A mode above those of air is bound to these cells and fades within a cell. The weight of a cell
    itself, zero in air, counts as stiffness against silence.
    """
    air = stencil.largest_symbol
    unlike = (np.abs(weight - stencil.weights) > _ROUNDING).any(axis=1)
    index, weight = index[unlike], weight[unlike]
    if len(index) == 0:
        return air
    if len(index) > _LARGE:
        index, weight, shape = _shortened(index, weight, shape)
    rows, place = _with_rim(index, shape)
    forth = np.broadcast_to(stencil.weights, (len(rows), 27)).copy()
    forth[place[index]] = weight
    parts = np.array_split(np.arange(len(rows), dtype=np.int32), 1 + len(rows) // _TOGETHER)

    def pairs(part: NDArray[np.int32]) -> tuple[NDArray[np.int32], Array]:
        """Return the places of neighbours, -1 outside, and their weights of the cells of a part."""
        neighbour = place[rows[part, None] + flat_offsets(shape)]
        return neighbour, np.where(neighbour >= 0, forth[neighbour, _REVERSED], stencil.weights)

    # Coupling K adds K (p_i - p_j)^2 <= max(K, 0) (1/m_i + 1/m_j) (m_i p_i^2 + m_j p_j^2) to the energy.
    # Summed over the neighbours of a cell, this bounds the largest eigenvalue at any contrast.
    bound = max(float(np.maximum(forth[part] + pairs(part)[1], 0).sum(1).max()) for part in parts)
    if bound <= CLOSE * air:
        return bound
    if len(index) > MOST_CELLS:
        logger.debug(
            "time step up to a quarter below the stability limit: %d heterogeneous cells, and the eigenvalue"
            " is iterated for at most %d", len(index), MOST_CELLS,
        )  # fmt: skip
        return bound
    matrix, column = np.empty(forth.shape), np.empty(forth.shape, np.int32)
    for part in parts:
        neighbour, back = pairs(part)
        # zeros by rounding may differ in sign
        product = np.where(neighbour >= 0, forth[part] * back, 0).clip(min=0)
        matrix[part] = -np.sign(forth[part]) * np.sqrt(product)
        column[part] = np.where(neighbour >= 0, neighbour, part[:, None])
    matrix[:, 13] = forth.sum(1)
    first = np.arange(0, 27 * len(rows) + 1, 27)
    reached = _lanczos(csr_array((matrix.ravel(), column.ravel(), first)), _LANCZOS_STEPS)
    return min(bound, max(air, MARGIN * reached))


def _shortened(
    index: Index, weight: Array, shape: tuple[int, int, int]
) -> tuple[Index, Array, tuple[int, int, int]]:
    """Return the cells of shorter bodies, without planes that repeat the one before once too often."""
    place, lengths = places_of(index, shape), list(shape)
    for axis in range(3):
        order = np.argsort(place[:, axis], kind="stable")
        beside = np.delete(place, axis, axis=1)[order]
        ends = np.cumsum(np.bincount(place[:, axis], minlength=lengths[axis]))
        parts = [slice(first, last) for first, last in itertools.pairwise((0, *ends))]
        pairs = list(itertools.pairwise(parts))
        alike = [
            number for number, (one, other) in enumerate(pairs) if np.array_equal(beside[one], beside[other])
        ]
        if len(alike) < _REPEATS:
            continue
        place, weight = place[order], weight[order]
        repeats = np.zeros(lengths[axis], np.int64)
        for number in alike:
            before, here = pairs[number]
            if np.abs(weight[here] - weight[before]).max(initial=0) <= _ROUNDING:
                repeats[number + 1] = repeats[number] + 1
        few = repeats < _REPEATS
        stays = few[place[:, axis]]
        place, weight, lengths[axis] = place[stays], weight[stays], int(few.sum())
        place[:, axis] = (np.cumsum(few) - 1)[place[:, axis]]
    x, y, z = lengths
    index = np.ravel_multi_index(tuple(place.T), (x, y, z))
    order = np.argsort(index)
    return index[order], weight[order], (x, y, z)


_REVERSED = 26 - np.arange(27)  # Index in `OFFSETS` of the opposite offset


def _with_rim(index: Index, shape: tuple[int, int, int]) -> tuple[Index, NDArray[np.int32]]:
    """Return cells `index` and their neighbours, ascending, and the place of each grid cell among them."""
    near = np.zeros(math.prod(shape), bool)
    for offset in flat_offsets(shape):
        near[index + offset] = True
    near &= np.pad(np.ones([cells - 2 for cells in shape], bool), 1).ravel()  # not in the outermost ring
    rows = np.flatnonzero(near)
    place = np.full(len(near), -1, np.int32)
    place[rows] = np.arange(len(rows))
    return rows, place


def _lanczos(matrix: csr_array, steps: int) -> float:
    """Return the largest Ritz value of a symmetric matrix, a lower bound of its largest eigenvalue.

    Without reorthogonalisation Ritz values repeat, but none leaves the spectrum (Paige 1980). The sums do not
    use BLAS, whose result depends on the number of threads.
    """
    vector = np.random.default_rng(0).standard_normal(matrix.shape[0])
    vector /= math.sqrt((vector * vector).sum())
    previous, beta = np.zeros_like(vector), 0.0
    diagonal, beside = [], []
    for _ in range(steps):
        image = matrix @ vector - beta * previous
        diagonal.append(float((vector * image).sum()))
        image -= diagonal[-1] * vector
        beta = math.sqrt((image * image).sum())
        if beta <= 1e-12 * abs(diagonal[0]):  # the vectors span an invariant space
            break
        beside.append(beta)
        previous, vector = vector, image / beta
    return float(eigvalsh_tridiagonal(diagonal, beside[: len(diagonal) - 1])[-1])


def fewest_steps(stencil: Stencil, largest: float) -> float:
    """Return steps per period at the stability limit, where time factor times `largest` eigenvalue is 4."""
    return 2 * math.pi / math.acos(1 - 2 * stencil.symbol / largest)


def whole_steps(fewest: float) -> Fraction:
    """Return at least `fewest` steps per period, a whole number in the shortest block that is `LONG_ENOUGH`.

    A block of q periods, the denominator, loses less than 1 step in q x fewest.
    """
    # rounding must not add a step to a number that is whole
    counts = (Fraction(math.ceil(block * fewest - 1e-9), block) for block in itertools.count(1))
    return next(count for count in counts if fewest >= LONG_ENOUGH * count)
