"""Measure what fewer runs save, and what the grid's place costs.

    python scripts/benchmark_runs.py            5 minutes on 2 idle cores

Transfer matrices of the paper's scenes from one run and its images, from a run a focus, and from disk; then
errors of the cubes with the grid where faces lie best and where it is symmetric.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from benchmark_accuracy import CUBES, ROOT, compare, cube_case, relative_error, simulate

import autdtorch as at
from autdtorch.fdtd import placement
from autdtorch.fdtd.grid import make_box
from autdtorch.propagators import SimulatedPropagator
from autdtorch.propagators.scene_region import region_of

SPACING = 1e-3
SPACINGS = (2.0, 1.7, 1.4, 1.3, 0.85, 0.75, 0.7, 0.65, 0.6, 0.45, 0.4)
"""Of the cubes [mm]: those where the two places differ are simulated."""


def measure_runs(name: str, method: str) -> None:
    """Print times and differences of one scene's matrix."""
    scene = at.load_scene(ROOT / "configs" / "scene" / f"{name}.yaml")
    at.make_propagator(
        scene, method, 2e-3, tolerance=0.1, cache=False
    ).transfer_matrix()  # compiles the kernel
    with tempfile.TemporaryDirectory() as folder:
        propagator = at.make_propagator(scene, method, SPACING, cache=folder)
        assert isinstance(propagator, SimulatedPropagator)
        begin = time.perf_counter()
        matrix = propagator.transfer_matrix()
        one = time.perf_counter()
        runs = len(propagator.runs)
        direct = torch.cat([propagator.transfer_matrix(point[None]) for point in scene.control_points])
        each = time.perf_counter()
        again = at.make_propagator(scene, method, SPACING, cache=folder)
        assembled = time.perf_counter()
        kept = again.transfer_matrix()
        end = time.perf_counter()
    assert torch.equal(kept, matrix)
    print(
        f"{name}, {method}: {runs} runs {one - begin:.1f} s; a run a focus {each - one:.1f} s, "
        f"{relative_error(matrix, direct):.1e} apart; from disk {1e3 * (end - assembled):.0f} ms "
        f"and {assembled - each:.1f} s to assemble the scene",
        flush=True,
    )


@contextmanager
def forgiven(missed: float) -> Iterator[None]:
    """Let a symmetric grid miss that much more than another."""
    usual = placement._FORGIVEN
    placement._FORGIVEN = missed
    try:
        yield
    finally:
        placement._FORGIVEN = usual


def measure_places(name: str) -> None:
    """Print the errors of both places at those spacings where they differ."""
    case = cube_case(name)
    ratios = []
    for spacing in SPACINGS:
        grids, errors = [], []
        for place, missed in (("best place", 0.0), ("symmetric", math.inf)):
            with forgiven(missed):
                grids.append(make_box(region_of(case.scene), spacing * 1e-3))
                if len(grids) == 1 or grids[0] != grids[1]:
                    errors.append(compare(case, place, spacing, simulate(case, spacing)).total)
        if len(errors) == 2:
            ratios.append(errors[1] / errors[0])
    mean = math.exp(sum(map(math.log, ratios)) / len(ratios))
    print(f"{name}: symmetric over best {min(ratios):.2f} to {max(ratios):.2f}, mean {mean:.2f}", flush=True)


if __name__ == "__main__":
    for name in (*CUBES, "sphere"):
        for method in ("box", "full"):
            measure_runs(name, method)
    for name in CUBES:
        measure_places(name)
