"""Run times of the transfer matrices of the paper's scenes.

    python scripts/benchmark.py speed             about 4 minutes on 2 idle cores

Fills in a block of performance.md. Errors are those of `benchmark.py accuracy`, of one focus. Each matrix
comes from a propagator of its own, assembly included, the fastest of three. Kernels are compiled before,
except for the first call of a process.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import subprocess
import sys
import tempfile
import time

import torch
from shared.cases import CUBES, cube_case
from shared.document import fill_in, measured, table
from shared.scenes import SCENES, autd3_array, paper_scene, relative_error, uncached, with_array

import autdtorch as at
from autdtorch.propagators import SimulatedPropagator

DOCUMENT = "performance.md"

SPACINGS = (1.0, 0.8, 2 / 3, 0.5)  # [mm]
REPEATS = 3


def timed(scene: at.Scene, method: str, spacing: float) -> tuple[torch.Tensor, float, SimulatedPropagator]:
    """Return the transfer matrix, its shortest time [s] and the last propagator."""
    spent = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        propagator = uncached(scene, method, spacing)
        matrix = propagator.transfer_matrix()
        spent.append(time.perf_counter() - begin)
    return matrix, min(spent), propagator


def matrices(name: str) -> list[list[str]]:
    """Return error and time of the four foci at several spacings."""
    scene, exact, rows = paper_scene(name), cube_case(name).exact, []
    for spacing in SPACINGS:
        matrix, seconds, propagator = timed(scene, "auto", spacing)
        error = relative_error(matrix[:1], exact)
        runs, periods = len(propagator.runs), max(run.periods for run in propagator.runs)
        rows.append(
            [name, f"{spacing:.3g} mm", propagator.method, f"{100 * error:.2f} %", f"{seconds:.2f} s",
             str(runs), str(periods)]
        )  # fmt: skip
        print(rows[-1], flush=True)
    return rows


def box_and_domain(name: str, off_axis: bool) -> list[str]:
    """Compare the box with the whole domain at 1 mm; foci off the axis have no mirror images."""
    scene = paper_scene(name)
    if off_axis:
        foci = scene.control_points + torch.tensor((0.0, 2e-3, 1e-3), dtype=torch.float64)
        scene = dataclasses.replace(scene, control_points=foci)
    small, fast, box = timed(scene, "box", 1.0)
    whole, slow, domain = timed(scene, "full", 1.0)
    shortest = [min(run.seconds for run in each.runs) for each in (box, domain)]
    row = [
        name, f"{len(box.runs)}", f"{100 * relative_error(small, whole):.3f} %",
        f"{fast:.2f} s", f"{slow:.2f} s", f"{slow / fast:.1f}", f"{shortest[1] / shortest[0]:.1f}",
    ]  # fmt: skip
    print(row, flush=True)
    return row


def large_array(spacing: float) -> str:
    """Compare an AUTD3 with the paper's 16 transducers, behind two cubes."""
    scene = paper_scene("two_cubes")
    _, small, _ = timed(scene, "auto", spacing)
    _, large, _ = timed(with_array(scene, autd3_array()), "auto", spacing)
    return f"249 transducers: {large:.2f} s at {spacing:g} mm, {large / small:.1f} times the paper's array."


_FIRST_CALL = """
import sys, time
begin = time.perf_counter()
import autdtorch as at
scene = at.load_scene(sys.argv[1])
imported = time.perf_counter()
at.make_propagator(scene, "auto", 1e-3, tolerance=1e-3, cache=False).transfer_matrix()
print(imported - begin, time.perf_counter() - imported)
"""


def first_calls() -> list[list[str]]:
    """Measure the first call of a process that compiles the kernels, and of one that loads them."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
        for what in ("first process, kernels compiled", "later process, kernels from disk"):
            command = [sys.executable, "-c", _FIRST_CALL, str(SCENES / "three_cubes.yaml")]
            done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
            imported, called = map(float, done.stdout.split())
            rows.append([what, f"{imported:.1f} s", f"{called:.1f} s"])
            print(rows[-1], flush=True)
    return rows


def main(given: argparse.Namespace) -> None:
    """Measure, and write the block."""
    first = table(["three cubes, 1 mm", "import and scene", "propagator and transfer matrix"], first_calls())
    made = [row for name in CUBES for row in matrices(name)]
    whole = table(["scene", "spacing", "method", "error", "time", "runs", "periods"], made)
    pairs = table(
        ["scene", "runs", "apart", "box", "full", "ratio", "of the fastest run alone"],
        [box_and_domain(name, off_axis) for off_axis in (False, True) for name in CUBES],
    )
    parts = (
        measured(),
        "Transfer matrix of all four foci and 16 transducers, 1e-3 from the steady state:",
        whole,
        large_array(0.5),
        "Box against whole domain at 1 mm: the paper's foci, which need one run, and foci off the axis:",
        pairs,
        "First call of a process:",
        first,
    )
    fill_in(DOCUMENT, "benchmark.py speed", parts, given.output)
