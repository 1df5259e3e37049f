"""Sound-hard sheets oblique to the grid, thickened until elements see them.

Elements see bodies at the points of a lattice, a quarter of a cell apart. A sheet between these would not be
there at all. `docs/decisions/surfaces.md` has figures.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from autdtorch.fdtd.region import Shape
from autdtorch.utils.triangles import extents, mean_thickness
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
