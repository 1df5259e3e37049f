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
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigvalsh_tridiagonal
from scipy.sparse import csr_array

from autdtorch.fdtd.assembly.neighbours import inner_cells, with_neighbours
from autdtorch.fdtd.stencil import ROW_ROUNDING, Stencil, flat_offsets, places_of
from autdtorch.utils.array_types import Array, Index, triple
from autdtorch.utils.process import parts_of_size, spread

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
_TOGETHER = 16_384  # Rows in a task: about a millisecond


def largest_eigenvalue(
    index: Index, weight: Array, stencil: Stencil, shape: tuple[int, int, int], known: float = math.inf
) -> float:
    """Return an upper bound of the largest eigenvalue of the operator, at most a `known` one.

    It is the larger one of uniform air, and of the heterogeneous cells `index` (n,), ascending, with a rim of
    one cell. A mode above those of air is bound to these cells and fades within a cell. The weight of a cell
    itself, zero in air, counts as stiffness against silence.
    """
    from autdtorch.fdtd.assembly.cell_kernels import symmetric_rows  # loads numba

    air = stencil.largest_symbol
    unlike = stencil.differs_from(weight)  # most rows of maps are those of air
    index, weight = index[unlike], weight[unlike]
    if len(index) == 0:
        return air
    if len(index) > _LARGE:
        index, weight, shape = _shortened(index, weight, shape)
    rows, place = _with_rim(index, shape)
    forth = np.broadcast_to(stencil.weights, (len(rows), 27)).copy()
    forth[place[index]] = weight
    iterated, offsets = len(index) <= MOST_CELLS, flat_offsets(shape)

    def part(ends: tuple[int, int]) -> tuple[float, csr_array]:
        """Return the bound of some rows, and these rows of the symmetric matrix, zero if not iterated."""
        size = 27 * (ends[1] - ends[0]) if iterated else 0
        values, columns = np.empty(size), np.empty(size, np.int32)
        begin = np.zeros(ends[1] - ends[0] + 1, np.int32)
        bound = symmetric_rows(*ends, rows, place, forth, stencil.weights, offsets, values, columns, begin)
        matrix = values[: begin[-1]], columns[: begin[-1]], begin
        return bound, csr_array(matrix, (len(begin) - 1, len(rows)))

    bounds, parts = zip(*spread(part, parts_of_size(len(rows), _TOGETHER)), strict=True)
    bound: float = min(known, max(bounds))
    if bound <= CLOSE * air:
        return bound
    if not iterated:
        logger.debug(
            "time step up to a quarter below the stability limit: %d heterogeneous cells, and the eigenvalue"
            " is iterated for at most %d", len(index), MOST_CELLS,
        )  # fmt: skip
        return bound
    enough = bound / CLOSE
    reached = _lanczos(parts, len(rows), enough)
    return bound if reached >= enough else min(bound, max(air, MARGIN * reached))


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
            if np.abs(weight[here] - weight[before]).max(initial=0) <= ROW_ROUNDING:
                repeats[number + 1] = repeats[number] + 1
        few = repeats < _REPEATS
        stays = few[place[:, axis]]
        place, weight, lengths[axis] = place[stays], weight[stays], int(few.sum())
        place[:, axis] = (np.cumsum(few) - 1)[place[:, axis]]
    index = np.ravel_multi_index(tuple(place.T), lengths)
    order = np.argsort(index)
    return index[order], weight[order], triple(lengths)


def _with_rim(index: Index, shape: tuple[int, int, int]) -> tuple[Index, NDArray[np.int32]]:
    """Return cells `index` and their neighbours, ascending, and the place of each grid cell among them."""
    rows = inner_cells(with_neighbours(index, shape))
    place = np.full(math.prod(shape), -1, np.int32)
    place[rows] = np.arange(len(rows))
    return rows, place


def _lanczos(parts: Sequence[csr_array], size: int, enough: float) -> float:
    """Return a lower bound of the largest eigenvalue of a symmetric matrix: its largest Ritz value.

    Iteration ends at a value that is `enough`: a pivot of `enough` times the identity less the tridiagonal
    matrix is then no longer positive. Rows (size, size) are those of all parts. Without reorthogonalisation
    Ritz values repeat, but none leaves the spectrum (Paige 1980). The sums do not use BLAS, whose result
    depends on the number of threads.
    """

    def product(vector: Array) -> Array:
        return np.concatenate(spread(lambda rows: np.asarray(rows @ vector), parts))

    vector = np.random.default_rng(0).standard_normal(size)
    vector /= math.sqrt((vector * vector).sum())
    previous, beta, pivot = np.zeros_like(vector), 0.0, math.inf
    diagonal: list[float] = []
    beside: list[float] = []
    for _ in range(_LANCZOS_STEPS):
        image = product(vector) - beta * previous
        diagonal.append(float((vector * image).sum()))
        pivot = enough - diagonal[-1] - beta**2 / pivot
        image -= diagonal[-1] * vector
        beta = math.sqrt((image * image).sum())
        if pivot <= 0 or beta <= 1e-12 * abs(diagonal[0]):  # the vectors span an invariant space
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
