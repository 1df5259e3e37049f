"""Run times of the transfer matrices of the paper's scenes.

Errors are those of `benchmark.py accuracy`, of one focus. Each matrix has a new propagator, assembly
included; the fastest of three counts. Kernels are compiled before, except for the first call of a process.
Takes about 4 minutes on 2 idle cores.
"""

import dataclasses
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator

import torch
from shared.cases import CUBES, cube_case
from shared.document import Page, printed, table
from shared.scenes import SCENES, autd3_array, paper_scene, relative_error, uncached, with_array
from shared.timing import shortest, timed

import autdtorch as at
from autdtorch.propagators import SimulatedPropagator

DOCUMENT = "performance.md"

SPACINGS = (1.0, 0.5)  # [mm]
REPEATS = 3


def main(page: Page) -> None:
    first = first_calls()
    page.write(
        "Transfer matrix of four foci and 16 transducers by the box method, to 1e-3 from the steady state:",
        table(["scene", "spacing", "error", "time", "periods"], printed(matrices())),
        "Box against whole domain at 1 mm, for four foci off axis:",
        table(["scene", "difference", "box", "full", "ratio"], printed(box_and_domain())),
        f"{large_array(0.5)} {first}",
    )


def measure(scene: at.Scene, method: str, spacing: float) -> tuple[torch.Tensor, float, SimulatedPropagator]:
    """Return the transfer matrix, its shortest time [s] and the last propagator."""

    def work() -> tuple[torch.Tensor, SimulatedPropagator]:
        propagator = uncached(scene, method, spacing)
        return propagator.transfer_matrix(), propagator

    (matrix, propagator), seconds = shortest(work, REPEATS)
    return matrix, seconds, propagator


def matrices() -> Iterator[list[str]]:
    """Yield error and time of the four foci at several spacings."""
    for name in CUBES:
        scene, exact = paper_scene(name), cube_case(name).exact
        for spacing in SPACINGS:
            matrix, seconds, propagator = measure(scene, "box", spacing)
            error, periods = relative_error(matrix[:1], exact), max(run.periods for run in propagator.runs)
            yield [name, f"{spacing:.3g} mm", f"{100 * error:.2f} %", f"{seconds:.2f} s", str(periods)]


def box_and_domain() -> Iterator[list[str]]:
    """Compare the box with the whole domain at 1 mm; foci off the axis have no mirror images."""
    for name in CUBES:
        scene = paper_scene(name)
        foci = scene.control_points + torch.tensor((0.0, 2e-3, 1e-3), dtype=torch.float64)
        scene = dataclasses.replace(scene, control_points=foci)
        small, fast, _ = measure(scene, "box", 1.0)
        whole, slow, _ = measure(scene, "full", 1.0)
        times = [f"{fast:.2f} s", f"{slow:.2f} s", f"{slow / fast:.1f}"]
        yield [name, f"{100 * relative_error(small, whole):.3f} %", *times]


def large_array(spacing: float) -> str:
    """Compare an AUTD3 with the paper's 16 transducers in front of two cubes, and 64 foci with 4."""
    scene = paper_scene("two_cubes")
    wide = with_array(scene, autd3_array())
    foci = at.circle_points((80e-3, 52e-3, 49e-3), 30e-3, 64, (1, 0, 0), angle=0.3)
    many = dataclasses.replace(wide, control_points=foci)
    small, large, largest = (measure(each, "auto", spacing)[1] for each in (scene, wide, many))
    times = f"{large:.2f} s at {spacing:g} mm, {large / small:.2f} times the paper's array"
    return f"249 transducers in front of the two cubes: {times}; 64 foci off axis: {largest:.2f} s."


_FIRST_CALL = """
import sys
import autdtorch as at
scene = at.load_scene(sys.argv[1])
at.make_propagator(scene, "auto", 1e-3, tolerance=1e-3, cache=False).transfer_matrix()
"""


def first_calls() -> str:
    """Measure the first call of a process that compiles the kernels, and of one that loads them."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
        command = [sys.executable, "-c", _FIRST_CALL, str(SCENES / "three_cubes.yaml")]
        first, later = (
            timed(lambda: subprocess.run(command, env=environment, check=True))[1] for _ in range(2)
        )
    times = f"{later:.1f} s, and {first:.1f} s the first time, with compilation"
    return f"Three cubes at 1 mm in a new process: {times}."
