"""Mirror images: which simulations stand for others.

A symmetry maps a scene on its grid onto itself: cells onto cells with the same rows, transducers onto
transducers. It is one of the 48 signed permutations of the axes about the grid's centre. The rows hold all
that obstacles, their order, the domain and the boundary layers do to sound, so nothing but them is compared,
and no kind of obstacle needs to know its symmetries. With S any of them, G[p, m] = G[S p, S m].
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import KDTree

from autdtorch.fdtd.assembly.heterogeneous import HeterogeneousCells
from autdtorch.fdtd.grid import Grid
from autdtorch.fdtd.stencil import OFFSETS
from autdtorch.fdtd.stepping import Assembly
from autdtorch.scene.arrays import Nodes
from autdtorch.utils.arrays import Array, Index
from autdtorch.utils.validation import LENGTH_TOLERANCE

_ALIKE = 1e-6
"""Rows that differ by less, relative to a face's weight, differ by rounding: as for places `LENGTH_TOLERANCE`
apart on a grid of 1 mm."""

_NONE = -1
"""Stands for the image of a point that is none of the points."""


@dataclass(frozen=True, eq=False)
class Symmetry:
    """One that a scene on its grid has.

    Attributes:
        matrix: signed permutation (3, 3).
        center: what it leaves where it is (3,) [m].
        transducers: transducer m comes to lie on transducer transducers[m] (M,).
    """

    matrix: Index
    center: Array
    transducers: Index

    def images(self, points: torch.Tensor) -> Index:
        """Which of the points (P, 3) [m] each one comes to lie on (P,), -1 where there is none."""
        if (self.matrix == np.eye(3)).all():
            return np.arange(len(points))
        return _matched(points[:, None].numpy(), np.ones(1), self.matrix, self.center)


@dataclass(frozen=True)
class Plan:
    """Which rows of a transfer matrix are simulated from points, or which columns from transducers.

    Attributes:
        backward: whether it is from points.
        stands: for each of them (n,) the one that stands for it, itself or one before.
        by: the symmetry that leads to that one (n,).
        images: what each symmetry makes of the entries of a row or column (S, k).
    """

    backward: bool
    stands: Index
    by: Index
    images: Index

    @property
    def runs(self) -> int:
        """How many simulations that takes."""
        return int((self.stands == np.arange(len(self.stands))).sum())


def backward_plan(points: torch.Tensor, symmetries: list[Symmetry]) -> Plan:
    """Rows of points (P, 3) [m] by the fewest simulations from points."""
    images = np.stack([symmetry.images(points) for symmetry in symmetries])
    return Plan(True, *_standing(images), np.stack([symmetry.transducers for symmetry in symmetries]))


def forward_plan(points: torch.Tensor, symmetries: list[Symmetry]) -> Plan:
    """Columns of transducers by the fewest simulations from them: images of all points must be points."""
    both = [(symmetry.images(points), symmetry.transducers) for symmetry in symmetries]
    images, transducers = zip(*[(own, to) for own, to in both if (own != _NONE).all()], strict=True)
    return Plan(False, *_standing(np.stack(transducers)), np.stack(images))


def _standing(images: Index) -> tuple[Index, Index]:
    """First image (n,) of each and the symmetry (n,) that leads there, from all images (S, n)."""
    known = np.where(images == _NONE, images.shape[1], images)
    return known.min(axis=0), known.argmin(axis=0)


def symmetries(assemblies: Sequence[Assembly], transducers: Nodes) -> list[Symmetry]:
    """All symmetries of a scene on its grid, the identity first; of several grids that alone."""
    assembly = assemblies[0]
    grid, varying = assembly.grid, assembly.heterogeneous
    center = np.array(grid.origin) + grid.spacing * (np.array(grid.shape) - 1) / 2
    alike = _ALIKE * assembly.stencil.face
    positions, weights = transducers.positions.numpy(), transducers.weights.numpy()
    found = [Symmetry(np.eye(3, dtype=np.int64), center, np.arange(len(positions)))]
    for matrix in itertools.islice(_signed_permutations(), 1, None if len(assemblies) == 1 else 1):
        images = _matched(positions, weights, matrix, center)
        if (images != _NONE).all() and _maps_cells(varying, grid, matrix, alike):
            found.append(Symmetry(matrix, center, images))
    return found


def _signed_permutations() -> Iterator[Index]:
    """All 48 matrices (3, 3), the identity first."""
    for axes in itertools.permutations(range(3)):
        for signs in itertools.product((1, -1), repeat=3):
            yield np.diag(signs) @ np.eye(3, dtype=np.int64)[list(axes)]


def _matched(groups: Array, weights: Array, matrix: Index, center: Array) -> Index:
    """Which group of places (N, n, 3) [m] with weights (n,) the image of each one is (N,), -1 for none."""
    count = len(weights)
    places = (groups - center).reshape(-1, 3)
    gap, nearest = KDTree(places).query(places @ matrix.T, distance_upper_bound=LENGTH_TOLERANCE)
    # what is not found is given the index one past the last
    group, node = np.divmod(np.where(np.isfinite(gap), nearest, 0), count)
    same = np.isfinite(gap) & (weights[node] == np.tile(weights, len(groups)))
    group, same = group.reshape(-1, count), same.reshape(-1, count)
    whole = same.all(axis=1) & (group == group[:, :1]).all(axis=1)
    return np.asarray(np.where(whole, group[:, 0], _NONE), np.int64)


def _maps_cells(varying: HeterogeneousCells, grid: Grid, matrix: Index, alike: float) -> bool:
    """Whether the cells that are not of air come to lie on such with the same rows and mass."""
    shape = np.array(grid.shape)
    if (np.abs(matrix) @ shape != shape).any():
        return False

    def image(cells: Index) -> Index:
        double = 2 * np.stack(np.unravel_index(cells, grid.shape), axis=-1) - (shape - 1)
        places = (double @ matrix.T + (shape - 1)) // 2
        return np.asarray(np.ravel_multi_index(tuple(places.T), grid.shape), np.int64)

    for cells in (varying.sound_hard, varying.shell):
        if not np.array_equal(np.sort(image(cells)), cells):
            return False
    images = image(varying.index)
    order = np.argsort(images)
    if not np.array_equal(images[order], varying.index):
        return False
    if not np.allclose(varying.mass, varying.mass[order], rtol=_ALIKE, atol=0):
        return False
    # the neighbour at an offset of the image is the image of the one at the offset turned back
    turned = (np.array(OFFSETS) @ matrix + 1) @ (9, 3, 1)
    return bool((np.abs(varying.weight - varying.weight[order][:, turned]) <= alike).all())
