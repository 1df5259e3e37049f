"""Compiled kernels: equal from memory and disk, of the present source; damaged files are compiled again."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

import autdtorch as at
from autdtorch.fdtd.kernels import compiled

TESTS = Path(__file__).parents[1]

SCRIPT = """
import hashlib, logging, sys
sys.path.insert(0, sys.argv[1])
from small_scenes import CUBE, small_scene
import autdtorch as at
from autdtorch.fdtd.kernels.compiled import _entries
logging.disable()
scene = small_scene((CUBE,))
propagator = at.make_propagator(scene, "box", 2e-3, cache=False)
objective = at.SimulatedObjective(scene, propagator)
results = [propagator.transfer_matrix()]
for solution in (at.gabs(objective, trials=3), at.identify(objective, 20)):
    results += [solution.drive, solution.pressure, solution.history]
print(hashlib.sha256(b"".join(one.numpy().tobytes() for one in results)).hexdigest())
print(sum(sum(one.stats.cache_misses.values()) for one in _entries))
"""


def run(cache):
    """Run `SCRIPT` in a new process; return the digest of its results and the number of kernels compiled."""
    command = [sys.executable, "-c", SCRIPT, str(TESTS)]
    process = subprocess.run(
        command,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
    )
    digest, compiled_now = process.stdout.split()
    return digest, int(compiled_now)


def test_cold_and_warm_caches_give_the_same_results(tmp_path):
    cold, compiled_first = run(tmp_path)
    warm, compiled_again = run(tmp_path)
    assert compiled_first > 0
    assert compiled_again == 0
    assert warm == cold
    names = [path.name for path in tmp_path.rglob("*.nbi")]
    digest = compiled._digest(Path(at.__file__).parent / "fdtd" / "kernels")
    assert all(digest in name for name in names)
    assert names


def test_any_change_of_the_kernels_changes_the_digest(tmp_path):
    (tmp_path / "one.py").write_text("a = 1\n", "utf-8")
    (tmp_path / "two.py").write_text("b = 2\n", "utf-8")
    before = compiled._digest.__wrapped__(tmp_path)
    times = (tmp_path / "two.py").stat()
    (tmp_path / "two.py").write_text("b = 3\n", "utf-8")
    # wheels of two versions have the same times
    os.utime(tmp_path / "two.py", ns=(times.st_atime_ns, times.st_mtime_ns))
    assert compiled._digest.__wrapped__(tmp_path) != before


SOURCE = """
from pathlib import Path
from autdtorch.fdtd.kernels.compiled import entry

@entry(Path(__file__).parent)
def doubled(x):
    return 2 * x
"""


@pytest.fixture
def kernel(tmp_path, monkeypatch):
    """Return a function that makes the kernel as a new process does, and the folder of its files."""
    (tmp_path / "module.py").write_text(SOURCE, "utf-8")
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))

    def made():
        spec = importlib.util.spec_from_file_location("module", tmp_path / "module.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module.doubled

    return made, tmp_path / "cache"


def hits(dispatcher):
    return sum(dispatcher.stats.cache_hits.values())


def test_what_is_whole_is_loaded(kernel):
    made, _ = kernel
    assert made()(3) == 6
    again = made()
    assert again(3) == 6
    assert hits(again) == 1


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
def test_what_is_damaged_is_compiled_again(kernel, suffix, caplog):
    made, folder = kernel
    made()(3)
    (path,) = folder.rglob(f"*{suffix}")
    whole, random = path.read_bytes(), np.random.default_rng(0)
    damages = [b"", whole[: len(whole) // 2], whole[:-1]]
    for place in random.integers(0, len(whole), 8).tolist():
        damages.append(whole[:place] + bytes([whole[place] ^ 1 << place % 8]) + whole[place + 1 :])
    for damaged in damages:
        path.write_bytes(damaged)
        caplog.clear()
        again = made()
        assert again(3) == 6
        assert hits(again) == 0
        assert "compiling again" in caplog.text
        after = made()
        assert after(3) == 6
        assert hits(after) == 1


def test_without_a_folder_to_write_to_kernels_run_and_say_so_once(kernel, monkeypatch, caplog):
    def refusing(cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return numba.njit(**options)

    made, folder = kernel
    compiled._log_once.cache_clear()
    monkeypatch.setattr(compiled, "njit", refusing)
    assert made()(3) == made()(3) == 6
    assert caplog.text.count("compiled in every process") == 1
    assert not os.path.exists(folder)
