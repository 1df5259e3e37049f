"""Bodies as the assembly sees them: unions of consecutive bodies of one material, and the materials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from autdtorch.fdtd.assembly.element import Materials
from autdtorch.fdtd.assembly.materials import Kind, materials_of
from autdtorch.fdtd.grid import Grid
from autdtorch.fdtd.region import Body, Region
from autdtorch.fdtd.shapes import Shape, bounds
from autdtorch.fdtd.stencil import Stencil
from autdtorch.fdtd.thin_walls import thickened
from autdtorch.fdtd.turning import slender_faces
from autdtorch.utils.array_types import Array, Index

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


def unions_of(region: Region, grid: Grid, stencil: Stencil) -> tuple[list[Union], Materials]:
    """Return unions of consecutive bodies that share a material, and the materials."""
    air = region.fluid
    kinds = [Kind(air, None)]
    unions: list[Union] = []
    for number, body in enumerate(region.bodies):
        _require_continuable(number, body)
        kind = Kind(body.fluid, body.impedance)
        if kind not in kinds:
            kinds.append(kind)
        aligned = body.is_along(np.eye(3), grid.spacing)
        union = Union(
            (body.shape,),
            kinds.index(kind),
            body.continued,
            aligned,
            body.fluid is None,
            not aligned and (body.fluid is None or body.fluid.inertia > air.inertia),
        )
        if unions and union == replace(unions[-1], shapes=union.shapes):
            unions[-1] = replace(union, shapes=(*unions[-1].shapes, *union.shapes))
        else:
            unions.append(union)
    return unions, materials_of(kinds, air, stencil)


def _require_continuable(number: int, body: Body) -> None:
    """Refuse bodies through the boundary layers that these do not absorb waves in.

    Layers stretch the coupling of cells, and not the damping of it by a complex density. Along a surface with
    an impedance waves grow in them.
    """
    if body.continued and body.impedance is not None:
        raise ValueError(
            f"obstacles[{number}]: a surface with an impedance ({body.impedance:.3g}) crosses the whole"
            " domain; must end inside it, or be a reflector"
        )
    if body.continued and body.fluid is not None and body.fluid.density.imag:
        raise ValueError(
            f"obstacles[{number}]: a fluid of complex density ({body.fluid.density:.3g} kg/m^3) crosses the"
            ' whole domain; must end inside it, or use method="box"'
        )
