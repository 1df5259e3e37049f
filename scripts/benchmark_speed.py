"""What the transfer matrix of the paper's scenes takes, and what is skipped; writes docs/performance.md.

    python scripts/benchmark_speed.py             about 4 minutes on 2 idle cores

Errors are those of benchmark_accuracy.py: of one focus, of which the others are mirror images, against our
own fine grids, extrapolated. Each matrix is made by a propagator of its own, its assembly included; kernels
are compiled before, except where the cold start is measured, in processes of their own.
"""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import tempfile
import time

import torch
from benchmark_accuracy import CUBES, ROOT, SCENES, TOLERANCE, cube_case, relative_error
from generated_block import fill_in, measured, table
from large_arrays import autd3_array, with_array

import autdtorch as at
from autdtorch.fdtd.kernels.cpu import CpuKernel
from autdtorch.fdtd.steady_state import Extrapolation, windows_of_run
from autdtorch.fdtd.stepping import RAMP_PERIODS
from autdtorch.propagators import BoxPropagator, SimulatedPropagator
from autdtorch.propagators.base import single_nodes
from autdtorch.utils.threads import thread_count

SPACINGS = (1.0, 0.8, 2 / 3, 0.5)  # [mm]
REPEATS = 3
LONG = 300
"""Periods of plain stepping, whose extrapolation is taken for the limit."""
CLOSE = 1e-3
"""Relative distance to the limit at which periods are counted."""


def prepared(scene: at.Scene, method: str, spacing: float) -> SimulatedPropagator:
    """A propagator at `spacing` [mm], nothing of it taken from disk."""
    propagator = at.make_propagator(scene, method, spacing * 1e-3, tolerance=TOLERANCE, cache=False)
    assert isinstance(propagator, SimulatedPropagator)
    return propagator


def timed(scene: at.Scene, method: str, spacing: float) -> tuple[torch.Tensor, float, SimulatedPropagator]:
    """The transfer matrix, the shortest time [s] it took and the last propagator."""
    spent = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        propagator = prepared(scene, method, spacing)
        matrix = propagator.transfer_matrix()
        spent.append(time.perf_counter() - begin)
    return matrix, min(spent), propagator


def matrices(name: str) -> list[list[str]]:
    """Error and time of all four foci at several spacings."""
    scene, exact, rows = at.load_scene(SCENES / f"{name}.yaml"), cube_case(name).exact, []
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
    """The box against the whole domain, both at 1 mm; foci off the axis have no mirror images."""
    scene = at.load_scene(SCENES / f"{name}.yaml")
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


def large_array(spacing: float) -> list[str]:
    """249 transducers in the places of an AUTD3's against the paper's 16, two cubes in between."""
    scene = at.load_scene(SCENES / "two_cubes.yaml")
    large = with_array(scene, autd3_array())
    _, small_seconds, small = timed(scene, "auto", spacing)
    _, seconds, propagator = timed(large, "auto", spacing)
    row = [
        f"{len(large.array)} transducers", f"{spacing:.3g} mm",
        f"{seconds:.2f} s, {len(propagator.runs)} runs",
        f"{small_seconds:.2f} s, {len(small.runs)} runs", f"{seconds / small_seconds:.2f}",
    ]  # fmt: skip
    print(row, flush=True)
    return row


def periods_to_limit(name: str) -> list[str]:
    """Periods until what the transducers hear stays within `CLOSE` of its limit, stepped and foretold."""
    scene = at.load_scene(SCENES / f"{name}.yaml")
    propagator = at.make_propagator(scene, "box", 1e-3, tolerance=TOLERANCE)
    assert isinstance(propagator, BoxPropagator)
    (box,) = propagator._boxes
    origin, heard = single_nodes(scene.control_points[:1]), scene.array.nodes
    strength = torch.full((1,), scene.array.source_strength, dtype=torch.complex128)
    reach, direct = box.near_to_far(*heard), box.incident(heard.positions.reshape(-1, 3), *origin, strength)
    matrix, sources = reach.matrix(1), box.sources(box.driving(*origin, strength))
    foretold = Extrapolation(64)
    counts, fields = [], []
    ramp = RAMP_PERIODS * box.assembly.steps_per_period
    for count, windows in windows_of_run(box.assembly, CpuKernel(), sources, reach.cells):
        for start, phasor in windows:
            if start >= ramp:
                foretold.append(phasor)
        if len(foretold):
            limits = (torch.from_numpy(each) for each in (windows[-1][1], foretold.limit()))
            counts.append(count)
            fields.append(torch.stack([direct + matrix @ each for each in limits]))
        if count >= LONG:
            break
    distances = torch.stack([(field - fields[-1][1]).norm(dim=1) / fields[-1][1].norm() for field in fields])
    needed = [counts[int((own > CLOSE).nonzero().max()) + 1] for own in distances.mT]
    row = [name, str(needed[0]), str(needed[1]), f"{needed[1] / needed[0]:.2f}"]
    print(row, flush=True)
    return row


_FIRST_CALL = """
import sys, time
begin = time.perf_counter()
import autdtorch as at
scene = at.load_scene(sys.argv[1])
imported = time.perf_counter()
at.make_propagator(scene, "auto", 1e-3, tolerance=1e-3, cache=False).transfer_matrix()
print(imported - begin, time.perf_counter() - imported)
"""


def cold_start() -> list[list[str]]:
    """The first call of a process: kernels compiled, then loaded from disk."""
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


def main() -> None:
    """Measure, and write the block."""
    cold = table(["three cubes, 1 mm", "import and scene", "propagator and transfer matrix"], cold_start())
    made = [row for name in CUBES for row in matrices(name)]
    whole = table(["scene", "spacing", "method", "error", "time", "runs", "periods"], made)
    pairs = table(
        ["scene", "runs", "apart", "box", "full", "ratio", "of the fastest run alone"],
        [box_and_domain(name, off_axis) for off_axis in (False, True) for name in CUBES],
    )
    sizes = table(
        ["array", "spacing", "time", "paper's array", "ratio"], [large_array(2 / 3), large_array(0.5)]
    )
    limits = table(
        ["scene", "periods stepped to 1e-3", "extrapolated", "ratio"],
        [periods_to_limit(name) for name in CUBES],
    )
    stated = measured("python scripts/benchmark_speed.py") + f"\n\nThreads: {thread_count()}."
    parts = (
        stated,
        "Transfer matrix of all four foci and 16 transducers, 1e-3 from the steady state:",
        whole,
        "Box against whole domain at 1 mm: the paper's foci, of which one run gives all, and foci off axis:",
        pairs,
        "AUTD3-size array, two cubes in between, the four foci:",
        sizes,
        "Periods until the field stays within 1e-3 of its limit (1 mm, one focus):",
        limits,
        "First call of a process:",
        cold,
    )
    fill_in(ROOT / "docs" / "performance.md", "benchmark_speed", parts, ROOT / "docs")


if __name__ == "__main__":
    main()
