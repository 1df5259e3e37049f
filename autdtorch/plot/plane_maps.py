"""Maps of the pressure on planes, with the force on a body or beside a camera's picture."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from autdtorch.hardware.camera.picture import Picture
from autdtorch.plot import data
from autdtorch.plot.colours import FLOOR
from autdtorch.plot.data import MM, ByMethod, largest, outside_on_plane, plane_magnitude, require_each
from autdtorch.plot.plane_axes import coordinates_in, draw_plane, points_for_map
from autdtorch.plot.style import TICK_SIZE, label_of, new_figure, readable, set_ticks, styled, wrapped
from autdtorch.scene.geometry import Plane, cell_centers_of
from autdtorch.scene.obstacles import Obstacle
from autdtorch.scene.reflectors import Reflector
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import Array
from autdtorch.utils.text import in_digits
from autdtorch.utils.units import prefixed
from autdtorch.utils.validation import (
    ArrayLike,
    boolean,
    finite_number,
    invalid,
    members,
    not_negative,
    real_tensor,
    require_kind,
)

# Lengths [inch]
_SIDE = 3.1  # of a square plane in a figure of one
_SMALL_SIDE = 1.85  # in a figure of several
_WIDTH = 7.0  # of the maps in a figure of several, unless they are more than three
_LEAST_COLUMN, _LEAST_ROW = 1.4, 0.8  # for the numbers of a colour bar, and the name of a method
_BAR = 0.11  # thickness of a colour bar
_LABELS = 0.62  # for tick labels and the name of an axis
_NAME_LINE = 0.16  # for each line of the name of a row
_END = 0.25  # for the half of the last tick label that is beyond its axis, and a margin

_ARROW = 1.0  # length of the median arrow, relative to the distance of two
_LONGEST = 2.5  # of all arrows, likewise; longer ones are cut


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
    title: str = "",
) -> Figure:
    """Plot the pressure magnitude on a plane over the coordinates along its edges.

    Cells inside the `obstacles` are grey, and the colours span the pressures outside. Without `obstacles`
    nothing is masked: a field inside a body may then be most of the scale.

    Args:
        pressure: complex pressure or its magnitude (Nu, Nv) [Pa], at `plane.points(...)`.
        plane: the plane.
        control_points: (P, 3) [m]; those in the plane are circled, others are logged.
        obstacles: obstacles, masked and outlined in the plane.
        ax: axes to draw into; by default those of a new figure.
        decibels: True for the level 20 lg(|p| / reference) [dB] instead of |p| [Pa].
        vmin: lower end of the colours [Pa], >= 0, or [dB] with `decibels`; by default 0 Pa or -30 dB.
        vmax: upper end of the colours, > `vmin`, in the same unit; by default the largest |p| or 0 dB.
        reference: the pressure of 0 dB [Pa], > 0; by default the largest |p|. Pictures with equal references
            can be compared.
        reflectors: reflectors, drawn where they cross the plane, hatched on their backs; cells behind are
            grey.
        title: lines above the map, broken where they are wider.

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
    points = points_for_map("control_points", control_points, plane, max(values.shape))
    require_kind("title", title, str)
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
    mesh = draw_plane(ax, values, plane, points, (obstacles, walls), size)
    mesh.set_clim(*limits)
    if title:  # without one, axes of the user keep theirs
        ax.set_title("\n".join(wrapped(line, width) for line in title.splitlines()))
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
    return _rows_of_maps(_checked(*arguments), vmin, vmax)


@styled
def plot_force(
    force: ArrayLike,
    pressure: ArrayLike,
    plane: Plane,
    control_points: ArrayLike | None = None,
    obstacles: Iterable[Obstacle] = (),
) -> Figure:
    """Plot the force at places of a plane as arrows, over the pressure magnitude on it.

    Arrows are the part of the force along the plane. Their lengths are in proportion to the force, up to 2.5
    times their distance; the key is of the median.

    Args:
        force: (Mu, Mv, 3) [N], at `plane.points(...)` of another spacing; 0 draws no arrow.
        pressure: complex pressure or its magnitude (Nu, Nv) [Pa], at `plane.points(...)`.
        plane: the plane.
        control_points: (P, 3) [m]; those in the plane are circled.
        obstacles: obstacles, masked and outlined in the plane.

    Raises:
        ValueError: an argument of another shape or out of range.
    """
    require_kind("plane", plane, Plane)
    force = real_tensor("force", force, "N").detach().cpu()
    if force.ndim != 3 or force.shape[2] != 3 or not force.numel():
        raise ValueError(f"force: shape {tuple(force.shape)}; must be (Mu, Mv, 3), at points of the plane")
    figure: Figure = plot_plane(pressure, plane, control_points, obstacles)
    counts = force.shape[0], force.shape[1]
    places = cell_centers_of(plane, counts).reshape(-1, 3)
    starts = coordinates_in(plane, places).numpy()
    along = coordinates_in(plane, places + force.reshape(-1, 3)).numpy() - starts  # coordinates are linear
    size = np.linalg.norm(along, axis=1)
    apart = MM * min(side / count for side, count in zip(plane.size, counts, strict=True))
    typical = float(np.median(size[size > 0])) if size.any() else 1.0
    shown = along * (_ARROW * apart / typical)
    shown /= np.maximum(np.linalg.norm(shown, axis=1) / (_LONGEST * apart), 1)[:, None]
    drawn = size > 0  # Matplotlib would mark the others by dots
    arrows = figure.axes[0].quiver(
        *(MM * starts[drawn]).T, *shown[drawn].T, angles="xy", scale_units="xy", scale=1, color="white",
        pivot="mid", width=0.006, path_effects=[withStroke(linewidth=1.6, foreground="black")],
    )  # fmt: skip
    if drawn.any():
        factor, unit = prefixed(typical, "N")
        label = f"median force {in_digits(factor * typical, 2)} {unit}"
        figure.axes[0].set_title(" ", fontsize=TICK_SIZE)  # room for the key
        key = {"labelpos": "W", "fontproperties": {"size": TICK_SIZE}}
        figure.axes[0].quiverkey(arrows, 0.92, 1.04, _ARROW * apart, label, **key)
    return figure


def camera_figure(picture: Picture, simulated: Array, plane: Plane, scene: Scene) -> Figure:
    """Draw a picture and |p| (Nu, Nv) [Pa] as `simulated` on a plane, with colours of one scale."""
    maps = {"camera": picture.pressure.numpy(), "simulation": np.nan_to_num(simulated)}
    return plot_planes(
        {name: {"": magnitude} for name, magnitude in maps.items()},
        {"camera": picture.plane, "simulation": plane},
        dict.fromkeys(maps, scene.control_points),
        dict.fromkeys(maps, scene.obstacles),
        vmax=max(map(largest, maps.values())) or 1.0,
        reflectors=dict.fromkeys(maps, scene.reflectors),
    )


class _SceneMaps(NamedTuple):
    """The maps of a scene, and what is drawn on them."""

    plane: Plane
    magnitudes: Mapping[str, Array]  # |p| outside obstacles (Nu, Nv) [Pa], by method
    points: torch.Tensor | None
    obstacles: Sequence[Obstacle]
    reflectors: Sequence[Reflector]


def _checked(
    pressure: Mapping[str, ByMethod],
    planes: Mapping[str, Plane],
    control_points: Mapping[str, ArrayLike] | None,
    obstacles: Mapping[str, Iterable[Obstacle]] | None,
    reflectors: Mapping[str, Iterable[Reflector]] | None,
) -> dict[str, _SceneMaps]:
    """Return the maps of all scenes, after checking the arguments of `plot_planes` by name of the scene."""
    data.require_scenes("pressure", pressure)
    require_each("planes", planes, pressure)
    for name, of_scenes in (
        ("control_points", control_points), ("obstacles", obstacles), ("reflectors", reflectors)
    ):  # fmt: skip
        if of_scenes is not None:
            require_each(name, of_scenes, pressure)
    scenes = {}
    for scene, fields in pressure.items():
        plane = planes[scene]
        require_kind(f"planes[{scene!r}]", plane, Plane)
        bodies = () if obstacles is None else members(f"obstacles[{scene!r}]", obstacles[scene], Obstacle)
        walls = () if reflectors is None else members(f"reflectors[{scene!r}]", reflectors[scene], Reflector)
        magnitudes = {}
        for method, field in fields.items():
            magnitude = plane_magnitude(f"pressure[{scene!r}][{method!r}]", field)
            magnitudes[method] = outside_on_plane(magnitude, plane, bodies, walls)
        of_scene = None if control_points is None else control_points[scene]
        points = points_for_map(f"control_points[{scene!r}]", of_scene, plane, max(magnitude.shape))
        scenes[scene] = _SceneMaps(plane, magnitudes, points, bodies, walls)
    return scenes


def _rows_of_maps(scenes: Mapping[str, _SceneMaps], vmin: float | None, vmax: float | None) -> Figure:
    """Plot a row for each method and a column for each scene, as `plot_planes` does."""
    every = [maps.magnitudes for maps in scenes.values()]
    peaks = [max(map(data.largest, magnitudes.values())) for magnitudes in every]
    ends = [_limits(vmin, vmax, 0.0, peak, "Pa") for peak in peaks]
    methods = data.methods_of(every)
    full = all(method in magnitudes for method in methods for magnitudes in every)
    alike = full and len({maps.plane for maps in scenes.values()}) == 1
    sizes = [_panel(maps.plane, _SMALL_SIDE, _WIDTH / len(scenes)) for maps in scenes.values()]
    widths = [max(_LEAST_COLUMN, width) for width, _ in sizes]
    row = max(_LEAST_ROW, *(height for _, height in sizes))
    between = (0.25, 0.15) if alike else (_LABELS, 0.5)  # columns and rows [inch]
    names = [wrapped(label_of(method), row) for method in methods]
    beside = _NAME_LINE * max(len(name.splitlines()) for name in names) + _LABELS + _END
    below = 1.4 if any(scenes) else 1.1  # or above: titles, the axis and the colour bar
    figure = new_figure(
        beside + sum(widths) + between[0] * (len(widths) - 1), below + (row + between[1]) * len(methods)
    )
    if [(widths[0], row)] == sizes:  # one column, that its maps fill
        figure.set_layout_engine("compressed")  # "constrained" cuts off labels beside them
    heights = [*(row for _ in methods), _BAR]
    axes = figure.subplots(
        len(heights), len(widths), squeeze=False, height_ratios=heights, width_ratios=widths
    )
    shown: list[tuple[QuadMesh, Collection[Array], float]] = []
    for column, size, width, limits, (scene, maps) in zip(
        axes.T, sizes, widths, ends, scenes.items(), strict=True
    ):
        mesh = _draw_column(column[:-1], maps, methods, size, limits)
        column[0].set_title(wrapped(readable(scene), width), weight="bold")
        shown.append((mesh, maps.magnitudes.values(), width))
    if alike:
        for ax in axes[:-2].ravel():
            ax.set_xlabel("")
            ax.tick_params(labelbottom=False)
        for ax in axes[:-1, 1:].ravel():
            ax.set_ylabel("")
            ax.tick_params(labelleft=False)
    for ax, name in zip(axes[:-1, 0], names, strict=True):
        _name_row(ax, name)
    bars = axes[-1]
    if vmax is not None:  # one bar for all
        bars = [figure.add_subplot(axes[-1, 0].get_gridspec()[-1, :])]
        for ax in axes[-1]:
            ax.remove()
        shown = [(shown[0][0], [values for _, maps, _ in shown for values in maps], sum(widths))]
    for bar, (mesh, values, width) in zip(bars, shown, strict=True):
        beyond = _beyond(values, mesh.get_clim())
        drawn = figure.colorbar(mesh, cax=bar, orientation="horizontal", extend=beyond)
        _label_bar(drawn, mesh.get_clim(), "|p|", "Pa", width)
    return figure


def _draw_column(
    column: Iterable[Axes],
    maps: _SceneMaps,
    methods: Sequence[str],
    size: tuple[float, float],
    limits: tuple[float, float],
) -> QuadMesh:
    """Draw the maps of a scene into axes of a size [inch], one for each method; return the last one."""
    for ax, method in zip(column, methods, strict=True):
        if method not in maps.magnitudes:
            ax.set_axis_off()
            continue
        parts = maps.obstacles, maps.reflectors
        mesh = draw_plane(ax, maps.magnitudes[method], maps.plane, maps.points, parts, size)
        mesh.set_clim(*limits)
    return mesh


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


def _label_bar(bar: Colorbar, limits: tuple[float, float], quantity: str, unit: str, length: float) -> None:
    """Label a colour bar of a length [inch] with the quantity and its unit, and with numbers that fit."""
    name, size = data.legible_unit(max(map(abs, limits))) if unit == "Pa" else (unit, 1.0)
    bar.set_label(quantity if "[" in quantity else f"{quantity} [{name}]")
    bar.ax.tick_params(labelsize=TICK_SIZE)
    set_ticks(bar.ax.xaxis if bar.orientation == "horizontal" else bar.ax.yaxis, length, limits, size)
