"""Where the grid lies best: with the flat faces along it half-way between cell centres.

The air between the last cell centre and a rigid face, d cells behind it, adds its mass to that cell's. The
standing wave on the grid would need a mass of 1/2 + tan(kappa d) / (2 tan(kappa / 2)) there, which is
1/2 + d + kappa^2 (d^3/3 - d/12) + ...: the last term is missed. It vanishes for d = 1/2 and is largest,
kappa^2 / 4, for a face that just touches the next centre. A curved surface has all distances and misses
little on average; a face along the grid has one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from autdtorch.obstacles import Obstacle
from autdtorch.scene import Scene

Array = NDArray[np.float64]

_ALONG = 1 - 1e-9
"""Cosine of the angle between a face's normal and an axis from which on the face lies along the grid."""

_TOUCHING = 1e-6
"""Distance of a face from a cell centre [cells] up to which the centre lies on it, thus in the obstacle."""

_STEPS = 20
"""Places within a cell that are tried, beside those with a face half-way between centres."""

_WORTHWHILE = 0.9
"""Share of the miss, of a grid that begins at the domain's corner, below which another place is taken."""


@dataclass(frozen=True)
class _Triangles:
    """An obstacle's surface.

    Attributes:
        corner: first corner of each triangle (n, 3) [m].
        normal: outward (n, 3), of twice the triangle's area [m^2].
    """

    corner: Array
    normal: Array

    @classmethod
    def of(cls, obstacle: Obstacle) -> _Triangles:
        vertices, triangles = (part.numpy() for part in obstacle.surface())
        first, second, third = np.moveaxis(vertices[triangles], 1, 0)
        return cls(first, np.cross(second - first, third - first))

    def across(self, axis: int) -> tuple[Array, Array, Array]:
        """Those across an axis: coordinate [m], sign of the normal along the axis, area [m^2]."""
        double = np.linalg.norm(self.normal, axis=1)
        flat = np.abs(self.normal[:, axis]) > _ALONG * double
        return self.corner[flat, axis], np.sign(self.normal[flat, axis]), double[flat] / 2


def grid_offset(scene: Scene, spacing: float, lower: Sequence[float]) -> tuple[float, float, float]:
    """How far below a grid's lower corner (3,) [m] its first cell should begin, per axis [cells], in [0, 1).

    Zero if no obstacle has flat faces along the grid, or if they lie as well as they can.
    """
    surfaces = [_Triangles.of(obstacle) for obstacle in scene.obstacles]
    x, y, z = (_axis_offset(*_faces(scene, surfaces, axis, low), spacing) for axis, low in enumerate(lower))
    return x, y, z


def _faces(scene: Scene, surfaces: list[_Triangles], axis: int, origin: float) -> tuple[Array, Array, Array]:
    """Faces across an axis within the domain.

    Their distance from an origin [m], 1 where the lighter side comes first and -1 where the heavier
    does, and their area [m^2].
    """
    low, high = (corner[axis] for corner in scene.domain)
    parts = [np.zeros((3, 0))]
    for obstacle, surface in zip(scene.obstacles, surfaces, strict=True):
        place, outward, area = surface.across(axis)
        heavier = obstacle.density is None or obstacle.density >= scene.medium.density
        inside = (place > low) & (place < high)
        parts.append(np.stack((place - origin, -outward if heavier else outward, area))[:, inside])
    place, first, area = np.concatenate(parts, axis=1)
    faces, own = np.unique(np.stack((place.round(9), first)), axis=1, return_inverse=True)
    return faces[0], faces[1], np.bincount(own.ravel(), area, faces.shape[1]).astype(np.float64)


def _axis_offset(place: Array, first: Array, area: Array, spacing: float) -> float:
    """Offset [cells] with the smallest sum of squares of what the faces miss."""
    if len(place) == 0:
        return 0.0
    cells = place / spacing
    between = np.unique(np.round(-cells % 1, 9) % 1)
    offsets = np.concatenate(((0.0,), between[:_STEPS], np.arange(_STEPS) / _STEPS))
    distance = first * (cells + offsets[:, None] - 0.5)
    distance = (distance - _TOUCHING) % 1 + _TOUCHING
    missed = (distance**3 / 3 - distance / 12) ** 2 @ area
    best = int(missed.argmin())
    return float(offsets[best]) if missed[best] < _WORTHWHILE * missed[0] else 0.0
