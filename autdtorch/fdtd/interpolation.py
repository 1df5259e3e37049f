"""Band-limited points: sources and receivers anywhere between the cells.

A point is spread over a few cells a side by weights that reproduce every plane wave up to the drive's
wavenumber, fitted by least squares along each axis. On a cell centre they reduce to that cell. A source and a
receiver use the same weights, so reciprocity holds to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve
from scipy.sparse import csr_array

from autdtorch.utils.arrays import Array

Shape = tuple[int, int, int]

WIDTHS = (4, 6, 8, 10)
WIDTH_ERROR = 3e-4
"""Largest error of a centred interpolation at the drive's wavenumber: small beside that of any grid."""

_REGULARISATION = 1e-5
"""Keeps the weights small where the fit leaves them free; far below WIDTH_ERROR."""

_ONE_SIDED_REGULARISATION = 1e-2
"""The same where cells are missing: what lies behind the others is extrapolated by up to a cell, and the
field there holds more than waves of the drive's wavenumber."""

_ONE_SIDED_REACH = 3
"""Farthest cells, along each axis, that are then fitted: solving for more takes long."""


@dataclass(frozen=True)
class Interpolation:
    """Cells and weights of P points, each spread over n cells.

    Attributes:
        index: flat cell indices (P, n), int64.
        weight: weights (P, n), float64; they sum to about 1.
    """

    index: NDArray[np.int64]
    weight: Array

    def matrix(self, cells: NDArray[np.int64]) -> csr_array:
        """Matrix (P, k) that reads the points from the values of `cells` (k,), ascending, all of theirs."""
        rows = np.arange(len(self.index)).repeat(self.index.shape[1])
        columns = np.searchsorted(cells, self.index.ravel())
        return csr_array((self.weight.ravel(), (rows, columns)), (len(self.index), len(cells)))


def axis_weights(offset: Array, nodes: Array, kappa: float) -> Array:
    """Weights (P, n) of samples at `nodes` (P, n) that give a function at `offset` (P,), in cells."""
    abscissa, quadrature = np.polynomial.legendre.leggauss(24)
    wavenumber, scale = kappa * (abscissa + 1) / 2, np.sqrt(quadrature / 2)
    phase = wavenumber[:, None] * (nodes - offset[:, None])[:, None, :]
    system = np.concatenate((scale[:, None] * np.cos(phase), scale[:, None] * np.sin(phase)), axis=1)
    target = np.concatenate((scale, np.zeros_like(scale)))
    normal = system.transpose(0, 2, 1) @ system + _REGULARISATION**2 * np.eye(nodes.shape[1])
    return np.linalg.solve(normal, (system.transpose(0, 2, 1) @ target)[..., None])[..., 0]


def exclude_cells(
    points: Interpolation, cells: Array, missing: NDArray[np.bool_], shape: Shape, kappa: float
) -> Interpolation:
    """Points of which some cells are missing, fitted to the others.

    The fit is that of `axis_weights`, over all waves whose wavenumbers along the axes are up to the drive's.
    Points with no cell left next to them get no weight.

    Args:
        points: P points on n cells.
        cells: their positions (P, 3) in cells.
        missing: which of their cells (P, n) do not count.
        shape: of the whole array.
        kappa: wavenumber times spacing [rad].
    """
    rows = np.flatnonzero(missing.any(axis=1))
    if len(rows) == 0:
        return points
    weight = points.weight.copy()
    weight[rows] = 0
    # The cells of all points lie alike, so that one matrix holds the systems of all.
    places = _places(points.index[rows[0]], shape)
    whole = np.sinc(kappa / np.pi * (places[:, None] - places)).prod(axis=-1)
    whole += _ONE_SIDED_REGULARISATION**2 * np.eye(len(whole))
    for row in rows:
        off = np.abs(_places(points.index[row], shape) - cells[row])
        left = np.flatnonzero(~missing[row] & (off < _ONE_SIDED_REACH).all(axis=1))
        if (off[left] < 1).all(axis=1).any():
            target = np.sinc(kappa / np.pi * off[left]).prod(axis=-1)
            weight[row, left] = solve(whole[np.ix_(left, left)], target, assume_a="pos", check_finite=False)
    return Interpolation(points.index, weight)


def _places(index: NDArray[np.int64], shape: Shape) -> NDArray[np.int64]:
    """Positions (n, 3) of cells (n,) of an array of that shape."""
    return np.stack(np.unravel_index(index, shape), axis=-1)


@lru_cache(maxsize=64)
def interpolation_width(kappa: float) -> int:
    """Fewest cells per axis with which a point is interpolated to within `WIDTH_ERROR`."""
    wavenumber = np.linspace(0, kappa, 33)
    for cells in WIDTHS:
        nodes = np.arange(cells, dtype=np.float64) - (cells - 1) / 2
        weight = axis_weights(np.zeros(1), nodes[None], kappa)[0]
        if np.abs(np.exp(1j * np.outer(wavenumber, nodes)) @ weight - 1).max() <= WIDTH_ERROR:
            return cells
    return WIDTHS[-1]


def average_nodes(points: Interpolation, share: Array) -> Interpolation:
    """Weighted means of groups of points, each cell of a group once.

    Args:
        points: P x n points, the n of a group one after the other.
        share: weight of each point in its group (n,).

    Returns:
        P groups, each of as many cells as the largest one: the rest has the group's first cell and no weight.
    """
    if len(share) == 1:
        return points
    index = points.index.reshape(-1, len(share) * points.index.shape[1])
    weight = (share[:, None] * points.weight.reshape(len(index), len(share), -1)).reshape(index.shape)
    groups = []
    for cells, parts in zip(index, weight, strict=True):
        unique, place = np.unique(cells, return_inverse=True)
        groups.append((unique, np.bincount(place, parts)))
    most = max(len(unique) for unique, _ in groups)
    return Interpolation(
        np.stack(
            [np.pad(unique, (0, most - len(unique)), constant_values=unique[0]) for unique, _ in groups]
        ),
        np.stack([np.pad(total, (0, most - len(total))) for _, total in groups]),
    )


def interpolate_points(
    positions: Array,
    shape: Shape,
    first: Shape,
    last: Shape,
    kappa: float,
) -> Interpolation:
    """Spread points over cells [first, last) of an array; near the rim the interpolation_width moves inwards.

    Args:
        positions: (P, 3) in cells, so that cell i has its centre at i.
        shape: shape of the whole array, which decides the flat index.
        first: first cell of each axis that may be used.
        last: one past the last such cell.
        kappa: wavenumber times spacing [rad].
    """
    index = np.zeros((len(positions), 1), np.int64)
    weight = np.ones((len(positions), 1))
    for axis in range(3):
        offset = positions[:, axis]
        cells = min(interpolation_width(kappa), last[axis] - first[axis])
        start = np.clip(np.floor(offset - cells / 2 + 1), first[axis], last[axis] - cells).astype(np.int64)
        nodes = start[:, None] + np.arange(cells)
        along = axis_weights(offset, nodes.astype(np.float64), kappa)
        flat = len(positions), index.shape[1] * cells
        index = (index[:, :, None] * shape[axis] + nodes[:, None, :]).reshape(flat)
        weight = (weight[:, :, None] * along[:, None, :]).reshape(flat)
    return Interpolation(index, weight)
