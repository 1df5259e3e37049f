"""Kernels just compiled and those loaded from disk: equal to the last bit, and of the present source."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from autdtorch.fdtd.kernels import compiled

TESTS = Path(__file__).parents[1]

SIMULATION = """
import hashlib, logging, sys
sys.path.insert(0, sys.argv[1])
from small_scenes import CUBE, small_scene
import autdtorch as at
from autdtorch.fdtd.kernels.cpu import _advance
from autdtorch.fdtd.kernels.cpu_waves import sum_at_points
logging.disable()
matrix = at.make_propagator(small_scene((CUBE,)), "box", 2e-3).transfer_matrix()
print(hashlib.sha256(matrix.numpy()).hexdigest())
print(sum(sum(one.stats.cache_misses.values()) for one in (_advance, sum_at_points)))
"""


def simulate(cache: Path) -> tuple[str, int]:
    """Digest of a transfer matrix from a process of its own, and how many kernels it compiled."""
    command = [sys.executable, "-c", SIMULATION, str(TESTS)]
    run = subprocess.run(
        command, capture_output=True, text=True, check=True, env=os.environ | {"NUMBA_CACHE_DIR": str(cache)}
    )
    digest, compiled_now = run.stdout.split()
    return digest, int(compiled_now)


def test_a_cold_process_and_a_warm_one_simulate_the_same(tmp_path: Path) -> None:
    cold, compiled_first = simulate(tmp_path)
    warm, compiled_again = simulate(tmp_path)
    assert compiled_first > 0
    assert compiled_again == 0
    assert warm == cold
    kept = list(tmp_path.rglob("*.nbi"))
    assert kept
    assert all(compiled._SOURCE in path.name for path in kept)


def test_any_change_of_the_kernels_compiles_anew(tmp_path: Path) -> None:
    (tmp_path / "one.py").write_text("a = 1\n", "utf-8")
    (tmp_path / "two.py").write_text("b = 2\n", "utf-8")
    before = compiled._digest(tmp_path)
    times = (tmp_path / "two.py").stat()
    (tmp_path / "two.py").write_text("b = 3\n", "utf-8")
    # wheels of two versions have the same times
    os.utime(tmp_path / "two.py", ns=(times.st_atime_ns, times.st_mtime_ns))
    assert compiled._digest(tmp_path) != before
