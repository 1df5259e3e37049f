"""Maps of the pressure on observation planes, outside obstacles and in front of reflectors."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, cast

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke, withTickedStroke

from autdtorch.plot import data
from autdtorch.plot.colours import EDGE_COLOUR, FLOOR, OBSTACLE_COLOUR, PRESSURE_MAP
from autdtorch.plot.data import MM, ByMethod, clipped, outside_on_plane, plane_magnitude, require_each
from autdtorch.plot.style import TICK_SIZE, label_of, new_figure, readable, set_ticks, styled, wrapped
from autdtorch.scene.geometry import Plane
from autdtorch.scene.obstacles import Obstacle
from autdtorch.scene.reflectors import Reflector, are_in_front
from autdtorch.utils.array_types import REAL, Array
from autdtorch.utils.validation import (
    LENGTH_TOLERANCE,
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

# Lengths [inch]
_SIDE = 3.1  # of a square plane in a figure of one
_SMALL_SIDE = 1.85  # in a figure of several
_WIDTH = 7.0  # of the maps in a figure of several, unless they are more than three
_LEAST_COLUMN, _LEAST_ROW = 1.4, 0.8  # for the numbers of a colour bar, and the name of a method
_BAR = 0.11  # thickness of a colour bar
_LABELS = 0.62  # for tick labels and the name of an axis
_NAME_LINE = 0.16  # for each line of the name of a row
_END = 0.25  # for the half of the last tick label that is beyond its axis, and a margin


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
    reflectors: Iterable[Reflector] = (),
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
        reflectors: reflectors, drawn where they cross the plane, hatched on their backs; cells behind are
            grey.

    Raises:
        ValueError: an argument of another shape or out of range, `pressure` of 0 everywhere with `decibels`
            and no `reference`, or a `reference` without `decibels`.
    """
    require_kind("plane", plane, Plane)
    if ax is not None:
        require_kind("ax", ax, Axes)
    obstacles, decibels = members("obstacles", obstacles, Obstacle), boolean("decibels", decibels)
    walls = members("reflectors", reflectors, Reflector)
    values = outside_on_plane(plane_magnitude("pressure", pressure), plane, obstacles, walls)
    points = None if control_points is None else points_tensor("control_points", control_points)
    if decibels:
        zero = data.zero_level(reference, "pressure", values)
        limits, unit = _limits(vmin, vmax, FLOOR, 0.0, "dB"), "dB"
        label = f"level of |p| [dB]\n0 dB = {data.pressure_text(zero)}"
        values = np.maximum(data.in_decibels(values, zero), limits[0])  # no cell is -inf
    else:
        if reference is not None:
            raise invalid("reference", reference, "must be None without decibels=True", "Pa")
        limits, unit, label = _limits(vmin, vmax, 0.0, data.largest(values), "Pa"), "Pa", "|p|"
    size = width, height = _panel(plane, _SIDE)
    flat = ax is None and width > 2 * height  # there is no room for numbers beside it
    if ax is None:
        figure = new_figure(width + (1 if flat else 2.4) * _LABELS, height + (2.4 if flat else 1) * _LABELS)
        figure.set_layout_engine("compressed")  # "constrained" cuts off labels beside a square
        ax = figure.add_subplot()
    figure = cast(Figure, ax.get_figure(root=True))
    mesh = _draw_plane(ax, values, plane, points, (obstacles, walls), size)
    mesh.set_clim(*limits)
    length, across = size if flat else (height, width)
    shape: Any = {"orientation": "horizontal" if flat else "vertical", "extend": _beyond([values], limits)}
    shape |= {"aspect": length / _BAR, "fraction": _BAR / across, "pad": 0.5 * _BAR / across}
    _label_bar(figure.colorbar(mesh, ax=ax, **shape), limits, label, unit, length)
    return figure


@styled
def plot_planes(
    pressure: Mapping[str, ByMethod] | ByMethod,
    planes: Mapping[str, Plane] | Plane,
    control_points: Mapping[str, ArrayLike] | ArrayLike | None = None,
    obstacles: Mapping[str, Iterable[Obstacle]] | Iterable[Obstacle] | None = None,
    *,
    vmin: float | None = None,
    vmax: float | None = None,
    reflectors: Mapping[str, Iterable[Reflector]] | Iterable[Reflector] | None = None,
) -> Figure:
    """Plot pressure maps, one row per method and one column per scene (the paper's Fig. 2).

    Of a single scene, all arguments may leave out its name: ``plot_planes({"a": p, "b": q}, plane)``.

    All maps of a scene share one colour scale, of the pressures outside the `obstacles`; cells inside these
    are grey. Without `obstacles` nothing is masked. With `vmax` one colour bar is for all scenes.

    Args:
        pressure: by scene and method, complex pressure or its magnitude (Nu, Nv) [Pa]. Methods may differ
            between scenes.
        planes: plane of each scene.
        control_points: control points of each scene (P, 3) [m]; those in the plane are circled.
        obstacles: obstacles of each scene, masked and outlined in the plane.
        vmin: lower end of the colours of all maps [Pa], >= 0; by default 0.
        vmax: upper end of them [Pa], > `vmin`; by default the largest |p| of each scene.
        reflectors: reflectors of each scene, as in `plot_plane`.

    Raises:
        ValueError: no scene, a scene without plane, an argument of another shape, or ends of the colours that
            are out of range.
    """
    arguments: tuple[Any, ...] = pressure, planes, control_points, obstacles, reflectors
    if isinstance(planes, Plane):
        arguments = _as_one_scene(*arguments)
    return _rows_of_maps(*arguments, vmin=vmin, vmax=vmax)


def _rows_of_maps(
    pressure: Mapping[str, ByMethod],
    planes: Mapping[str, Plane],
    control_points: Mapping[str, ArrayLike] | None,
    obstacles: Mapping[str, Iterable[Obstacle]] | None,
    reflectors: Mapping[str, Iterable[Reflector]] | None,
    *,
    vmin: float | None,
    vmax: float | None,
) -> Figure:
    """Plot as `plot_planes` does, the arguments by name of the scene."""
    data.require_scenes("pressure", pressure)
    require_each("planes", planes, pressure)
    for scene in pressure:
        require_kind(f"planes[{scene!r}]", planes[scene], Plane)
    if control_points is not None:
        require_each("control_points", control_points, pressure)
    if obstacles is not None:
        require_each("obstacles", obstacles, pressure)
    if reflectors is not None:
        require_each("reflectors", reflectors, pressure)
    methods = data.methods_of(pressure.values())
    full = all(method in maps for method in methods for maps in pressure.values())
    alike = full and len({planes[scene] for scene in pressure}) == 1
    sizes = [_panel(planes[scene], _SMALL_SIDE, _WIDTH / len(pressure)) for scene in pressure]
    widths = [max(_LEAST_COLUMN, width) for width, _ in sizes]
    row = max(_LEAST_ROW, *(height for _, height in sizes))
    between = (0.25, 0.15) if alike else (_LABELS, 0.5)  # columns and rows [inch]
    names = [wrapped(label_of(method), row) for method in methods]
    beside = _NAME_LINE * max(len(name.splitlines()) for name in names) + _LABELS + _END
    below = 1.4 if any(pressure) else 1.1  # or above: titles, the axis and the colour bar
    figure = new_figure(
        beside + sum(widths) + between[0] * (len(widths) - 1), below + (row + between[1]) * len(methods)
    )
    if [(widths[0], row)] == sizes:  # one column, that its maps fill
        figure.set_layout_engine("compressed")  # "constrained" cuts off labels beside them
    heights = [*(row for _ in methods), _BAR]
    axes = figure.subplots(
        len(heights), len(widths), squeeze=False, height_ratios=heights, width_ratios=widths
    )
    bars = axes[-1]
    if vmax is not None:
        bars = [figure.add_subplot(axes[-1, 0].get_gridspec()[-1, :])]
        for ax in axes[-1]:
            ax.remove()
    shown: list[tuple[QuadMesh, Collection[Array], float]] = []
    for column, size, width, (scene, maps) in zip(axes.T, sizes, widths, pressure.items(), strict=True):
        bodies = () if obstacles is None else members(f"obstacles[{scene!r}]", obstacles[scene], Obstacle)
        walls = () if reflectors is None else members(f"reflectors[{scene!r}]", reflectors[scene], Reflector)
        magnitudes = {}
        for method, field in maps.items():
            magnitude = plane_magnitude(f"pressure[{scene!r}][{method!r}]", field)
            magnitudes[method] = outside_on_plane(magnitude, planes[scene], bodies, walls)
        limits = _limits(vmin, vmax, 0.0, max(map(data.largest, magnitudes.values())), "Pa")
        points = None
        if control_points is not None:
            points = points_tensor(f"control_points[{scene!r}]", control_points[scene])
        for ax, method in zip(column[:-1], methods, strict=True):
            if method not in magnitudes:
                ax.set_axis_off()
                continue
            mesh = _draw_plane(ax, magnitudes[method], planes[scene], points, (bodies, walls), size)
            mesh.set_clim(*limits)
            if alike and ax is not column[-2]:
                ax.set_xlabel("")
                ax.tick_params(labelbottom=False)
            if alike and column[0] is not axes[0, 0]:
                ax.set_ylabel("")
                ax.tick_params(labelleft=False)
        column[0].set_title(wrapped(readable(scene), width), weight="bold")
        shown.append((mesh, magnitudes.values(), width))
    if vmax is not None:
        every = [magnitude for _, magnitudes, _ in shown for magnitude in magnitudes]
        shown = [(shown[0][0], every, sum(widths))]
    for bar, (mesh, values, width) in zip(bars, shown, strict=True):
        beyond = _beyond(values, mesh.get_clim())
        drawn = figure.colorbar(mesh, cax=bar, orientation="horizontal", extend=beyond)
        _label_bar(drawn, mesh.get_clim(), "|p|", "Pa", width)
    for ax, name in zip(axes[:-1, 0], names, strict=True):
        _name_row(ax, name)
    return figure


def _panel(plane: Plane, side: float, widest: float = np.inf) -> tuple[float, float]:
    """Return the width and height [inch] of the map of a plane.

    A square plane has sides of `side`. The longer side of others is up to one and a half times as long.
    """
    longer = max(plane.size)
    scale = side * min(1.5, (longer / min(plane.size)) ** 0.5) / longer
    scale = min(scale, max(widest, side) / plane.size[0])
    return scale * plane.size[0], scale * plane.size[1]


def _name_row(ax: Axes, name: str) -> None:
    """Write the name of a row left of the label of its first axes, or of the axes if they are empty."""
    style: Any = {"rotation": 90, "ha": "right", "va": "center", "ma": "center", "weight": "bold"}
    beside: Any = (ax.yaxis.label, ax.transAxes) if ax.axison else ax.transAxes
    ax.annotate(name, (0, 0.5), (-4, 0), xycoords=beside, textcoords="offset points", **style)


def _as_one_scene(pressure: Any, *others: Any) -> tuple[Any, ...]:
    """Return the arguments of one scene as mappings, by an empty name."""
    nested = isinstance(pressure, Mapping) and any(isinstance(field, Mapping) for field in pressure.values())
    if nested or not isinstance(pressure, Mapping):
        accepted = "must be maps by name, as {'gabs': p}, for one plane; plot_plane plots a single map"
        raise invalid("pressure", pressure, accepted)
    return {"": pressure}, *(
        None if other is None or isinstance(other, Mapping) else {"": other} for other in others
    )


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
    return low, high if high > low else low + 1  # of 0 Pa everywhere


def _beyond(maps: Collection[Array], limits: tuple[float, float]) -> str:
    """Return Matplotlib's name for the ends of the colour bar that some values exceed."""
    low = any((values < limits[0]).any() for values in maps)
    high = any((values > limits[1]).any() for values in maps)
    return "both" if low and high else "min" if low else "max" if high else "neither"


def _draw_plane(
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
    edge = max(plane.size) / _OUTLINE_CELLS
    points = plane.points(edge)
    lower, upper = torch.tensor(obstacle.lower, **REAL), torch.tensor(obstacle.upper, **REAL)
    near = ((points > lower - 2 * edge) & (points < upper + 2 * edge)).all(dim=2).numpy()
    some = [near.any(axis=1), near.any(axis=0)]  # rows and columns
    points = points[np.ix_(*some)]
    distance = obstacle.signed_distance(points).numpy()
    distance[~are_in_front(reflectors, points).numpy()] = np.nan
    if not np.nanmin(distance, initial=np.inf) < 0 < np.nanmax(distance, initial=-np.inf):
        return
    edges = (_plane_axis(plane, side, cells)[1] for side, cells in enumerate(near.shape))
    centers = ((along[:-1] + along[1:])[part] / 2 for along, part in zip(edges, some, strict=True))
    lines = ax.contour(*centers, distance.T, levels=[0.0], colors="white", linewidths=1.0)
    lines.set_path_effects([withStroke(linewidth=2.2, foreground="black")])


def _hatch(ax: Axes, plane: Plane, reflector: Reflector, others: Iterable[Reflector]) -> None:
    """Draw the line where a reflector crosses the plane in front of the others, with strokes on its back."""
    corners = plane.corners[[0, 1, 3, 2]]
    height = reflector.mirror.height(corners).numpy()
    height[np.abs(height) < LENGTH_TOLERANCE] = 0.0
    ends = list(corners[height == 0].numpy())
    for here, there in zip(range(4), (1, 2, 3, 0), strict=True):
        if height[here] * height[there] < 0:
            share = height[here] / (height[here] - height[there])
            ends.append((corners[here] + share * (corners[there] - corners[here])).numpy())
    if len(ends) != 2:  # it misses the plane, or touches a corner
        return
    ends = list(clipped(np.array(ends), (-math.inf,) * 3, (math.inf,) * 3, others)[:2])
    if len(ends) != 2:
        return
    here, there = coordinates_in(plane, torch.from_numpy(np.array(ends))).numpy()
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


def _circle_points(ax: Axes, plane: Plane, points: torch.Tensor, cells: int) -> None:
    """Circle the `points` (P, 3) [m] that are less than one cell away from the plane."""
    center = points.new_tensor(plane.center)
    near = ((points - center) @ points.new_tensor(plane.normal)).abs() < max(plane.size) / cells
    coordinates = coordinates_in(plane, points[near])
    style: Any = {"marker": "o", "ms": 9, "mfc": "none", "mec": "white", "mew": 1.2, "linestyle": "none"}
    outline = [withStroke(linewidth=2.6, foreground="black")]
    ax.plot(*(MM * coordinates.T.cpu().numpy()), path_effects=outline, **style)


def _label_bar(bar: Colorbar, limits: tuple[float, float], quantity: str, unit: str, length: float) -> None:
    """Label a colour bar of a length [inch] with the quantity and its unit, and with numbers that fit."""
    name, size = data.pressure_unit(max(map(abs, limits))) if unit == "Pa" else (unit, 1.0)
    bar.set_label(quantity if "[" in quantity else f"{quantity} [{name}]")
    bar.ax.tick_params(labelsize=TICK_SIZE)
    set_ticks(bar.ax.xaxis if bar.orientation == "horizontal" else bar.ax.yaxis, length, limits, size)
