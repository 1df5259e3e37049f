"""The scattered field alone: driven where the medium is not air, radiated from a surface around it.

With p = p_inc + p_scat and p_inc the exact field in free space, the scheme leaves for p_scat a force
sum_j (w_ij - w_air) (p_inc,j - p_inc,i) on the heterogeneous cells. Around them, where chi steps from 1 to 0
between two cells of air, the cells radiate sum_j w_ij (chi_j - chi_i) p_scat,j, by the exact Green's
function: what a field that is p_scat outside and zero inside needs for its sources (a discrete Huygens
surface). Between the surface and everything else lies no grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array

from autdtorch.fdtd.interpolation import Interpolation
from autdtorch.fdtd.kernels.contract import Sources
from autdtorch.fdtd.stencil import flat_offsets
from autdtorch.fdtd.stepping import Assembly
from autdtorch.fdtd.superposition import superposition

_BESIDE = 1.25
"""Cells from the rim of the interior up to which points are not read. The outermost are not interpolated
well; what radiates, two cells from the rim, is not a point source closer than half a cell."""

_NEAREST = 0.5
"""Distance [cells] from a source at which the incident field is cut off; it is singular there."""


@dataclass(frozen=True)
class ScatteredField:
    """An assembled box with what drives it and what it radiates.

    Attributes:
        assembly: of the box.
        wavenumber: complex [rad/m].
    """

    assembly: Assembly
    wavenumber: complex

    @property
    def driven(self) -> torch.Tensor:
        """Places (n, 3) [m] where the incident field is needed: heterogeneous cells and their neighbours."""
        return self.positions(self._driven[0])

    def sources(self, field: torch.Tensor) -> Sources:
        """Forces of an incident field, given (n,) where it drives."""
        assembly = self.assembly
        place = self._driven[1]
        received = field.numpy()
        step = received[place] - received[place[:, 13]][:, None]
        factor = assembly.coefficients.face / assembly.stencil.face
        force = factor * ((assembly.heterogeneous.weight - assembly.stencil.weights) * step).sum(axis=1)
        both = torch.view_as_real(torch.from_numpy(force)).to(assembly.dtype)
        return Sources(torch.from_numpy(assembly.heterogeneous.index), both)

    def incident(
        self, points: torch.Tensor, nodes: torch.Tensor, weights: torch.Tensor, strength: torch.Tensor
    ) -> torch.Tensor:
        """Return the incident field (P,) at points (P, 3) [m].

        Its N sources have nodes (N, n, 3) [m] with `weights` (n,) and strengths (N,) [Pa m].
        """
        return self._incident(points, nodes, weights, strength, 0.0)

    def driving(self, nodes: torch.Tensor, weights: torch.Tensor, strength: torch.Tensor) -> torch.Tensor:
        """Return the incident field (n,) where it drives; see `incident`."""
        nearest = _NEAREST * self.assembly.grid.spacing
        return self._incident(self.driven, nodes, weights, strength, nearest)

    def _incident(
        self,
        points: torch.Tensor,
        nodes: torch.Tensor,
        weights: torch.Tensor,
        strength: torch.Tensor,
        nearest: float,
    ) -> torch.Tensor:
        amplitude = strength.repeat_interleave(len(weights)) * weights.repeat(len(strength))
        return self._sum(points, nodes.reshape(-1, 3), amplitude[:, None], nearest)[:, 0]

    def near_to_far(self, nodes: torch.Tensor, weights: torch.Tensor) -> NearToFar:
        """How the scattered field gets to P targets: means with `weights` (n,) over nodes (P, n, 3) [m]."""
        _, surface, outward = self._surface
        within = self.inside(nodes)
        inner = self.assembly.interpolation(nodes[within])
        cells = np.unique(np.concatenate((surface, inner.index.ravel())))
        picked = Interpolation(surface[:, None], np.ones((len(surface), 1))).matrix(cells)
        return NearToFar(self, nodes, weights, within, cells, outward @ picked, inner.matrix(cells))

    def radiated(self, amplitude: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        """Fields (P, R) at points (P, 3) [m] of the radiating cells with amplitudes (n, R) [Pa m]."""
        return self._sum(points, self._surface[0], amplitude, 0.0)

    def at_surface(self, sources: torch.Tensor, amplitude: torch.Tensor) -> torch.Tensor:
        """Fields (n, R) at the radiating cells of point sources (N, 3) [m] with amplitudes (N, R) [Pa m]."""
        return self._sum(self._surface[0], sources, amplitude, 0.0)

    def inside(self, points: torch.Tensor) -> torch.Tensor:
        """Which points (..., 3) are read from the grid; others are far enough from the cells that radiate."""
        grid = self.assembly.grid
        cells = torch.from_numpy(grid.to_cells(points))
        first, last = torch.tensor([grid.first, grid.last], dtype=torch.int64, device="cpu").unbind()
        return ((cells > first + _BESIDE) & (cells < last - 1 - _BESIDE)).all(dim=-1)

    @cached_property
    def _driven(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Cells where the incident field is needed, and the places among them of the neighbours (n, 27)."""
        around = self.assembly.heterogeneous.index[:, None] + flat_offsets(self.assembly.grid.shape)
        cells, place = np.unique(around, return_inverse=True)
        return cells, place.reshape(around.shape)

    @cached_property
    def _surface(self) -> tuple[torch.Tensor, NDArray[np.int64], csr_array]:
        """Positions (n, 3) of the radiating cells, the cells (m,) they read, and with what weights (n, m)."""
        assembly = self.assembly
        grid, stencil = assembly.grid, assembly.stencil

        def inside(depth: int) -> tuple[slice, ...]:
            ends = zip(grid.first, grid.last, strict=True)
            return tuple(slice(first + depth, last - depth) for first, last in ends)

        chi, radiating = np.zeros(grid.shape), np.zeros(grid.shape, bool)
        chi[inside(3)], radiating[inside(2)], radiating[inside(4)] = 1, True, False
        index = np.flatnonzero(radiating)
        around = index[:, None] + flat_offsets(grid.shape)
        step = chi.ravel()[around] - chi.ravel()[index, None]
        cells, place = np.unique(around[step != 0], return_inverse=True)
        row, column = np.nonzero(step)
        factor = assembly.coefficients.face / stencil.face * grid.spacing
        value = factor / assembly.stencil.source_factor(float(assembly.steps_per_period))
        value = value * stencil.weights[column] * step[row, column]
        return self.positions(index), cells, csr_array((value, (row, place)), (len(index), len(cells)))

    def positions(self, cells: NDArray[np.int64]) -> torch.Tensor:
        """Centres (n, 3) [m] of cells."""
        grid = self.assembly.grid
        places = np.stack(np.unravel_index(cells, grid.shape), axis=-1)
        return torch.from_numpy(np.array(grid.origin) + grid.spacing * places)

    def _sum(
        self, points: torch.Tensor, sources: torch.Tensor, amplitude: torch.Tensor, nearest: float
    ) -> torch.Tensor:
        return superposition(points, sources, amplitude, self.wavenumber, nearest, self.assembly.dtype)


@dataclass(frozen=True)
class NearToFar:
    """From phasors of the box's cells to the scattered field at P targets of n nodes.

    Attributes:
        scattering: of the box.
        nodes: where the field is wanted (P, n, 3) [m].
        weights: of the nodes of a target (n,).
        within: which nodes (P, n) lie in the box, where its cells are read.
        cells: flat indices (k,) of the cells whose phasors are needed.
        outward: amplitudes of the radiating cells from those phasors.
        inward: field at the nodes in the box from them.
    """

    scattering: ScatteredField
    nodes: torch.Tensor
    weights: torch.Tensor
    within: torch.Tensor
    cells: NDArray[np.int64]
    outward: csr_array
    inward: csr_array

    def field(self, phasors: torch.Tensor) -> torch.Tensor:
        """Scattered fields (P, R) at the targets, from the cells' phasors (k, R) in R runs."""
        field = torch.zeros((*self.within.shape, phasors.shape[1]), dtype=torch.complex128, device="cpu")
        field[self.within] = torch.from_numpy(self.inward @ phasors.numpy())
        amplitude = self.amplitudes(phasors)
        field[~self.within] = self.scattering.radiated(amplitude, self.nodes[~self.within])
        return torch.einsum("pnr,n->pr", field, self.weights.to(field.dtype))

    def amplitudes(self, phasors: torch.Tensor) -> torch.Tensor:
        """What the radiating cells send out (n, R) [Pa m], from the cells' phasors (k, R)."""
        return torch.from_numpy(self.outward @ phasors.numpy())

    def matrix(self, every: int) -> torch.Tensor:
        """Matrix from phasors (k,) to the scattered field at each `every`-th target."""
        within, share = self.within[::every], self.weights.expand(self.within[::every].shape)
        target = torch.arange(len(within), device="cpu")[:, None].expand(within.shape)
        outside = self.nodes[::every][~within]
        amplitude = torch.zeros((len(outside), len(within)), dtype=torch.complex128, device="cpu")
        amplitude[torch.arange(len(outside), device="cpu"), target[~within]] = share[~within].to(
            amplitude.dtype
        )
        received = self.scattering.at_surface(
            outside, amplitude
        )  # as from there: Green's function is symmetric
        number = torch.zeros(self.within.shape, dtype=torch.int64, device="cpu")
        number[self.within] = torch.arange(int(self.within.sum()), device="cpu")
        picked = csr_array(
            (share[within].numpy(), (target[within].numpy(), number[::every][within].numpy())),
            (len(within), self.inward.shape[0]),
        )
        return torch.from_numpy((self.outward.T @ received.numpy()).T + (picked @ self.inward).toarray())
