"""Maps of the pressure on observation planes, outside obstacles."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any, cast

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from autdtorch.plot import data
from autdtorch.plot.colours import FLOOR, OBSTACLE_COLOUR, PRESSURE_MAP
from autdtorch.plot.data import MM, ByMethod, outside_on_plane, plane_magnitude, require_each
from autdtorch.plot.style import TICK_SIZE, label_of, new_figure, readable, styled, wrapped
from autdtorch.scene.geometry import Plane
from autdtorch.scene.obstacles import Obstacle
from autdtorch.utils.array_types import Array
from autdtorch.utils.validation import (
    ArrayLike,
    boolean,
    finite_number,
    invalid,
    members,
    not_negative,
    points_tensor,
    require_kind,
)

_AXIS_TOLERANCE = 1e-12  # deviation from 1 of the coordinate of a unit vector along x, y or z
_OUTLINE_CELLS = 400  # samples along the longer side of a plane, to outline obstacles


@styled
def plot_plane(
    pressure: ArrayLike,
    plane: Plane,
    control_points: ArrayLike | None = None,
    obstacles: Iterable[Obstacle] = (),
    ax: Axes | None = None,
    decibels: bool = False,
    *,
    vmin: float | None = None,
    vmax: float | None = None,
    reference: float | None = None,
) -> Figure:
    """Plot the pressure magnitude on a plane over the coordinates along its edges.

    Cells inside the `obstacles` are grey, and the colours span the pressures outside. Without `obstacles`
    nothing is masked: a field inside a body may then be most of the scale.

    Args:
        pressure: complex pressure or its magnitude (Nu, Nv) [Pa], at `plane.points(...)`.
        plane: the plane.
        control_points: (P, 3) [m]; those in the plane are circled.
        obstacles: obstacles, masked and outlined in the plane.
        ax: axes to draw into; by default those of a new figure.
        decibels: True for the level 20 lg(|p| / reference) [dB] instead of |p| [Pa].
        vmin: lower end of the colours [Pa], >= 0, or [dB] with `decibels`; by default 0 Pa or -30 dB.
        vmax: upper end of the colours, > `vmin`, in the same unit; by default the largest |p| or 0 dB.
        reference: the pressure of 0 dB [Pa], > 0; by default the largest |p|. Pictures with equal references
            can be compared.

    Raises:
        ValueError: `pressure` is not (Nu, Nv), or 0 everywhere with `decibels` and no `reference`,
            `control_points` are not points, the ends of the colours are out of range, or `reference` is given
            without `decibels`.
    """
    require_kind("plane", plane, Plane)
    if ax is not None:
        require_kind("ax", ax, Axes)
    obstacles, decibels = members("obstacles", obstacles, Obstacle), boolean("decibels", decibels)
    values = outside_on_plane(plane_magnitude("pressure", pressure), plane, obstacles)
    points = None if control_points is None else points_tensor("control_points", control_points)
    if decibels:
        zero = data.zero_level(reference, "pressure", values)
        limits, label = _limits(vmin, vmax, FLOOR, 0.0, "dB"), f"level of |p| [dB], 0 dB = {zero:.3g} Pa"
        values = np.maximum(data.in_decibels(values, zero), limits[0])  # no cell is -inf
    else:
        if reference is not None:
            raise invalid("reference", reference, "must be None without decibels=True", "Pa")
        limits, label = _limits(vmin, vmax, 0.0, data.largest(values), "Pa"), "|p| [Pa]"
    if ax is None:
        figure = new_figure(4.4, 3.6)
        figure.set_layout_engine("compressed")  # "constrained" cuts off labels beside a square
        ax = figure.add_subplot()
    figure = cast(Figure, ax.get_figure(root=True))
    mesh = _draw_plane(ax, values, plane, points, obstacles)
    mesh.set_clim(*limits)
    _add_colour_bar(figure, mesh, [ax], "vertical", label, _beyond([values], limits))
    return figure


@styled
def plot_planes(
    pressure: Mapping[str, ByMethod],
    planes: Mapping[str, Plane],
    control_points: Mapping[str, ArrayLike] | None = None,
    obstacles: Mapping[str, Iterable[Obstacle]] | None = None,
    *,
    vmin: float | None = None,
    vmax: float | None = None,
) -> Figure:
    """Plot pressure maps, one row per method and one column per scene (the paper's Fig. 2).

    All maps of a scene share one colour scale, of the pressures outside the `obstacles`; cells inside these
    are grey. Without `obstacles` nothing is masked.

    Args:
        pressure: by scene and method, complex pressure or its magnitude (Nu, Nv) [Pa]. Methods may differ
            between scenes.
        planes: plane of each scene.
        control_points: control points of each scene (P, 3) [m]; those in the plane are circled.
        obstacles: obstacles of each scene, masked and outlined in the plane.
        vmin: lower end of the colours of all maps [Pa], >= 0; by default 0.
        vmax: upper end of them [Pa], > `vmin`; by default the largest |p| of each scene.

    Raises:
        ValueError: no scene, a scene without plane, an argument of another shape, or ends of the colours that
            are out of range.
    """
    data.require_scenes("pressure", pressure)
    require_each("planes", planes, pressure)
    for scene in pressure:
        require_kind(f"planes[{scene!r}]", planes[scene], Plane)
    if control_points is not None:
        require_each("control_points", control_points, pressure)
    if obstacles is not None:
        require_each("obstacles", obstacles, pressure)
    methods = data.methods_of(pressure.values())
    full = all(method in maps for method in methods for maps in pressure.values())
    alike = full and len({planes[scene] for scene in pressure}) == 1
    figure = new_figure(2.2 * len(pressure) + 0.7, 2.2 * len(methods) + 0.8)
    axes = figure.subplots(len(methods), len(pressure), squeeze=False)
    for column, (scene, maps) in zip(axes.T, pressure.items(), strict=True):
        bodies = () if obstacles is None else members(f"obstacles[{scene!r}]", obstacles[scene], Obstacle)
        magnitudes = {}
        for method, field in maps.items():
            magnitude = plane_magnitude(f"pressure[{scene!r}][{method!r}]", field)
            magnitudes[method] = outside_on_plane(magnitude, planes[scene], bodies)
        limits = _limits(vmin, vmax, 0.0, max(map(data.largest, magnitudes.values())), "Pa")
        points = None
        if control_points is not None:
            points = points_tensor(f"control_points[{scene!r}]", control_points[scene])
        for ax, method in zip(column, methods, strict=True):
            if method not in magnitudes:
                ax.set_axis_off()
                continue
            mesh = _draw_plane(ax, magnitudes[method], planes[scene], points, bodies)
            mesh.set_clim(*limits)
            if alike:
                ax.label_outer()
        column[0].set_title(wrapped(readable(scene), 2.0), weight="bold")
        beyond = _beyond(magnitudes.values(), limits)
        _add_colour_bar(figure, mesh, list(column), "horizontal", "|p| [Pa]", beyond)
    for ax, method in zip(axes[:, 0], methods, strict=True):
        # Left of the axes, even if they are empty.
        style: Any = {"rotation": 90, "ha": "right", "va": "center", "ma": "center", "weight": "bold"}
        where: Any = {"xy": (0, 0.5), "xycoords": "axes fraction", "textcoords": "offset points"}
        ax.annotate(wrapped(label_of(method), 2.0), xytext=(-40, 0), **where, **style)
    return figure


def _limits(
    vmin: float | None, vmax: float | None, low: float, high: float, unit: str
) -> tuple[float, float]:
    """Return the ends of the colours after checking them, by default `low` and `high`."""
    check = finite_number if unit == "dB" else not_negative
    low = low if vmin is None else check("vmin", vmin, unit)
    if vmax is not None:
        high = check("vmax", vmax, unit)
        if high <= low:
            raise invalid("vmax", vmax, f"must be > {low:.3g}, the lower end of the colours", unit)
    elif vmin is not None and high <= low:
        raise invalid("vmin", vmin, f"must be < {high:.3g}, the upper end of the colours", unit)
    return low, high


def _beyond(maps: Collection[Array], limits: tuple[float, float]) -> str:
    """Return the ends of the colour bar beyond which values lie, as Matplotlib names them."""
    low = any((values < limits[0]).any() for values in maps)
    high = any((values > limits[1]).any() for values in maps)
    return "both" if low and high else "min" if low else "max" if high else "neither"


def _draw_plane(
    ax: Axes, values: Array, plane: Plane, points: torch.Tensor | None, obstacles: Iterable[Obstacle]
) -> QuadMesh:
    axes = (_plane_axis(plane, side, cells) for side, cells in enumerate(values.shape))
    (label_u, edges_u), (label_v, edges_v) = axes
    colours = colormaps[PRESSURE_MAP].with_extremes(bad=OBSTACLE_COLOUR)  # of NaN
    mesh = ax.pcolormesh(edges_u, edges_v, values.T, cmap=colours, rasterized=True)
    for obstacle in obstacles:
        _outline(ax, plane, obstacle)
    if points is not None:
        _circle_points(ax, plane, points, max(values.shape))
    ax.set(xlabel=label_u, ylabel=label_v, aspect="equal")
    ax.tick_params(labelsize=TICK_SIZE)
    return mesh


def _plane_axis(plane: Plane, side: int, cells: int) -> tuple[str, Array]:
    """Return the axis label and the edges of the cells [mm] along side u (0) or v (1) of the plane.

    They are x, y or z if the side is parallel to that axis, and otherwise distances from the plane's centre.
    """
    direction = plane.basis[side]
    along = MM * plane.size[side] * np.linspace(-0.5, 0.5, cells + 1)
    axis = int(direction.abs().argmax())
    if direction[axis].abs() <= 1 - _AXIS_TOLERANCE:
        return f"{'uv'[side]} [mm]", along
    return f"{'xyz'[axis]} [mm]", MM * plane.center[axis] + float(direction[axis]) * along


def _outline(ax: Axes, plane: Plane, obstacle: Obstacle) -> None:
    """Draw the intersection of an obstacle's surface with the plane."""
    distance = obstacle.signed_distance(plane.points(max(plane.size) / _OUTLINE_CELLS)).numpy()
    if not distance.min() < 0 < distance.max():
        return
    edges = (_plane_axis(plane, side, cells)[1] for side, cells in enumerate(distance.shape))
    centers = ((along[:-1] + along[1:]) / 2 for along in edges)
    lines = ax.contour(*centers, distance.T, levels=[0.0], colors="white", linewidths=1.0)
    lines.set_path_effects([withStroke(linewidth=2.2, foreground="black")])


def _circle_points(ax: Axes, plane: Plane, points: torch.Tensor, cells: int) -> None:
    """Circle the `points` (P, 3) [m] that are less than one cell away from the plane."""
    center = points.new_tensor(plane.center)
    near = ((points - center) @ points.new_tensor(plane.normal)).abs() < max(plane.size) / cells
    sides = torch.stack(plane.basis).to(points)
    axes = sides.abs().argmax(dim=1)
    along_axis = sides.abs().amax(dim=1) > 1 - _AXIS_TOLERANCE
    coordinates = torch.where(along_axis, points[:, axes], (points - center) @ sides.T)[near]
    style: Any = {"marker": "o", "ms": 9, "mfc": "none", "mec": "white", "mew": 1.2, "linestyle": "none"}
    outline = [withStroke(linewidth=2.6, foreground="black")]
    ax.plot(*(MM * coordinates.T.cpu().numpy()), path_effects=outline, **style)


def _add_colour_bar(
    figure: Figure, mesh: QuadMesh, axes: list[Axes], orientation: str, label: str, extend: str
) -> None:
    part = min(0.15, 0.45 / len(axes))  # share of the height of all axes
    shape: Any = {"shrink": 0.9, "aspect": 25, "fraction": part, "pad": 0.05 / len(axes)}
    bar = figure.colorbar(mesh, ax=axes, orientation=orientation, extend=extend, **shape)
    bar.set_label(label)
    bar.ax.tick_params(labelsize=TICK_SIZE)
