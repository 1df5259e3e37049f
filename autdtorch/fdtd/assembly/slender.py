"""Cylinders along the grid that are about as thin as a cell, such as needles and wires.

A staircase of blocks with the area of the circle stands for it: the elements that it passes are then fitted
as those at edges are (`prisms.py`).
"""

from __future__ import annotations

import numpy as np

from autdtorch.fdtd.region import Shape
from autdtorch.fdtd.turning import flat_faces
from autdtorch.utils.array_types import Array

# Largest radius [cells] of such a cylinder: elements across it are fitted together, at most four by four
_LARGEST_RADIUS = 1.25
_FEWEST_CORNERS = 16  # Fewest corners of a polygon that stands for a circle
_ROUND = 1e-6  # Largest deviation of corners from the circle, relative to the radius
_STEPS = np.cos((np.arange(4) + 0.5) * np.pi / 8)  # Faces of the staircase, relative to its radius
_SCALE = 0.957173  # Radius of the staircase over that of the circle of equal area


def slender_faces(corners: Array) -> list[Array] | None:
    """Return the places of the faces of a slender cylinder along each axis, or None for other shapes.

    `corners` (V, 3) [cells] are the vertices of its surface.
    """
    extent = np.ptp(corners, axis=0)
    axis = int(extent.argmax())
    if np.delete(extent, axis).max() > 2 * _LARGEST_RADIUS:
        return None
    low, high = corners[:, axis].min(), corners[:, axis].max()
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    from_axis = np.delete(corners - middle, axis, axis=1)
    distance = np.hypot(*from_axis.T)
    radius, on_axis = float(distance.max()), distance < _ROUND * distance.max()
    at_ends = (np.abs(corners[:, axis] - low) < _ROUND) | (np.abs(corners[:, axis] - high) < _ROUND)
    round_ = np.abs(distance - radius) < _ROUND * radius
    if not at_ends.all() or not (round_ | on_axis).all():
        return None
    corner_count = len(np.unique(np.arctan2(*from_axis[round_].T).round(6)))
    if corner_count < _FEWEST_CORNERS:
        return None
    steps = radius * _SCALE * np.concatenate((-_STEPS, _STEPS))
    return [np.array([low, high]) if one == axis else middle[one] + steps for one in range(3)]


def is_along(shape: Shape, axes: Array, spacing: float) -> bool:
    """Return whether a shape has flat faces along `axes`, one a row (3, 3), or is slender on cells [m]."""
    if flat_faces(shape).all_aligned(axes):
        return True
    return slender_faces(shape.surface()[0].numpy() @ axes.T / spacing) is not None
