"""Convex edges of rigid bodies at the drive's frequency.

Elements that are fitted to long waves (`edge_fit.py`) leave an error of second order at an edge: behind large
plates, whose shadow is lit by their edges alone, 1 to 3 % at 6 to 9 cells per wavelength. Around
a rigid right angle, waves of wavenumber k are J_n(k r) cos(n phi), n = 0, 2/3, 4/3, ... The masses of the
element at the edge, and a change of its couplings, are fitted to them in a window of cells. Differences from
the waves leave the window through an impedance at its rim: with known pressures there it would resonate at 7
to 9 cells per wavelength.
"""

from __future__ import annotations

import numpy as np
from scipy.special import jv

from autdtorch.fdtd.assembly.edge_fit import columns_of, importance, known_elements, stiffness_between
from autdtorch.fdtd.assembly.reference_element import stiffness_matrix, without_negative
from autdtorch.fdtd.assembly.sections import COLUMN_PAIRS, RING, MaterialKey, Section
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array

_ORDERS = np.arange(5) * 2 / 3  # n of the waves
_STEPS = 3  # Linear steps of the fit
_RIDGE = 1e-3  # Weight of the changes: some combinations hardly matter
_SUM = 100.0  # Weight of the sum of masses, which is the volume of air


def rigid_corner(section: Section, materials: MaterialKey) -> tuple[int, int] | None:
    """Return the only rigid block of a section in air, at a convex edge, or None."""
    blocks = np.array(section.material)
    if blocks.shape != (2, 2):
        return None
    rigid = np.array(materials.rigid)[blocks]
    others = blocks[~rigid]
    if rigid.sum() != 1 or (materials.mobility[others] != 1).any() or (materials.masses[others] != 1).any():
        return None
    x, y = np.argwhere(rigid)[0].tolist()
    return x, y


def at_the_drive(
    section: Section,
    corner: tuple[int, int],
    coupling: Array,
    mass: Array,
    materials: MaterialKey,
    stencil: Stencil,
) -> tuple[Array, Array]:
    """Return coupling (6,) and masses (4,) of the element at a rigid corner, from those for long waves."""
    window = _WaveWindow(section, corner, materials, stencil)
    fitted, masses = window.fitted(coupling, mass)
    if (masses < 0).any():  # in slivers, and where the fit diverges: the element for long waves remains
        return coupling, mass
    matrix = without_negative(stiffness_matrix(fitted, COLUMN_PAIRS))  # slivers would lose energy otherwise
    return -matrix[tuple(COLUMN_PAIRS.T)], masses


class _WaveWindow:
    """The vertices around an edge, the operator of all elements but one, and the waves."""

    def __init__(
        self, section: Section, corner: tuple[int, int], materials: MaterialKey, stencil: Stencil
    ) -> None:
        """Assemble the elements beside the one at the edge, and the waves at the vertices."""
        side = 2 * (RING + 1)
        places = np.stack(np.meshgrid(*2 * [np.arange(side) - RING], indexing="ij"), axis=-1).reshape(-1, 2)
        from_edge = (places - np.array(section.cuts)[:, 0]) * np.where(np.array(corner) == 0, 1, -1)
        present = (from_edge > 0).any(axis=1)
        inside = ((places > -RING) & (places < RING + 1)).all(axis=1)
        self._present, self._rim = present, present & ~inside
        self._columns = columns_of((0, 0))
        self._air = np.flatnonzero(present[self._columns])
        self._pairs = np.flatnonzero(present[self._columns][COLUMN_PAIRS].all(axis=1))
        self._judged = present.copy()
        self._judged[self._columns] = False
        self._kappa, self._symbol = stencil.kappa, stencil.symbol
        radius, angle = np.hypot(*from_edge.T), np.arctan2(from_edge[:, 1], from_edge[:, 0]) + np.pi / 2
        waves = jv(_ORDERS, stencil.kappa * radius[:, None]) * np.cos(_ORDERS * angle[:, None])
        waves *= present[:, None]
        self._waves = waves / np.abs(waves).max(axis=0) * importance(_ORDERS)
        stiffness, masses = known_elements(section, materials, stencil, stencil.kappa)
        self._operator = stiffness - self._symbol * np.diag(masses)

    def fitted(self, coupling: Array, mass: Array) -> tuple[Array, Array]:
        """Return coupling (6,) and masses (4,) that miss the waves by less than those to start from."""
        count = len(self._air)
        change = np.zeros(count + len(self._pairs))  # of the masses, and of the couplings over kappa squared
        least = np.concatenate((_RIDGE * np.eye(len(change)), _SUM * (np.arange(len(change)) < count)[None]))
        missed, slopes = self.missed(coupling, mass)
        first = np.linalg.norm(missed)
        for _ in range(_STEPS):
            both = np.concatenate((slopes, least)), np.concatenate((-missed, -least @ change))
            change += np.linalg.lstsq(*both)[0]
            fitted, masses = coupling.copy(), mass.copy()
            masses[self._air] += change[:count]
            fitted[self._pairs] += self._kappa**2 * change[count:]
            missed, slopes = self.missed(fitted, masses)
        return (fitted, masses) if np.linalg.norm(missed) < first else (coupling, mass)

    def missed(self, coupling: Array, mass: Array) -> tuple[Array, Array]:
        """Return the differences (n,) from the waves at the judged vertices, and their derivatives (n, k).

        The element at the edge has a coupling (6,) and masses (4,). Real parts come first.
        """
        columns, count = self._columns, len(self._operator)
        operator = self._operator + stiffness_between(columns[COLUMN_PAIRS], coupling, count)
        operator[columns, columns] -= self._symbol * mass
        some, judged = np.ix_(self._present, self._present), self._judged
        inverse = np.zeros(operator.shape, np.complex128)
        inverse[some] = np.linalg.inv((operator - 1j * self._kappa * np.diag(self._rim))[some])
        missed = -inverse[:, ~self._rim] @ (operator @ self._waves)[~self._rim]
        solution, response = self._waves + missed, inverse[judged]
        air, (one, other) = columns[self._air], columns[COLUMN_PAIRS[self._pairs]].T
        by_mass = self._symbol * response[:, air, None] * solution[air]
        across = (response[:, other] - response[:, one])[..., None]
        by_coupling = self._kappa**2 * across * (solution[one] - solution[other])
        slopes = np.concatenate((by_mass, by_coupling), axis=1).transpose(0, 2, 1)
        parts = missed[judged].ravel(), slopes.reshape(-1, slopes.shape[2])
        differences, derivatives = (np.concatenate((part.real, part.imag)) for part in parts)
        return differences, derivatives
