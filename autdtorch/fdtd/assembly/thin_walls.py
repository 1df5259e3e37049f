"""Thin rigid sheets and walls: their least thickness, and the finite elements on their sides.

Sheets are thickened on both sides. Where a later fluid leaves a thin wall of a rigid body, the fluid
recedes, so that the outer surface of the body stays.

Finite elements in front of a wall and behind it share no vertices. The air in an element that walls cross is
in several parts, its sides. To a side belong the vertices in its air, and those inside a wall whose nearest
face does not look the opposite way. Sound would pass through others. Vertices half-way between two faces
belong to no side, as a mirror image would choose the other one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import generate_binary_structure, label

from autdtorch.fdtd.assembly.reference_element import CORNERS, SUBCELLS, subcell_gradients, subcell_means
from autdtorch.fdtd.shapes import Bounded, Shape
from autdtorch.utils.array_types import REAL, Array, Index
from autdtorch.utils.spatial import extents, mean_thickness
from autdtorch.utils.validation import Vector

_THINNEST = 0.32  # Least thickness of a rigid sheet or wall [cells]
_OPEN = 1e-9  # Thickness [cells] up to which a surface is open, as of a half-space
_WIDE = 2.0  # Least extent [cells] of a sheet along two axes: needles would become much thicker than they are
_FLUSH = 1e-6  # Thickness of a wall [cells] up to which its faces coincide: the fluid opens to the air there
_PARALLEL = 0.85  # Least cosine of the angle between the faces of a wall
_STEP = 1e-3  # Distance [cells] of the points that tell the directions of faces
_OPPOSITE = -0.5  # Cosine of the angle between two faces below which they look opposite ways
_LEAST = 1 / len(CORNERS)  # Sum of the shares of sub-cells in which a side has one point of the lattice
_NEIGHBOURS = np.zeros((3,) * 4, bool)  # of points of the lattices of n elements: six, of the same element
_NEIGHBOURS[1] = generate_binary_structure(3, 1)


class Side(NamedTuple):
    """The air on one side of thin walls in n elements."""

    share: Array  # of the air in each sub-cell (n, 64)
    out: NDArray[np.bool_]  # vertices that do not belong to the side (n, 8)

    def chosen(self, some: Index | NDArray[np.bool_]) -> Side:
        """Return the side in some of the elements."""
        return Side(self.share[some], self.out[some])


def wall_sides(level: Array, normal: Array, walls: NDArray[np.bool_]) -> tuple[Side, ...]:
    """Return the sides of walls in n elements; without walls, and in the mask `walls` (n,), there is one.

    Signed distances `level` (n, 125) are those from rigid bodies, and `normal` (n, 8, 3) their gradients at
    vertices inside. A side that an element does not have has no share there.
    """
    sides = [Side(np.ones((len(level), SUBCELLS**3)), np.zeros((len(level), 8), bool))]
    for number, side in enumerate(_sides(level[walls], normal[walls])):
        if number > 0:
            sides.append(Side(np.zeros_like(sides[0].share), np.zeros_like(sides[0].out)))
        sides[-1].share[walls], sides[-1].out[walls] = side
    return tuple(sides)


def _sides(level: Array, normal: Array) -> Iterator[Side]:
    """Yield the sides of walls in elements that all have walls; see `wall_sides`."""
    outside, gradient = level > 0, subcell_gradients(level)
    inside, whole = ~outside[:, CORNERS], subcell_means(outside.astype(float))
    undecided = ~normal.any(axis=2)
    labels, count = label(outside.reshape(-1, *(SUBCELLS + 1,) * 3), _NEIGHBOURS)
    labels = labels.reshape(level.shape)
    while labels.any():
        first = np.where(labels > 0, labels, count + 1).min(axis=1, keepdims=True)
        here = labels == first
        labels[here] = 0
        part = subcell_means(here.astype(float))
        facing = (part[:, None] @ gradient)[:, 0] / np.maximum(part.sum(axis=1, keepdims=True), _LEAST)
        opposite = (normal * facing[:, None]).sum(axis=2) < _OPPOSITE
        share = np.divide(part, whole, out=np.zeros_like(part), where=whole > 0)
        yield Side(share, np.where(inside, opposite | undecided, ~here[:, CORNERS]))


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
