"""Band-limited interpolation kernels: sources and receivers anywhere between the cells.

The weights of a point on a few cells a side reproduce every plane wave up to the drive's wavenumber. They are
fitted by least squares along each axis, and reduce to one cell at a cell centre. A source and a receiver use
the same weights, so reciprocity holds to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from autdtorch.fdtd.stencil import places_of
from autdtorch.utils.array_types import Array, Index

GridShape = tuple[int, int, int]
WIDTHS = (4, 6, 8, 10)
# Largest error of a centred kernel at the drive's wavenumber: small compared with the error of any grid
WIDTH_ERROR = 3e-4
_REGULARISATION = 1e-5  # Keeps weights small where the fit does not determine them; far below WIDTH_ERROR
# Regularisation where cells are excluded. The field there is extrapolated by up to a cell, and holds more
# than waves of the drive's wavenumber.
_ONE_SIDED_REGULARISATION = 1e-2
# Distance [cells] along each axis of the cells that are then fitted: larger systems take long
ONE_SIDED_REACH = 3
_TOGETHER = 64  # Points whose systems are solved together: a few MB
AT_CENTRE = 1e-6  # Distance from a cell's centre that is rounding [cells]
_ABSCISSA, _QUADRATURE = np.polynomial.legendre.leggauss(24)  # of wavenumbers up to the drive's


@dataclass(frozen=True)
class Interpolation:
    """Interpolation kernels of P points on n cells each."""

    index: Index  # flat cell indices (P, n), int64
    weight: Array  # weights (P, n), float64, with a sum of about 1

    def matrix(self, cells: Index) -> csr_array:
        """Return the matrix (P, k) from values of `cells` (k,), ascending, to values at the points."""
        rows = np.arange(len(self.index)).repeat(self.index.shape[1])
        columns = np.searchsorted(cells, self.index.ravel())
        return csr_array((self.weight.ravel(), (rows, columns)), (len(self.index), len(cells)))


def axis_weights(offset: Array, nodes: Array, kappa: float) -> Array:
    """Return weights (P, n) of samples at `nodes` (P, n) for values at `offset` (P,), in cells."""
    wavenumber, scale = kappa * (_ABSCISSA + 1) / 2, np.sqrt(_QUADRATURE / 2)
    phase = wavenumber[:, None] * (nodes - offset[:, None])[:, None, :]
    system = np.concatenate((scale[:, None] * np.cos(phase), scale[:, None] * np.sin(phase)), axis=1)
    target = np.concatenate((scale, np.zeros_like(scale)))
    normal = system.transpose(0, 2, 1) @ system + _REGULARISATION**2 * np.eye(nodes.shape[1])
    return np.linalg.solve(normal, (system.transpose(0, 2, 1) @ target)[..., None])[..., 0]


def exclude_cells(
    points: Interpolation, cells: Array, excluded: NDArray[np.bool_], shape: GridShape, kappa: float
) -> Interpolation:
    """Return kernels of points at `cells` (P, 3) without the `excluded` cells (P, n), fitted to the others.

    The fit covers all waves up to the drive's wavenumber. Points get no weight if all cells next to them are
    excluded. At the centre of a cell that is not, points have its pressure: a fit would leave out the short
    waves of a grid at a surface.
    """
    centred = (np.abs(cells - cells.round()) < AT_CENTRE).all(axis=1)
    centred &= ~np.take_along_axis(excluded, points.weight.argmax(axis=1)[:, None], axis=1)[:, 0]
    rows = np.flatnonzero(excluded.any(axis=1) & ~centred)
    if len(rows) == 0:
        return points
    weight = points.weight.copy()
    weight[rows] = 0
    # The cells of all points have one arrangement, a product of three axes.
    corners, far = (places_of(points.index[rows, column], shape) for column in (0, -1))
    counts = far[0] - corners[0] + 1
    numbers = np.arange(points.index.shape[1]).reshape(counts)
    off = [np.abs(corners[:, [axis]] + np.arange(counts[axis]) - cells[rows][:, [axis]]) for axis in range(3)]
    # as many on both sides of a point at a centre
    near = [along < min(ONE_SIDED_REACH, along.shape[1] / 2) - AT_CENTRE for along in off]
    blocks, block_of = np.unique(np.concatenate(near, axis=1), axis=0, return_inverse=True)
    for number, block in enumerate(blocks):
        some = np.flatnonzero(block_of.ravel() == number)
        sides = np.split(block, np.cumsum(counts)[:-1])
        columns = numbers[np.ix_(*sides)].ravel()
        out = excluded[np.ix_(rows[some], columns)]
        distances = [along[some][:, side] for along, side in zip(off, sides, strict=True)]
        beside = _products([along < 1 - AT_CENTRE for along in distances])
        fitted = np.flatnonzero((beside & ~out).any(axis=1))
        factors = [np.sinc(kappa / np.pi * along[fitted]) for along in distances]
        inverse = _inverse_of_block(kappa, *(int(side.sum()) for side in sides))
        weight[np.ix_(rows[some[fitted]], columns)] = _fit_to_others(factors, out[fitted], inverse)
    return Interpolation(points.index, weight)


def _products(factors: list[NDArray[Any]]) -> NDArray[Any]:
    """Return the products (P, i * j * k) of factors (P, i), (P, j) and (P, k) along three axes."""
    x, y, z = factors
    products: NDArray[Any] = x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]
    return products.reshape(len(x), -1)


@lru_cache(maxsize=16)
def _inverse_of_block(kappa: float, *counts: int) -> Array:
    """Return the inverse of the system (n, n) of a block of cells, with `counts` along the axes."""
    x, y, z = (np.sinc(kappa / np.pi * np.subtract.outer(*[np.arange(count)] * 2)) for count in counts)
    # By eigenvalues: their rounding errors cancel in the fit, but those of an elimination would not.
    values, vectors = np.linalg.eigh(np.kron(np.kron(x, y), z))
    inverse: Array = (vectors / (values + _ONE_SIDED_REGULARISATION**2)) @ vectors.T
    return inverse


def _fit_to_others(factors: list[Array], out: NDArray[np.bool_], inverse: Array) -> Array:
    """Return weights (P, n) of the cells that are not `out` (P, n), by the `inverse` of the system of all.

    The few cells that are out then need a small system: weights of all, less those that make theirs 0. Points
    with about as many of them are solved together; rows of the identity matrix fill up the smaller systems.
    The right side of the system of all is the products of `factors` along the axes.
    """
    weight, count = np.zeros(out.shape), out.sum(axis=1)
    ascending = np.argsort(count, kind="stable")
    for first in range(0, len(out), _TOGETHER):
        some = ascending[first : first + _TOGETHER]
        of_all = np.where(out[some], 0.0, _products([along[some] for along in factors])) @ inverse
        places = np.argsort(~out[some], axis=1, kind="stable")[:, : count[some[-1]]]
        is_out = np.take_along_axis(out[some], places, axis=1)
        both = is_out[:, :, None] & is_out[:, None, :]
        system = np.where(both, inverse[places[:, :, None], places[:, None, :]], np.eye(places.shape[1]))
        excess = np.where(is_out, np.take_along_axis(of_all, places, axis=1), 0.0)
        taken = np.zeros(of_all.shape)
        np.put_along_axis(taken, places, np.linalg.solve(system, excess[..., None])[..., 0], axis=1)
        weight[some] = of_all - taken @ inverse
    weight[out] = 0
    return weight


@lru_cache(maxsize=64)
def interpolation_width(kappa: float) -> int:
    """Return the fewest cells per axis that interpolate to within `WIDTH_ERROR`."""
    wavenumber = np.linspace(0, kappa, 33)
    for cells in WIDTHS:
        nodes = np.arange(cells, dtype=np.float64) - (cells - 1) / 2
        weight = axis_weights(np.zeros(1), nodes[None], kappa)[0]
        if np.abs(np.exp(1j * np.outer(wavenumber, nodes)) @ weight - 1).max() <= WIDTH_ERROR:
            return cells
    return WIDTHS[-1]


def average_nodes(nodes: Interpolation, share: Array) -> Interpolation:
    """Return means, weighted by `share` (n,), over groups of n kernels; padded with weight 0."""
    if len(share) == 1:
        return nodes
    index = nodes.index.reshape(-1, len(share) * nodes.index.shape[1])
    weight = (share[:, None] * nodes.weight.reshape(len(index), len(share), -1)).reshape(index.shape)
    groups = []
    for cells, parts in zip(index, weight, strict=True):
        unique, place = np.unique(cells, return_inverse=True)
        groups.append((unique, np.bincount(place, parts)))
    most = max(len(unique) for unique, _ in groups)
    padded = [np.pad(unique, (0, most - len(unique)), constant_values=unique[0]) for unique, _ in groups]
    sums = [np.pad(sums, (0, most - len(sums))) for _, sums in groups]
    return Interpolation(np.stack(padded), np.stack(sums))


def interpolate_points(
    positions: Array, shape: GridShape, first: GridShape, last: GridShape, kappa: float
) -> Interpolation:
    """Return kernels of positions (P, 3) in cells on cells [first, last), one-sided near the rim."""
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
