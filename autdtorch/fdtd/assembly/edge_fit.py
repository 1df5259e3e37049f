"""Couplings of the elements at an edge, fitted to the fields of long waves in the window around them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from autdtorch.fdtd.assembly.reference_element import stiffness_matrix
from autdtorch.fdtd.assembly.sections import (
    COLUMN_PAIRS,
    COLUMNS,
    RING,
    MaterialKey,
    PlaneFields,
    Section,
    layered_element,
    mean_densities,
    uniform_columns,
)
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array, Index

# Order up to which fields count in the fit, and steepness of the decay of their weights beyond: no coupling
# reproduces the rapid variation of higher fields between cells
_ORDER, _STEEPNESS = 2.6, 8
_PRIOR = 1e-4  # Weight of the first guess, for couplings that the fields do not determine
_LEAST_START = 0.03  # Least coupling to start from, relative to air: no slope leads away from zero
# Relative change at which a fit ends: symmetric scenes remain symmetric, and derivatives by density are
# smooth
_FIT_EXACT = 1e-13
_GROUND = 1e-9  # Stiffness to zero pressure, for a cavity that rigid material closes within the window
_MOST_FIT_STEPS = 80  # of a fit; within a heavy cylinder it is too flat to end by itself


def importance(order: Array) -> Array:
    """Return the weights (m,) of fields by their order."""
    return np.asarray(1 / (1 + (order / _ORDER) ** _STEEPNESS))


def fitted_couplings(
    section: Section,
    varied: list[tuple[int, int]],
    fields: PlaneFields,
    materials: MaterialKey,
    stencil: Stencil,
) -> Array:
    """Return the couplings (k, 6) between the columns of the elements `varied` of a section.

    The stiffness matrix of an element is B R R^T B^T with R triangular, so that no energy is negative. B
    spans the differences of its columns outside rigid materials.
    """
    window = _Window(section, varied, fields, materials, stencil)
    means = np.stack([mean_densities(section, *place, materials) for place in varied])
    guess = uniform_columns(stencil) * np.maximum(1 / means, _LEAST_START)
    roots = _Roots([window.present[columns] for columns in window.columns])
    start = roots.of(guess)
    if not len(start):  # at most one column of each element is outside rigid materials
        return np.zeros_like(guess)

    def missed(root: Array) -> Array:
        coupling = roots.couplings(root)
        return np.concatenate((window.missed(coupling), _PRIOR * (coupling / guess - 1).ravel()))

    def slopes(root: Array) -> Array:
        by_coupling = window.slopes(roots.couplings(root))
        by_coupling = np.concatenate((by_coupling, _PRIOR * np.diag(1 / guess.ravel())))
        return np.asarray(by_coupling @ roots.slopes(root))

    fit = least_squares(
        missed, start, slopes, ftol=_FIT_EXACT, xtol=_FIT_EXACT, gtol=_FIT_EXACT, max_nfev=_MOST_FIT_STEPS
    )
    parts = [section.parts(*place, materials.rigid) for place in varied]
    couplings = roots.couplings(fit.x)
    return np.stack([_apart(coupling, part) for coupling, part in zip(couplings, parts, strict=True)])


def _apart(coupling: Array, part: Index) -> Array:
    """Return the coupling (6,) of an element without any between columns (4,) in different parts.

    The energy of pressures that vary in one part only is unchanged, so that no energy is negative.
    """
    matrix, separate = stiffness_matrix(coupling, COLUMN_PAIRS), np.zeros((4, 4))
    for number in range(1, int(part.max()) + 1):
        basis = _differences(np.asarray(part == number))
        separate += basis @ (basis.T @ matrix @ basis) @ basis.T
    return np.asarray(-separate[tuple(COLUMN_PAIRS.T)])


class _Window:
    """The vertices of a window, the stiffness of its known elements, and the fields."""

    def __init__(
        self,
        section: Section,
        varied: list[tuple[int, int]],
        fields: PlaneFields,
        materials: MaterialKey,
        stencil: Stencil,
    ) -> None:
        """Assemble all elements but those `varied`."""
        self.present = fields.present.ravel()
        inside = np.zeros(fields.present.shape, bool)
        inside[1:-1, 1:-1] = True
        self._fixed, self._free = self.present & ~inside.ravel(), self.present & inside.ravel()
        self._fields = (fields.values[:, :, 1:] * importance(fields.order[1:])).reshape(len(self.present), -1)
        self._matrix = known_elements(section, materials, stencil)[0][self._free]
        self.columns = [columns_of(section, place) for place in varied]
        judged = self._free.copy()
        judged[np.concatenate(self.columns)] = False
        self._judged = judged[self._free]
        # the vertices that each coupling connects
        self._pairs = np.concatenate([columns[COLUMN_PAIRS] for columns in self.columns])

    def missed(self, coupling: Array) -> Array:
        """Return the difference of the pressure at the vertices of other elements from the fields."""
        solution, _ = self._solved(coupling)
        return np.asarray((solution - self._fields)[self._free][self._judged].ravel())

    def slopes(self, coupling: Array) -> Array:
        """Return the derivatives (n, 6 k) of `missed` by the couplings."""
        solution, inverse = self._solved(coupling)
        one, other = self._pairs.T
        change = solution[one] - solution[other]
        padded = np.zeros((int(self._judged.sum()), len(self.present)))
        padded[:, self._free] = inverse[self._judged]
        response = padded[:, other] - padded[:, one]
        return np.asarray((response[:, None] * change.T).reshape(-1, len(change)))

    def _solved(self, coupling: Array) -> tuple[Array, Array]:
        """Return the fields with the scheme's pressures inside the rim, and the inverse of the stiffness."""
        matrix = self._matrix + stiffness_between(self._pairs, coupling, len(self.present))[self._free]
        inverse = np.linalg.inv(matrix[:, self._free] + _GROUND * np.eye(len(matrix)))
        solution = self._fields.copy()
        solution[self._free] = -inverse @ (matrix[:, self._fixed] @ self._fields[self._fixed])
        return solution, np.asarray(inverse)


def columns_of(section: Section, place: Sequence[int]) -> Index:
    """Return the flat indices (4,) of the columns of an element among the vertices of the window."""
    return np.asarray((COLUMNS + place + RING) @ (section.size[1] + 2 * RING + 1, 1))


def known_elements(
    section: Section, materials: MaterialKey, stencil: Stencil, air: float | None = None
) -> tuple[Array, Array]:
    """Return stiffness matrix (n, n) and masses (n,) of the elements of a window that `layered_element` has.

    Elements beyond the section continue those beside it.
    """
    wide, tall = section.size
    alike = {
        (x, y): layered_element(section, x, y, materials, stencil, air)
        for x, y in itertools.product(range(-1, wide + 1), range(-1, tall + 1))
    }
    columns, couplings, masses = [], [], []
    for x, y in itertools.product(range(-RING, wide + RING), range(-RING, tall + RING)):
        element = alike[min(max(x, -1), wide), min(max(y, -1), tall)]
        if element is not None:
            columns.append(columns_of(section, (x, y)))
            couplings.append(element.coupling)
            masses.append(element.mass.ravel())
    count, place = (wide + 2 * RING + 1) * (tall + 2 * RING + 1), np.stack(columns)
    mass = np.bincount(place.ravel(), np.concatenate(masses), count).astype(np.float64)
    return stiffness_between(place[:, COLUMN_PAIRS], np.stack(couplings), count), mass


def stiffness_between(pairs: Index, coupling: Array, count: int) -> Array:
    """Return the stiffness matrix of `count` vertices with couplings (...) between pairs of them (..., 2)."""
    (one, other), value = pairs.reshape(-1, 2).T, coupling.ravel()
    rows, columns = np.concatenate((one, other, one, other)), np.concatenate((other, one, one, other))
    entries = np.concatenate((-value, -value, value, value))
    matrix = np.bincount(rows * count + columns, entries, count**2)
    return np.asarray(matrix.reshape(count, count), np.float64)


class _Roots:
    """The triangular matrices, flat and joined, of the couplings of k elements."""

    def __init__(self, present: list[NDArray[np.bool_]]) -> None:
        """Start from masks (4,) of the columns of each element outside rigid materials."""
        self._bases = [_differences(columns) for columns in present]
        counts = [basis.shape[1] * (basis.shape[1] + 1) // 2 for basis in self._bases]
        self._ends = list(itertools.pairwise(np.cumsum([0, *counts])))

    def of(self, coupling: Array) -> Array:
        """Return the roots of couplings (k, 6) of positive energy between the columns that are present."""
        roots = []
        for basis, of_element in zip(self._bases, coupling, strict=True):
            present = np.asarray(basis.any(axis=1))[COLUMN_PAIRS].all(axis=1)
            matrix = stiffness_matrix(np.where(present, of_element, 0), COLUMN_PAIRS)
            roots.append(np.linalg.cholesky(basis.T @ matrix @ basis)[np.tril_indices(basis.shape[1])])
        return np.concatenate(roots)

    def couplings(self, root: Array) -> Array:
        """Return the couplings (k, 6) of roots."""
        halves = [
            basis @ _triangle(root[first:last], basis)
            for basis, (first, last) in zip(self._bases, self._ends, strict=True)
        ]
        return np.stack([-(half @ half.T)[tuple(COLUMN_PAIRS.T)] for half in halves])

    def slopes(self, root: Array) -> Array:
        """Return the derivatives (6 k, n) of the couplings by the roots."""
        slopes = np.zeros((6 * len(self._bases), len(root)))
        for number, (basis, (first, last)) in enumerate(zip(self._bases, self._ends, strict=True)):
            half = basis @ _triangle(root[first:last], basis)
            for place, unit in enumerate(np.eye(last - first)):
                change = basis @ _triangle(unit, basis) @ half.T
                by_pairs = -(change + change.T)[tuple(COLUMN_PAIRS.T)]
                slopes[6 * number : 6 * number + 6, first + place] = by_pairs
        return slopes


def _triangle(root: Array, basis: Array) -> Array:
    """Return the lower triangular matrix of flat entries."""
    size = basis.shape[1]
    triangle = np.zeros((size, size))
    triangle[np.tril_indices(size)] = root
    return triangle


def _differences(present: NDArray[np.bool_]) -> Array:
    """Return orthonormal differences (4, n - 1) of the n columns that are present."""
    some = np.flatnonzero(present)
    basis = np.zeros((4, max(len(some) - 1, 0)))
    for number in range(1, len(some)):
        basis[some[:number], number - 1] = 1 / np.sqrt(number * (number + 1))
        basis[some[number], number - 1] = -number / np.sqrt(number * (number + 1))
    return basis
