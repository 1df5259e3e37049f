"""Compiled kernels: of the present source; damaged files are compiled again. Cold and warm: test_forks.py."""

import importlib.util
import os

import numba
import numpy as np
import pytest

from autdtorch.fdtd.kernels import compiled


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
