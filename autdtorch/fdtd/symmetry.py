"""Symmetries of a scene on its grid, and the runs that they make unnecessary.

A symmetry maps heterogeneous cells onto cells with equal stencil rows, and transducers onto transducers. It
is one of the 48 signed permutations of the axes about the grid's centre. Stencil rows contain all effects of
obstacles, their order, the domain and the absorbing layers, so only rows are compared. For any symmetry S the
transfer matrix satisfies G[p, m] = G[S p, S m].
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import KDTree

from autdtorch.fdtd.assembly.heterogeneous import HeterogeneousCells
from autdtorch.fdtd.grid import Grid
from autdtorch.fdtd.stencil import OFFSETS, places_of
from autdtorch.fdtd.stepping import Assembly
from autdtorch.utils.apertures import Apertures, Discs
from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.mirror_images import Mirror
from autdtorch.utils.validation import LENGTH_TOLERANCE

# Largest difference of equal stencil rows, relative to the weight of a face: on a grid of 1 mm, shifts by
# `LENGTH_TOLERANCE` cause it
_ROUNDING = 1e-6
_TURNED = 1e-9  # Difference of equal unit normals
_NONE = -1  # Index of an image that is none of the points


@dataclass(frozen=True, eq=False)
class Symmetry:
    """A symmetry: an orthogonal matrix (3, 3), its fixed point (3,) [m] and the transducers' images (M,)."""

    matrix: Array
    center: Array
    transducers: Index

    def images(self, points: torch.Tensor) -> Index:
        """Return the index (P,) of the point that each of the points (P, 3) [m] is mapped to, or -1."""
        if (self.matrix == np.eye(3)).all():
            return np.arange(len(points))
        return _matched(points.numpy(), self.matrix, self.center)

    def keeps(self, mirrors: Sequence[Mirror]) -> bool:
        """Return whether it maps each mirror to one of the same reflection."""
        others = [(np.array(mirror.point), np.array(mirror.normal), mirror.reflection) for mirror in mirrors]
        for point, normal, reflection in others:
            moved, turned = self.matrix @ (point - self.center) + self.center, self.matrix @ normal
            if not any(
                reflection == factor
                and np.abs(turned - other).max() < _TURNED
                and abs((moved - place) @ other) < LENGTH_TOLERANCE
                for place, other, factor in others
            ):
                return False
        return True


@dataclass(frozen=True)
class Orbits:
    """Symmetry orbits of n sources, points (by reciprocity) or transducers: one run serves an orbit.

    The representative (n,) of each source is the first of its orbit; `symmetry` (n,) maps the source to it.
    Each symmetry maps each of k receivers to another, `images` (S, k).
    """

    from_points: bool
    representative: Index
    symmetry: Index
    images: Index

    @property
    def representatives(self) -> Index:
        """Indices (runs,) of the sources to simulate."""
        return np.flatnonzero(self.representative == np.arange(len(self.representative)))

    @property
    def runs(self) -> int:
        """Number of simulations."""
        return len(self.representatives)

    def expand(self, rows: torch.Tensor) -> torch.Tensor:
        """Return rows (n, k), the pressure at k receivers, of all sources from those of representatives."""
        place = np.searchsorted(self.representatives, self.representative)
        return rows[torch.from_numpy(place)[:, None], torch.from_numpy(self.images[self.symmetry])]


def orbits_of_points(points: torch.Tensor, symmetries: Sequence[Symmetry]) -> Orbits:
    """Return the orbits of points (P, 3) [m] as sources."""
    images = np.stack([symmetry.images(points) for symmetry in symmetries])
    return Orbits(True, *_representatives(images), np.stack([each.transducers for each in symmetries]))


def orbits_of_transducers(points: torch.Tensor, symmetries: Sequence[Symmetry]) -> Orbits:
    """Return the orbits of transducers as sources, by the symmetries that map the points onto themselves."""
    pairs = [(symmetry.images(points), symmetry.transducers) for symmetry in symmetries]
    images, transducers = zip(*[pair for pair in pairs if (pair[0] != _NONE).all()], strict=True)
    return Orbits(False, *_representatives(np.stack(transducers)), np.stack(images))


def orbits_of_array(symmetries: Sequence[Symmetry]) -> tuple[Index, Index]:
    """Return the representative (M,) of each transducer, and the symmetry (M,) that maps it there."""
    return _representatives(np.stack([symmetry.transducers for symmetry in symmetries]))


def _representatives(images: Index) -> tuple[Index, Index]:
    """First image (n,) of each source and the symmetry (n,) that maps to it, from all images (S, n)."""
    known = np.where(images == _NONE, images.shape[1], images)
    return known.min(axis=0), known.argmin(axis=0)


def symmetries(assemblies: Sequence[Assembly], along: Array, transducers: Apertures) -> list[Symmetry]:
    """Return all symmetries of a scene on its grid, the identity first; only that on several grids.

    `along` holds the axes of the grid, one a row (3, 3).
    """
    assembly = assemblies[0]
    grid, cells = assembly.grid, assembly.heterogeneous
    center = (np.array(grid.origin) + grid.spacing * (np.array(grid.shape) - 1) / 2) @ along
    result = [Symmetry(np.eye(3), center, np.arange(len(transducers.centers)))]
    turns = itertools.product(itertools.permutations(range(3)), itertools.product((1, -1), repeat=3))
    for axes, signs in itertools.islice(turns, 1, None if len(assemblies) == 1 else 1):
        turn = np.diag(signs) @ np.eye(3, dtype=np.int64)[list(axes)]
        if (np.abs(turn) @ grid.shape != grid.shape).any():
            continue
        matrix = along.T @ turn @ along
        images = _matched_places(transducers.places, matrix, center)
        if (images != _NONE).all() and _maps_cells(cells, grid, turn, _ROUNDING * assembly.stencil.face):
            result.append(Symmetry(matrix, center, images))
    return result


def _matched_places(places: torch.Tensor | Discs, matrix: Array, center: Array) -> Index:
    """Map points (N, 3) [m] or discs; return the number (N,) of each image, or -1."""
    if not isinstance(places, Discs):
        return _matched(places.numpy(), matrix, center)
    centers, normals, radii = (part.numpy() for part in places)
    images = _matched(centers, matrix, center)
    turned, others = normals @ matrix.T, normals[images]
    apart = np.minimum(np.abs(turned - others).max(axis=1), np.abs(turned + others).max(axis=1))
    return np.where((apart < _TURNED) & (radii == radii[images]), images, _NONE)


def _matched(points: Array, matrix: Array, center: Array) -> Index:
    """Map points (N, 3) [m]; return the number (N,) of each image, or -1."""
    places = points - center
    gap, nearest = KDTree(places).query(places @ matrix.T, distance_upper_bound=LENGTH_TOLERANCE)
    return np.asarray(np.where(np.isfinite(gap), nearest, _NONE), np.int64)


def _maps_cells(cells: HeterogeneousCells, grid: Grid, matrix: Index, rounding: float) -> bool:
    """Return whether a turn maps heterogeneous cells onto cells with equal rows, mass and losses."""
    shape = np.array(grid.shape)

    def image(index: Index) -> Index:
        double = 2 * places_of(index, grid.shape) - (shape - 1)
        places = (double @ matrix.T + (shape - 1)) // 2
        return np.asarray(np.ravel_multi_index(tuple(places.T), grid.shape), np.int64)

    if not all(np.array_equal(np.sort(image(hard)), hard) for hard in (cells.rigid, cells.shell)):
        return False
    images = image(cells.index)
    order = np.argsort(images)
    same_mass = np.allclose(cells.mass, cells.mass[order], rtol=_ROUNDING, atol=0)
    if not (np.array_equal(images[order], cells.index) and same_mass):
        return False
    # a neighbour of an image is the image of the neighbour at the offset mapped back
    turned = (np.array(OFFSETS) @ matrix + 1) @ (9, 3, 1)
    if not (np.abs(cells.weight - cells.weight[order][:, turned]) <= rounding).all():
        return False
    if not len(cells.lossy):
        return True
    losses = cells.loss_rows
    images_of_losses = losses[order][:, [*turned, 27, 28]]
    return bool((np.abs(losses - images_of_losses) <= rounding).all())
