"""Drawings of a scene in 3D with Matplotlib."""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
import torch
from matplotlib.colors import to_rgb, to_rgba
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d import Axes3D
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from mpl_toolkits.mplot3d.proj3d import proj_transform
from numpy.typing import NDArray

from autdtorch.plot import colours
from autdtorch.plot.axes3d import axes_of, grid_lines, view_from
from autdtorch.plot.data import MM, clipped, parts_of_reflectors, single_drive_phases
from autdtorch.plot.style import TICK_SIZE, new_figure, styled, text_width
from autdtorch.scene.obstacles import Obstacle
from autdtorch.scene.reflectors import are_in_front
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.spatial import doubled_normals, paired_sides, sides_of
from autdtorch.utils.validation import ArrayLike, Vector, require_kind

# Lengths [inch]
_SIZE = (5.2, 4.2)  # of the figure
_MARGIN = 0.08  # at the edges of the figure
_LEGEND_ROOM = 0.35  # above the axes
_BAR_ROOM = 0.9  # beside the axes
_BAR = (1 - 0.8 / _SIZE[0], 0.2, 0.12 / _SIZE[0], 0.55)  # place of the colour bar, as shares of the figure
_ELEVATION, _AZIMUTH = 22.0, -118.0  # of the viewer [degrees]


def _direction(elevation: float, azimuth: float) -> Array:
    up, around = np.radians((elevation, azimuth))
    return np.array([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)])


_TO_VIEWER = _direction(_ELEVATION, _AZIMUTH)
_LIGHT = _direction(50.0, -160.0)


@styled
def plot_scene(scene: Scene, drive: ArrayLike | None = None) -> Figure:
    """Draw a scene in 3D (the paper's Fig. 1), for machines on which `view3d` cannot render.

    The drawing order is fixed: from the plane to obstacles and points. Reflectors are translucent, as far as
    the domain goes.

    Args:
        scene: scene to draw.
        drive: complex (M,); colours the transducers by phase.

    Raises:
        ValueError: `drive` does not fit the array.
    """
    require_kind("scene", scene, Scene)
    phases = None if drive is None else single_drive_phases(drive, len(scene.array))
    figure = new_figure(*_SIZE)
    figure.set_layout_engine("none")  # all places are set here
    ax = _new_axes(figure, scene.domain, 0.0 if phases is None else _BAR_ROOM)
    _add_reflectors(ax, scene)
    if scene.observation_plane is not None:
        corners = MM * scene.observation_plane.corners[[0, 1, 3, 2]].numpy()
        ax.add_collection3d(Poly3DCollection([corners], facecolor=colours.PLANE_COLOUR, alpha=0.3, zorder=1))
    # From far to near: the order of drawing is fixed, and later obstacles cover earlier ones.
    for obstacle in sorted(
        scene.obstacles, key=lambda body: (np.array(body.lower) + body.upper) @ _TO_VIEWER
    ):
        _add_obstacle(ax, obstacle, scene)
    foci = MM * scene.control_points.numpy()
    ax.scatter(*foci.T, color=colours.FOCUS_COLOUR, s=22, depthshade=False, label="control points", zorder=3)
    _scatter_transducers(ax, scene, phases)
    handles = ax.get_legend_handles_labels()[0]
    figure.legend(handles=handles, loc="upper center", ncols=len(handles), columnspacing=1.2)
    return figure


def _new_axes(figure: Figure, domain: tuple[Vector, Vector], right: float) -> Axes3D:
    """Return axes that show a domain [m] below the legend and left of a margin [inch], with their labels.

    The ticks and labels of Matplotlib overlap if the sides of the domain differ much.
    """
    lower, upper = (MM * np.array(corner) for corner in domain)
    view, (width, height) = view_from(_TO_VIEWER), _SIZE
    room = width - right - 2 * _MARGIN, height - _LEGEND_ROOM - 2 * _MARGIN
    titles = [f"{name} [mm]" for name in "xyz"]
    height_of_digits = 0.75 * TICK_SIZE / 72  # which have no descenders
    axes = axes_of(
        lower, upper, view, room, lambda text: (text_width(text, TICK_SIZE), height_of_digits), titles
    )
    middle = np.array([(width - right) / 2, (height - _LEGEND_ROOM) / 2]) - (axes.low + axes.high) / 2

    ax = cast(Axes3D, figure.add_axes((0.0, 0.0, 1.0, 1.0), projection="3d", computed_zorder=False))
    ax.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), zlim=(lower[2], upper[2]))
    ax.set_axis_off()
    ax.set_proj_type("ortho")
    ax.view_init(elev=_ELEVATION, azim=_AZIMUTH)
    ax.set_box_aspect(upper - lower)
    centre, length = (lower + upper) / 2, max(upper - lower)
    drawn, above = (_place(ax, centre + step * view[1]) for step in (0.0, length))
    ax.set_box_aspect(upper - lower, zoom=axes.scale * length / (above - drawn)[1])
    ax.set_position((*(middle - drawn) / _SIZE, 1.0, 1.0))
    lines = grid_lines(lower, upper, axes.ticks)
    broken = np.concatenate([lines, np.full_like(lines[:, :1], np.nan)], axis=1).reshape(-1, 3)
    ax.plot(*broken.T, color="0.75", linewidth=0.6, zorder=0)
    for label in axes.labels:
        corner = middle + axes.scale * view @ (label.point - centre) + label.corner
        figure.text(
            corner[0] / width, corner[1] / height, label.text, fontsize=TICK_SIZE, va="baseline", ha="left"
        )
    return ax


def _place(ax: Axes3D, point: Array) -> Array:
    ax.apply_aspect()
    projected = proj_transform(*point, ax.get_proj())[:2]
    place: Array = ax.transData.transform(projected) / ax.get_figure().dpi
    return place


def _add_reflectors(ax: Axes3D, scene: Scene) -> None:
    """Draw the reflectors, below everything else or, if the viewer looks at their backs, above."""
    style: Any = {"edgecolor": colours.REFLECTOR_COLOUR, "lw": 0.8, "label": "reflectors"}
    for reflector, corners in zip(
        scene.reflectors, parts_of_reflectors(scene.reflectors, scene.domain), strict=True
    ):
        if len(corners):
            in_front = np.array(reflector.normal) @ _TO_VIEWER > 0
            order, opacity = (0.5, colours.REFLECTOR_OPACITY) if in_front else (4, colours.BACK_OPACITY)
            style["facecolor"] = to_rgba(colours.REFLECTOR_COLOUR, opacity)
            ax.add_collection3d(Poly3DCollection([MM * corners], zorder=order, **style))
            style["label"] = None  # one entry in the legend


def _add_obstacle(ax: Axes3D, obstacle: Obstacle, scene: Scene) -> None:
    """Draw the triangles that face the viewer, shaded, and their sharp edges.

    An obstacle is cut at reflectors and at the domain's edge; its far side, visible there, is drawn first.
    """
    domain, reflectors = scene.domain, scene.reflectors
    vertices, faces = (part.numpy() for part in obstacle.surface())
    corners = vertices[faces]
    normals = doubled_normals(corners)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    front = normals @ _TO_VIEWER > 0
    leaves = (vertices < domain[0]).any() or (vertices > domain[1]).any()
    leaves |= not are_in_front(reflectors, torch.from_numpy(vertices)).all()
    for side in (~front, front) if leaves else (front,):
        light = 0.7 + 0.3 * normals[side] @ _LIGHT
        shades = np.clip(light[:, None] * to_rgb(colours.OBSTACLE_COLOUR), 0, 1)
        polygons = [clipped(triangle, *domain, reflectors) for triangle in corners[side]]
        if inside := [index for index, polygon in enumerate(polygons) if len(polygon)]:
            # Edges in the colours of the faces close the seams between them.
            style: Any = {"facecolor": shades[inside], "edgecolor": shades[inside], "lw": 0.3, "zorder": 2}
            ax.add_collection3d(Poly3DCollection([MM * polygons[index] for index in inside], **style))
    edges = vertices[_sharp_edges(faces, normals, front)]
    if len(edges) > colours.MOST_EDGES:
        return
    lines = [clipped(edge, *domain, reflectors) for edge in edges[~_hidden(obstacle, edges.mean(axis=1))]]
    if lines := [MM * line for line in lines if len(line)]:  # Matplotlib refuses a collection of none
        ax.add_collection3d(Line3DCollection(lines, colors=colours.EDGE_COLOUR, lw=0.8, zorder=2))


def _hidden(obstacle: Obstacle, points: Array) -> NDArray[np.bool_]:
    """Return whether the obstacle hides each point (N, 3) [m] of its surface from the viewer (N,)."""
    across = math.dist(obstacle.lower, obstacle.upper)
    steps = across * (np.arange(64) + 0.5) / 64
    return obstacle.contains(points[:, None] + steps[:, None] * _TO_VIEWER).any(dim=1).numpy()


def _sharp_edges(faces: Index, normals: Array, front: NDArray[np.bool_]) -> Index:
    """Return the vertices (E, 2) of edges between faces at over `SHARP_ANGLE`, one of them in `front`."""
    pairs = paired_sides(faces)
    one, other = pairs.T % len(faces)
    sharp = (normals[one] * normals[other]).sum(axis=1) < np.cos(colours.SHARP_ANGLE)
    edges: Index = sides_of(faces)[pairs[sharp & (front[one] | front[other]), 0]]
    return edges


def _scatter_transducers(ax: Axes3D, scene: Scene, phases: Array | None) -> None:
    positions = MM * scene.array.positions.numpy()
    style: Any = {"edgecolors": colours.EDGE_COLOUR, "s": 36, "depthshade": False, "zorder": 1}
    style["label"] = "transducers"
    if phases is None:
        ax.scatter(*positions.T, color=colours.TRANSDUCER_COLOUR, **style)
        return
    dots = ax.scatter(*positions.T, c=phases, cmap=colours.PHASE_MAP, vmin=0, vmax=2 * np.pi, **style)
    figure = ax.get_figure()
    bar = figure.colorbar(dots, cax=figure.add_axes(_BAR))
    bar.set_ticks([0, np.pi, 2 * np.pi], labels=["0", "π", "2π"])
    bar.set_label("phase [rad]")
