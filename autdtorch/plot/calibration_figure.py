"""A figure of a calibration: predictions against readings, and gains and phases on the array."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import CenteredNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator

from autdtorch.methods.calibration.calibration import Calibration, gain_to, relative_error
from autdtorch.plot import colours
from autdtorch.plot.data import MM, legible_unit
from autdtorch.plot.style import TICK_SIZE, add_legend, new_figure, set_ticks, styled
from autdtorch.utils.array_types import Array
from autdtorch.utils.spatial import closest_pair
from autdtorch.utils.text import counted
from autdtorch.utils.validation import require_kind

_SIZE = (9.0, 3.1)  # of the figure [inch]
_PANEL = 1.9  # of the longer side of the array [inch]
_BEFORE, _AFTER, _LEFT_OUT = "0.6", "#0072B2", "#D55E00"  # colours
_MOST_DOTS = 400  # readings, above which dots are small
_FLAT = 0.5  # least ratio of the distance of neighbours in a drawing to their distance in space
_FILLED = 0.44  # radius of a dot, in distances of neighbours
_UNSURE = 0.55  # radius of the dot of a transducer that the readings hardly determine, in those of others
_HARDLY = 0.5  # share of the prior's variance that is left of such a transducer, at least
_LEAST_RANGE = 0.01  # of the colours of gains and of phases [rad]; values and deviations may be smaller


@styled
def plot_calibration(calibration: Calibration) -> Figure:
    """Plot a calibration: predictions against readings, and gains and phases of the transducers.

    Predictions are those of readings that were held back from the fit, if there are any: the error says what
    to expect of drives that were not played. Others are of the readings that were fitted.

    Gains and phases are drawn at the places of the transducers, in the two axes along which the array extends
    farthest. Small dots are transducers of which the readings left more than half of the prior's variance.
    Colours span at least twice the median deviation of the others, so that noise alone is pale.
    Without a scene, or where transducers would cover each other, gains and phases are drawn by index, with
    their standard deviations.

    Args:
        calibration: of `calibrate` or `load_calibration`.

    Raises:
        ValueError: another object.
    """
    require_kind("calibration", calibration, Calibration)
    figure = new_figure(*_SIZE)
    left, *others = figure.subplots(1, 3)
    handles = _draw_readings(left, calibration)
    settings = calibration.settings
    values: tuple[Array, ...] = tuple(
        part.numpy()
        for part in (
            calibration.gain,
            calibration.gain * calibration.gain_deviation,
            calibration.phase,
            calibration.phase_deviation,
        )
    )
    hardly = (
        calibration.gain_deviation.numpy() > _HARDLY**0.5 * settings.gain,
        values[3] > _HARDLY**0.5 * settings.phase,
    )
    places = _places(calibration)
    for ax, title, middle, value, deviation, unsure in (
        (others[0], "gain", 1.0, *values[:2], hardly[0]),
        (others[1], "phase [rad]", 0.0, *values[2:], hardly[1]),
    ):
        if places is None:
            _draw_by_index(ax, value, deviation, middle)
            ax.set_ylabel(title)
        else:
            known = deviation[~unsure] if not unsure.all() else deviation
            reach = max(np.abs(value - middle).max(), 2 * float(np.median(known)), _LEAST_RANGE)
            _draw_on_array(ax, places, value, unsure, (middle, reach), title)
    if places is not None and np.any(hardly):
        style: Any = {
            "marker": "o",
            "linestyle": "none",
            "color": "0.8",
            "markeredgecolor": colours.EDGE_COLOUR,
        }
        handles.append(Line2D([], [], markersize=3, label="hardly determined by the readings", **style))
    add_legend(figure, handles)
    return figure


def _draw_readings(ax: Axes, calibration: Calibration) -> list[Line2D]:
    """Draw predictions before and after against readings; return the entries of the legend."""
    readings, held, outliers = calibration.readings, calibration.held_back, calibration.outliers
    observed = readings.pressure.clone()
    rejected = tuple(torch.tensor(outliers, dtype=torch.int64, device="cpu").reshape(-1, 2).T)
    lost = observed[rejected]
    observed[rejected] = torch.nan
    fitted = (readings.drives @ calibration.transfer_matrix.T).abs()
    if held is None:
        before, after = (readings.drives @ calibration.simulated.T).abs(), fitted
        before = gain_to(observed, before) * before
        errors, title = (relative_error(before, observed), relative_error(after, observed)), "readings fitted"
    else:
        before, after, title = held.simulated, held.predicted, "readings held back"
        errors = held.before, held.error
    known = ~observed.isnan()
    levels = torch.cat([part[known] for part in (observed, before, after)])
    name, unit = legible_unit(float(levels.max()))
    most = 1.05 * float(levels.max()) / unit
    size = 9.0 if len(levels) < 3 * _MOST_DOTS else 2.0
    ax.plot([0, most], [0, most], color="0.2", linewidth=0.8, zorder=1)
    handles = []
    worse = "" if errors[1] < errors[0] else ", no better than the simulation"
    for part, colour, label, error, note in (
        (before, _BEFORE, "simulation with one gain", errors[0], ""),
        (after, _AFTER, "calibrated", errors[1], worse),
    ):
        ax.scatter(observed[known] / unit, part[known] / unit, size, color=colour, linewidths=0, alpha=0.7)
        dot: Any = {"marker": "o", "linestyle": "none", "markersize": 4, "color": colour}
        handles.append(Line2D([], [], label=f"{label}: {100 * error:.1f} % off{note}", **dot))
    if outliers:
        cross: Any = {"marker": "x", "color": _LEFT_OUT}
        ax.scatter((lost / unit).clamp(max=most), fitted[rejected] / unit, 18, clip_on=False, **cross)
        beyond = " (to the right)" if (lost / unit > most).any() else ""
        label = f"{counted(len(outliers), 'outlier')}{beyond}"
        handles.append(Line2D([], [], linestyle="none", markersize=4, label=label, **cross))
    ax.set(xlim=(0, most), ylim=(0, most), aspect="equal")
    ax.set(xlabel=f"reading [{name}]", ylabel=f"predicted [{name}]", title=title)
    ax.tick_params(labelsize=TICK_SIZE)
    for axis in (ax.xaxis, ax.yaxis):
        set_ticks(axis, _PANEL, (0, most))
    return handles


def _places(calibration: Calibration) -> tuple[Array, tuple[str, str], float] | None:
    """Return places (M, 2) [mm] of transducers, the names of their axes, and the radius of dots [mm].

    None where there is no scene, or where transducers would cover each other.
    """
    scene = calibration.simulation.scene
    if scene is None:
        return None
    positions = scene.array.positions
    if len(positions) == 1:
        return MM * positions[:, :2].numpy(), ("x", "y"), 1.0
    extent = positions.amax(dim=0) - positions.amin(dim=0)
    first, second = sorted(extent.argsort(descending=True, stable=True)[:2].tolist())
    flat = positions[:, [first, second]]
    apart = closest_pair(torch.cat([flat, torch.zeros_like(flat[:, :1])], dim=1))[0]
    if apart < _FLAT * closest_pair(positions)[0]:
        return None
    return MM * flat.numpy(), ("xyz"[first], "xyz"[second]), _FILLED * MM * apart


def _draw_on_array(
    ax: Axes,
    places: tuple[Array, tuple[str, str], float],
    values: Array,
    unsure: Array,
    colours_around: tuple[float, float],
    title: str,
) -> None:
    """Draw transducers, coloured from a middle by a largest difference to either side."""
    centres, axes, radius = places
    radii = np.where(unsure, _UNSURE, 1.0) * radius
    dots = [Circle(tuple(place), size) for place, size in zip(centres.tolist(), radii.tolist(), strict=True)]
    drawn = PatchCollection(
        dots,
        cmap=colours.WAVE_MAP,
        norm=CenteredNorm(*colours_around),
        edgecolors=colours.EDGE_COLOUR,
        linewidths=0.3,
    )
    drawn.set_array(values)
    ax.add_collection(drawn)
    lower, upper = centres.min(axis=0) - 2 * radius, centres.max(axis=0) + 2 * radius
    ax.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), aspect="equal", title=title)
    ax.set(xlabel=f"{axes[0]} [mm]", ylabel=f"{axes[1]} [mm]")
    ax.tick_params(labelsize=TICK_SIZE)
    lengths = _PANEL * (upper - lower) / (upper - lower).max()
    for axis, length, *limits in zip((ax.xaxis, ax.yaxis), lengths.tolist(), lower, upper, strict=True):
        set_ticks(axis, length, (limits[0], limits[1]))
    bar = ax.figure.colorbar(drawn, cax=ax.inset_axes((1.04, 0.0, 0.05, 1.0)))  # as high as the axes
    bar.ax.tick_params(labelsize=TICK_SIZE)
    set_ticks(bar.ax.yaxis, float(lengths[1]), bar.ax.get_ylim())


def _draw_by_index(ax: Axes, values: Array, deviations: Array, middle: float) -> None:
    ax.axhline(middle, color="0.6", linewidth=0.8)
    dots: Any = {
        "linestyle": "none",
        "marker": "o",
        "markersize": 2.5,
        "elinewidth": 0.8,
        "ecolor": (_AFTER, 0.3),
    }
    ax.errorbar(np.arange(len(values)), values, deviations, color=_AFTER, **dots)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.set_xlabel("transducer")
    ax.tick_params(labelsize=TICK_SIZE)
