"""Losses of elements: the imaginary parts of coupling and mass at the drive's frequency.

With e^{-i w t}, a fluid that absorbs has a complex density and bulk modulus, and a surface that reacts
locally an admittance. In the equation of a cell, m and B are then complex.

    symbol m_i p_i + sum_j B_ij (p_j - p_i) = 0.

The power it absorbs is the form g_i |p_i|^2 + sum_j c_ij |p_i - p_j|^2 / 2 with the damping
coefficients g = symbol Im m and c = -Im B. Passive means that this form is never negative. `damping.py` turns
it into terms of the time step.

The elements of materials without loss are analytic functions of density and compressibility. Those of lossy
materials continue them: they are assembled for real values, and a little more and less, by the imaginary
parts times a step. From these the values at i times the imaginary parts follow (`_continued`).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.reference_element import (
    PAIRS,
    VERTICES,
    InterfaceElements,
    Materials,
    stiffness_matrix,
)
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array

COUPLING, MASS, GROUND = slice(0, 28), slice(28, 36), slice(36, 44)
"""Columns of the losses of an element: damping of its `PAIRS` and vertices, and the vertices' stiffness."""

# Largest tangent of half the phase of a step, times the tangent of the loss angle, with a positive stiffness
LARGEST_TANGENT = 0.7
_ROUNDING = 1e-9  # Negative power of a form, relative to its largest entry, that is rounding


def with_losses(
    make: Callable[[Materials], InterfaceElements], materials: Materials, stencil: Stencil
) -> InterfaceElements:
    """Return the elements that `make` assembles from materials, continued to the lossy ones."""
    if materials.losses is None:
        return make(materials)
    still, *sides = map(make, materials.losses.variants)
    if not sides:
        return still._replace(loss=np.zeros((len(still.mass), GROUND.stop)))
    values = ((part.coupling, part.mass) for part in (still, *sides))
    coupling, mass = (_continued(*each) for each in zip(*values, strict=True))
    # the stiffness of a step at the largest tangent of half its phase
    tangent = LARGEST_TANGENT / max(materials.losses.tangent, LARGEST_TANGENT)
    stable = ~_negative(stiffness_matrix(coupling.real + tangent * coupling.imag))[:, None]
    air = stencil.loss * still.mass  # all cells absorb as air does
    # some masses have kinks, beyond which nothing continues them
    mass = np.where((mass.real >= 0).all(axis=1, keepdims=True), mass, still.mass)
    loss = _passive(np.where(stable, -coupling.imag, 0), stencil.symbol * mass.imag, air)
    real = np.where(stable, coupling.real, still.coupling)
    return still._replace(coupling=real, mass=np.asarray(mass.real), loss=loss)


STEP = 0.05
"""Share of the imaginary parts by which `with_losses` changes the real values: truncation and rounding are
below 1e-6."""


def _continued(still: Array, ahead: Array, behind: Array) -> NDArray[np.complex128]:
    """Return f(i) from f(0), f(STEP) and f(-STEP), as (a + b t) / (1 + c t): exact for layers in series."""
    slope = (ahead - behind) / (2 * STEP)
    bend = (ahead + behind - 2 * still) / (2 * STEP**2)
    below = slope - 1j * bend
    return still + 1j * np.divide(slope**2, below, out=np.zeros_like(below), where=below != 0)


def _passive(coupling: Array, mass: Array, air: Array) -> Array:
    """Return losses (n, 44) that absorb at any pressure.

    They are close to damping of coupling (n, 28) and of mass (n, 8), beside air's (n, 8).
    """
    form = stiffness_matrix(coupling)
    form[:, range(8), range(8)] += mass + air
    some = np.flatnonzero(_negative(form))
    positive = positive_part(form[some])
    coupling[some] = -positive[:, PAIRS[:, 0], PAIRS[:, 1]]
    mass[some] = positive.sum(axis=2) - air[some]
    return np.concatenate((coupling, mass, np.zeros_like(mass)), axis=1)


# Constant and linear fields at the vertices, of unit length (8, 4)
_LINEAR = np.column_stack((np.full(8, 0.5), VERTICES - 0.5)) / math.sqrt(2)


def positive_part(form: Array) -> Array:
    """Return forms (n, 8, 8) without their negative parts.

    Constant and linear fields keep the power that they have, if it is positive: only the rest is cut. Forces
    whose power is less than any positive form of this size gives count as if it were that: others would be
    amplified without limit.
    """
    power, directions = np.linalg.eigh(_LINEAR.T @ form @ _LINEAR)
    forces = form @ _LINEAR @ directions
    size = np.linalg.norm(form, axis=(1, 2))[:, None]
    least = np.divide((forces**2).sum(axis=1), size, out=np.zeros_like(power), where=size > 0)
    share = np.divide(1, np.maximum(power, least), out=np.zeros_like(power), where=power > 0)
    flow = (forces * share[:, None]) @ forces.transpose(0, 2, 1)
    values, vectors = np.linalg.eigh(form - flow)
    return np.asarray(flow + (vectors * np.maximum(values, 0)[:, None]) @ vectors.transpose(0, 2, 1))


def _negative(matrix: Array) -> NDArray[np.bool_]:
    """Return whether symmetric matrices (n, 8, 8) have a negative eigenvalue."""
    size = np.abs(matrix).max(axis=(1, 2))
    return np.asarray(np.linalg.eigvalsh(matrix)[:, 0] < -_ROUNDING * size)


def condensed_loss(loss: Array, followed: Array, out: NDArray[np.bool_]) -> Array:
    """Return losses (n, 44) without vertices `out` (n, 8), whose pressures follow the others.

    `followed` (n, 8, 8) are the shares of the others in them; see `heterogeneous.condensed`.
    """
    form = stiffness_matrix(loss[:, COUPLING])
    form[:, range(8), range(8)] += loss[:, MASS]
    shares = np.where(out[:, :, None], followed, np.eye(8))
    form = shares.transpose(0, 2, 1) @ form @ shares
    form[out[:, :, None] | out[:, None, :]] = 0
    ground = np.maximum((loss[:, None, GROUND] @ shares)[:, 0], 0)
    return np.concatenate((-form[:, PAIRS[:, 0], PAIRS[:, 1]], form.sum(axis=2), ground), axis=1)
