"""What benchmark_scaling.py writes: fitted exponents, tables and a figure of how cost grows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from generated_block import table
from matplotlib.figure import Figure

from autdtorch.plot import plot_scaling
from autdtorch.plot.scaling import FEWEST, fit_power
from autdtorch.plot.style import TICK_SIZE

GROWTHS = {
    "spacing": ("spacing h [mm]", "h", "two cubes, one run"),
    "domain": ("edge of the domain L [mm]", "L", "three cubes, 1.5 mm, one run"),
    "transducers": ("transducers M", "M", "two cubes, 1 mm, 4 foci"),
    "foci": ("foci P", "P", "two cubes, 1 mm, 249 transducers"),
}
"""Label and symbol of what grows, and what does not."""

COSTS = {"time": ("seconds", "s"), "memory": ("megabytes", "MB")}
"""Attribute and unit of what is measured."""


@dataclass(frozen=True)
class Point:
    """One measurement.

    Attributes:
        growth: what grows, a key of `GROWTHS`.
        series: what is measured, its name.
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
            fit = fit_power(sizes, costs)
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


def figure(points: Sequence[Point], command: str) -> Figure:
    """Time and memory over what grows, with the fits."""
    values: dict[str, dict[str, dict[str, list[tuple[float, float]]]]] = {}
    for series in each_series(points):
        label, _, fixed = GROWTHS[series[0].growth]
        for cost, (_, unit) in COSTS.items():
            by_size = values.setdefault(f"{cost} of a transfer matrix [{unit}]", {})
            by_method = by_size.setdefault(f"{label}\n({fixed})", {})
            by_method[series[0].series] = list(zip(*costs_of(series, cost), strict=True))
    drawn = plot_scaling(values)
    drawn.supxlabel(command, fontsize=TICK_SIZE)
    return drawn
