"""The reference element, the cube between eight cell centres, and the shares of materials in its parts.

The scheme is a sum over elements of a stiffness matrix, with 28 coupling coefficients between vertices,
and of a lumped mass at each vertex. Lengths are in cells, densities and masses relative to air.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array, Index

SUBCELLS = 4  # Sub-cells along each edge of an interface element, for the volume quadrature
FAR = 1e3  # Signed distance of a body that is too far from an element to matter
# Offsets of the eight vertices of an element [cells]
VERTICES = np.array(list(itertools.product((0, 1), repeat=3)))
PAIRS = np.array(list(itertools.combinations(range(8), 2)))  # The 28 pairs of vertices that are coupled
PAIR_OF = np.zeros((8, 8), np.int64)  # Number of each pair of vertices in `PAIRS`; 0 of a vertex and itself
PAIR_OF[PAIRS[:, 0], PAIRS[:, 1]] = PAIR_OF[PAIRS[:, 1], PAIRS[:, 0]] = np.arange(len(PAIRS))
# Number of edges along each axis between the vertices of a pair (28, 3)
EDGES_BETWEEN = np.abs(VERTICES[PAIRS[:, 0]] - VERTICES[PAIRS[:, 1]])
# Points of an element at which signed distances are measured (125, 3), from its first vertex [cells]
LATTICE = np.array(list(itertools.product(range(SUBCELLS + 1), repeat=3))) / SUBCELLS
SUBCENTERS = (np.array(list(np.ndindex((SUBCELLS,) * 3))) + 0.5) / SUBCELLS  # Centres of sub-cells (64, 3)
# Indices of the vertices in `LATTICE`
CORNERS = np.ravel_multi_index((VERTICES * SUBCELLS).T, (SUBCELLS + 1,) * 3)

_ALIKE = 0.1  # Difference of two densities over their sum at which they are half alike


class MaterialLosses(NamedTuple):
    """Losses of materials relative to air, which is number 0; see `losses.py`."""

    coupling: Array  # damping coefficients over the coupling of air (m,)
    mass: Array  # damping coefficient of a cell beyond air's (m,)
    tangent: float  # largest ratio of `coupling` to the coupling itself
    admittance: NDArray[np.complex128]  # of the surface (m,); zero where it is rigid or a fluid's
    variants: tuple[Materials, ...]  # materials without loss, from which elements are continued


@dataclass(frozen=True)
class Materials:
    """Materials relative to air, which is number 0."""

    density: Array  # density (m,)
    mass: Array  # mass of a cell (m,)
    slowness: Array  # wavenumber (m,), 1 for rigid materials
    rigid: NDArray[np.bool_]  # mask of the rigid materials (m,)
    losses: MaterialLosses | None = None  # None if nothing absorbs

    @property
    def reacting(self) -> NDArray[np.bool_]:
        """Mask of the materials whose surface has an impedance (m,)."""
        nothing = np.zeros(len(self.rigid), bool)
        return nothing if self.losses is None else np.asarray(self.losses.admittance != 0)

    def alike(self, one: int, other: int) -> float:
        """Return how much two fluids are alike: 1 for equal densities, 0 for very different ones."""
        first, second = self.density[[one, other]]
        return float(1 / (1 + ((first - second) / (first + second) / _ALIKE) ** 2))

    @property
    def speed(self) -> Array:
        """Stencil weights over those of air (m,), about the square of the sound speed ratio."""
        return 1 / (self.density * self.mass)


class InterfaceElements(NamedTuple):
    """Contributions of n elements that surfaces intersect."""

    coupling: Array  # coupling coefficients of the `PAIRS` (n, 28)
    mass: Array  # lumped mass at the vertices (n, 8)
    material: Index  # number of the material at each vertex (n, 8)
    finite: NDArray[np.bool_]  # mask of finite elements, whose rigid vertices remain cells (n,)
    flat: NDArray[np.bool_]  # mask of elements of which all faces are parallel to the grid (n,)
    # damping of the pairs and vertices, and the vertices' stiffness (n, 44); none (n, 0) if nothing absorbs
    loss: Array

    @classmethod
    def joined(cls, parts: Sequence[InterfaceElements]) -> InterfaceElements:
        """Return the elements of several parts in their order."""
        return cls(*(np.concatenate(each) for each in zip(*parts, strict=True)))

    def chosen(self, some: Index | slice) -> InterfaceElements:
        """Return some of the elements."""
        parts: list[Any] = [part[some] for part in self]
        return InterfaceElements(*parts)


def hats(places: Array) -> Array:
    """Return the trilinear functions (..., 8) of the vertices at places (..., 3) from the first [cells]."""
    return np.asarray(_factors(places).prod(axis=-1))


def hat_slopes(places: Array, axis: int) -> Array:
    """Return the derivatives (..., 8) of these functions along an axis."""
    factors = _factors(places)
    factors[..., axis] = 2 * VERTICES[:, axis] - 1
    return np.asarray(factors.prod(axis=-1))


def _factors(places: Array) -> Array:
    return np.where(VERTICES == 1, places[..., None, :], 1 - places[..., None, :])


HATS = hats(SUBCENTERS)  # Those functions at the centres of the sub-cells (64, 8)
SLOPES = np.stack([hat_slopes(SUBCENTERS, axis) for axis in range(3)], axis=2)  # Their gradients (64, 8, 3)


def coupling_by_edges(stencil: Stencil) -> Array:
    """Return the coupling (4,) in air by edges between vertices; 4 elements share a face, 2 an edge."""
    return np.array((0.0, stencil.face / 4, stencil.edge / 2, stencil.corner))


def uniform_coupling(stencil: Stencil) -> Array:
    """Return the coupling coefficients (28,) of an element of air."""
    return np.asarray(coupling_by_edges(stencil)[EDGES_BETWEEN.sum(axis=1)])


def tend_to_mean(
    values: Sequence[Array], some: Index, singles: Sequence[Sequence[Array]], part: Array, alike: float
) -> None:
    """Change values of elements at the seam of two fluids towards the mean of elements of each of the two.

    Args:
        values: arrays of all elements, to be changed.
        some: the rows of these that change (k,).
        singles: of each fluid, these rows of the elements with it in place of both.
        part: of each fluid in the elements (k, 2).
        alike: how much the fluids are alike; see `Materials.alike`.
    """
    for number, value in enumerate(values):
        value[some] *= 1 - alike
        for weight, single in zip(alike * part.T[:, :, None], singles, strict=True):
            value[some] += weight * single[number]


def stiffness_matrix(coupling: Array, pairs: Index = PAIRS) -> Array:
    """Return the stiffness matrices (..., v, v) of coupling coefficients (..., k) of pairs of vertices."""
    size = int(pairs.max()) + 1
    matrix = np.zeros((*coupling.shape[:-1], size, size))
    matrix[..., pairs[:, 0], pairs[:, 1]] = -coupling
    matrix += matrix.swapaxes(-2, -1)
    matrix[..., range(size), range(size)] = -matrix.sum(axis=-1)
    return matrix


def tuning_of(stencil: Stencil) -> Array:
    """Return the stiffness (8, 8) of an element of air, less the one by trilinear functions."""
    trilinear = np.einsum("qix,qjx->ij", SLOPES, SLOPES) / SUBCELLS**3
    return np.asarray(stiffness_matrix(uniform_coupling(stencil)) - trilinear)


_PRODUCTS = np.einsum("qix,qjx->qij", SLOPES, SLOPES)[:, PAIRS[:, 0], PAIRS[:, 1]]


def cut_coupling(mobility: Array, stencil: Stencil) -> Array:
    """Return the coupling (n, 28) of finite elements, from the mobility of their sub-cells (n, 64)."""
    tuning = tuning_of(stencil)[PAIRS[:, 0], PAIRS[:, 1]]
    return np.asarray(-(mobility @ _PRODUCTS) - np.outer(mobility.sum(axis=1), tuning))


def without_negative(matrices: Array) -> Array:
    """Return symmetric matrices (..., m, m) without their negative eigenvalues."""
    value, vector = np.linalg.eigh(matrices)
    positive = (vector * np.maximum(value, 0)[..., None, :]) @ vector.mT
    return np.where(value[..., :1, None] < 0, positive, matrices)


# Eigenvalues below this share of the largest are rounding in a condensed stiffness matrix. A higher value
# would remove energy from nearly constant pressures.
_NULL_EIGENVALUE = 1e-10


def without_vertices(coupling: Array, gone: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Eliminate vertices `gone` (n, 8) from the coupling of elements (n, 28) by static condensation.

    Their pressures take the values of least energy. Also returns the shares (n, 8, 8) of the others in them.
    """
    matrix = stiffness_matrix(coupling)
    both = gone[:, :, None] & gone[:, None, :]
    inverse = np.linalg.pinv(np.where(both, matrix, 0), rcond=_NULL_EIGENVALUE, hermitian=True)
    across = np.where(gone[:, None, :], matrix, 0)
    matrix = matrix - across @ inverse @ across.transpose(0, 2, 1)
    matrix[gone[:, :, None] | gone[:, None, :]] = 0
    return -matrix[:, PAIRS[:, 0], PAIRS[:, 1]], -inverse @ across.transpose(0, 2, 1)


_FROM, _TO = VERTICES[PAIRS[:, 0], None], VERTICES[PAIRS[:, 1], None]
_ALONG = SUBCELLS * _FROM + np.arange(SUBCELLS + 1)[:, None] * (_TO - _FROM)
# Indices in the lattice of the points along the line between each pair of vertices (28, 5)
_LINES = np.ravel_multi_index(tuple(np.moveaxis(_ALONG, -1, 0)), (SUBCELLS + 1,) * 3)


def distance_to_material(distance: Array, material: Index, inner: Index) -> Array:
    """Return the signed distance (n, 125) to the region of material `inner` (n,), cut by later bodies."""
    level = np.broadcast_to(np.where(inner == 0, -FAR, FAR)[:, None], distance.shape[1:])
    for far, number in zip(distance, material, strict=True):
        same = (inner == number)[:, None]
        level = np.where(same, np.minimum(level, far), np.maximum(level, -far))
    return level


def subcell_means(values: Array) -> Array:
    """Return the means (n, 64) of lattice values (n, 125) over the corners of each sub-cell."""
    return np.asarray(_over_subcells(values)[0])


def subcell_gradients(values: Array) -> Array:
    """Return the gradients (n, 64, 3) of lattice values (n, 125) in each sub-cell."""
    return np.asarray(SUBCELLS * np.moveaxis(_over_subcells(values)[1:], 0, -1))


def volume_coverage(distance: Array) -> Array:
    """Return the share of each sub-cell (..., 64) inside a body, exact for axis-aligned faces."""
    from autdtorch.fdtd.assembly.element_kernels import cover_subcells  # loads numba

    covered = np.empty((*distance.shape[:-1], SUBCELLS**3))
    rows = np.ascontiguousarray(distance.reshape(-1, len(LATTICE)))
    cover_subcells(rows, covered.reshape(-1, SUBCELLS**3))
    return covered


def _over_subcells(values: Array) -> Array:
    """Return means (4, ..., 64) of lattice values (..., 125) and of their slopes over sub-cells' corners."""
    parts = [values.reshape(*values.shape[:-1], *(SUBCELLS + 1,) * 3)]
    for axis in (-3, -2, -1):
        ends = [np.moveaxis(part, axis, 0) for part in parts]
        means = [np.moveaxis((part[:-1] + part[1:]) / 2, 0, axis) for part in ends]
        parts = [*means, np.moveaxis(ends[0][1:] - ends[0][:-1], 0, axis)]
    return np.stack(parts).reshape(4, *values.shape[:-1], SUBCELLS**3)


def line_coverage(distance: Array) -> Array:
    """Return the share inside a body of each quarter of the lines between vertices (..., 112)."""
    ends = distance[..., _LINES]
    low = np.minimum(ends[..., :-1], ends[..., 1:])
    high = np.maximum(ends[..., :-1], ends[..., 1:])
    share = np.clip(-low / np.maximum(high - low, 1e-12), 0, 1)
    return np.asarray(share.reshape(*distance.shape[:-1], -1))


def shares(coverage: Callable[[Array], Array], distance: Array, material: Index, count: int) -> Array:
    """Return the share of each material (n, q, count) in the q parts that `coverage` divides an element into.

    Distances are (K, n, 125) [cells]. A later body replaces the earlier ones where it is, as far as the union
    of all does not grow: of bodies that touch it replaces nothing, and no air is left between them.
    """
    covered = coverage(distance)
    share = np.zeros((*covered.shape[1:], count))
    union = np.zeros(covered.shape[1:])
    for body, (cover, number) in enumerate(zip(covered, material, strict=True)):
        joint = coverage(distance[: body + 1].min(axis=0)) if body else cover
        both = np.maximum(np.maximum(joint, cover), union)
        share *= np.divide(both - cover, union, out=np.zeros_like(union), where=union > 0)[..., None]
        share[..., number] += cover
        union = both
    share[..., 0] += 1 - union
    return share
