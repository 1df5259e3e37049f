"""The proof that no drive makes all of J Hermitian forms large, by cells of drives, for few transducers.

The semidefinite relaxation (`hermitian`) can be positive where no drive is: a mixture of drives may make all
forms positive. Drives with the largest amplitude at transducer r have ratios u_i = q_i / q_r with |u_i| <= 1.
A cell has each ratio in a square. With its circumscribed disc of centre c and radius d,

    q^H B_i q = d^2 |q_r|^2 - |q_i - c q_r|^2 >= 0

is one more Hermitian form. Where weights w >= 0 make sum w_j A_j + sum w_i B_i negative definite, no drive of
the cell makes all forms A_j >= 0. Other cells are divided.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.optimize

from autdtorch.utils.array_types import Array, ComplexArray
from autdtorch.utils.process import one_library_thread

_MARGIN = 1e-9  # of eigenvalues; rounding of forms of size 1 is below 1e-12
_CUTS = 40  # eigenvectors for a cell
_CELLS = 300
_NARROW = 2e-3  # forms of discs are below 1.3e5 then, and their rounding below the margin
_REACH = math.sqrt(2) * (1 + 1e-9)  # of a disc around a square of half width 1


@one_library_thread()
def no_drive_above(rows: ComplexArray, weights: Array, least: float) -> bool:
    """Return whether it is proved that no drive of amplitudes <= 1 makes all forms larger than `least`.

    Args:
        rows: R (N, M); the effort grows fast with M.
        weights: W (J, N); see `hermitian`.
        least: >= 0.
    """
    forms = np.stack([(rows.conj().T * row) @ rows for row in weights])
    sizes = np.abs(weights) @ (np.abs(rows) ** 2).sum(axis=1)
    unit, left = np.eye(rows.shape[1]), _CELLS
    for largest in range(rows.shape[1]):
        others = np.delete(unit, largest, axis=0)
        full = np.outer(unit[largest], unit[largest])
        # of a drive with amplitude 1 at the largest; a lower one has lower forms
        above = (forms - least * full) / (sizes + least)[:, None, None]
        above = np.concatenate([above, full - others[:, :, None] * others[:, None]])
        cells = [(np.zeros(len(others), complex), np.ones(len(others)))]
        while cells:
            left -= 1
            centres, widths = cells.pop()
            if left < 0 or widths.min() < _NARROW:
                return False
            drive = unit[largest] + centres @ others
            if ((above @ drive) @ drive.conj()).real.min() >= 0:
                return False
            normals = others - centres.conj()[:, None] * unit[largest]
            discs = (
                full - normals[:, :, None] * normals[:, None].conj() / (_REACH * widths[:, None, None]) ** 2
            )
            if not _has_negative(np.concatenate([above, discs])):
                cells += _divided(centres, widths)
    return True


def _divided(centres: ComplexArray, widths: Array) -> list[tuple[ComplexArray, Array]]:
    """Return the four parts of a cell, by its widest square, without those of ratios above 1."""
    parts, widest = [], int(widths.argmax())
    half = widths.copy()
    half[widest] /= 2
    for corner in (1 + 1j, 1 - 1j, -1 + 1j, -1 - 1j):
        part = centres.copy()
        part[widest] += corner * half[widest]
        x, y = (max(abs(at) - half[widest], 0.0) for at in (part[widest].real, part[widest].imag))
        if math.hypot(x, y) <= 1:
            parts.append((part, half))
    return parts


def _has_negative(forms: ComplexArray) -> bool:
    """Return whether weights >= 0 are known that make a sum of forms (C, M, M) negative definite.

    By cutting planes: linear programs over the weights, with the forms at the eigenvectors so far.
    """
    count, cuts = len(forms), np.zeros((0, len(forms)))
    weights = np.full(count, 1 / count)
    for _ in range(_CUTS):
        values, vectors = np.linalg.eigh(np.tensordot(weights, forms, 1))
        if values[-1] < -_MARGIN:
            return True
        vector = vectors[:, -1]
        cuts = np.vstack([cuts, ((forms @ vector) @ vector.conj()).real])
        program = scipy.optimize.linprog(
            np.append(np.zeros(count), 1.0),
            A_ub=np.hstack([cuts, -np.ones((len(cuts), 1))]),
            b_ub=np.zeros(len(cuts)),
            A_eq=np.append(np.ones(count), 0.0)[None],
            b_eq=[1.0],
            bounds=[(0, None)] * count + [(None, None)],
        )
        if program.x is None or program.fun >= -_MARGIN:
            return False
        weights = np.maximum(program.x[:-1], 0)
    return False
