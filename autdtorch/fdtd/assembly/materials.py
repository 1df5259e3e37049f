"""Materials on a grid: factors with which waves in them have the drive's frequency, and their losses."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from autdtorch.fdtd.assembly.element import MaterialLosses, Materials
from autdtorch.fdtd.assembly.losses import STEP
from autdtorch.fdtd.region import Fluid
from autdtorch.fdtd.stencil import Stencil

# Density with which rigid bodies are assembled; cells that remain almost uncoupled become rigid
_RIGID_DENSITY = 1e5


class Kind(NamedTuple):
    """A material."""

    fluid: Fluid | None  # None where no sound enters
    impedance: complex | None  # of the surface, as a ratio to air; None if it is rigid or a fluid's


def speed_factor(stencil: Stencil, speed_ratio: float) -> float:
    """Return the factor by which to divide masses, so that a wave in a material has the drive's frequency."""
    return stencil.symbol / stencil.isotropic_symbol(stencil.kappa / speed_ratio)


def flow_factor(kappa: float, speed_ratio: float) -> float:
    """Return the factor on a material's coupling and mass with which the flow of waves is continuous.

    On a grid the discrete flow of a wave of unit pressure and flow is sin(k) / k, with the wavenumber k of
    the material. At oblique incidence the two normal k differ, but the ratio is unchanged to second order.
    """
    inner = kappa / speed_ratio
    return math.sin(kappa) / kappa / (math.sin(inner) / inner)


def materials_of(kinds: Sequence[Kind], air: Fluid, stencil: Stencil) -> Materials:
    """Return materials of these kinds, air first."""
    materials = _lossless(kinds, air, stencil, 0.0)
    lossy = [number for number, kind in enumerate(kinds) if kind.fluid is not None and kind.fluid.is_lossy]
    if not lossy and all(kind.impedance is None for kind in kinds):
        return materials
    admittance = np.array([0 if kind.impedance is None else 1 / kind.impedance for kind in kinds], complex)
    density, mass = materials.density.copy(), materials.mass.copy()
    coupling_loss, mass_loss, tangent = np.zeros(len(kinds)), np.zeros(len(kinds)), 0.0
    for number in lossy:
        fluid = kinds[number].fluid
        assert fluid is not None
        coupling, whole = _passive(*_complex(fluid, air, stencil), stencil)
        density[number], mass[number] = 1 / coupling.real, whole.real
        coupling_loss[number], mass_loss[number] = -coupling.imag, stencil.symbol * whole.imag
        tangent = max(tangent, -coupling.imag / coupling.real)
    steps = (0.0, STEP, -STEP) if lossy else (0.0,)
    nothing = MaterialLosses(np.zeros(len(kinds)), np.zeros(len(kinds)), 0.0, admittance, ())
    variants = tuple(replace(_lossless(kinds, air, stencil, step), losses=nothing) for step in steps)
    losses = MaterialLosses(coupling_loss, mass_loss, tangent, admittance, variants)
    return Materials(density, mass, materials.slowness, materials.rigid, losses)


def _relative(fluid: Fluid, air: Fluid, stencil: Stencil) -> tuple[complex, complex]:
    """Return density and compressibility over those of air, less the absorption that all cells have."""
    density, speed = fluid.density / air.density, fluid.sound_speed / air.sound_speed
    compressibility = 1 / (density * speed**2)
    return density, compressibility - 1j * stencil.loss / stencil.symbol * compressibility.real


def _lossless(kinds: Sequence[Kind], air: Fluid, stencil: Stencil, step: float) -> Materials:
    """Return materials of real density and compressibility: real parts plus `step` times imaginary parts."""
    density = np.full(len(kinds), _RIGID_DENSITY)
    factor, slowness = np.ones(len(kinds)), np.ones(len(kinds))
    for number, (fluid, _) in enumerate(kinds):
        if fluid is None:
            continue
        relative, ratio = fluid.inertia / air.inertia, fluid.phase_speed / air.phase_speed
        if fluid.is_lossy:
            parts = _relative(fluid, air, stencil)
            relative, compressibility = (part.real + step * part.imag for part in parts)
            ratio = 1 / math.sqrt(relative * compressibility)
        density[number] = relative / flow_factor(stencil.kappa, ratio)
        factor[number], slowness[number] = speed_factor(stencil, ratio), 1 / ratio
    rigid = np.array([fluid is None for fluid, _ in kinds])
    return Materials(density, 1 / (density * factor), slowness, rigid)


def _complex(fluid: Fluid, air: Fluid, stencil: Stencil) -> tuple[complex, complex]:
    """Return the coupling relative to air, and the mass of a cell, of a lossy fluid."""
    density, compressibility = _relative(fluid, air, stencil)
    kappa = stencil.kappa
    inner = kappa * cmath.sqrt(density * compressibility)
    coupling = math.sin(kappa) / kappa / (cmath.sin(inner) / inner) / density
    return coupling, coupling * stencil.mean_symbol(inner) / stencil.symbol


def _passive(coupling: complex, mass: complex, stencil: Stencil) -> tuple[complex, complex]:
    """Turn the phases of both, which leaves the wavenumber, until waves of every length are damped.

    Errors of the grid, of second order in the wavenumber, may give a fluid that absorbs by its density alone
    a mass that amplifies. A fluid that absorbs by its bulk modulus alone may amplify the shortest waves by
    its coupling.
    """
    for symbol in (0.0, stencil.largest_symbol):
        power = stencil.symbol * mass.imag + stencil.loss * mass.real - symbol * coupling.imag
        if power < 0:
            # to first order; the rest is rounding
            turn = cmath.exp(1j * power / (symbol * coupling.real - stencil.symbol * mass.real))
            coupling, mass = coupling * turn, mass * turn
    return coupling, mass
