"""The axes of a grid, which follow the flat faces of the bodies in it.

The field around a box is exact, so that its grid may have any direction. A tilted cuboid is then as accurate
as one aligned with the axes of the scene.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from autdtorch.fdtd.shapes import Shape
from autdtorch.utils.array_types import Array
from autdtorch.utils.spatial import doubled_normals

ALIGNED = 1 - 1e-9  # Smallest cosine between the normal of a face and an axis that is parallel to it
_PERPENDICULAR = 4e-5  # Largest cosine between perpendicular normals; the same angle
# Least additional share of all surfaces aligned by turning a grid, which may cost symmetries
_WORTHWHILE = 0.4
_AXES_DECIMALS = 12  # Decimals of normals: rounding of positions must not turn the grid
_DECIMALS = 6  # Normals that agree to so many decimals are equal: files hold single precision
_ALL = 1 - 1e-6  # Aligned share of a surface from which all of it is aligned, apart from slivers


def is_tilted(axes: Array) -> bool:
    """Return whether axes, one a row (3, 3), are not those of the scene in any order."""
    return bool((np.abs(axes).max(axis=1) < 1).any())


class FlatFaces(NamedTuple):
    """The flat faces of a surface."""

    normals: Array  # outward unit vectors (n, 3)
    areas: Array  # areas (n,) [m^2]

    def aligned_share(self, axes: Array) -> float:
        """Return the share of their area that is normal to one of the axes, one a row (3, 3)."""
        aligned = (np.abs(self.normals @ axes.T) > ALIGNED).any(axis=1)
        return 1.0 if aligned.all() else float(self.areas[aligned].sum() / self.areas.sum())

    def is_prism(self, axis: Array) -> bool:
        """Return whether each of them is parallel or normal to an axis (3,)."""
        along = np.abs(self.normals @ axis)
        return bool(((along < _PERPENDICULAR) | (along > ALIGNED)).all())

    def all_aligned(self, axes: Array) -> bool:
        """Return whether all of them are normal to one of the axes, one a row (3, 3)."""
        return self.aligned_share(axes) >= _ALL


def axes_along(surfaces: Sequence[FlatFaces]) -> Array:
    """Return the axes, one a row (3, 3), that are normal to the largest area of surfaces.

    Where flat faces are too small, a direction along which no body varies, as along a cylinder, is an axis.
    """
    together = FlatFaces(*(np.concatenate(parts) for parts in zip(*surfaces, strict=True)))
    scene_axes = np.eye(3)
    best = max((_axes_of_faces(*faces) for faces in surfaces), key=together.aligned_share)
    if together.aligned_share(best) > together.aligned_share(scene_axes) + _WORTHWHILE:
        return best
    if any(together.is_prism(axis) for axis in scene_axes):
        return scene_axes
    _, directions = np.linalg.eigh(together.normals.T @ (together.areas[:, None] * together.normals))
    along = next((axis for axis in directions.T if together.is_prism(axis)), None)
    return scene_axes if along is None else _axes_with(along.round(_AXES_DECIMALS))


def flat_faces(shape: Shape) -> FlatFaces:
    """Return the flat faces of a shape; triangles of a curved surface are faces, too."""
    vertices, triangles = (part.numpy() for part in shape.surface())
    normal = doubled_normals(vertices[triangles])
    double = np.linalg.norm(normal, axis=1)
    normal, double = normal[double > 0], double[double > 0]
    rounded = (normal / double[:, None]).round(_DECIMALS)
    _, place = np.unique(rounded, axis=0, return_inverse=True)
    total = np.stack([np.bincount(place.ravel(), component) for component in normal.T], axis=1)
    areas = np.linalg.norm(total, axis=1)
    return FlatFaces(total / areas[:, None], areas / 2)


def _axes_of_faces(normals: Array, areas: Array) -> Array:
    """Return the axes (3, 3) of the largest face and of the largest perpendicular one, in the usual order."""
    normals = normals.round(_AXES_DECIMALS)
    first = normals[areas.argmax()]
    beside = np.abs(normals @ first) < _PERPENDICULAR
    return _axes_with(first, normals[beside][areas[beside].argmax()] if beside.any() else None)


def _axes_with(first: Array, second: Array | None = None) -> Array:
    """Return axes (3, 3) along a direction (3,) and one about perpendicular, in the usual order."""
    second = np.eye(3)[np.abs(first).argmin()] if second is None else second
    second = second - (second @ first) / (first @ first) * first
    first, second = first / np.linalg.norm(first), second / np.linalg.norm(second)
    axes = np.stack((first, second, np.cross(first, second)))
    orders = [axes[list(order)] for order in itertools.permutations(range(3))]
    usual = max(orders, key=lambda each: np.abs(np.diag(each)).sum())
    return usual * np.where(np.diag(usual) < 0, -1.0, 1.0)[:, None]


_LARGEST_RADIUS = 1.25  # of such a cylinder [cells]
_FEWEST_CORNERS = 16  # Fewest corners of a polygon that represents a circle
_ROUND = 1e-6  # Largest deviation of corners from the circle, relative to the radius
_STEPS = np.cos((np.arange(4) + 0.5) * np.pi / 8)  # Faces of the staircase, relative to its radius
_SCALE = 0.957173  # Radius of the staircase over the radius of the circle of equal area
_PERIMETER = float(8 * _SCALE * _STEPS[0] / (2 * np.pi))  # Perimeters: staircase over circle


def slender_faces(corners: Array) -> list[Array] | None:
    """Return the places of the faces of a slender cylinder along each axis, or None for other shapes.

    `corners` (V, 3) [cells] are the vertices of its surface.
    """
    lower, upper = corners.min(axis=0), corners.max(axis=0)
    at_ends = (np.minimum(corners - lower, upper - corners) < _ROUND).all(axis=0)
    axis = int(at_ends.argmax())  # not of the largest extent: a cylinder may be as long as it is wide
    length, across = upper[axis] - lower[axis], np.delete(upper - lower, axis).max()
    if not at_ends.any() or across > min(2 * _LARGEST_RADIUS, length * (1 + _ROUND)):
        return None
    middle = (lower + upper) / 2
    from_axis = np.delete(corners - middle, axis, axis=1)
    distance = np.hypot(*from_axis.T)
    radius, on_axis = float(distance.max()), distance < _ROUND * distance.max()
    round_ = np.abs(distance - radius) < _ROUND * radius
    if not (round_ | on_axis).all():
        return None
    corner_count = len(np.unique(np.arctan2(*from_axis[round_].T).round(6)))
    if corner_count < _FEWEST_CORNERS:
        return None
    steps = radius * _SCALE * np.concatenate((-_STEPS, _STEPS))
    ends = np.array([lower[axis], upper[axis]])
    return [ends if along == axis else middle[along] + steps for along in range(3)]


def staircase_excess(corners: Array) -> float:
    """Return the ratio of the areas of `slender_faces` and of the surface; 1 for other shapes."""
    if slender_faces(corners) is None:
        return 1.0
    *_, across, length = np.sort(np.ptp(corners, axis=0))
    return 1 + (_PERIMETER - 1) * float(length / (length + across / 2))
