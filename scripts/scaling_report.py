"""What benchmark_scaling.py writes: fitted exponents, tables and a plot of how cost grows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from generated_block import table
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter, NullLocator

from autdtorch.plot.style import TICK_SIZE, new_figure, styled

OVERHEAD = 2.0
"""Costs from this many times the least one on are fitted: at most half of them is what costs always."""

FEWEST = 3
"""Points of a fit."""

GROWTHS = {
    "spacing": ("spacing h [mm]", "h", "two cubes, one run"),
    "domain": ("edge of the domain L [mm]", "L", "three cubes, 1.5 mm, one run"),
    "transducers": ("transducers M", "M", "two cubes, 1 mm, 4 foci"),
    "foci": ("foci P", "P", "two cubes, 1 mm, 249 transducers"),
}
"""Label and symbol of what grows, and what does not."""

COSTS = {"time": ("seconds", "s"), "memory": ("megabytes", "MB")}
"""Attribute and unit of what is measured."""

# Okabe-Ito, and a marker each
_LOOKS = {
    "box": ("#0072B2", "o"),
    "full": ("#D55E00", "s"),
    "box, mirror images": ("#009E73", "D"),
}


@dataclass(frozen=True)
class Point:
    """One measurement.

    Attributes:
        growth: what grows, a key of `GROWTHS`.
        series: what is measured, a key of `_LOOKS`.
        size: of what grows.
        seconds: time of a transfer matrix.
        megabytes: its peak memory.
        runs: simulations it took.
        periods: of the longest.
    """

    growth: str
    series: str
    size: float
    seconds: float
    megabytes: float
    runs: int
    periods: int


@dataclass(frozen=True)
class Fit:
    """Cost factor * size^exponent, between the sizes that it was fitted to."""

    exponent: float
    factor: float
    sizes: tuple[float, float]


def fitted(sizes: Sequence[float], costs: Sequence[float]) -> Fit | None:
    """Least-squares line in logarithms through costs that are not constant overhead.

    These are at least `OVERHEAD` times the least one; None if they are fewer than `FEWEST`.
    """
    chosen = [pair for pair in zip(sizes, costs, strict=True) if pair[1] >= OVERHEAD * min(costs)]
    if len(chosen) < FEWEST:
        return None
    exponent, logarithm = np.polyfit(*np.log(np.array(chosen)).T, 1)
    return Fit(float(exponent), float(np.exp(logarithm)), (chosen[0][0], chosen[-1][0]))


def each_series(points: Sequence[Point]) -> Iterator[list[Point]]:
    """The points of every series of every growth, in the order of their first mention."""
    for key in dict.fromkeys((point.growth, point.series) for point in points):
        yield [point for point in points if (point.growth, point.series) == key]


def costs_of(points: Sequence[Point], cost: str) -> tuple[list[float], list[float]]:
    """Sizes and costs of a series."""
    return [point.size for point in points], [getattr(point, COSTS[cost][0]) for point in points]


def spread(costs: Sequence[float]) -> float:
    """The largest over the least."""
    return max(costs) / min(costs)


def exponents(points: Sequence[Point]) -> str:
    """A Markdown table of the fits; where there is none, how far costs are apart."""
    rows = []
    for series in each_series(points):
        if len(series) < FEWEST:
            continue
        label, symbol, fixed = GROWTHS[series[0].growth]
        row = [label, fixed, series[0].series]
        for cost in COSTS:
            sizes, costs = costs_of(series, cost)
            fit = fitted(sizes, costs)
            if fit is None:
                row += ["", f"none: within a factor {spread(costs):.2g}"]
            else:
                first, last = fit.sizes
                row += [f"{symbol}^{fit.exponent:.2f}", f"{first:.3g} to {last:.3g}"]
        rows.append(row)
    return table(["growing", "fixed", "method", "time", "fitted over", "memory", "fitted over"], rows)


def measurements(points: Sequence[Point]) -> str:
    """A Markdown table of all points."""
    rows = [
        [GROWTHS[point.growth][0], point.series, f"{point.size:.3g}", f"{point.seconds:.2f} s",
         f"{point.megabytes:.0f} MB", str(point.runs), str(point.periods)]
        for point in points
    ]  # fmt: skip
    return table(["growing", "method", "size", "time", "memory", "runs", "periods"], rows)


@styled
def plot_scaling(points: Sequence[Point], command: str) -> Figure:
    """Time and memory over what grows, with the fits."""
    growths = list(dict.fromkeys(point.growth for point in points))
    figure = new_figure(0.5 + 2.5 * len(growths), 5.6)
    panels = figure.subplots(len(COSTS), len(growths), squeeze=False, sharex="col", sharey="row")
    for line, (cost, (_, unit)) in zip(panels, COSTS.items(), strict=True):
        line[0].set_ylabel(f"{cost} of a transfer matrix [{unit}]")
        for ax, growth in zip(line, growths, strict=True):
            _draw(ax, [point for point in points if point.growth == growth], cost)
    for ax, growth in zip(panels[-1], growths, strict=True):
        label, _, fixed = GROWTHS[growth]
        ax.set_xlabel(f"{label}\n({fixed})")
    figure.supxlabel(
        f"broad lines: fitted powers; $\\times$: largest over least, where none was fitted\n{command}",
        fontsize=TICK_SIZE,
    )
    return figure


def _draw(ax: Axes, points: Sequence[Point], cost: str) -> None:
    for series in each_series(points):
        name, symbol = series[0].series, GROWTHS[series[0].growth][1]
        colour, marker = _LOOKS[name]
        sizes, costs = costs_of(series, cost)
        fit = fitted(sizes, costs)
        if len(series) < FEWEST:
            label = name
        elif fit is None:
            label = f"{name}, within ${{\\times}}{spread(costs):.2g}$"
        else:
            label = f"{name}, ${symbol}^{{{fit.exponent:.1f}}}$"
            ends = np.array(fit.sizes)
            ax.plot(ends, fit.factor * ends**fit.exponent, color=colour, lw=5, alpha=0.3)
        ax.plot(sizes, costs, color=colour, marker=marker, ms=4, lw=1, label=label)
    ax.set(xscale="log", yscale="log")
    ax.xaxis.set_major_locator(FixedLocator(sorted({point.size for point in points})))
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 3)))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.yaxis.set_minor_formatter(NullFormatter())
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{round(value, 2):g}"))
    ax.tick_params(labelsize=TICK_SIZE)
    ax.grid(color="0.9", lw=0.6)
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), borderaxespad=0)
