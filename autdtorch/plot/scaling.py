"""Plots of costs against problem sizes, with fitted power laws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

from autdtorch.plot.data import ByMethod, labelled, methods_of
from autdtorch.plot.style import TICK_SIZE, Look, label_of, log_axes, looks_of, new_figure, styled
from autdtorch.utils.array_types import Array

OVERHEAD = 2.0  # fitted costs are at least this many times the smallest: overhead is at most half of each
FEWEST = 3  # points for a fit
_TICKS_APART = 0.12  # least distance of ticks, as a share of the axis


@dataclass(frozen=True)
class PowerLaw:
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

    A broad pale line is a power law, fitted to the costs that are at least twice the smallest one. The legend
    gives its exponent as slope. With fewer than three such costs it gives the ratio of largest to smallest.

    Args:
        costs: sizes and costs (N, 2), all > 0, by labels of cost and size (with units) and by method.

    Raises:
        ValueError: no cost or size, or values that are not (N, 2) finite numbers > 0.
    """
    data = labelled("costs", costs, "points", "2", positive=2)
    growths = methods_of(data.values())
    looks = looks_of(methods_of(series for by_size in data.values() for series in by_size.values()))
    figure = new_figure(0.6 + 2.5 * len(growths), 0.2 + 2.7 * len(data))
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
    style: Any = {"color": look.colour, "marker": look.marker, "linestyle": look.dashes, "label": name}
    ax.plot(sizes, costs, ms=4, lw=1.2, **style)


def _mark_sizes(ax: Axes, sizes: Array) -> None:
    """Make the axes logarithmic, with ticks at the sizes that do not overlap."""
    log_axes(ax)
    ax.set_xmargin(0.08)
    logarithms = np.log(np.unique(sizes))
    least = _TICKS_APART * np.ptp(logarithms)
    kept: list[float] = []
    for place in logarithms:
        if not kept or place - kept[-1] >= least:
            kept.append(place)
    ax.xaxis.set_major_locator(FixedLocator(list(np.exp(kept))))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(lambda value, _: f"{value:.3g}")
    ax.tick_params(labelsize=TICK_SIZE)
    ax.grid(color="0.9", linewidth=0.6)
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0)
