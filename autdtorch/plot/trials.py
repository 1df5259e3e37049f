"""How methods compare over their trials."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from autdtorch.drawing import Array
from autdtorch.plot.style import (
    TICK_SIZE,
    ByMethod,
    label_of,
    methods_of,
    new_figure,
    readable,
    require_scenes,
    styled,
)
from autdtorch.validation import ArrayLike, real_tensor

# Okabe-Ito. Our methods have the same colour in every figure, any other takes the next one left over.
_COLOURS = {
    "lssg": "#0072B2",
    "bayes_opt": "#D55E00",
    "gabs": "#009E73",
    "identify": "#CC79A7",
    "random_search": "#56B4E9",
    "lss": "#E69F00",
    "gradient_ascent": "#000000",
}
_SPARE_COLOURS = ("#882255", "#999933", "#999999")  # of Tol's muted scheme

_Dashes: TypeAlias = tuple[float, tuple[float, ...]]
_DASHES: tuple[_Dashes, ...] = (
    (0, ()),
    (0, (5, 1.5)),
    (0, (5, 1.5, 1, 1.5)),
    (0, (1, 1)),
    (0, (8, 1.5)),
    (0, (3, 1, 1, 1, 1, 1)),
)
# The first is broad and pale, so that what lies on it is seen.
_LEVELS: tuple[dict[str, Any], ...] = (
    {"color": "0.75", "linewidth": 2.5, "linestyle": "-"},
    {"color": "0.2", "linewidth": 1.0, "linestyle": (0, (5, 3))},
    {"color": "0.2", "linewidth": 1.0, "linestyle": (0, (1, 1.5))},
)

_WIDTH = 7.2  # of the trials' figure [inch]
_LEGEND_COLUMN = 1.4  # inch


@styled
def plot_trials(quantities: Mapping[str, Mapping[str, ByMethod]]) -> Figure:
    """The paper's Fig. 3(a) to (c): how each quantity spreads over the trials, a panel for each quantity.

    A box spans the quartiles with a line at the median, its whiskers reach to the last trial within 1.5 times
    the box, and what lies beyond is drawn as points. A method with a single trial is drawn as a diamond.

    Args:
        quantities: by label (with unit, for the axis), scene and method: one value for each trial (trials,).

    Returns:
        The figure.

    Raises:
        ValueError: no quantity or scene, or values that are not (trials,) finite numbers.
    """
    if not quantities:
        raise ValueError("quantities: empty; must have at least one")
    methods = methods_of(values for scenes in quantities.values() for values in scenes.values())
    colours = _colours(methods)
    figure = new_figure(_WIDTH, 0.7 + 2.1 * len(quantities))
    axes = figure.subplots(len(quantities), squeeze=False)[:, 0]
    single = dict.fromkeys(methods, True)
    for letter, ax, (label, scenes) in zip("abcdefgh", axes, quantities.items(), strict=False):
        require_scenes(f"quantities[{label!r}]", scenes)
        for column, (scene, by_method) in enumerate(scenes.items()):
            for method, given in by_method.items():
                values = _values(f"quantities[{label!r}][{scene!r}][{method!r}]", given, "trials")
                position = column + 0.8 * ((methods.index(method) + 0.5) / len(methods) - 0.5)
                _draw_trials(ax, values, position, 0.6 / len(methods), colours[method])
                single[method] &= values.size == 1
        ax.set_xticks(range(len(scenes)), [readable(scene) for scene in scenes])
        ax.set_xlim(-0.5, len(scenes) - 0.5)
        ax.set_ylim(bottom=min(0.0, ax.get_ylim()[0]))
        ax.set_ylabel(label)
        ax.tick_params(labelsize=TICK_SIZE)
        if len(quantities) > 1:
            ax.set_title(f"({letter})", loc="left")
    axes[-1].set_xlabel("scene")
    handles = [
        Line2D([], [], color=colours[method], marker="D", linestyle="none", label=label_of(method))
        if single[method]
        else Patch(facecolor=colours[method], alpha=0.6, edgecolor="black", label=label_of(method))
        for method in methods
    ]
    _add_legend(figure, handles)
    return figure


@styled
def plot_convergence(
    history: Mapping[str, ByMethod],
    levels: Mapping[str, Mapping[str, float]] | None = None,
    label: str = "best weakest focus so far [Pa]",
) -> Figure:
    """The paper's Fig. 3(d): best score so far against evaluations, a panel for each scene.

    A line is the median over the trials, its band spans their 10th to 90th percentile; a dot marks where a
    method ends.

    Args:
        history: by scene and method, `Solution.history` (trials, evaluations).
        levels: by scene and label, scores to compare with; drawn across the panel.
        label: of the score, with its unit.

    Returns:
        The figure.

    Raises:
        ValueError: no scene, a history that is not (trials, evaluations) finite numbers, or levels of a scene
            without history.
    """
    require_scenes("history", history)
    levels = levels or {}
    if unknown := levels.keys() - history.keys():
        raise ValueError(
            f"levels: of scenes {sorted(unknown)}; must be of scenes in history: {list(history)}"
        )
    level_labels = list(dict.fromkeys(name for by_label in levels.values() for name in by_label))
    styles = {name: _LEVELS[index % len(_LEVELS)] for index, name in enumerate(level_labels)}
    methods = methods_of(history.values())
    colours = _colours(methods)
    dashes = {method: _DASHES[index % len(_DASHES)] for index, method in enumerate(methods)}
    figure = new_figure(0.6 + 2.7 * len(history), 3.4)
    axes = figure.subplots(1, len(history), squeeze=False, sharey=True)[0]
    for ax, (scene, by_method) in zip(axes, history.items(), strict=True):
        for method, given in by_method.items():
            values = _values(f"history[{scene!r}][{method!r}]", given, "trials", "evaluations")
            _draw_history(ax, values, colours[method], dashes[method])
        for name, level in levels.get(scene, {}).items():
            ax.axhline(level, zorder=1, **styles[name])
        ax.set_title(readable(scene))
        ax.set_xlim(left=0.0)
        ax.set_xlabel("evaluations")
        ax.tick_params(labelsize=TICK_SIZE)
    # Once all panels are drawn: they share the axis, and a limit set earlier would keep it from growing.
    axes[0].set_ylim(bottom=min(0.0, axes[0].get_ylim()[0]))
    axes[0].set_ylabel(label)
    handles = [
        Line2D([], [], color=colours[method], linestyle=dashes[method], label=label_of(method))
        for method in methods
    ]
    handles += [Line2D([], [], label=name, **styles[name]) for name in level_labels]
    _add_legend(figure, handles, "median of the trials, band: 10th to 90th percentile")
    return figure


def _add_legend(figure: Figure, handles: Sequence[Artist], title: str | None = None) -> None:
    """A legend above all panels, in as many rows as its entries need."""
    rows = math.ceil(len(handles) * _LEGEND_COLUMN / figure.get_figwidth())
    columns = math.ceil(len(handles) / rows)
    figure.legend(handles=handles, title=title, loc="outside upper center", ncols=columns)


def _colours(methods: list[str]) -> dict[str, str]:
    others = [method for method in methods if method not in _COLOURS]
    return _COLOURS | {method: _SPARE_COLOURS[i % len(_SPARE_COLOURS)] for i, method in enumerate(others)}


def _values(name: str, given: ArrayLike, *axes: str) -> Array:
    values: Array = real_tensor(name, given).detach().cpu().numpy()
    if values.ndim != len(axes) or values.size == 0:
        raise ValueError(f"{name}: shape {values.shape}; must be ({', '.join(axes)}), none of them 0")
    return values


def _draw_trials(ax: Axes, values: Array, position: float, width: float, colour: str) -> None:
    if values.size == 1:
        ax.plot([position], values, linestyle="none", marker="D", markersize=6, color=colour, clip_on=False)
        return
    ax.boxplot(
        [values],
        positions=[position],
        widths=width,
        manage_ticks=False,
        patch_artist=True,
        boxprops={"facecolor": colour, "alpha": 0.6, "linewidth": 0.8},
        medianprops={"color": "black", "linewidth": 1.4},
        whiskerprops={"linewidth": 0.8},
        capprops={"linewidth": 0.8},
        flierprops={"marker": ".", "markersize": 4, "markeredgecolor": colour, "markerfacecolor": colour},
    )


def _draw_history(ax: Axes, values: Array, colour: str, dashes: _Dashes) -> None:
    evaluations = np.arange(1, values.shape[1] + 1)
    low, median, high = np.percentile(values, [10, 50, 90], axis=0)
    if len(values) > 1:
        ax.fill_between(evaluations, low, high, color=colour, alpha=0.2, linewidth=0)
    ax.plot(evaluations, median, color=colour, linestyle=dashes, linewidth=1.5)
    ax.plot(evaluations[-1:], median[-1:], marker="o", markersize=4, color=colour, clip_on=False)
