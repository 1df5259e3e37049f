"""Compiled kernels and those loaded from disk: equal to the last bit, and of the present source."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import autdtorch as at
from autdtorch.fdtd.kernels import compiled

TESTS = Path(__file__).parents[1]

FOUND = """
import hashlib, logging, sys
sys.path.insert(0, sys.argv[1])
from small_scenes import CUBE, small_scene
import autdtorch as at
from autdtorch.fdtd.kernels.compiled import _entries
logging.disable()
scene = small_scene((CUBE,))
propagator = at.make_propagator(scene, "box", 2e-3, cache=False)
objective = at.SimulatedObjective(scene, propagator)
found = [propagator.transfer_matrix()]
for solution in (at.gabs(objective, trials=3), at.identify(objective, 20)):
    found += [solution.drive, solution.pressure, solution.history]
print(hashlib.sha256(b"".join(one.numpy().tobytes() for one in found)).hexdigest())
print(sum(sum(one.stats.cache_misses.values()) for one in _entries))
"""


def run(cache: Path) -> tuple[str, int]:
    """Run `FOUND` in a new process; return the digest of its results and the number of kernels compiled."""
    command = [sys.executable, "-c", FOUND, str(TESTS)]
    process = subprocess.run(
        command, capture_output=True, text=True, check=True, env=os.environ | {"NUMBA_CACHE_DIR": str(cache)}
    )
    digest, compiled_now = process.stdout.split()
    return digest, int(compiled_now)


def test_cold_and_warm_caches_give_the_same_results(tmp_path: Path) -> None:
    cold, compiled_first = run(tmp_path)
    warm, compiled_again = run(tmp_path)
    assert compiled_first > 0
    assert compiled_again == 0
    assert warm == cold
    kept = [path.name for path in tmp_path.rglob("*.nbi")]
    digest = compiled._digest(Path(at.__file__).parent / "fdtd" / "kernels")
    assert all(digest in name for name in kept)
    assert kept


def test_any_change_of_the_kernels_changes_the_digest(tmp_path: Path) -> None:
    (tmp_path / "one.py").write_text("a = 1\n", "utf-8")
    (tmp_path / "two.py").write_text("b = 2\n", "utf-8")
    before = compiled._digest.__wrapped__(tmp_path)
    times = (tmp_path / "two.py").stat()
    (tmp_path / "two.py").write_text("b = 3\n", "utf-8")
    # wheels of two versions have the same times
    os.utime(tmp_path / "two.py", ns=(times.st_atime_ns, times.st_mtime_ns))
    assert compiled._digest.__wrapped__(tmp_path) != before
