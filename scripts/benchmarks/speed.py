"""Run times of the transfer matrices of the paper's scenes.

Fills in a block of performance.md. Errors are those of `benchmark.py accuracy`, of one focus. Each matrix
comes from a propagator of its own, assembly included, the fastest of three. Kernels are compiled before,
except for the first call of a process.

    python scripts/benchmark.py speed             about 4 minutes on 2 idle cores
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

SPACINGS = (1.0, 2 / 3, 0.5)  # [mm]
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
        matrix, seconds, propagator = timed(scene, "box", spacing)
        error, periods = relative_error(matrix[:1], exact), max(run.periods for run in propagator.runs)
        rows.append([name, f"{spacing:.3g} mm", f"{100 * error:.2f} %", f"{seconds:.2f} s", str(periods)])
        print(rows[-1], flush=True)
    return rows


def box_and_domain(name: str, off_axis: bool) -> list[str]:
    """Compare the box with the whole domain at 1 mm; foci off the axis have no mirror images."""
    scene = paper_scene(name)
    if off_axis:
        foci = scene.control_points + torch.tensor((0.0, 2e-3, 1e-3), dtype=torch.float64)
        scene = dataclasses.replace(scene, control_points=foci)
    small, fast, box = timed(scene, "box", 1.0)
    whole, slow, _ = timed(scene, "full", 1.0)
    times = [f"{fast:.2f} s", f"{slow:.2f} s", f"{slow / fast:.1f}"]
    row = [name, str(len(box.runs)), f"{100 * relative_error(small, whole):.3f} %", *times]
    print(row, flush=True)
    return row


def large_array(spacing: float) -> str:
    """Compare an AUTD3 with the paper's 16 transducers, in front of two cubes."""
    scene = paper_scene("two_cubes")
    _, small, _ = timed(scene, "auto", spacing)
    _, large, _ = timed(with_array(scene, autd3_array()), "auto", spacing)
    times = f"{large:.2f} s at {spacing:g} mm, {large / small:.2f} times the paper's array"
    return f"249 transducers in front of the two cubes: {times}."


_FIRST_CALL = """
import sys
import autdtorch as at
scene = at.load_scene(sys.argv[1])
at.make_propagator(scene, "auto", 1e-3, tolerance=1e-3, cache=False).transfer_matrix()
"""


def first_calls() -> str:
    """Measure the first call of a process that compiles the kernels, and of one that loads them."""
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
        for _ in range(2):
            begin = time.perf_counter()
            command = [sys.executable, "-c", _FIRST_CALL, str(SCENES / "three_cubes.yaml")]
            subprocess.run(command, env=environment, check=True)
            seconds.append(time.perf_counter() - begin)
    first, later = (f"{one:.1f} s" for one in seconds)
    return f"Three cubes at 1 mm in a new process: {later}, and {first} the first time, with compilation."


def main(given: argparse.Namespace) -> None:
    """Measure, and write the block."""
    first = first_calls()
    made = [row for name in CUBES for row in matrices(name)]
    pairs = [box_and_domain(name, off_axis) for off_axis in (False, True) for name in CUBES]
    parts = (
        measured(),
        "Transfer matrix of four foci and 16 transducers by the box method, to 1e-3 from the steady state:",
        table(["scene", "spacing", "error", "time", "periods"], made),
        "Box against whole domain at 1 mm, for the paper's foci (one run by symmetry) and foci off axis:",
        table(["scene", "runs", "difference", "box", "full", "ratio"], pairs),
        f"{large_array(0.5)} {first}",
    )
    fill_in(DOCUMENT, "benchmark.py speed", parts, given.output)
