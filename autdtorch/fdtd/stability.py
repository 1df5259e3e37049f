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

from autdtorch.fdtd.stencil import Stencil, flat_offsets
from autdtorch.utils.array_types import Array

logger = logging.getLogger(__name__)


CLOSE = 1.03
"""A bound within this factor of an attained value is used as it is: 1.5 % of the time step."""

MARGIN = 1.01
"""Factor on the iterated eigenvalue, at 0.5 % of the time step. Iteration approaches from below: 60 steps
leave up to 2e-4, the rim of one cell 3e-4 (cubes of density ratio 1e-3 to 1e4, speed ratio 0.3 to 4)."""

MOST_CELLS = 1_000_000
"""Most heterogeneous cells for the iteration, which takes about five seconds; beyond, the bound decides."""

LONG_ENOUGH = 0.97
"""Least share of the largest time step. A longer step needs blocks of more periods, and a run ends with a
whole block: nothing is gained."""

_LANCZOS_STEPS = 60

_ROUNDING = 1e-9
"""Stencil rows within this of air's are those of air; most rows of maps are."""


def largest_eigenvalue(
    index: NDArray[np.int64], weight: Array, stencil: Stencil, shape: tuple[int, int, int]
) -> float:
    """Return an upper bound of the largest eigenvalue of the operator.

    The larger of two eigenvalues: of uniform air, and of the heterogeneous cells with a rim of one cell. A
    mode above those of air is bound to the heterogeneous cells and fades within a cell.

    Args:
        index: flat indices (n,) of the heterogeneous cells, ascending, not in the outermost ring.
        weight: their stencil rows (n, 27).
        stencil: weights of all other cells.
        shape: shape of the grid.
    """
    air = stencil.largest_symbol
    unlike = (np.abs(weight - stencil.weights) > _ROUNDING).any(axis=1)
    index, weight = index[unlike], weight[unlike]
    if len(index) == 0:
        return air
    rows, place = _with_rim(index, shape)
    neighbour = place[rows[:, None] + flat_offsets(shape)]
    inside = neighbour >= 0
    forth = np.broadcast_to(stencil.weights, (len(rows), 27)).copy()
    forth[place[index]] = weight
    back = np.where(inside, forth[neighbour, _REVERSED], stencil.weights)
    # Coupling K adds K (p_i - p_j)^2 <= max(K, 0) (1/m_i + 1/m_j) (m_i p_i^2 + m_j p_j^2) to the energy.
    # Summed over the neighbours of a cell, this bounds the largest eigenvalue at any contrast.
    bound = float(np.maximum(forth + back, 0).sum(1).max())
    if bound <= CLOSE * air:
        return bound
    if len(index) > MOST_CELLS:
        logger.info(
            "time step up to a quarter below the stability limit: %d heterogeneous cells, and the eigenvalue"
            " is iterated for at most %d", len(index), MOST_CELLS,
        )  # fmt: skip
        return bound
    product = np.where(inside, forth * back, 0).clip(min=0)  # zeros by rounding may differ in sign
    matrix = -np.sign(forth) * np.sqrt(product)
    matrix[:, 13] = forth.sum(1)
    column = np.where(inside, neighbour, np.arange(len(rows), dtype=np.int32)[:, None])
    first = np.arange(0, 27 * len(rows) + 1, 27)
    reached = _lanczos(csr_array((matrix.ravel(), column.ravel(), first)), _LANCZOS_STEPS)
    return min(bound, max(air, MARGIN * reached))


_REVERSED = 26 - np.arange(27)
"""Index in `OFFSETS` of the opposite offset."""


def _inner(shape: tuple[int, int, int]) -> NDArray[np.bool_]:
    """Return which cells (k,) are not in the outermost ring."""
    return np.pad(np.ones([cells - 2 for cells in shape], bool), 1).ravel()


def _with_rim(
    index: NDArray[np.int64], shape: tuple[int, int, int]
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Return cells `index` and their neighbours, ascending, and the place of each grid cell among them."""
    found = np.zeros(math.prod(shape), bool)
    for offset in flat_offsets(shape):
        found[index + offset] = True
    found &= _inner(shape)
    rows = np.flatnonzero(found)
    place = np.full(len(found), -1, np.int32)
    place[rows] = np.arange(len(rows))
    return rows, place


def _lanczos(matrix: csr_array, steps: int) -> float:
    """Return the largest Ritz value of a symmetric matrix, a lower bound of its largest eigenvalue.

    Without reorthogonalisation Ritz values repeat, but none leaves the spectrum (Paige 1980). The sums do not
    use BLAS, whose result depends on the number of threads.
    """
    vector = np.random.default_rng(0).standard_normal(matrix.shape[0])
    vector /= _length(vector)
    previous, beta = np.zeros_like(vector), 0.0
    diagonal, beside = [], []
    for _ in range(steps):
        image = matrix @ vector - beta * previous
        diagonal.append(float((vector * image).sum()))
        image -= diagonal[-1] * vector
        beta = _length(image)
        if beta <= 1e-12 * abs(diagonal[0]):  # the vectors span an invariant space
            break
        beside.append(beta)
        previous, vector = vector, image / beta
    return float(eigvalsh_tridiagonal(diagonal, beside[: len(diagonal) - 1])[-1])


def fewest_steps(stencil: Stencil, largest: float) -> float:
    """Return steps per period at the stability limit, where time factor times `largest` eigenvalue is 4."""
    return 2 * math.pi / math.acos(1 - 2 * stencil.symbol / largest)


def whole_steps(fewest: float) -> Fraction:
    """Return at least `fewest` steps per period, a whole number in a block of q periods (denominator).

    The block is the shortest whose time step is `LONG_ENOUGH`. It loses less than 1 step in q x fewest: 12
    steps per period need q up to 3, 6 steps up to 6.
    """
    # rounding must not add a step to a number that is whole
    counts = (Fraction(math.ceil(block * fewest - 1e-9), block) for block in itertools.count(1))
    return next(count for count in counts if fewest >= LONG_ENOUGH * count)


def _length(vector: NDArray[np.float64]) -> float:
    return math.sqrt(float((vector * vector).sum()))
