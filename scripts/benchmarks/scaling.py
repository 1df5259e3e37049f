"""Growth of time and memory with spacing, domain, transducers and foci.

Fills in a block of the documentation. A new process computes each transfer matrix, after it has loaded the
kernels. The time includes a new propagator; the shorter of two counts. The memory is the increase of the
largest resident set by the first one; memory that the kernels had freed may hide some MB. Two cubes are the
obstacles, three in the growing domain. Symmetry saves no run for transducers and foci, as their circle lies
off the axis, except in one point.

    python scripts/benchmark.py scaling             about 5 minutes on 2 idle cores
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from itertools import groupby
from typing import NamedTuple

from matplotlib.figure import Figure
from shared.document import Page, command_line, table
from shared.scenes import MIDDLE, autd3_array, paper_scene, uncached, with_array
from shared.timing import in_new_process, peak_memory, timed

import autdtorch as at
from autdtorch.plot.costs import FEWEST, fit_power, plot_scaling
from autdtorch.plot.style import TICK_SIZE

DOCUMENT = "performance.md"

COARSEST = 2.0  # [mm]

SPACINGS = {"box": (2.0, 4 / 3, 1.0, 2 / 3, 0.5, 0.4), "full": (2.0, 4 / 3, 1.0, 0.8, 2 / 3)}  # [mm]
EDGES = (100.0, 130.0, 180.0, 250.0)  # [mm]
EDGE_SPACING = 1.5  # [mm]
ARRAYS: dict[int, Callable[[], at.TransducerArray]] = {
    16: lambda: at.TransducerArray.grid((4, 4), 10e-3, MIDDLE),
    64: lambda: at.TransducerArray.grid((8, 8), 10e-3, MIDDLE),
    249: autd3_array,
    498: lambda: autd3_array((2, 1)),
    996: lambda: autd3_array((2, 2)),
}
COUNTS = (1, 2, 4, 8, 16, 32, 64)

GROWTHS = {
    "spacing": ("spacing h [mm]", "h", "two cubes, one run"),
    "domain": ("edge of the domain L [mm]", "L", "three cubes, 1.5 mm, one run"),
    "transducers": ("transducers M", "M", "two cubes, 1 mm, 4 foci"),
    "foci": ("foci P", "P", "two cubes, 1 mm, 249 transducers"),
}
"""Label and symbol of the growing size, and the fixed parameters."""

COSTS = {"time": ("seconds", "s"), "memory": ("megabytes", "MB")}
"""Attribute and unit of each cost."""


OPTIONS = {
    "--growth": {"nargs": "+", "choices": GROWTHS, "default": list(GROWTHS), "help": "measured sizes"},
}


def main(page: Page, growth: list[str]) -> None:
    """Measure, and write block and figure."""
    points = list(measure_all([task for task in tasks() if task.growth in growth]))
    fits, ranges = exponents(points)
    page.write(
        "![Time and memory over spacing, domain, transducers and foci](scaling.png)",
        "Powers fitted to costs of at least twice the cheapest of a series.",
        fits,
        f"Longest over shortest time of series without a fit: {ranges or 'none'}.",
    )
    page.save("scaling.png", figure(points))


class Task(NamedTuple):
    """A transfer matrix to measure: key of `GROWTHS`, name of the series, growing size, spacing in [mm]."""

    growth: str
    series: str
    size: float
    scene: at.Scene
    method: str
    spacing: float


class Point(NamedTuple):
    """A measurement; `growth`, `series` and `size` are those of its `Task`."""

    growth: str
    series: str
    size: float
    seconds: float
    megabytes: float


def load_kernels(method: str) -> None:
    """Compile the kernels of a method, or load them from disk."""
    uncached(paper_scene("two_cubes"), method, COARSEST, tolerance=0.5).transfer_matrix()


def measure(task: Task) -> Point:
    """Measure a task, in a process that has done nothing else."""
    load_kernels(task.method)
    before = peak_memory()

    def work() -> int:
        uncached(task.scene, task.method, task.spacing).transfer_matrix()
        return max(2**20, peak_memory() - before)

    (memory, first), (_, second) = timed(work), timed(work)
    return Point(task.growth, task.series, task.size, min(first, second), memory / 2**20)


def measure_all(tasks: Sequence[Task]) -> Iterator[Point]:
    """Measure one task after the other, with kernels compiled before."""
    for method in dict.fromkeys(task.method for task in tasks):
        in_new_process(load_kernels, method)
    for task in tasks:
        point = in_new_process(measure, task)
        print(point, flush=True)
        yield point


def foci(count: int) -> at.Scene:
    """Return two cubes and foci without symmetry."""
    circle = at.circle_points((80e-3, 52e-3, 49e-3), 30e-3, count, (1, 0, 0), angle=0.3)
    return dataclasses.replace(paper_scene("two_cubes"), control_points=circle)


def tasks() -> list[Task]:
    """Return the tasks of every growth."""
    two, three, array = paper_scene("two_cubes"), paper_scene("three_cubes"), autd3_array()

    def grown(edge: float) -> at.Scene:
        corners = tuple((50e-3 + side * edge * 1e-3 / 2,) * 3 for side in (-1, 1))
        return dataclasses.replace(three, domain=corners)

    return [
        *(Task("spacing", method, h, two, method, h) for method, each in SPACINGS.items() for h in each),
        *(
            Task("domain", method, edge, grown(edge), method, EDGE_SPACING)
            for method in ("box", "full")
            for edge in EDGES
        ),
        *(
            Task("transducers", "box", count, with_array(foci(4), make()), "box", 1.0)
            for count, make in ARRAYS.items()
        ),
        *(Task("foci", "box", count, with_array(foci(count), array), "box", 1.0) for count in COUNTS),
        Task("foci", "box, mirror images", len(two.control_points), two, "box", 1.0),
    ]


def each_series(points: Sequence[Point]) -> list[list[Point]]:
    """Return the points of each series of each growth."""
    return [list(group) for _, group in groupby(points, lambda point: (point.growth, point.series))]


def exponents(points: Sequence[Point]) -> tuple[str, str]:
    """Return a table of the fitted powers, and the range of times in each series without a fit."""
    rows, ranges = [], []
    for series in each_series(points):
        if len(series) < FEWEST:
            continue
        label, symbol, fixed = GROWTHS[series[0].growth]
        costs = [[getattr(point, attribute) for point in series] for attribute, _ in COSTS.values()]
        fits = [fit_power([point.size for point in series], cost) for cost in costs]
        if fits[0] is None:
            ranges.append(f"{label}, {series[0].series}: {max(costs[0]) / min(costs[0]):.2g} times")
        powers = ["" if fit is None else f"{symbol}^{fit.exponent:.2f}" for fit in fits]
        if any(powers):
            rows.append([label, fixed, series[0].series, *powers])
    return table(["growing", "scene", "method", "time", "memory"], rows), "; ".join(ranges)


def figure(points: Sequence[Point]) -> Figure:
    """Plot time and memory over the growing sizes, with the fits."""
    values: dict[str, dict[str, dict[str, list[tuple[float, float]]]]] = {}
    for series in each_series(points):
        label, _, fixed = GROWTHS[series[0].growth]
        for cost, (attribute, unit) in COSTS.items():
            by_size = values.setdefault(f"{cost} of a transfer matrix [{unit}]", {})
            by_method = by_size.setdefault(f"{label}\n({fixed})", {})
            by_method[series[0].series] = [(point.size, getattr(point, attribute)) for point in series]
    drawn = plot_scaling(values)
    drawn.supxlabel(command_line(), fontsize=TICK_SIZE)
    return drawn
