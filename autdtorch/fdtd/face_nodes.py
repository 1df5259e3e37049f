"""Few nodes that radiate like the cells of a Huygens surface, to receivers at a distance.

The wave from a place on a face to a distant receiver is smooth along the face: its values at Chebyshev nodes
give it anywhere. Transposed, this interpolation moves the amplitudes of cells to the nodes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from autdtorch.fdtd.grid import Grid
from autdtorch.utils.array_types import Array, Index

# Nodes along a face, over the phase [rad] of a wave across half of it, and beside it. Fields of the nodes are
# within 2e-6 of those of the cells.
_PER_PHASE, _MORE = 1.15, 8
_CLEAR = 1.5  # Least distance [wavelengths] of receivers; evanescent waves have decayed there


@dataclass(frozen=True)
class FaceNodes:
    """The nodes of all faces.

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
