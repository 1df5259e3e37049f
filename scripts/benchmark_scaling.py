"""How time and memory grow with spacing, domain, transducers and foci; writes docs/performance.md.

    python scripts/benchmark_scaling.py             about 5 minutes on 2 idle cores

A transfer matrix of each size is made in a process of its own, which first loads the kernels. The time is
that of a new propagator and its matrix, assembly included, the shorter of two. The memory is what the first
of them adds to the largest resident set of the process; as it may use again what loading the kernels has left
free, that can be some MB too little. Two cubes are in the way, in the growing domain three. For transducers
and foci the circle of foci lies off the axis, so that no symmetry saves a run; one point, the paper's, does.
"""

from __future__ import annotations

import dataclasses
import resource
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import TypeVar

from benchmark_accuracy import ROOT, SCENES, TOLERANCE
from generated_block import fill_in, measured
from large_arrays import MIDDLE, autd3_array, with_array
from scaling_report import Point, exponents, figure, measurements

import autdtorch as at
from autdtorch.propagators import SimulatedPropagator
from autdtorch.utils.threads import thread_count

DOCS = ROOT / "docs"

COMMAND = "python scripts/benchmark_scaling.py"

REPEATS = 2
COARSEST = 2.0
"""Spacing [mm] at which kernels are loaded."""

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


Argument = TypeVar("Argument")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Task:
    """A transfer matrix to measure; `growth`, `series` and `size` are those of its `Point`."""

    growth: str
    series: str
    size: float
    scene: at.Scene
    method: str
    spacing: float  # [mm]


def prepared(scene: at.Scene, method: str, spacing: float, tolerance: float) -> SimulatedPropagator:
    """A propagator at `spacing` [mm], nothing of it taken from disk."""
    propagator = at.make_propagator(scene, method, spacing * 1e-3, tolerance=tolerance, cache=False)
    assert isinstance(propagator, SimulatedPropagator)
    return propagator


def load_kernels(method: str) -> None:
    """Compile what steps the grids of a method, or load it from disk."""
    scene = at.load_scene(SCENES / "two_cubes.yaml")
    prepared(scene, method, COARSEST, tolerance=0.5).transfer_matrix()


def peak() -> int:
    """Largest resident set of this process so far [KiB]; macOS gives bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def measure(task: Task) -> Point:
    """Time and memory of a task, in a process that has done nothing else."""
    load_kernels(task.method)
    before = peak()
    spent, added = [], []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        propagator = prepared(task.scene, task.method, task.spacing, TOLERANCE)
        propagator.transfer_matrix()
        spent.append(time.perf_counter() - begin)
        added.append(max(1024, peak() - before))
    periods = max(run.periods for run in propagator.runs)
    return Point(
        task.growth, task.series, task.size, min(spent), added[0] / 1024, len(propagator.runs), periods
    )


def in_new_process(work: Callable[[Argument], Result], argument: Argument) -> Result:
    """What `work` returns, done by a process of its own."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(work, argument).result()


def measure_all(tasks: Sequence[Task]) -> Iterator[Point]:
    """One task after the other, with kernels compiled before."""
    for method in dict.fromkeys(task.method for task in tasks):
        in_new_process(load_kernels, method)
    for task in tasks:
        point = in_new_process(measure, task)
        print(point, flush=True)
        yield point


def spacing_tasks() -> list[Task]:
    """Two cubes, ever finer."""
    scene = at.load_scene(SCENES / "two_cubes.yaml")
    return [
        Task("spacing", method, spacing, scene, method, spacing)
        for method, spacings in SPACINGS.items()
        for spacing in spacings
    ]


def domain_tasks() -> list[Task]:
    """Three cubes, the paper's domain growing about its middle."""
    scene = at.load_scene(SCENES / "three_cubes.yaml")

    def grown(edge: float) -> at.Scene:
        corners = tuple((50e-3 + side * edge * 1e-3 / 2,) * 3 for side in (-1, 1))
        return dataclasses.replace(scene, domain=corners)

    return [
        Task("domain", method, edge, grown(edge), method, EDGE_SPACING)
        for method in ("box", "full")
        for edge in EDGES
    ]


def foci(count: int) -> at.Scene:
    """Two cubes and foci of which no two are mirror images."""
    scene = at.load_scene(SCENES / "two_cubes.yaml")
    circle = at.circle_points((80e-3, 52e-3, 49e-3), 30e-3, count, (1, 0, 0), angle=0.3)
    return dataclasses.replace(scene, control_points=circle)


def transducer_tasks() -> list[Task]:
    """Four foci, ever more transducers."""
    return [
        Task("transducers", "box", count, with_array(foci(4), make()), "box", 1.0)
        for count, make in ARRAYS.items()
    ]


def foci_tasks() -> list[Task]:
    """An AUTD3, ever more foci; and the paper's array and foci, of which one stands for all."""
    array = autd3_array()
    tasks = [Task("foci", "box", count, with_array(foci(count), array), "box", 1.0) for count in COUNTS]
    paper = at.load_scene(SCENES / "two_cubes.yaml")
    return [*tasks, Task("foci", "box, mirror images", len(paper.control_points), paper, "box", 1.0)]


def main() -> None:
    """Measure, and write block and figure."""
    tasks = [*spacing_tasks(), *domain_tasks(), *transducer_tasks(), *foci_tasks()]
    points = list(measure_all(tasks))
    figure(points, COMMAND).savefig(DOCS / "scaling.png")
    stated = measured(COMMAND) + f"\n\nThreads: {thread_count()}."
    parts = (
        stated,
        '"Box, mirror images" is the paper\'s array of 16 and its four foci, one run standing for all.',
        "![Time and memory over spacing, domain, transducers and foci](scaling.png)",
        "Powers fitted to what costs at least twice as much as the cheapest of the series:",
        exponents(points),
        "All measurements:",
        measurements(points),
    )
    fill_in(DOCS / "performance.md", "benchmark_scaling", parts, DOCS)


if __name__ == "__main__":
    main()
