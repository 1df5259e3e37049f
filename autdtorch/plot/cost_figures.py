"""Plots of costs: against results, with Pareto fronts, and against problem sizes, with fitted power laws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, NullLocator

from autdtorch.plot import style
from autdtorch.plot.data import ByMethod, by_scene, labelled, methods_of, require_each
from autdtorch.plot.style import (
    TICK_SIZE,
    Look,
    add_legend,
    begin_at_zero,
    label_of,
    log_axes,
    looks_of,
    styled,
    text_width,
    wrapped,
)
from autdtorch.utils.array_types import Array
from autdtorch.utils.validation import boolean, invalid, members, require_kind

_FRONT: dict[str, Any] = {"color": "0.8", "linewidth": 4.0, "solid_joinstyle": "miter", "zorder": 1.0}
_PANEL, _HEIGHT = 2.6, 2.5  # inch
_INSIDE = 2.0  # inch, of a panel, without labels
_BESIDE = 0.08  # inch, between a point and its name
_MARGIN = 0.15  # between points and the ends of an axis, as a share of what the points span
_LEAST_DECADES = 1.0  # of costs along an axis: ticks of nearly equal ones would have many digits, and overlap
_NAME_WIDTH, _NAME_LINES = 0.8, 3  # inch, and lines; of longer names the rest is left out

OVERHEAD = 2.0  # fitted costs are at least this many times the smallest: overhead is at most half of each
FEWEST = 3  # points for a fit
_TICKS_APART = 0.12  # least distance of ticks, as a share of the axis


@styled
def plot_pareto(
    points: Mapping[str, ByMethod],
    xlabel: str,
    ylabel: str,
    higher_is_better: bool = False,
    names: Mapping[str, Mapping[str, Sequence[str]]] | None = None,
) -> Figure:
    """Plot results against costs of methods or programs, with the Pareto front, one panel per scene.

    A line joins the Pareto front of each method; its other points are small and pale. The broad grey line is
    the front of all methods together. Costs and errors have logarithmic axes, scores a linear one.

    Args:
        points: by scene and method, (N, 2): cost > 0, and error > 0 or score.
        xlabel: label of the cost, with its unit.
        ylabel: label of the result, with its unit.
        higher_is_better: True if the result is a score, not an error.
        names: by scene and method, N names of the points; those on the front of all methods are shown, in
            up to three lines.

    Raises:
        ValueError: no scene, points that are not (N, 2) finite numbers, or a cost or error <= 0.
    """
    higher_is_better = boolean("higher_is_better", higher_is_better)
    data = by_scene("points", points, "points", "2", positive=1 if higher_is_better else 2)
    require_kind("xlabel", xlabel, str)
    require_kind("ylabel", ylabel, str)
    if names is not None:
        require_each("names", names, data)
    looks = looks_of(methods_of(data.values()))
    figure, panels = style.new_panels(data, _PANEL, _HEIGHT, xlabel, ylabel, sharey=higher_is_better)
    for ax, (scene, drawn) in zip(panels, data.items(), strict=True):
        for method, values in drawn.items():
            _draw_points(ax, values, looks[method], higher_is_better)
        everything = np.concatenate(list(drawn.values()))
        best = _pareto_front(everything, higher_is_better)
        texts = [] if names is None else _texts(f"names[{scene!r}]", names[scene], drawn)
        shown = {index: wrapped(texts[index], _NAME_WIDTH, _NAME_LINES) for index in best if texts}
        _make_room(ax, [_size(text) for text in shown.values()])
        log_axes(ax, "x" if higher_is_better else "xy")
        _name_front(ax, everything, shown, higher_is_better)
        # The best result within each cost: steps up to the edge of the panel.
        ends = np.vstack([everything[best], (ax.get_xlim()[1], everything[best[-1], 1])])
        ax.step(*ends.T, where="post", scalex=False, scaley=False, **_FRONT)
    if higher_is_better:  # after all panels, which share the axis, are drawn
        begin_at_zero(panels[0])
    handles = [
        Line2D([], [], color=look.colour, marker=look.marker, markersize=5, label=label_of(method))
        for method, look in looks.items()
    ]
    add_legend(figure, [*handles, Line2D([], [], label="front of all", **_FRONT)])
    return figure


def _pareto_front(points: Array, higher_is_better: bool) -> list[int]:
    """Return the indices of the Pareto-optimal points (N, 2), by rising cost; of equal points the first."""
    costs, results = points.T
    worse = -results if higher_is_better else results
    front: list[int] = []
    for index in np.lexsort((worse, costs)):
        if not front or worse[index] < worse[front[-1]]:
            front.append(int(index))
    return front


def _size(name: str) -> Array:
    """Return width and height [inch] of a name with its distance from a point."""
    lines = name.split("\n")
    width = max(text_width(line, TICK_SIZE) for line in lines)
    return np.array([width, 1.2 * TICK_SIZE / 72 * len(lines)]) + _BESIDE


def _make_room(ax: Axes, sizes: Sequence[Array]) -> None:
    """Set limits with room for names of sizes [inch] left of, above and below all points."""
    width, height = np.max([*sizes, np.zeros(2)], axis=0)
    ax.margins(_MARGIN, max(_MARGIN, height / (_INSIDE - 2 * height)))
    ax.set_xscale("log")
    low, high = np.log10(ax.get_xlim())
    first, share = low + _MARGIN / (1 + 2 * _MARGIN) * (high - low), width / _INSIDE
    short = max(0.0, _LEAST_DECADES - (high - low)) / 2
    low, high = low - short, high + short
    ax.set_xlim(10 ** min(low, (first - share * high) / (1 - share)), 10**high)


def _name_front(ax: Axes, points: Array, names: Mapping[int, str], higher_is_better: bool) -> None:
    """Write names on the side of the front without points; leave out names that would cover another."""
    up, side = (3, "bottom") if higher_is_better else (-3, "top")
    where: Any = {"xytext": (-4, up), "textcoords": "offset points", "ha": "right", "va": side}
    place = (ax.transData + ax.transAxes.inverted()).transform(points) * _INSIDE
    written: list[tuple[Array, float]] = []  # places and heights
    for index, name in names.items():
        width, height = _size(name)
        # Costs rise along the front: a name covers one before it if it is too wide, and that is too high.
        apart = [abs(place[index] - other) > (width, room) for other, room in written]
        if all(gaps.any() for gaps in apart):
            ax.annotate(name, tuple(points[index]), fontsize=TICK_SIZE, **where)
            written.append((place[index], height))


def _texts(name: str, names: Mapping[str, Sequence[str]], drawn: Mapping[str, Array]) -> list[str]:
    require_each(name, names, drawn)
    texts: list[str] = []
    for method, values in drawn.items():
        of_method = members(f"{name}[{method!r}]", names[method], str)
        if len(of_method) != len(values):
            raise invalid(
                f"{name}[{method!r}]", of_method, f"must be {len(values)} names, one for each point"
            )
        texts += of_method
    return texts


def _draw_points(ax: Axes, points: Array, look: Look, higher_is_better: bool) -> None:
    colour, marker, _ = look
    front = _pareto_front(points, higher_is_better)
    beaten = np.delete(points, front, axis=0)
    ax.plot(*beaten.T, color=colour, marker=marker, markersize=2.5, linewidth=0, alpha=0.35)
    ax.plot(*points[front].T, color=colour, marker=marker, markersize=5, linewidth=1.2, clip_on=False)


class PowerLaw(NamedTuple):
    """The power law cost = factor * size^exponent, for sizes in the fitted range."""

    exponent: float
    factor: float
    sizes: tuple[float, float]


def fit_power(sizes: Sequence[float] | Array, costs: Sequence[float] | Array) -> PowerLaw | None:
    """Fit the costs that are at least `OVERHEAD` times the smallest; None if fewer than `FEWEST` are."""
    chosen = [pair for pair in zip(sizes, costs, strict=True) if pair[1] >= OVERHEAD * min(costs)]
    if len(chosen) < FEWEST:
        return None
    logarithms = np.log(np.array(chosen, dtype=np.float64))
    exponent, logarithm = np.polyfit(logarithms[:, 0], logarithms[:, 1], 1)
    return PowerLaw(float(exponent), float(np.exp(logarithm)), (float(chosen[0][0]), float(chosen[-1][0])))


@styled
def plot_scaling(costs: Mapping[str, Mapping[str, ByMethod]]) -> Figure:
    """Plot costs against sizes on logarithmic axes with fitted power laws, one row of panels per cost.

    A broad pale line is a power law, fitted to the costs of at least twice the smallest one; the legend gives
    its exponent as slope. With fewer than three such costs, it gives the ratio of largest to smallest.

    Args:
        costs: sizes and costs (N, 2), all > 0, by labels of cost and size (with units) and by method.

    Raises:
        ValueError: no cost or size, or values that are not (N, 2) finite numbers > 0.
    """
    data = labelled("costs", costs, "points", "2", positive=2)
    growths = methods_of(data.values())
    looks = looks_of(methods_of(series for by_size in data.values() for series in by_size.values()))
    figure = style.new_figure(0.6 + 2.5 * len(growths), 0.2 + 2.7 * len(data))
    panels = figure.subplots(len(data), len(growths), squeeze=False, sharex="col", sharey="row")
    for line, (label, by_size) in zip(panels, data.items(), strict=True):
        for ax, growth in zip(line, growths, strict=True):
            if growth not in by_size:
                ax.set_axis_off()
                continue
            for method, values in by_size[growth].items():
                _draw_series(ax, label_of(method), values, looks[method])
            _mark_sizes(ax, np.concatenate(list(by_size[growth].values()))[:, 0])
        line[0].set_ylabel(label)
    for ax, growth in zip(panels[-1], growths, strict=True):
        ax.set_xlabel(growth)
    for line in panels:  # after all panels of a row, which share the axis, are drawn
        log_axes(line[0], "y")
    return figure


def _draw_series(ax: Axes, name: str, values: Array, look: Look) -> None:
    sizes, costs = values.T
    fit = fit_power(sizes, costs)
    if fit is not None:
        ends = np.array(fit.sizes)
        ax.plot(ends, fit.factor * ends**fit.exponent, color=look.colour, linewidth=5, alpha=0.3)
        name += f", slope {fit.exponent:.1f}".replace("-", "\N{MINUS SIGN}")
    elif len(values) >= FEWEST:
        name += f", within a factor {costs.max() / costs.min():.2g}"
    line: Any = {"color": look.colour, "marker": look.marker, "linestyle": look.dashes, "label": name}
    ax.plot(sizes, costs, ms=4, lw=1.2, **line)


def _mark_sizes(ax: Axes, sizes: Array) -> None:
    """Make the axes logarithmic, with ticks at the sizes that do not overlap."""
    log_axes(ax)
    ax.set_xmargin(0.08)
    logarithms = np.log(np.unique(sizes))
    least = _TICKS_APART * np.ptp(logarithms)
    ticks: list[float] = []
    for place in logarithms:
        if not ticks or place - ticks[-1] >= least:
            ticks.append(place)
    ax.xaxis.set_major_locator(FixedLocator(list(np.exp(ticks))))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(lambda value, _: f"{value:.3g}")
    ax.tick_params(labelsize=TICK_SIZE)
    ax.grid(color="0.9", linewidth=0.6)
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0)
