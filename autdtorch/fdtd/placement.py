"""Where the grid lies best: with the flat faces along it half-way between cell centres.

The air between the last cell centre and a rigid face, d cells behind it, adds its mass to that cell's. The
standing wave on the grid would need a mass of 1/2 + tan(kappa d) / (2 tan(kappa / 2)) there, which is
1/2 + d + kappa^2 (d^3/3 - d/12) + ...: the last term is missed. It vanishes for d = 1/2 and is largest,
kappa^2 / 4, for a face that just touches the next centre. A curved surface has all distances and misses
little on average; a face along the grid has one.

Of places about as good, the grid takes one whose middle is that of what it covers: a scene that is its own
mirror image is then one on the grid, too, which saves runs (`propagator/symmetry.py`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autdtorch.fdtd.region import Region, Shape
from autdtorch.utils.arrays import Array
from autdtorch.utils.validation import LENGTH_TOLERANCE

_ALONG = 1 - 1e-9
"""Cosine of the angle between a face's normal and an axis from which on the face lies along the grid."""

_TOUCHING = 1e-6
"""Distance of a face from a cell centre [cells] up to which the centre lies on it, thus in the obstacle."""

_ROUNDING = 1e-6
"""Of a length [cells]: that much more than whole cells needs no further one."""

_STEPS = 20
"""Places within a cell that are tried, beside those with a face half-way between centres; from a symmetric
one on, so that mirror images of faces have mirror images of places."""

_SYMMETRIC = 0, _STEPS // 2
"""Those among them where the grid is symmetric: a cell or a face between cells in the middle."""

_WORTHWHILE = 0.9
"""Share of the miss of a symmetric grid below which another place is taken, for faces that are not."""

_FORGIVEN = 0.07
"""Miss [kappa^2], root of the mean square, that a symmetric grid may have more for faces that are symmetric:
a quarter of the largest. `docs/decisions/runs.md` has the errors."""


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
    def of(cls, shape: Shape) -> _Triangles:
        vertices, triangles = (part.numpy() for part in shape.surface())
        first, second, third = np.moveaxis(vertices[triangles], 1, 0)
        return cls(first, np.cross(second - first, third - first))

    def across(self, axis: int) -> tuple[Array, Array, Array]:
        """Those across an axis: coordinate [m], sign of the normal along the axis, area [m^2]."""
        double = np.linalg.norm(self.normal, axis=1)
        flat = np.abs(self.normal[:, axis]) > _ALONG * double
        return self.corner[flat, axis], np.sign(self.normal[flat, axis]), double[flat] / 2


def grid_offset(
    region: Region, spacing: float, lower: Sequence[float], upper: Sequence[float]
) -> tuple[float, float, float]:
    """How far below a lower corner (3,) [m] a grid's first cell should begin, per axis [cells], in [0, 1).

    Args:
        region: its bodies decide.
        spacing: edge of a cell [m].
        lower: corner of what the grid is to cover.
        upper: the other corner.

    Returns:
        Offsets with which the grid extends as far beyond the one corner as beyond the other, unless flat
        faces lie clearly better in another place.
    """
    surfaces = [_Triangles.of(shape) for shape in region.shapes]
    x, y, z = (
        _axis_offset(
            _faces(region, surfaces, axis, low),
            region.sources[:, axis] - low,
            high - low,
            spacing,
        )
        for axis, (low, high) in enumerate(zip(lower, upper, strict=True))
    )
    return x, y, z


def _faces(
    region: Region, surfaces: list[_Triangles], axis: int, origin: float
) -> tuple[Array, Array, Array]:
    """Faces across an axis within the domain.

    Their distance from an origin [m], 1 where the lighter side comes first and -1 where the heavier
    does, and their area [m^2].
    """
    low, high = (corner[axis] for corner in region.domain)
    parts = [np.zeros((3, 0))]
    for body, surface in zip(region.bodies, surfaces, strict=True):
        place, outward, area = surface.across(axis)
        heavier = body.fluid is None or body.fluid.density >= region.fluid.density
        inside = (place > low) & (place < high)
        parts.append(np.stack((place - origin, -outward if heavier else outward, area))[:, inside])
    place, first, area = np.concatenate(parts, axis=1)
    faces, own = np.unique(np.stack((place.round(9), first)), axis=1, return_inverse=True)
    return faces[0], faces[1], np.bincount(own.ravel(), area, faces.shape[1]).astype(np.float64)


def _axis_offset(
    faces: tuple[Array, Array, Array], transducers: Array, length: float, spacing: float
) -> float:
    """Offset [cells] with a small sum of squares of what the faces miss, if need be of the symmetric ones.

    Coordinates of faces and transducers begin at one end of what is covered [m]; `length` is that of the
    other.
    """
    place, first, area = faces
    cells, whole = place / spacing, length / spacing
    middle = (math.ceil(whole - _ROUNDING) - whole) / 2
    if len(place) == 0:
        return middle
    between = np.unique(np.round(-cells % 1, 9))[:_STEPS]
    offsets = np.concatenate((middle + np.arange(_STEPS) / _STEPS, between))
    offsets -= np.floor(offsets + _ROUNDING)
    distance = first * (cells + offsets[:, None] - 0.5)
    distance = (distance - _TOUCHING) % 1 + _TOUCHING
    missed = (distance**3 / 3 - distance / 12) ** 2 @ area / area.sum()
    best, symmetric = int(missed.argmin()), min(_SYMMETRIC, key=lambda number: missed[number])
    allowed = missed[best] / _WORTHWHILE
    pointlike = np.stack((transducers, np.zeros_like(transducers), np.zeros_like(transducers)))
    if _mirrored(np.concatenate((faces, pointlike), axis=1), length):
        allowed = max(allowed, (math.sqrt(missed[best]) + _FORGIVEN) ** 2)
    return float(offsets[symmetric if missed[symmetric] <= allowed else best])


def _mirrored(things: Array, length: float) -> bool:
    """Whether things (3, n) are their own mirror images: coordinate from one end [m], direction and area."""
    images = np.stack((length - things[0], -things[1], things[2]))
    here, there = (each[:, np.lexsort((each[1], each[0].round(9)))] for each in (things, images))
    return np.allclose(here, there, rtol=0, atol=2 * LENGTH_TOLERANCE)
