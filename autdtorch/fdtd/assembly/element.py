"""The reference element: the cube between eight cell centres, its vertices.

The scheme is a sum over elements of a stiffness matrix, given by 28 coupling coefficients between vertices,
and of a lumped mass at each vertex. Lengths are in cells, densities and masses relative to air.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array, Index

SUBCELLS = 4  # Sub-cells along each edge of an interface element, for the volume quadrature
FAR = 1e3  # Signed distance of a body that is too far from an element to matter
# Offsets of the eight vertices of an element [cells]
VERTICES = np.array(list(itertools.product((0, 1), repeat=3)))
PAIRS = np.array(list(itertools.combinations(range(8), 2)))  # The 28 pairs of vertices that are coupled
# Number of edges along each axis between the vertices of a pair (28, 3)
EDGES_BETWEEN = np.abs(VERTICES[PAIRS[:, 0]] - VERTICES[PAIRS[:, 1]])
# Points of an element at which signed distances are needed (125, 3), from its first vertex [cells]
LATTICE = np.array(list(itertools.product(range(SUBCELLS + 1), repeat=3))) / SUBCELLS
# Indices of the vertices in `LATTICE`
CORNERS = np.ravel_multi_index((VERTICES * SUBCELLS).T, (SUBCELLS + 1,) * 3)


@dataclass(frozen=True)
class Materials:
    """Materials relative to air, which is number 0."""

    density: Array  # density (m,)
    mass: Array  # mass of a cell (m,)
    slowness: Array  # wavenumber (m,), of sound-hard materials that of air
    sound_hard: NDArray[np.bool_]  # whether the material is sound-hard (m,)

    @property
    def speed(self) -> Array:
        """Stencil weights over those of air (m,), about the square of the sound speed ratio."""
        return 1 / (self.density * self.mass)


class InterfaceElements(NamedTuple):
    """Contributions of n elements that surfaces intersect."""

    coupling: Array  # coupling coefficients of the `PAIRS` (n, 28)
    mass: Array  # lumped mass at the vertices (n, 8)
    material: Index  # number of the material at each vertex (n, 8)
    finite: NDArray[np.bool_]  # whether it is a finite element, whose sound-hard vertices stay cells (n,)

    @classmethod
    def joined(cls, parts: Sequence[InterfaceElements]) -> InterfaceElements:
        """Return the elements of several parts in their order."""
        return cls(*(np.concatenate(each) for each in zip(*parts, strict=True)))

    def chosen(self, some: Index) -> InterfaceElements:
        """Return some of the elements."""
        return InterfaceElements(self.coupling[some], self.mass[some], self.material[some], self.finite[some])


def coupling_by_edges(stencil: Stencil) -> Array:
    """Return the coupling (4,) in air by edges between vertices; 4 elements share a face, 2 an edge."""
    return np.array((0.0, stencil.face / 4, stencil.edge / 2, stencil.corner))


def uniform_coupling(stencil: Stencil) -> Array:
    """Return the coupling coefficients (28,) of an element of air."""
    return np.asarray(coupling_by_edges(stencil)[EDGES_BETWEEN.sum(axis=1)])


def stiffness_matrix(coupling: Array, pairs: Index = PAIRS) -> Array:
    """Return the stiffness matrices (..., v, v) of coupling coefficients (..., k) of pairs of vertices."""
    size = int(pairs.max()) + 1
    matrix = np.zeros((*coupling.shape[:-1], size, size))
    matrix[..., pairs[:, 0], pairs[:, 1]] = -coupling
    matrix += matrix.swapaxes(-2, -1)
    matrix[..., range(size), range(size)] = -matrix.sum(axis=-1)
    return matrix
