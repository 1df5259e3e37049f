"""Measure what gradients take: memory, and time beside a run without.

    python scripts/benchmark_gradient.py            5 minutes on 2 idle cores

The paper's two cubes at 1 mm, 100^3 cells and the layers around them, in 1008 steps; gradients by the drive,
also by the cubes' materials, and also by density and sound speed of every cell. Each is measured in a process
of its own, after a small one that compiles the kernel. Fills in a block of docs/performance.md.
"""

from __future__ import annotations

import multiprocessing
import resource
import time
from pathlib import Path
from typing import NamedTuple

import torch
from generated_block import fill_in, measured, table

import autdtorch as at
from autdtorch.utils.threads import thread_count

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"

STEPS_PER_PERIOD, PERIODS = 14, 72
CASES = ("drive", "cubes", "maps")
CHANGED = {"drive": "drive", "cubes": "drive, cubes' materials", "maps": "drive, maps of 100^3 cells"}


class Cost(NamedTuple):
    """Seconds without gradients, then with; largest resident set before and after [GiB]."""

    forward: float
    gradient: float
    before: float
    most: float


def medium(case: str, spacing: float) -> tuple[at.Scene, dict[str, torch.Tensor]]:
    """The scene of a case, and what of its medium is differentiated."""
    scene = at.load_scene(ROOT / "configs" / "scene" / "two_cubes.yaml")
    cubes = scene.obstacles
    if case == "drive":
        return scene, {}
    if case == "cubes":
        density, sound_speed = (
            torch.tensor([getattr(cube, name) for cube in cubes], dtype=torch.float64)
            for name in ("density", "sound_speed")
        )
        return scene, {"density": density, "sound_speed": sound_speed}
    air = at.Scene(scene.array, scene.medium, scene.frequency, scene.control_points, domain=scene.domain)
    centers = at.cell_centers(air, spacing)
    inside = torch.stack([cube.contains(centers) for cube in cubes]).any(dim=0)
    density = torch.where(inside, 100.0, 1.293).double()
    return air, {"density": density, "sound_speed": torch.full_like(density, 340.0)}


def gradient(case: str, spacing: float, periods: int) -> Cost:
    """Measure one case in this process."""
    scene, given = medium(case, spacing)
    drive = torch.ones(len(scene.array), dtype=torch.complex128)
    settings = {"spacing": spacing, "periods": periods, "time_step": 1 / (scene.frequency * STEPS_PER_PERIOD)}
    begin, before = time.perf_counter(), resident()
    at.differentiable_field(scene, drive, **given, **settings)
    middle = time.perf_counter()
    for each in (drive, *given.values()):
        each.requires_grad_()
    at.differentiable_field(scene, drive, **given, **settings).abs().min().backward()
    return Cost(middle - begin, time.perf_counter() - middle, before, resident())


def resident() -> float:
    """Largest resident set of this process so far [GiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def measure(case: str) -> Cost:
    """Compile, then measure."""
    gradient("cubes", 2e-3, 9)
    return gradient(case, 1e-3, PERIODS)


def main() -> None:
    """Measure, and write the block."""
    rows = []
    for case in CASES:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            cost = pool.apply(measure, (case,))
        memory = f"{cost.most:.2f} GiB", f"{cost.before:.2f} GiB"
        times = f"{cost.forward:.1f} s", f"{cost.gradient / cost.forward:.2f}"
        rows.append([CHANGED[case], *times, *memory])
        print(rows[-1], flush=True)
    header = ["gradient by", "run without", "times that", "largest resident set", "before"]
    stated = measured("python scripts/benchmark_gradient.py") + f"\n\nThreads: {thread_count()}."
    fill_in(DOCS / "performance.md", "benchmark_gradient", (stated, table(header, rows)), DOCS)


if __name__ == "__main__":
    main()
