"""The reference element: the cube between eight cell centres, its vertices.

The scheme is a sum over elements of a stiffness matrix, given by 28 coupling coefficients between pairs of
vertices, and of a lumped mass at each vertex. Lengths are in cells, densities and masses relative to air.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.constants import SUBCELLS
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array, Index

VERTICES = np.array(list(itertools.product((0, 1), repeat=3)))
"""Offsets of the eight vertices of an element [cells]."""

PAIRS = np.array(list(itertools.combinations(range(8), 2)))
"""The 28 pairs of vertices that are coupled."""

EDGES_BETWEEN = np.abs(VERTICES[PAIRS[:, 0]] - VERTICES[PAIRS[:, 1]])
"""Number of edges along each axis between the vertices of a pair (28, 3)."""

LATTICE = np.array(list(itertools.product(range(SUBCELLS + 1), repeat=3))) / SUBCELLS
"""Points of an element at which signed distances are needed (125, 3), from its first vertex [cells]."""

CORNERS = np.ravel_multi_index((VERTICES * SUBCELLS).T, (SUBCELLS + 1,) * 3)
"""Indices of the vertices in `LATTICE`."""


@dataclass(frozen=True)
class Materials:
    """Materials relative to air, which is number 0.

    Attributes:
        density: density (m,).
        mass: mass of a cell (m,).
        sound_hard: whether the material is sound-hard (m,).
    """

    density: Array
    mass: Array
    sound_hard: NDArray[np.bool_]

    @property
    def speed(self) -> Array:
        """Stencil weights over those of air (m,), about the square of the sound speed ratio."""
        return 1 / (self.density * self.mass)


@dataclass(frozen=True)
class InterfaceElements:
    """Contributions of n elements that surfaces intersect.

    Attributes:
        coupling: coupling coefficients of the `PAIRS` (n, 28).
        mass: lumped mass at the vertices (n, 8).
        material: number of the material at each vertex (n, 8).
    """

    coupling: Array
    mass: Array
    material: Index


def coupling_by_edges(stencil: Stencil) -> Array:
    """Return the coupling coefficients in air of vertices that are 0 to 3 edges apart (4,).

    Four elements share a face of the stencil, two share an edge.
    """
    return np.array((0.0, stencil.face / 4, stencil.edge / 2, stencil.corner))


def uniform_coupling(stencil: Stencil) -> Array:
    """Return the coupling coefficients (28,) of an element of air."""
    return np.asarray(coupling_by_edges(stencil)[EDGES_BETWEEN.sum(axis=1)])


def stiffness_matrix(coupling: Array) -> Array:
    """Return the stiffness matrices (n, 8, 8) of coupling coefficients (n, 28)."""
    matrix = np.zeros((len(coupling), 8, 8))
    matrix[:, PAIRS[:, 0], PAIRS[:, 1]] = -coupling
    matrix += matrix.transpose(0, 2, 1)
    matrix[:, range(8), range(8)] = -matrix.sum(axis=2)
    return matrix
