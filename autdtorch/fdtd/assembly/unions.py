"""Bodies as the assembly sees them: unions of consecutive bodies of one material, and the materials."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from autdtorch.fdtd.assembly.element import Materials
from autdtorch.fdtd.grid import Grid
from autdtorch.fdtd.region import Fluid, Region, Shape, bounds
from autdtorch.fdtd.stencil import Stencil
from autdtorch.fdtd.thin_walls import thickened
from autdtorch.fdtd.turning import is_along, slender_faces
from autdtorch.utils.array_types import Array, Index

# Density with which rigid bodies are assembled; cells that remain almost uncoupled become rigid
_RIGID_DENSITY = 1e5
# Distance by which bodies are grown, so that touching bodies leave no film of air between them
_CONTACT_GAP = 1e-9


@dataclass(frozen=True)
class Union:
    """Union of consecutive bodies of one material."""

    shapes: tuple[Shape, ...]
    material: int
    continued: bool  # whether they continue through the boundary layers, unchanged from the interior
    # whether blocks represent it: its faces are flat and parallel to the grid, or it is slender
    aligned: bool
    rigid: bool
    finite: bool  # whether finite elements represent its surface, or the edges of a fluid

    def distance(self, cell: Array, grid: Grid) -> Array:
        """Return the signed distance [cells] of positions (..., 3) in cells."""
        places = np.array(grid.origin) + grid.spacing * (grid.clip(cell) if self.continued else cell)
        each = [shape.signed_distance(torch.from_numpy(places)) for shape in self.shapes]
        distance = torch.stack(each).amin(dim=0).numpy() / grid.spacing - _CONTACT_GAP
        if self.continued:
            return np.asarray(distance)
        beyond = np.maximum(np.array(grid.first) - cell, cell - np.array(grid.last) + 1).max(axis=-1) + 0.5
        return np.asarray(np.maximum(distance, beyond))

    def measured(self, spacing: float) -> Union:
        """Return the union with thin rigid sheets thickened, for the lattices on cells of a spacing [m]."""
        if not self.rigid:
            return self
        return replace(self, shapes=tuple(thickened(shape, spacing) for shape in self.shapes))

    def faces(self, grid: Grid) -> list[Array]:
        """Return the places [cells] of its faces along each axis, up to its end on a grid."""
        corners = [grid.to_cells(one.surface()[0]) for one in self.shapes]
        by_shape = [slender_faces(each) or list(each.T) for each in corners]
        faces = []
        for axis, places in enumerate(map(np.concatenate, zip(*by_shape, strict=True))):
            first, last = float(grid.first[axis]), grid.last[axis] - 1.0
            inside = places[(places > first) & (places < last)]
            faces.append(inside if self.continued else np.clip(places, first + 0.5, last - 0.5))
        return faces

    def parts(self) -> list[Union]:
        """Return unions of one shape each."""
        return [replace(self, shapes=(shape,)) for shape in self.shapes]

    def near(self, cells: Array, grid: Grid) -> tuple[slice, slice, slice]:
        """Return the part of positions (nx, ny, nz, 3) [cells] of a rectangular grid in the bounds of all."""
        positions = [np.moveaxis(cells[..., axis], axis, 0)[:, 0, 0] for axis in range(3)]
        if self.continued:
            limits = zip(positions, grid.first, grid.last, strict=True)
            positions = [along.clip(first, last - 1) for along, first, last in limits]
        x, y, z = map(slice, *self._reach(positions, grid).tolist())
        return x, y, z

    def range(self, grid: Grid) -> Index:
        """Return the first element around it along each axis, and one past the last (2, 3)."""
        sides = zip(grid.shape, grid.first, grid.last, strict=True)
        middles = [(np.arange(cells - 1) + 0.5).clip(first, last - 1) for cells, first, last in sides]
        return self._reach(middles, grid)

    def _reach(self, positions: Sequence[Array], grid: Grid) -> Index:
        """Return the first of positions [cells] in its bounds along each axis, and one past the last."""
        ends = np.array(bounds(self.shapes)).T + grid.spacing * np.array([-1, 1])
        axes = zip(positions, grid.origin, ends, strict=True)
        ranges = [np.searchsorted(origin + grid.spacing * along, both) for along, origin, both in axes]
        return np.array(ranges, np.int64).T


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


def unions_of(region: Region, grid: Grid, stencil: Stencil) -> tuple[list[Union], Materials]:
    """Return unions of consecutive bodies that share a material, and the materials."""
    air = region.fluid
    fluids: list[Fluid | None] = [air]
    unions: list[Union] = []
    for body in region.bodies:
        if body.fluid not in fluids:
            fluids.append(body.fluid)
        aligned = is_along(body.shape, np.eye(3), grid.spacing)
        union = Union(
            (body.shape,),
            fluids.index(body.fluid),
            body.continued,
            aligned,
            body.fluid is None,
            not aligned and (body.fluid is None or body.fluid.inertia > air.inertia),
        )
        if unions and union == replace(unions[-1], shapes=union.shapes):
            unions[-1] = replace(union, shapes=(*unions[-1].shapes, *union.shapes))
        else:
            unions.append(union)
    density = np.full(len(fluids), _RIGID_DENSITY)
    factor, slowness = np.ones(len(fluids)), np.ones(len(fluids))
    for number, fluid in enumerate(fluids):
        if fluid is not None:
            ratio = fluid.phase_speed / air.phase_speed
            density[number] = fluid.inertia / air.inertia / flow_factor(stencil.kappa, ratio)
            factor[number], slowness[number] = speed_factor(stencil, ratio), 1 / ratio
    rigid = np.array([fluid is None for fluid in fluids])
    return unions, Materials(density, 1 / (density * factor), slowness, rigid)
