"""Bodies as the assembly sees them: unions of consecutive bodies of one material, and the materials.

Elements measure bodies on a lattice of points a quarter of a cell apart, so that they would miss a rigid
sheet between these. Such sheets, oblique to the grid, are thickened (`docs/decisions/surfaces.md` has
figures).
"""

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
from autdtorch.fdtd.turning import is_along, slender_faces
from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.spatial import extents, mean_thickness
from autdtorch.utils.validation import Vector

_THINNEST = 0.32  # Least thickness [cells]
_OPEN = 1e-9  # Thickness [cells] up to which a surface is not closed, such as that of a half-space
_WIDE = 2.0  # Least extent [cells] of a sheet along two axes: needles would become much thicker than they are


@dataclass(frozen=True, eq=False)
class Thickened:
    """A shape whose surface is moved outwards."""

    shape: Shape
    distance: float  # of the surfaces [m]

    @property
    def lower(self) -> Vector:
        """Corner of the bounding box with the smallest coordinates (3,) [m]."""
        x, y, z = self.shape.lower
        return x - self.distance, y - self.distance, z - self.distance

    @property
    def upper(self) -> Vector:
        """Corner of the bounding box with the largest coordinates (3,) [m]."""
        x, y, z = self.shape.upper
        return x + self.distance, y + self.distance, z + self.distance

    def signed_distance(self, points: torch.Tensor, /) -> torch.Tensor:
        """Return the distance (...) [m] of points (..., 3) to the surface, negative inside."""
        return self.shape.signed_distance(points) - self.distance

    def surface(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the vertices (V, 3) [m] and triangles (F, 3) of the shape as it was."""
        return self.shape.surface()


def thickened(shape: Shape, spacing: float) -> Shape:
    """Return a sheet of the least thickness on cells of a spacing [m], and any other shape as it is."""
    vertices, triangles = (part.numpy() for part in shape.surface())
    thickness = mean_thickness(vertices, triangles) / spacing
    if not _OPEN < thickness < _THINNEST or extents(vertices)[1] < _WIDE * spacing:
        return shape
    return Thickened(shape, (_THINNEST - thickness) * spacing / 2)


# Density with which sound-hard bodies are assembled. Cells that stay almost uncoupled become sound-hard.
_SOUND_HARD_DENSITY = 1e5
# Distance by which bodies are grown, so that touching bodies leave no film of air between them
_CONTACT_GAP = 1e-9


@dataclass(frozen=True)
class Union:
    """Union of consecutive bodies of one material."""

    shapes: tuple[Shape, ...]
    material: int
    continued: bool  # whether they continue through the boundary layers, unchanged from the interior
    aligned: (
        bool  # whether blocks represent it: all its faces are flat and parallel to the grid, or it is slender
    )
    sound_hard: bool
    finite: bool  # whether finite elements represent its surface; of a fluid only the edges

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
        """Return the union as lattices of elements see it, on cells of a spacing [m]: without thin sheets."""
        if not self.sound_hard:
            return self
        return replace(self, shapes=tuple(thickened(shape, spacing) for shape in self.shapes))

    def faces(self, grid: Grid) -> list[Array]:
        """Return the places [cells] of its faces along each axis, up to its end on a grid."""
        corners = [grid.to_cells(one.surface()[0]) for one in self.shapes]
        faces = [slender_faces(own) or list(own.T) for own in corners]
        found = []
        for axis, own in enumerate(map(np.concatenate, zip(*faces, strict=True))):
            first, last = float(grid.first[axis]), grid.last[axis] - 1.0
            inside = own[(own > first) & (own < last)]
            found.append(inside if self.continued else np.clip(own, first + 0.5, last - 0.5))
        return found

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
        ranges = [np.searchsorted(origin + grid.spacing * own, both) for own, origin, both in axes]
        return np.array(ranges, np.int64).T


def speed_factor(stencil: Stencil, speed_ratio: float) -> float:
    """Return the factor by which to divide masses, so that a wave in a material has the drive's frequency."""
    return stencil.symbol / stencil.isotropic_symbol(stencil.kappa / speed_ratio)


def flow_factor(kappa: float, speed_ratio: float) -> float:
    """Return the factor on a material's coupling and mass with which waves keep their flow at its surface.

    Where a wave of unit pressure and flow passes a grid, the discrete flow is sin(k) / k, with the material's
    own k. At oblique incidence the two normal k differ, but the ratio is unchanged to second order.
    """
    own = kappa / speed_ratio
    return math.sin(kappa) / kappa / (math.sin(own) / own)


def unions_of(region: Region, grid: Grid, stencil: Stencil) -> tuple[list[Union], Materials]:
    """Return unions of consecutive bodies that share a material, and the materials."""
    air = region.fluid
    known: list[Fluid | None] = [air]
    unions: list[Union] = []
    for body in region.bodies:
        if body.fluid not in known:
            known.append(body.fluid)
        aligned = is_along(body.shape, np.eye(3), grid.spacing)
        own = Union(
            (body.shape,),
            known.index(body.fluid),
            body.continued,
            aligned,
            body.fluid is None,
            not aligned and (body.fluid is None or body.fluid.density > air.density),
        )
        if unions and own == replace(unions[-1], shapes=own.shapes):
            unions[-1] = replace(own, shapes=(*unions[-1].shapes, *own.shapes))
        else:
            unions.append(own)
    density = np.full(len(known), _SOUND_HARD_DENSITY)
    factor, slowness = np.ones(len(known)), np.ones(len(known))
    for number, fluid in enumerate(known):
        if fluid is not None:
            ratio = fluid.sound_speed / air.sound_speed
            density[number] = fluid.density / air.density / flow_factor(stencil.kappa, ratio)
            factor[number], slowness[number] = speed_factor(stencil, ratio), 1 / ratio
    sound_hard = np.array([fluid is None for fluid in known])
    return unions, Materials(density, 1 / (density * factor), slowness, sound_hard)
