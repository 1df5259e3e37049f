"""A map of a plane in axes of Matplotlib: cells in colour, outlines of obstacles, reflectors and points."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.patheffects import withStroke, withTickedStroke

from autdtorch.plot.colours import EDGE_COLOUR, OBSTACLE_COLOUR, PRESSURE_MAP
from autdtorch.plot.data import MM, clipped
from autdtorch.plot.style import TICK_SIZE, set_ticks
from autdtorch.scene.geometry import Plane
from autdtorch.scene.obstacles import Obstacle
from autdtorch.scene.reflectors import Reflector, are_in_front
from autdtorch.utils.array_types import REAL, Array
from autdtorch.utils.validation import ArrayLike, points_tensor

logger = logging.getLogger(__name__)

_AXIS_TOLERANCE = 1e-12  # deviation from 1 of the coordinate of a unit vector along x, y or z
_OUTLINE_CELLS = 400  # samples along the longer side of a plane, to outline obstacles


def draw_plane(
    ax: Axes,
    values: Array,
    plane: Plane,
    points: torch.Tensor | None,
    parts: tuple[Iterable[Obstacle], Sequence[Reflector]],
    size: tuple[float, float],
) -> QuadMesh:
    """Draw |p| or its level (Nu, Nv), points, obstacles and reflectors into axes of a size [inch]."""
    obstacles, reflectors = parts
    axes = (_plane_axis(plane, side, cells) for side, cells in enumerate(values.shape))
    (label_u, edges_u), (label_v, edges_v) = axes
    colours = colormaps[PRESSURE_MAP].with_extremes(bad=OBSTACLE_COLOUR)  # of NaN
    mesh = ax.pcolormesh(edges_u, edges_v, values.T, cmap=colours, rasterized=True)
    for obstacle in obstacles:
        _outline(ax, plane, obstacle, reflectors)
    for reflector in reflectors:
        _hatch(ax, plane, reflector, [other for other in reflectors if other is not reflector])
    if points is not None:
        _circle_points(ax, plane, points, max(values.shape))
    ax.set(xlabel=label_u, ylabel=label_v, aspect="equal")
    ax.tick_params(labelsize=TICK_SIZE)
    for axis, length, edges in zip((ax.xaxis, ax.yaxis), size, (edges_u, edges_v), strict=True):
        set_ticks(axis, length, (edges[0], edges[-1]))
    return mesh


def _plane_axis(plane: Plane, side: int, cells: int) -> tuple[str, Array]:
    """Return the axis label and the edges of the cells [mm] along side u (0) or v (1) of the plane.

    Along x, y or z these are coordinates, otherwise distances from the plane's centre.
    """
    direction = plane.basis[side]
    along = MM * plane.size[side] * np.linspace(-0.5, 0.5, cells + 1)
    axis = int(direction.abs().argmax())
    if direction[axis].abs() <= 1 - _AXIS_TOLERANCE:
        return f"{'uv'[side]} [mm]", along
    return f"{'xyz'[axis]} [mm]", MM * plane.center[axis] + float(direction[axis]) * along


def _outline(ax: Axes, plane: Plane, obstacle: Obstacle, reflectors: Sequence[Reflector]) -> None:
    """Draw the intersection of an obstacle's surface, in front of reflectors, with the plane."""
    center = torch.tensor(plane.center, **REAL)
    axes = torch.stack((*plane.basis, center.new_tensor(plane.normal)))
    corners = torch.cartesian_prod(*center.new_tensor((obstacle.lower, obstacle.upper)).T)
    lower, upper = ((corners - center) @ axes.T).aminmax(dim=0)
    if lower[2] > 0 or upper[2] < 0:  # it is beside the plane
        return
    edge = max(plane.size) / _OUTLINE_CELLS
    points, reach = plane.points(edge), 2 * edge
    along = (points[:, 0] - center) @ axes[0], (points[0] - center) @ axes[1]
    some = [
        ((lower[side] - reach < places) & (places < upper[side] + reach)).numpy()
        for side, places in enumerate(along)
    ]
    points = points[np.ix_(*some)]
    distance = obstacle.signed_distance(points).numpy()
    distance[~are_in_front(reflectors, points).numpy()] = np.nan
    if not np.nanmin(distance, initial=np.inf) < 0 < np.nanmax(distance, initial=-np.inf):
        return
    edges = (_plane_axis(plane, side, cells)[1] for side, cells in enumerate(map(len, some)))
    centers = ((ends[:-1] + ends[1:])[part] / 2 for ends, part in zip(edges, some, strict=True))
    lines = ax.contour(*centers, distance.T, levels=[0.0], colors="white", linewidths=1.0)
    lines.set_path_effects([withStroke(linewidth=2.2, foreground="black")])


def _hatch(ax: Axes, plane: Plane, reflector: Reflector, others: Iterable[Reflector]) -> None:
    """Draw the line where a reflector crosses the plane in front of the others, with strokes on its back."""
    corners = plane.corners[[0, 1, 3, 2]]
    everywhere = (-math.inf,) * 3, (math.inf,) * 3
    behind = Reflector(reflector.point, [-part for part in reflector.normal])
    ends = clipped(corners.numpy(), *everywhere, [reflector, behind])
    if len(ends) != 2:  # it misses the plane, or touches a corner
        return
    ends = clipped(ends, *everywhere, others)[:2]
    if len(ends) != 2:
        return
    here, there = coordinates_in(plane, torch.from_numpy(ends)).numpy()
    height = reflector.mirror.height(corners).numpy()
    far = int(np.abs(height).argmax())
    aside = coordinates_in(plane, corners)[far].numpy() - here
    line = MM * np.array([here, there])
    if ((there - here)[0] * aside[1] - (there - here)[1] * aside[0]) * height[far] > 0:
        line = line[::-1]  # strokes are on the left
    style: Any = {"color": EDGE_COLOUR, "linewidth": 1.4, "clip_on": False}
    ax.plot(*line.T, path_effects=[withTickedStroke(spacing=4.5, angle=135, length=0.7)], **style)


def coordinates_in(plane: Plane, points: torch.Tensor) -> torch.Tensor:
    """Return the coordinates (P, 2) [m] of points (P, 3) in a map of the plane, as of `_plane_axis`."""
    sides = torch.stack(plane.basis).to(points)
    axes = sides.abs().argmax(dim=1)
    along_axis = sides.abs().amax(dim=1) > 1 - _AXIS_TOLERANCE
    return torch.where(along_axis, points[:, axes], (points - points.new_tensor(plane.center)) @ sides.T)


def points_for_map(name: str, points: ArrayLike | None, plane: Plane, cells: int) -> torch.Tensor | None:
    """Return points (P, 3) [m] after checking them; log those that a map of so many cells does not circle."""
    if points is None:
        return None
    points = points_tensor(name, points)
    if missed := int((~_are_near(plane, points, cells)).sum()):
        text = "%s: %d of %d are more than a cell off the plane, and not circled"
        logger.warning(text, name, missed, len(points))
    return points


def _are_near(plane: Plane, points: torch.Tensor, cells: int) -> torch.Tensor:
    """Return which points (P, 3) [m] are less than one cell off a plane, of so many cells a longer side."""
    height = (points - points.new_tensor(plane.center)) @ points.new_tensor(plane.normal)
    return height.abs() < max(plane.size) / cells


def _circle_points(ax: Axes, plane: Plane, points: torch.Tensor, cells: int) -> None:
    """Circle the `points` (P, 3) [m] that are on the map."""
    coordinates = coordinates_in(plane, points[_are_near(plane, points, cells)])
    style: Any = {"marker": "o", "ms": 9, "mfc": "none", "mec": "white", "mew": 1.2, "linestyle": "none"}
    outline = [withStroke(linewidth=2.6, foreground="black")]
    ax.plot(*(MM * coordinates.T.cpu().numpy()), path_effects=outline, **style)
