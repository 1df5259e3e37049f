"""Pareto plots of cost and result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from autdtorch.plot.data import ByMethod, by_scene, methods_of, numbers, require_each
from autdtorch.plot.style import TICK_SIZE, Look, add_legend, label_of, log_axes, looks_of, new_panels, styled
from autdtorch.utils.array_types import Array
from autdtorch.utils.validation import ArrayLike, boolean, invalid, members, require_kind

_FRONT: dict[str, Any] = {"color": "0.8", "linewidth": 4.0, "solid_joinstyle": "miter", "zorder": 1.0}
_PANEL = 2.6  # inch


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
        names: by scene and method, N names of the points; shown along the front of all methods.

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
    figure, panels = new_panels(data, _PANEL, _PANEL, xlabel, ylabel, sharey=higher_is_better)
    for ax, (scene, drawn) in zip(panels, data.items(), strict=True):
        for method, values in drawn.items():
            _draw_points(ax, values, looks[method], higher_is_better)
        everything = np.concatenate(list(drawn.values()))
        best = pareto_front(everything, higher_is_better)
        if names is not None:
            require_each(f"names[{scene!r}]", names[scene], drawn)
            texts: list[str] = []
            for method, values in drawn.items():
                texts += _texts(f"names[{scene!r}][{method!r}]", names[scene][method], len(values))
            for index in best:
                _write_beside(ax, everything[index], texts[index], higher_is_better)
        ax.margins(0.15)
        log_axes(ax, "x" if higher_is_better else "xy")
        _draw_front(ax, everything[best])
    if higher_is_better:  # after all panels, which share the axis, are drawn
        panels[0].set_ylim(bottom=min(0.0, panels[0].get_ylim()[0]))
    handles = [
        Line2D([], [], color=look.colour, marker=look.marker, markersize=5, label=label_of(method))
        for method, look in looks.items()
    ]
    add_legend(figure, [*handles, Line2D([], [], label="front of all", **_FRONT)])
    return figure


def pareto_front(points: ArrayLike, higher_is_better: bool = False) -> list[int]:
    """Return the indices of the Pareto-optimal points (N, 2), by rising cost; of equal points the first."""
    costs, results = numbers("points", points, "points", "2").T
    worse = -results if higher_is_better else results
    kept: list[int] = []
    for index in np.lexsort((worse, costs)):
        if not kept or worse[index] < worse[kept[-1]]:
            kept.append(int(index))
    return kept


def _texts(name: str, given: Sequence[str], count: int) -> tuple[str, ...]:
    texts = members(name, given, str)
    if len(texts) != count:
        raise invalid(name, texts, f"must be {count} names, one for each point")
    return texts


def _draw_points(ax: Axes, points: Array, look: Look, higher_is_better: bool) -> None:
    colour, marker, _ = look
    front = pareto_front(points, higher_is_better)
    beaten = np.delete(points, front, axis=0)
    ax.plot(*beaten.T, color=colour, marker=marker, markersize=2.5, linewidth=0, alpha=0.35)
    ax.plot(*points[front].T, color=colour, marker=marker, markersize=5, linewidth=1.2, clip_on=False)


def _write_beside(ax: Axes, point: Array, text: str, higher_is_better: bool) -> None:
    """Write on the side of the front that has no points."""
    up, side = (3, "bottom") if higher_is_better else (-3, "top")
    where: Any = {"xytext": (-4, up), "textcoords": "offset points", "ha": "right", "va": side}
    ax.annotate(text, (point[0], point[1]), fontsize=TICK_SIZE, **where)


def _draw_front(ax: Axes, front: Array) -> None:
    """Draw the best result within each cost as steps up to the edge of the panel."""
    right = ax.get_xlim()[1]
    ends = np.vstack([front, (right, front[-1, 1])])
    ax.step(*ends.T, where="post", scalex=False, scaley=False, **_FRONT)
