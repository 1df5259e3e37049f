"""Plots that compare methods over their trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from string import ascii_lowercase
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from autdtorch.plot import style
from autdtorch.plot.data import ByMethod, Checked, by_scene, labelled, methods_of
from autdtorch.plot.style import TICK_SIZE, Look, add_legend, label_of, looks_of, styled
from autdtorch.utils.array_types import Array
from autdtorch.utils.validation import ArrayLike, finite_number, magnitude_tensor, real_tensor, require_kind

# The first is broad and pale, so that lines on it stay visible.
_LEVELS: tuple[dict[str, Any], ...] = (
    {"color": "0.75", "linewidth": 2.5, "linestyle": "-"},
    {"color": "0.2", "linewidth": 1.0, "linestyle": (0, (5, 3))},
    {"color": "0.2", "linewidth": 1.0, "linestyle": (0, (1, 1.5))},
)

_SINGLE: dict[str, Any] = {"marker": "D", "markersize": 6}  # of a single trial
_FEW: dict[str, Any] = {"marker": "o", "markersize": 4}  # of each of a few trials

_WIDTH = 7.2  # of a figure of boxes [inch]
_BOX = 0.22  # least width of a box with its margin [inch]
_ROW = 1.75  # height of a panel of boxes [inch]
_LOW_ROW = 1.3  # without boxes
_FEWEST = 6  # trials for a box; of fewer, each is a dot
_PANEL = (2.7, 2.5)  # convergence of a scene [inch]
_ALIKE = 5.0  # largest ratio of the highest scores of scenes that share an axis
_POSES = (4.6, 3.2)  # a figure of scores along a path [inch]


@styled
def plot_trials(quantities: Mapping[str, Mapping[str, ByMethod]]) -> Figure:
    """Plot the spread of quantities over the trials, one panel per quantity (the paper's Fig. 3(a) to (c)).

    A box spans the quartiles, with a line at the median. Its whiskers reach to the last trial within 1.5
    times the box; trials beyond are points. Of two to five trials, each is a dot, with a line at the median.
    A single trial is a diamond. The panels of a single scene are side by side if its methods are few.

    Args:
        quantities: by label (with unit), scene and method: one value for each trial (trials,).

    Raises:
        ValueError: no quantity or scene, or values that are not (trials,) finite numbers.
    """
    data = labelled("quantities", quantities, "trials")
    methods = methods_of(values for scenes in data.values() for values in scenes.values())
    scenes = methods_of(data.values())
    looks = looks_of(methods)
    figure, axes, columns = _trial_panels(data, scenes, methods)
    width, height = (
        figure.get_figwidth() / columns - 1.0,
        (figure.get_figheight() - 0.7) * columns / len(axes),
    )
    most = dict.fromkeys(methods, 1)
    for letter, ax, (label, of_scenes) in zip(ascii_lowercase, axes, data.items(), strict=False):
        for scene, by_method in of_scenes.items():
            for method, values in by_method.items():
                place = 0.8 * ((methods.index(method) + 0.5) / len(methods) - 0.5)
                _draw_trials(ax, values, scenes.index(scene) + place, 0.6 / len(methods), looks[method])
                most[method] = max(most[method], values.size)
        for border in range(1, len(scenes)):
            ax.axvline(border - 0.5, color="0.9", linewidth=0.8, zorder=0)
        style.begin_at_zero(ax)
        ax.set_ylabel(style.wrapped(label, height))
        ax.tick_params(labelsize=TICK_SIZE)
        ax.set_xlim(-0.5, len(scenes) - 0.5)
        if len(data) > 1:
            ax.set_title(f"({letter})", loc="left")
    names = [style.wrapped(style.readable(scene), width / len(scenes)) for scene in scenes]
    for ax in axes[-columns:]:
        ax.set_xticks(range(len(scenes)), names)
        ax.set_xlabel("scene")
    add_legend(figure, [_trial_handle(method, look, most[method]) for method, look in looks.items()])
    return figure


def _trial_panels(
    data: Mapping[str, Checked], scenes: Sequence[str], methods: Sequence[str]
) -> tuple[Figure, list[Axes], int]:
    """Return a figure, its panels row by row, and the number of columns."""
    width = 1.0 + _BOX * len(scenes) * len(methods)
    if len(scenes) == 1 and width * len(data) <= _WIDTH:
        figure = style.new_figure(_WIDTH, 0.7 + _ROW)
        return figure, list(figure.subplots(1, len(data), squeeze=False)[0]), len(data)
    by_scene_and_method = (by_method for of_scenes in data.values() for by_method in of_scenes.values())
    sizes = (values.size for by_method in by_scene_and_method for values in by_method.values())
    row = _ROW if max(sizes) >= _FEWEST else _LOW_ROW
    figure = style.new_figure(max(_WIDTH, width), 0.7 + max(_ROW, row * len(data)))
    return figure, list(figure.subplots(len(data), squeeze=False, sharex=True)[:, 0]), 1


@styled
def plot_poses(
    scores: ByMethod, places: ArrayLike, xlabel: str, ylabel: str, bounds: ArrayLike | None = None
) -> Figure:
    """Plot the scores of methods along a path of poses: the median of the trials, and their range.

    Args:
        scores: by method (poses, trials).
        places: of the poses along the path (poses,).
        xlabel: label of the places, with their unit.
        ylabel: label of the scores, with their unit.
        bounds: upper bound of the score at each pose (poses,); infinite where none is known.

    Raises:
        ValueError: no method, or values that are not numbers of these shapes.
    """
    (data,) = by_scene("scores", {"path": scores}, "poses", "trials").values()
    along: Array = real_tensor("places", places).detach().cpu().numpy()
    if along.ndim != 1:
        raise ValueError(f"places: shape {along.shape}; must be (poses,)")
    require_kind("xlabel", xlabel, str)
    require_kind("ylabel", ylabel, str)
    for method, values in data.items():
        if len(values) != len(along):
            raise ValueError(f"scores[{method!r}]: {len(values)} poses; must be {len(along)}, as places")
    limits: Array | None = None
    if bounds is not None:
        limits = magnitude_tensor("bounds", bounds).detach().cpu().numpy()
        if limits.shape != along.shape:
            raise ValueError(f"bounds: shape {limits.shape}; must be {along.shape}, as places")
        if np.isnan(limits).any():
            raise ValueError("bounds: nan; must be numbers, or infinite where none is known")
    (width, height), looks = _POSES, looks_of(data)
    figure = style.new_figure(width, height)
    ax = figure.subplots()
    for method, values in data.items():
        ax.plot(along, np.median(values, axis=1), color=looks[method].colour, label=label_of(method))
        ax.fill_between(
            along, values.min(axis=1), values.max(axis=1), color=looks[method].colour, alpha=0.2, linewidth=0
        )
    if limits is not None and np.isfinite(limits).any():
        ax.plot(along, limits, "k:", label="bound")
    ax.set(xlabel=style.wrapped(xlabel, width - 1.0), ylabel=style.wrapped(ylabel, height - 1.0))
    style.begin_at_zero(ax)
    ax.tick_params(labelsize=TICK_SIZE)
    add_legend(figure, ax.get_legend_handles_labels()[0])
    return figure


@styled
def plot_convergence(
    history: Mapping[str, ByMethod],
    levels: Mapping[str, Mapping[str, float]] | None = None,
    label: str = "weakest focus, best so far [Pa]",
) -> Figure:
    """Plot the best score so far against evaluations, one panel per scene (the paper's Fig. 3(d)).

    A line is the median over the trials, a band spans their quartiles, a dot marks the end of a method.

    Args:
        history: by scene and method, `Solution.history` (trials, evaluations).
        levels: by scene and label, scores to compare with; horizontal lines.
        label: label of the score, with its unit.

    Raises:
        ValueError: no scene, a history that is not (trials, evaluations) finite numbers, or levels of an
            unknown scene.
    """
    histories = by_scene("history", history, "trials", "evaluations")
    require_kind("label", label, str)
    levels = {} if levels is None else levels
    require_kind("levels", levels, Mapping)
    for scene, by_label in levels.items():
        require_kind(f"levels[{scene!r}]", by_label, Mapping)
    if unknown := levels.keys() - history.keys():
        raise ValueError(f"levels: of scenes {list(unknown)}; must be of scenes in history: {list(history)}")
    heights = {
        scene: {
            name: finite_number(f"levels[{scene!r}][{name!r}]", height) for name, height in by_label.items()
        }
        for scene, by_label in levels.items()
    }
    level_labels = list(dict.fromkeys(name for by_label in levels.values() for name in by_label))
    styles = {name: _LEVELS[index % len(_LEVELS)] for index, name in enumerate(level_labels)}
    looks = looks_of(methods_of(histories.values()))
    peaks = [
        max(*(values.max() for values in by_method.values()), 0.0, *heights.get(scene, {}).values())
        for scene, by_method in histories.items()
    ]
    alike = max(peaks) <= _ALIKE * min(peaks)  # otherwise the lower curves would be flat
    figure, panels = style.new_panels(history, *_PANEL, "evaluations", label, sharey=alike)
    title = None
    for ax, (scene, by_method) in zip(panels, histories.items(), strict=True):
        for method, values in by_method.items():
            title = "median of the trials, band: quartiles" if len(values) > 1 else title
            _draw_history(ax, values, looks[method])
        for name, height in heights.get(scene, {}).items():
            ax.axhline(height, zorder=1, **styles[name])
        ax.set_xlim(left=0.0)
    # After all panels are drawn: they share the axis, and a limit set earlier would keep it from growing.
    for ax in panels:
        style.begin_at_zero(ax)
    handles = [
        Line2D([], [], color=look.colour, linestyle=look.dashes, label=label_of(method))
        for method, look in looks.items()
    ]
    handles += [Line2D([], [], label=name, **styles[name]) for name in level_labels]
    add_legend(figure, handles, title)
    return figure


def _trial_handle(method: str, look: Look, trials: int) -> Artist:
    """Return the legend entry of a method with this many trials, at most, in a panel."""
    label = label_of(method)
    if trials >= _FEWEST:
        return Patch(facecolor=(look.colour, 0.4), edgecolor=look.colour, label=label)
    marker = _SINGLE if trials == 1 else _FEW
    return Line2D([], [], color=look.colour, linestyle="none", label=label, **marker)


def _draw_trials(ax: Axes, values: Array, position: float, width: float, look: Look) -> None:
    colour = look.colour
    if values.size < _FEWEST:
        marker = _SINGLE if values.size == 1 else _FEW
        where = np.full(values.size, position)
        ax.plot(where, values, linestyle="none", color=colour, clip_on=False, **marker)
        if values.size > 1:
            ends = position - width / 2, position + width / 2
            ax.hlines(np.median(values), *ends, colors=colour, linewidth=2.2)
        return
    line = {"color": colour, "linewidth": 0.9}
    ax.boxplot(
        [values],
        positions=[position],
        widths=width,
        manage_ticks=False,
        patch_artist=True,
        boxprops={"facecolor": (colour, 0.4), "edgecolor": colour, "linewidth": 0.9},
        medianprops={"color": colour, "linewidth": 2.2, "solid_capstyle": "butt"},  # visible on a flat box
        whiskerprops=line,
        capprops=line,
        flierprops={"marker": ".", "markersize": 4, "markeredgecolor": colour, "markerfacecolor": colour},
    )


def _draw_history(ax: Axes, values: Array, look: Look) -> None:
    evaluations = np.arange(1, values.shape[1] + 1)
    low, median, high = np.percentile(values, [25, 50, 75], axis=0)
    if len(values) > 1:
        ax.fill_between(evaluations, low, high, color=look.colour, alpha=0.2, linewidth=0)
    ax.plot(evaluations, median, color=look.colour, linestyle=look.dashes, linewidth=1.5)
    ax.plot(evaluations[-1:], median[-1:], marker="o", markersize=4, color=look.colour, clip_on=False)
