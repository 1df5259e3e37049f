"""Couplings of the element at an edge, fitted to the fields of long waves in the window around them."""

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
    section: Section, fields: PlaneFields, materials: MaterialKey, stencil: Stencil
) -> Array:
    """Return the couplings (6,) between the columns of a section.

    The stiffness matrix of the element is B R R^T B^T with R triangular, so that no energy is negative. B
    spans the differences of its columns outside rigid materials.
    """
    window = _Window(section, fields, materials, stencil)
    guess = uniform_columns(stencil) * np.maximum(1 / mean_densities(section, materials), _LEAST_START)
    roots = _Roots(window.present[window.columns])
    start = roots.of(guess)
    if not len(start):  # at most one column is outside rigid materials
        return np.zeros_like(guess)

    def missed(root: Array) -> Array:
        coupling = roots.couplings(root)
        return np.concatenate((window.missed(coupling), _PRIOR * (coupling / guess - 1)))

    def slopes(root: Array) -> Array:
        by_coupling = window.slopes(roots.couplings(root))
        by_coupling = np.concatenate((by_coupling, _PRIOR * np.diag(1 / guess)))
        return np.asarray(by_coupling @ roots.slopes(root))

    fit = least_squares(
        missed, start, slopes, ftol=_FIT_EXACT, xtol=_FIT_EXACT, gtol=_FIT_EXACT, max_nfev=_MOST_FIT_STEPS
    )
    return _apart(roots.couplings(fit.x), section.parts(materials.rigid))


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
        self, section: Section, fields: PlaneFields, materials: MaterialKey, stencil: Stencil
    ) -> None:
        """Assemble all elements but those that vary along both axes."""
        self.present = fields.present.ravel()
        inside = np.zeros(fields.present.shape, bool)
        inside[1:-1, 1:-1] = True
        self._fixed, self._free = self.present & ~inside.ravel(), self.present & inside.ravel()
        self._fields = (fields.values[:, :, 1:] * importance(fields.order[1:])).reshape(len(self.present), -1)
        self._matrix = known_elements(section, materials, stencil)[0][self._free]
        self.columns = columns_of((0, 0))
        judged = self._free.copy()
        judged[self.columns] = False
        self._judged = judged[self._free]
        self._pairs = self.columns[COLUMN_PAIRS]  # the vertices that each coupling connects

    def missed(self, coupling: Array) -> Array:
        """Return the difference of the pressure at the vertices of other elements from the fields."""
        solution, _ = self._solved(coupling)
        return np.asarray((solution - self._fields)[self._free][self._judged].ravel())

    def slopes(self, coupling: Array) -> Array:
        """Return the derivatives (n, 6) of `missed` by the couplings."""
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


def columns_of(place: Sequence[int]) -> Index:
    """Return the flat indices (4,) of the columns of an element among the vertices of the window."""
    return np.asarray((COLUMNS + place + RING) @ (2 * RING + 2, 1))


def known_elements(
    section: Section, materials: MaterialKey, stencil: Stencil, air: float | None = None
) -> tuple[Array, Array]:
    """Return stiffness matrix (n, n) and masses (n,) of the elements of a window that `layered_element` has.

    Elements farther from the section continue those beside it.
    """
    alike = {
        (x, y): layered_element(section, x, y, materials, stencil, air)
        for x, y in itertools.product((-1, 0, 1), repeat=2)
    }
    columns, couplings, masses = [], [], []
    for x, y in itertools.product(range(-RING, 1 + RING), repeat=2):
        element = alike[min(max(x, -1), 1), min(max(y, -1), 1)]
        if element is not None:
            columns.append(columns_of((x, y)))
            couplings.append(element.coupling)
            masses.append(element.mass.ravel())
    count, place = (2 * RING + 2) ** 2, np.stack(columns)
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
    """The triangular matrices, flat, of the couplings of an element."""

    def __init__(self, present: NDArray[np.bool_]) -> None:
        """Start from a mask (4,) of its columns outside rigid materials."""
        self._basis = _differences(present)

    def of(self, coupling: Array) -> Array:
        """Return the root of couplings (6,) of positive energy between the columns that are present."""
        basis = self._basis
        present = np.asarray(basis.any(axis=1))[COLUMN_PAIRS].all(axis=1)
        matrix = stiffness_matrix(np.where(present, coupling, 0), COLUMN_PAIRS)
        return np.asarray(np.linalg.cholesky(basis.T @ matrix @ basis)[np.tril_indices(basis.shape[1])])

    def couplings(self, root: Array) -> Array:
        """Return the couplings (6,) of a root."""
        half = self._basis @ _triangle(root, self._basis)
        return np.asarray(-(half @ half.T)[tuple(COLUMN_PAIRS.T)])

    def slopes(self, root: Array) -> Array:
        """Return the derivatives (6, n) of the couplings by the root."""
        basis = self._basis
        half = basis @ _triangle(root, basis)
        changes = [basis @ _triangle(unit, basis) @ half.T for unit in np.eye(len(root))]
        return np.stack([-(change + change.T)[tuple(COLUMN_PAIRS.T)] for change in changes], axis=1)


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
