"""Where the medium varies: symmetric bonds between cells.

The scheme is m_i d2p_i/dt2 = sum_j B_ij (p_j - p_i) with mass m_i = 1 / (rho_i s_i), bonds B_ij = 2 g_ij /
(rho_i + rho_j) and g_ij the tuned stencil. s_i is 1 in air and elsewhere the factor that gives a wave in that
cell's sound speed its right frequency. Symmetric bonds keep reciprocity and an energy at any contrast. A
rigid cell has no bonds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.grid import CellMedium
from autdtorch.fdtd.stencil import OFFSETS, Stencil

Array = NDArray[np.float64]


@dataclass(frozen=True)
class VaryingCells:
    """The cells whose bonds differ from those of uniform air.

    Attributes:
        index: flat cell indices (n,), int64, ascending.
        weight: what (p_j - p_i) is multiplied with for the 27 neighbours (n, 27), to be scaled by the time
            factor.
    """

    index: NDArray[np.int64]
    weight: Array


def speed_factors(stencil: Stencil, sound_speed: Array, air_speed: float) -> Array:
    """s_i for each of `sound_speed` (n,): symbol of air over the symbol at the own wavenumber."""
    speeds, inverse = np.unique(sound_speed, return_inverse=True)
    factors = [stencil.symbol / stencil.isotropic_symbol(stencil.kappa * air_speed / c) for c in speeds]
    return np.array(factors)[inverse]


def varying_cells(medium: CellMedium, stencil: Stencil, air_density: float, air_speed: float) -> VaryingCells:
    """Find the cells that a uniform-air sweep would get wrong, and their weights.

    Args:
        medium: what fills the grid; its outermost two layers of cells must be air.
        stencil: weights in air.
        air_density: [kg/m^3].
        air_speed: [m/s].
    """
    air = (medium.density == air_density) & (medium.sound_speed == air_speed) & ~medium.rigid
    other = np.argwhere(~air)
    if len(other) == 0:
        return VaryingCells(np.zeros(0, np.int64), np.zeros((0, 27)))
    offsets = np.array(OFFSETS)
    shape = air.shape
    near = np.unique(np.ravel_multi_index(tuple((other[:, None, :] + offsets).reshape(-1, 3).T), shape))
    strides = np.array((shape[1] * shape[2], shape[2], 1))
    neighbour = near[:, None] + offsets @ strides
    density, rigid = medium.density.ravel(), medium.rigid.ravel()
    speed = speed_factors(stencil, medium.sound_speed.ravel()[neighbour.ravel()], air_speed).reshape(
        neighbour.shape
    )
    own, others = density[near, None], density[neighbour]
    open_bond = ~(rigid[near, None] | rigid[neighbour])
    bond = np.where(open_bond, 2 * stencil.weights / (own + others), 0.0)
    own_speed = speed[:, 13:14]
    weight = bond * own * own_speed
    changed = (weight != stencil.weights).any(1) | (own_speed[:, 0] != 1)
    return VaryingCells(near[changed], weight[changed])
