"""Scattering operators of the paper's cubes: time to build, accuracy after moves, and matrices a second.

Fills in a block of performance.md. Shifts and turns are random, and compared with the box solver at the same
spacing and at a fine one.

    python scripts/benchmark.py operator        about five minutes on 2 idle cores
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from shared.document import fill_in, measured, table
from shared.scenes import paper_scene, relative_error

import autdtorch as at
from autdtorch.propagators.moved_boxes import forget_assemblies

DOCUMENT = "performance.md"

SCENES = ("two_cubes", "three_cubes")
SPACING, FINE = 1e-3, 0.4e-3  # [m]
LARGEST_SHIFT = 4e-3  # [m]
REPEATS = 5
OPTIONS = {
    "--shifts": {"type": int, "default": 50, "help": "random shifts, against the box at the same spacing"},
    "--fine": {"type": int, "default": 3, "help": "of these, against the box at 0.4 mm"},
}


def shortest(work: Callable[[], object]) -> float:
    """Return the shortest time [s] of some repetitions."""
    spent = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        work()
        spent.append(time.perf_counter() - begin)
    return min(spent)


def by_box(scene: at.Scene, shift: list[float], spacing: float) -> torch.Tensor:
    """Return the transfer matrix of the box solver with all obstacles shifted."""
    moved = tuple(
        replace(body, center=tuple(np.add(body.center, shift)))  # type: ignore[attr-defined, call-arg]
        for body in scene.obstacles
    )
    propagator = at.make_propagator(replace(scene, obstacles=moved), "box", spacing, cache=False)
    return propagator.transfer_matrix()


def row(name: str, shifts: int, fine: int) -> list[str]:
    """Return the cells of one scene."""
    scene, generator = paper_scene(name), np.random.default_rng(0)
    forget_assemblies()
    begin = time.perf_counter()
    operator = at.ScatteringOperator.of(scene.obstacles, scene.medium, scene.frequency, SPACING)
    built = time.perf_counter() - begin
    errors, finer = [], []
    for number in range(shifts):
        shift = generator.uniform(-LARGEST_SHIFT, LARGEST_SHIFT, 3).tolist()
        found = operator.moved(shift).transfer_matrix(scene.array, scene.control_points)
        errors.append(relative_error(found, by_box(scene, shift, SPACING)))
        if number < fine:
            finer.append(relative_error(found, by_box(scene, shift, FINE)))
    pose = shortest(lambda: operator.moved((1e-3, 0, 0)).transfer_matrix(scene.array, scene.control_points))
    array = at.TransducerArray.grid((16, 16), 5e-3, (1e-3, 50e-3, 50e-3), (1, 0, 0), radius=0)
    sets = torch.tensor([90e-3, 50e-3, 50e-3]) + 10e-3 * torch.rand(
        1000, 4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    plane = at.Plane(center=(90e-3, 50e-3, 50e-3), normal=(1, 0, 0), size=(100e-3, 100e-3)).points(1e-3)
    cells = [
        f"{len(operator.matrix)}",
        f"{built:.0f}",
        f"{operator.reciprocity:.1e}, {operator.energy:.1e}",
        f"{100 * float(np.median(errors)):.2g}, {100 * max(errors):.2g}",
        f"{100 * max(finer, default=math.nan):.2g}",
        f"{1e3 * pose:.1f}",
        f"{1000 / shortest(lambda: operator.transfer_matrix(array, sets)):,.0f}",
        f"{shortest(lambda: operator.transfer_matrix(array, plane)):.1f}",
    ]
    print(name, *cells, flush=True)
    return [name, *cells]


def main(given: argparse.Namespace) -> None:
    """Measure, and write the block."""
    head = [
        "body",
        "waves",
        "built [s]",
        "reciprocity, energy",
        "from `box`, median and largest [%]",
        "from `box` at 0.4 mm [%]",
        "pose [ms]",
        "matrices/s",
        "plane [s]",
    ]
    parts = (
        measured(),
        f"Operators at {1e3 * SPACING:g} mm, {given.shifts} random shifts up to {1e3 * LARGEST_SHIFT:g} mm:\n"
        "the paper's array and foci. Matrices of four points, and a plane of 10,000, are for 256\n"
        "transducers.",
        table(head, [row(name, given.shifts, given.fine) for name in SCENES]),
    )
    fill_in(DOCUMENT, "benchmark.py operator", parts, given.output)
