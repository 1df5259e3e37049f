"""Time saved by symmetry between foci, and by matrices kept on disk.

Prints a Markdown table of the transfer matrices of the foci at 1 mm, from one run, from a run per focus, and
from disk.

    python scripts/benchmark.py runs            about 3 minutes on 2 idle cores
"""

from __future__ import annotations

import argparse
import tempfile
import time

import torch
from shared.document import table
from shared.scenes import paper_scene, relative_error, uncached

import autdtorch as at
from autdtorch.propagators import SimulatedPropagator

SCENES = ("three_cubes", "two_cubes", "sphere")


def measure(name: str, method: str, spacing: float) -> list[str]:
    """Return a row of times and the difference of the matrices."""
    scene = paper_scene(name)
    uncached(scene, method, 2.0, tolerance=0.1).transfer_matrix()  # compiles the kernel
    with tempfile.TemporaryDirectory() as folder:
        propagator = at.make_propagator(scene, method, spacing, cache=folder)
        assert isinstance(propagator, SimulatedPropagator)
        begin = time.perf_counter()
        matrix = propagator.transfer_matrix()
        one, runs = time.perf_counter(), len(propagator.runs)
        direct = torch.cat([propagator.transfer_matrix(point[None]) for point in scene.control_points])
        each = time.perf_counter()
        again = at.make_propagator(scene, method, spacing, cache=folder)
        assembled = time.perf_counter()
        kept = again.transfer_matrix()
        end = time.perf_counter()
    assert torch.equal(kept, matrix)
    times = [f"{one - begin:.1f} s", f"{each - one:.1f} s"]
    apart, disk = f"{relative_error(matrix, direct):.0e}", f"{1e3 * (end - assembled):.0f} ms"
    return [f"{name}, {method}", str(runs), *times, apart, disk]


OPTIONS = {"--spacing": {"type": float, "default": 1.0, "help": "[mm]"}}


def main(given: argparse.Namespace) -> None:
    """Print the table."""
    rows = [measure(name, method, 1e-3 * given.spacing) for name in SCENES for method in ("box", "full")]
    print(table(["scene", "runs", "these runs", "a run per focus", "apart", "from disk"], rows))
