"""The power that lossy bodies absorb, from the phasors of a steady state in their cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor

from autdtorch.fdtd.assembly.heterogeneous import LossyCells
from autdtorch.fdtd.region import Region
from autdtorch.fdtd.stencil import flat_offsets
from autdtorch.fdtd.stepping import Assembly
from autdtorch.utils.array_types import Array, Index


@dataclass(frozen=True)
class Absorption:
    """The absorbed power of K bodies on a grid, a form of the pressure in their cells."""

    cells: Index  # flat indices (k,) of the cells whose phasors are needed, ascending
    body: Index  # number of the body that each lossy cell belongs to (l,)
    bodies: int  # K
    place: Index  # places of the lossy cells and their neighbours among the cells (l, 27)
    mass: Array  # power [W/Pa^2] by the squared pressure of each lossy cell (l,)
    coupling: Array  # by squared differences of pressure from its neighbours (l, 27)

    def power(self, phasors: Tensor) -> Tensor:
        """Return the power (K, R) [W] that each body absorbs, from phasors (k, R) [Pa] of the total field."""
        pressure = phasors.numpy()
        power = self.mass[:, None] * np.abs(pressure[self.place[:, 13]]) ** 2
        for column, neighbour in zip(self.coupling.T, self.place.T, strict=True):
            power += column[:, None] * np.abs(pressure[neighbour] - pressure[self.place[:, 13]]) ** 2
        return torch.from_numpy(self._sums @ power)

    @property
    def _sums(self) -> csr_array:
        """The matrix (K, l) that sums over the cells of each body."""
        places = self.body, np.arange(len(self.body))
        return csr_array((np.ones(len(self.body)), places), (self.bodies, len(self.body)))


def absorption(assembly: Assembly, region: Region, axes: Array | None = None) -> Absorption:
    """Return the absorption of a region's bodies on a grid.

    A cell belongs to the nearest body that absorbs. `axes` are those of a turned grid, one a row (3, 3).
    """
    cells, grid, stencil = assembly.heterogeneous, assembly.grid, assembly.stencil
    nothing = np.zeros(0, np.int64), np.zeros((0, 27)), np.zeros(0), np.zeros(0)
    losses = cells.losses or LossyCells(*nothing)
    index = cells.index[losses.place]
    around = index[:, None] + flat_offsets(grid.shape)
    used, place = np.unique(around, return_inverse=True)
    # on the grid the flow of a wave of unit pressure is less than in air by slope / 2 kappa
    watts = grid.spacing / (2 * 2 * np.pi * region.frequency * region.fluid.density.real)
    watts *= 2 * stencil.kappa / stencil.slope.real
    places = grid.centers_of(index)
    body = _nearest(torch.from_numpy(places @ (np.eye(3) if axes is None else axes)), region)
    # of a fluid the mass also absorbs as air does, which its losses leave out
    in_fluid = np.array([each.fluid is not None for each in region.bodies], bool)[body]
    mass = losses.mass + np.where(in_fluid, stencil.loss * cells.mass[losses.place], 0)
    return Absorption(
        used, body, len(region.bodies), place.reshape(around.shape), watts * mass, watts / 2 * losses.coupling
    )


def _nearest(places: Tensor, region: Region) -> NDArray[np.int64]:
    """Return the number (n,) of the absorbing body that is nearest to each place (n, 3) [m]."""
    absorbing = [
        number
        for number, body in enumerate(region.bodies)
        if body.impedance is not None or (body.fluid is not None and body.fluid.is_lossy)
    ]
    if not absorbing:
        return np.zeros(len(places), np.int64)
    distance = [region.bodies[number].shape.signed_distance(places) for number in absorbing]
    return np.asarray(np.array(absorbing)[torch.stack(distance).argmin(dim=0).numpy()], np.int64)
