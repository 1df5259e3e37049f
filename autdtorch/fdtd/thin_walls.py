"""Walls thinner than a cell and oblique to the grid: rigid sheets are thickened, and a warning is logged.

Elements measure bodies on a lattice of points a quarter of a cell apart, so that they would miss a rigid
sheet between these (`docs/numerics.md` has figures). Errors at such walls are larger than
estimated.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch

from autdtorch.fdtd.region import Region
from autdtorch.fdtd.shapes import Shape
from autdtorch.utils.array_types import Array
from autdtorch.utils.spatial import doubled_normals, extents, mean_thickness, spread_evenly
from autdtorch.utils.validation import Vector

logger = logging.getLogger(__name__)

_PLACES, _DEPTHS = 200, 16  # Places of a surface where the thickness is measured, and depths below each
_LEAST_SHARE = 0.05  # Least share of a surface that is a thin wall; at sharp edges less is
_PARALLEL = 0.85  # Least cosine of the angle between the faces of a wall
_ALIKE = 2.0  # Ratio of densities up to which a thin wall of fluid causes only a small error

_THINNEST = 0.32  # Least thickness of a rigid sheet [cells]
_OPEN = 1e-9  # Thickness [cells] up to which a surface is open, as of a half-space
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
        """Return the vertices (V, 3) [m] and triangles (F, 3) of the original shape."""
        return self.shape.surface()


def thickened(shape: Shape, spacing: float) -> Shape:
    """Return a thinner sheet with the least thickness on cells of a spacing [m], other shapes unchanged."""
    vertices, triangles = (part.numpy() for part in shape.surface())
    thickness = mean_thickness(vertices, triangles) / spacing
    if not _OPEN < thickness < _THINNEST or extents(vertices)[1] < _WIDE * spacing:
        return shape
    return Thickened(shape, (_THINNEST - thickness) * spacing / 2)


def warn_of_thin_walls(region: Region, spacing: float, grids: Iterable[tuple[Iterable[int], Array]]) -> None:
    """Log which bodies have walls thinner than a cell [m], oblique to their grid.

    `grids` are the numbers of the bodies on each, and its axes, one a row (3, 3).
    """
    for numbers, axes in grids:
        for number in numbers:
            body = region.bodies[number]
            if region.is_as_heavy(body, _ALIKE) or body.is_along(axes, spacing):
                continue
            if (wall := thin_wall(body.shape, spacing)) is not None:
                thickness, place = wall
                logger.warning(
                    "obstacle %d has a wall of %.2g mm at %s mm, oblique to the grid and thinner than a cell"
                    " of %.3g mm: the error may be larger than estimated",
                    number, 1e3 * thickness, tuple((1e3 * place).round(2).tolist()), 1e3 * spacing,
                )  # fmt: skip


def thin_wall(shape: Shape, spacing: float) -> tuple[float, Array] | None:
    """Return the median thickness [m] of the walls of a shape thinner than a cell, and its place (3,) [m].

    Thickness is measured along the inward normal, at places that share the area evenly, up to a face that is
    nearly parallel.
    """
    vertices, triangles = (part.numpy() for part in shape.surface())
    if extents(vertices)[1] < spacing:
        return None
    corners = vertices[triangles]
    normals = doubled_normals(corners)
    area = np.linalg.norm(normals, axis=1)
    some = spread_evenly(area, _PLACES)
    places, inwards = corners[some].mean(axis=1), -normals[some] / area[some, None]
    step = spacing / _DEPTHS
    depths = step * np.arange(1, _DEPTHS + 2)  # one beyond a cell, for the slope there
    below = places[:, None] + depths[:, None] * inwards[:, None]
    distance = shape.signed_distance(torch.from_numpy(below)).numpy()
    first = (distance[:, :-1] > 0).argmax(axis=1)  # depth behind the opposite face
    behind, farther = (distance[np.arange(_PLACES), first + more] for more in (0, 1))
    thin = (behind > 0) & (farther - behind > _PARALLEL * step)
    if thin.mean() < _LEAST_SHARE:
        return None
    thickness = depths[first[thin]] - behind[thin]
    median = int(np.argsort(thickness)[len(thickness) // 2])
    return float(thickness[median]), np.asarray(places[thin][median])
