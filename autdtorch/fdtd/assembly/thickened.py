"""Rigid sheets and walls with the least thickness that elements see.

Sheets are thickened on both sides. Where a later fluid leaves a thin wall of a rigid body, the fluid
recedes, so that the outer surface of the body stays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from autdtorch.fdtd.shapes import Bounded, Shape
from autdtorch.utils.array_types import REAL
from autdtorch.utils.spatial import extents, mean_thickness
from autdtorch.utils.validation import Vector

_THINNEST = 0.32  # Least thickness of a rigid sheet or wall [cells]
_OPEN = 1e-9  # Thickness [cells] up to which a surface is open, as of a half-space
_WIDE = 2.0  # Least extent [cells] of a sheet along two axes: needles would become much thicker than they are
_FLUSH = 1e-6  # Thickness of a wall [cells] up to which its faces coincide: the fluid opens to the air there
_PARALLEL = 0.85  # Least cosine of the angle between the faces of a wall
_STEP = 1e-3  # Distance [cells] of the points that tell the directions of faces


@dataclass(frozen=True, eq=False)
class Thickened(Bounded):
    """A shape whose surface is moved outwards."""

    shape: Shape
    distance: float  # of the surfaces [m]

    @property
    def _bounds(self) -> tuple[Vector, Vector]:
        (x, y, z), (u, v, w), far = self.shape.lower, self.shape.upper, self.distance
        return (x - far, y - far, z - far), (u + far, v + far, w + far)

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


@dataclass(frozen=True, eq=False)
class _Receding(Bounded):
    """A fluid shape inside a rigid one, whose surface recedes where the wall between them is thin."""

    shape: Shape
    rigid: Shape
    spacing: float  # [m]

    @property
    def _bounds(self) -> tuple[Vector, Vector]:
        return self.shape.lower, self.shape.upper

    def signed_distance(self, points: torch.Tensor, /) -> torch.Tensor:
        """Return the distance (...) [m] of points (..., 3) to the surface, negative inside.

        In a wall and beside it, the distances from its two faces differ by its thickness.
        """
        distance, outer = (each.signed_distance(points) for each in (self.shape, self.rigid))
        wall = distance - outer
        thin = (wall > _FLUSH * self.spacing) & (wall < _THINNEST * self.spacing)
        thin[thin.clone()] = self._is_parallel(points[thin])
        return torch.where(thin, outer + _THINNEST * self.spacing, distance)

    def _is_parallel(self, points: torch.Tensor) -> torch.Tensor:
        """Return at which points (n, 3) the nearest faces of both shapes look the same way."""
        step = _STEP * self.spacing
        axes = torch.eye(3, **REAL).to(points)
        around = points + step * torch.cat((axes, -axes))[:, None]
        ahead, behind = (
            torch.stack([each.signed_distance(part) for each in (self.shape, self.rigid)])
            for part in torch.split(around, 3)
        )
        cosine = ((ahead - behind) / (2 * step)).prod(dim=0).sum(dim=0)
        return cosine > _PARALLEL

    def surface(self) -> tuple[torch.Tensor, torch.Tensor]:
        return self.shape.surface()


def receding(shape: Shape, before: Sequence[Shape], spacing: float) -> Shape:
    """Return a fluid shape that leaves rigid shapes `before` it walls of the least thickness on cells [m]."""
    for rigid in before:
        if (np.maximum(shape.lower, rigid.lower) < np.minimum(shape.upper, rigid.upper)).all():
            shape = _Receding(shape, rigid, spacing)
    return shape
