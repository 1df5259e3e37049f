"""The Huygens surface of a grid: the cells of two shells, whose phasors radiate the field within them.

Between the shells chi steps from 1 to 0. The cells radiate sum_j w_ij (chi_j - chi_i) p_j by the exact
Green's function: the sources of a field that is p outside and zero inside.

On a face, cells receive from the plane across the step alone, with a symbol W(kx, ky) of the weights. A plane
wave that leaves at kz is radiated as W sin(kz) / kz times itself. With the stencil's weights this differs
from 1 by up to 3e-4 at 9 cells per wavelength, depending on the direction. Behind a large body, where
incident and scattered field cancel, that would be 1 % of what is left. Weights of 25 cells are within 1e-6,
and at 4 cells per wavelength within 1e-4. Next to edges of the surface the stencil's stay.

The wave from a place on a face to a distant receiver is smooth along the face: its values at Chebyshev nodes
give it anywhere. Transposed, this interpolation moves the amplitudes of cells to a few nodes (`FaceNodes`).
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor

from autdtorch.fdtd.grid import Grid
from autdtorch.fdtd.stencil import OFFSETS, Stencil, flat_strides, places_of
from autdtorch.utils.array_types import Array, Index, triple
from autdtorch.utils.process import cached_property, parts_of_size, spread
from autdtorch.utils.spatial import places_among

# Wavenumbers along a face up to which its weights are fitted, relative to air's, and the weight of those
# above 1: waves that decay
_FARTHEST, _DECAYING = 1.2, 0.1
_SIZES, _TURNS = 61, 9  # Wavenumbers of the fit: sizes, and directions in an eighth of a turn
_CELLS = 2**15  # Cells that are looked at together
_ALIKE = 19  # Cells along an axis, the middle one of which has the weights of all farther from the ends
_DISTANCE = np.abs(np.array(OFFSETS)).sum(axis=1)
_STRAIGHT = np.flatnonzero(_DISTANCE == 1)  # neighbours across faces, in the order of `OFFSETS`
# Places along a face of the weights, up to symmetry: those among the neighbours, and those farther away
_NEAR, _FAR = ((0, 0), (1, 0), (1, 1)), ((2, 0), (2, 1), (3, 0))

# Nodes along a face, over the phase [rad] of a wave across half of it, and beside it. Fields of the nodes are
# within 2e-6 of those of the cells.
_PER_PHASE, _MORE = 1.15, 8
_CLEAR = 1.5  # Least distance [wavelengths] of receivers; evanescent waves have decayed there


@dataclass(frozen=True)
class HuygensSurface:
    """The cells that radiate, and how."""

    cells: Index  # flat indices (n,), two and three cells from the rim of the interior
    weights: csr_array  # of the cells' phasors (n, n), real
    factor: complex  # on these, for amplitudes [m]

    @classmethod
    def of(cls, grid: Grid, stencil: Stencil, scale: float, steps_per_period: float) -> Self:
        """Return the surface of a grid; `scale` is the ratio of its coefficients in air to the stencil's."""
        cells = _radiating(grid)
        place = places_among(cells, math.prod(grid.shape))
        small = replace(grid, interior=triple(min(count, _ALIKE) for count in grid.interior))
        weight, offset = _rows(small, stencil, flat_strides(grid.shape))
        alike = _among_rows(grid, small, cells)
        width = np.count_nonzero(weight, axis=1)

        def taken(ends: tuple[int, int]) -> tuple[NDArray[np.int32], Array]:
            rows = alike[slice(*ends)]
            some = np.arange(weight.shape[1]) < width[rows, None]
            beside = (cells[slice(*ends), None] + offset[rows])[some]
            return place[beside], weight[rows][some]

        places, weights = zip(*spread(taken, parts_of_size(len(cells), _CELLS)), strict=True)
        first_of_row = np.concatenate(([0], np.cumsum(width[alike]))).astype(place.dtype)
        parts = np.concatenate(weights), np.concatenate(places), first_of_row
        factor = scale * grid.spacing / stencil.source_factor(steps_per_period)
        return cls(cells, csr_array(parts, (len(cells), len(cells))), factor)

    def of_phasors(self, phasors: Tensor) -> Tensor:
        """Return amplitudes (n, R) [Pa m] from the phasors (n, R) [Pa] of the cells, on their device."""
        values = torch.view_as_real(phasors.contiguous()).flatten(1)
        if values.is_cuda:
            amplitude = self._weights_on_gpu @ values
        else:
            amplitude = torch.from_numpy(self.weights @ values.numpy())
        return self.factor * torch.view_as_complex(amplitude.reshape(len(self.cells), -1, 2))

    @cached_property
    def _weights_on_gpu(self) -> Tensor:
        parts = self.weights.indptr, self.weights.indices, self.weights.data
        first_of_row, place, weight = (torch.from_numpy(part).cuda() for part in parts)
        with warnings.catch_warnings():  # that PyTorch may change its sparse matrices
            warnings.simplefilter("ignore", UserWarning)
            return torch.sparse_csr_tensor(first_of_row, place, weight, self.weights.shape)


def _radiating(grid: Grid) -> Index:
    """Return the flat indices (n,) of the cells two and three from the rim of the interior."""
    radiating = np.zeros(grid.shape, bool)
    radiating[grid.deeper(2)], radiating[grid.deeper(4)] = True, False
    return np.flatnonzero(radiating)


def _rows(grid: Grid, stencil: Stencil, strides: Index) -> tuple[Array, Index]:
    """Return weights (n, w) of the cells about each one that radiates, zeros last, and where they are (n, w).

    These are flat offsets in a grid of other `strides`.
    """
    cells, chi = _radiating(grid), np.zeros(grid.shape, np.int8)
    chi[grid.deeper(3)] = 1
    radiating, flat, among = np.isin(np.arange(chi.size), cells), chi.ravel(), flat_strides(grid.shape)
    near, beside = np.array(OFFSETS), _farther_beside()
    step = flat[cells[:, None] + near @ among] - flat[cells, None]
    straight = step[:, _STRAIGHT]
    farther = beside[np.abs(straight).argmax(axis=1)]
    far = cells[:, None] + farther @ among
    ahead = flat[far] - flat[cells, None]
    on_face = (np.count_nonzero(step, axis=1) == 9) & radiating[far].all(axis=1)
    on_face &= (ahead == straight.sum(axis=1)[:, None]).all(axis=1)
    of_face = face_weights(stencil)
    on_near = np.append(0.0, of_face[: len(_NEAR)])[_DISTANCE]
    on_far = np.repeat(of_face[len(_NEAR) :], [len(_alike(each)) for each in _FAR])
    weight = np.where(on_face[:, None], on_near, stencil.weights) * step
    weight = np.concatenate((weight, np.where(on_face[:, None], on_far * ahead, 0.0)), axis=1)
    offset = np.concatenate((np.tile(near @ strides, (len(cells), 1)), farther @ strides), axis=1)
    order = np.argsort(weight == 0, axis=1, kind="stable")[:, : np.count_nonzero(weight, axis=1).max()]
    return np.take_along_axis(weight, order, axis=1), np.take_along_axis(offset, order, axis=1)


def _among_rows(grid: Grid, small: Grid, cells: Index) -> NDArray[np.int32]:
    """Return for each cell of a grid its like (n,) among those of a `small` one, cut in the middle."""
    shape, fewer = np.array(grid.shape), np.array(small.shape)
    places = places_of(cells, grid.shape)
    folded = np.minimum(places, np.maximum(fewer // 2, places - (shape - fewer)))
    place = places_among(_radiating(small), math.prod(small.shape))
    return np.asarray(place[folded @ flat_strides(small.shape)], np.int32)


@lru_cache(maxsize=64)
def face_weights(stencil: Stencil) -> Array:
    """Return the weights (w,) of cells across the step, at the places of `_NEAR` and `_FAR`.

    Least squares of W sin(kz) / kz for waves along the face of all directions and of wavenumbers kx, ky up to
    `_FARTHEST`: kz is imaginary above air's.
    """
    kappa, turn = stencil.kappa, np.linspace(0, np.pi / 4, _TURNS)[:, None]
    size = np.linspace(0, _FARTHEST, _SIZES)
    x, y = kappa * size * np.cos(turn), kappa * size * np.sin(turn)
    across = np.sqrt(np.asarray(kappa**2 * (1 - size**2), np.complex128))
    ratio = np.broadcast_to(np.sinc(across / np.pi).real, x.shape)  # sin(kz) / kz
    symbol = np.stack([face_symbol(place, x, y) for place in _NEAR + _FAR], axis=-1)
    weight = np.sqrt(size) * np.where(size <= 1, 1, _DECAYING)  # as many waves as of a size
    weight = np.broadcast_to(weight, x.shape).ravel()
    system = (symbol * ratio[..., None]).reshape(len(weight), -1) * weight[:, None]
    fit, *_ = np.linalg.lstsq(system, weight)
    return np.asarray(fit * (stencil.slope / (2 * complex(kappa, stencil.eta))).real)


def face_symbol(place: tuple[int, int], x: Array, y: Array) -> Array:
    """Return the sum of waves (...) of phases x and y (...) [rad/cell] over all cells alike a place."""
    return np.asarray(sum(np.cos(x * first + y * second) for first, second in _alike(place)))


def _alike(place: tuple[int, int]) -> list[tuple[int, int]]:
    """Return the places along a face that are alike one by symmetry."""
    images = itertools.product(set(itertools.permutations(place)), (-1, 1), (-1, 1))
    return sorted({(a * x, b * y) for (x, y), a, b in images})


def _farther_beside() -> Index:
    """Return the offsets (6, n, 3), by `_STRAIGHT` neighbour, of the cells at `_FAR` places beside it."""
    offsets = np.array(OFFSETS)[_STRAIGHT]
    beside = np.array([each for place in _FAR for each in _alike(place)])
    lateral = [np.eye(3, dtype=np.int64)[offset == 0] for offset in offsets]
    return np.stack([offset + beside @ each for offset, each in zip(offsets, lateral, strict=True)])


@dataclass(frozen=True)
class FaceNodes:
    """Few nodes that radiate like the cells of a Huygens surface, to receivers at a distance.

    Attributes:
        positions: along the axes of the grid (m, 3) [m].
        faces: of each layer of a face, the cells (A, B) by their place in the surface, on a device. Weights
            (a, A) and (b, B) move amplitudes to its nodes (a, b).
        bounds: lower and upper corner of the surface, along the axes of the grid [m].
        clearance: least distance of receivers from the surface [m].
    """

    positions: Array
    faces: Sequence[Sequence[Tensor]]
    bounds: tuple[Array, Array]
    clearance: float

    @classmethod
    def of(cls, grid: Grid, surface: Index, wavenumber: float, device: str = "cpu") -> Self:
        """Return the nodes of a surface, by the flat indices (n,) of its cells.

        These are two and three cells from the rim of the interior.
        """
        place = np.zeros(grid.shape, np.int64)
        place.ravel()[surface] = np.arange(len(surface))
        positions, faces = [], []
        for axis in range(3):  # edges go to the first axis that has them
            depths = [4 if index < axis else 2 for index in range(3)]
            ends = zip(grid.first, grid.last, depths, strict=True)
            cells = [np.arange(first + depth, last - depth) for first, last, depth in ends]
            one, other = (index for index in range(3) if index != axis)
            (along, first), (across, second) = (
                _nodes(cells[index], wavenumber * grid.spacing) for index in (one, other)
            )
            for layer in np.unique(np.concatenate([cells[axis][:2], cells[axis][-2:]])):
                cells[axis] = np.array([layer])
                inside = place[np.ix_(*cells)].squeeze(axis)
                faces.append([torch.from_numpy(part).to(device) for part in (inside, first, second)])
                node = np.empty((len(along), len(across), 3))
                node[..., axis], node[..., one], node[..., other] = layer, along[:, None], across
                positions.append(node.reshape(-1, 3))
        bounds = np.array(grid.first) + 2, np.array(grid.last) - 3
        lower, upper, everywhere = (
            grid.origin + grid.spacing * each for each in (*bounds, np.concatenate(positions))
        )
        return cls(everywhere, faces, (lower, upper), _CLEAR * 2 * math.pi / wavenumber)

    def reach(self, points: Array, radii: Array | float = 0.0) -> NDArray[np.bool_]:
        """Return which points (P, 3) [m], or discs about them, are far enough, along the axes of the grid."""
        lower, upper = self.bounds
        apart = np.maximum(np.maximum(lower - points, points - upper), 0)
        return np.asarray(np.linalg.norm(apart, axis=1) >= self.clearance + radii)

    def amplitudes(self, amplitude: Tensor) -> Tensor:
        """Return the amplitudes (m, R) of the nodes, on the CPU, from those (n, R) of the cells."""
        values = torch.view_as_real(amplitude.to(self.faces[0][0].device)).flatten(1)
        parts = []
        for cells, first, second in self.faces:
            moved = first @ values[cells].flatten(1)
            moved = second @ moved.reshape(len(first), cells.shape[1], -1)
            parts.append(moved.flatten(0, 1))
        return torch.view_as_complex(torch.cat(parts).reshape(-1, *amplitude.shape[1:], 2).cpu())


def _nodes(cells: Index, phase: float) -> tuple[Array, Array]:
    """Return nodes (a,) along cells (A,), in cells, and the values (a, A) of their polynomials at the cells.

    A wave advances by `phase` [rad] over a cell.
    """
    half = (len(cells) - 1) / 2
    count = math.ceil(_PER_PHASE * phase * half) + _MORE
    if count >= len(cells):
        return cells.astype(float), np.eye(len(cells))
    angle = (2 * np.arange(count) + 1) * np.pi / (2 * count)
    nodes, sign = np.cos(angle), np.sin(angle) * (-1.0) ** np.arange(count)
    apart = (cells - cells.mean()) / half - nodes[:, None]
    terms = sign[:, None] / np.where(apart == 0, 1e-99, apart)  # barycentric
    return cells.mean() + half * nodes, terms / terms.sum(axis=0)


def row_matrix(weight: Array, place: NDArray[np.int32], count: int) -> csr_array:
    """Return the matrix (h, count) of rows (h, w) of weights, of cells by their place (h, w)."""
    first_of_row = np.arange(0, weight.size + 1, weight.shape[1], dtype=place.dtype)
    return csr_array((weight.ravel(), place.ravel(), first_of_row), (len(weight), count))
