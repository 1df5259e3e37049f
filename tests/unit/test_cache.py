"""Matrices on disk: found again for the same simulation only, whole or not at all."""

import contextlib
import importlib
import multiprocessing
import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_scenes import AIR, CORNER, CUBE, small_scene

from autdtorch.propagators import SteadyStateWarning, make_propagator
from autdtorch.propagators.plan import plan
from autdtorch.propagators.store import SUFFIX, Store, _with_checksum, store_in
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.obstacles import Mesh, Sphere, VoxelMask
from autdtorch.scene.scene import Medium, Scene
from autdtorch.utils.digest import digest_of
from autdtorch.utils.files import ABANDONED, PARTIAL

SPACING = 2.5e-3
UNEQUAL = 1 + np.eye(4)  # strengths or radii of four transducers, of which one differs


def write_for_ever(folder, value):
    cache = Store(folder)
    while True:
        cache.save("shared", np.full(200_000, value), value)


def write_until_half_done(folder, stopped):
    Path.replace = lambda *_: (stopped.touch(), time.sleep(600))
    write_for_ever(folder, 1.0)


@contextlib.contextmanager
def killed(*works):
    """Do each work (function and arguments) in a process of its own; kill them at the end."""
    context = multiprocessing.get_context("fork")
    processes = [context.Process(target=function, args=arguments) for function, *arguments in works]
    for process in processes:
        process.start()
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.join()


needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="no forks here")


def prepared(scene, folder, **settings):
    return make_propagator(scene, **{"method": "box", "spacing": SPACING, "cache": folder, **settings})


def files(folder):
    return sorted(folder.glob(f"*{SUFFIX}"))


def wait_for(condition):
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_what_was_simulated_is_not_simulated_again(tmp_path):
    scene = small_scene((CUBE,))
    first = prepared(scene, tmp_path)
    matrix, error = first.transfer_matrix(return_error=True)
    assert first.runs
    assert len(files(tmp_path)) == 2  # one for each grid
    same = Scene(scene.array, AIR, 40e3, scene.control_points, (CUBE,), domain=scene.domain)
    again = prepared(same, tmp_path)
    kept, kept_error = again.transfer_matrix(return_error=True)
    assert torch.equal(kept, matrix)
    assert kept_error == error
    assert not again.runs
    assert (first.loaded_from, again.loaded_from) == (None, tmp_path)
    assert not again._others[0].runs
    drives = torch.ones((5, 4), dtype=torch.complex128)
    assert torch.allclose(again.field(drives, scene.control_points), matrix.sum(dim=1))
    assert not again.runs


def test_a_resonance_is_told_of_a_kept_matrix_too(tmp_path, caplog):
    bubble = Sphere(
        (12.2e-3, 11.9e-3, 12.1e-3), 2.1e-3, density=0.1 * AIR.density, sound_speed=0.32 * AIR.sound_speed
    )
    for _ in range(2):
        caplog.clear()
        propagator = make_propagator(small_scene((bubble,)), "box", None, 0.05, cache=tmp_path)
        propagator.transfer_matrix(return_error=True)
        assert caplog.text.count("sound rings for") == 1
    assert not propagator.runs


def test_a_folder_by_the_environment(tmp_path, monkeypatch):
    scene = small_scene((CUBE,))
    monkeypatch.setenv("AUTDTORCH_CACHE_DIR", str(tmp_path / "new" / "folder"))
    make_propagator(scene, "box", SPACING, cache=False).transfer_matrix()
    assert not (tmp_path / "new").exists()
    propagator = make_propagator(scene, "box", SPACING)
    make_propagator(scene, "free_space").transfer_matrix()
    assert not (tmp_path / "new").exists()  # nothing to keep yet
    propagator.transfer_matrix()
    assert propagator.loaded_from is None
    assert len(files(tmp_path / "new" / "folder")) == 1
    (tmp_path / "file").touch()
    for below in ("", "below/it"):
        monkeypatch.setenv("AUTDTORCH_CACHE_DIR", str(tmp_path / "file" / below))
        with pytest.raises(ValueError, match=r"AUTDTORCH_CACHE_DIR: .* must be a folder"):
            make_propagator(scene, "box", SPACING)
    for refused in (True, 3, ""):
        with pytest.raises(ValueError, match=r"cache: .* must be the path of a folder, or False"):
            make_propagator(scene, "box", SPACING, cache=refused)


def test_everything_that_affects_a_matrix_affects_its_key(tmp_path):
    """Down to the last bit."""
    plain, above = small_scene((CUBE,)), np.nextafter
    mask = np.ones((3, 3, 3), bool)
    holed = mask.copy()
    holed[1, 1, 1] = False
    for name, corner in (("one", "v 1 0 0"), ("copy", "v 1 0 0"), ("two", "v 1.0000001 0 0")):
        (tmp_path / f"{name}.obj").write_text(CORNER.replace("v 1 0 0", corner), "utf-8")

    def key(scene=plain, **settings):
        return plan(scene, **{"method": "box", "spacing": SPACING, **settings}).key

    def of(*obstacles, **changes):
        return key(replace(plain, obstacles=obstacles or (CUBE,), **changes))

    def mesh(name):
        return Mesh(tmp_path / f"{name}.obj", scale=5e-3, offset=(9e-3, 9e-3, 9e-3), rigid=True)

    def voxels(mask):
        return VoxelMask(mask, 2e-3, (9e-3,) * 3, rigid=True)

    def array(positions=plain.array.positions, normals=(1, 0, 0), **radius):
        return TransducerArray(positions, normals, **radius)

    x, y, z = CUBE.center
    sphere = Sphere(CUBE.center, 3e-3, density=100.0, sound_speed=340.0)
    keys = [
        key(),
        *(of(mesh(name)) for name in ("one", "two")),
        *(of(replace(CUBE, center=(above(x, 1), y, z))), of(replace(CUBE, density=above(100.0, 101)))),
        *(of(replace(CUBE, rotation=(1e-12, 0, 0))), of(sphere), of(sphere, CUBE), of(CUBE, sphere)),
        *(of(voxels(mask)), of(voxels(holed)), of(medium=Medium(AIR.density, AIR.sound_speed, 1.3))),
        *(of(frequency=above(40e3, 41e3)), of(domain=((0, 0, 0), (24e-3, 24e-3, above(24e-3, 1))))),
        of(array=array(normals=(1, 0.1, 0))),
        *(of(array=array(radius=1e-3)), of(array=array(plain.array.positions.flip(0)))),
        *(of(array=array(radius=each)) for each in 1e-3 * UNEQUAL),
        *(key(method="full"), key(spacing=above(SPACING, 1)), key(tolerance=1e-3), key(dtype="float64")),
        *(key(kernel="reference"), key(max_periods=599), key(time_step=5e-6)),
        of(control_points=plain.control_points.flip(0)),  # they judge when a run has converged
    ]
    assert len(set(keys)) == len(keys)
    # names and the places of files have no effect, and matrices of unit strength are multiplied later
    assert keys[0] == of(array=plain.array.calibrated(UNEQUAL[0], UNEQUAL[1]))
    assert keys.index(of(mesh("copy"))) == 1
    assert keys[0] == of(name="other")


def test_another_version_of_the_code_or_of_a_package_has_another_key(monkeypatch):
    planned = plan(small_scene((CUBE,)), "box", SPACING)
    keys = {planned.key}
    for name, value in (("source_digest", "changed"), ("package_versions", {"torch": "0"})):
        monkeypatch.setattr(f"autdtorch.propagators.store.{name}", lambda value=value: value)
        keys.add(replace(planned).key)
    assert len(keys) == 3


def test_digests_of_values_and_of_code_are_not_confused(tmp_path, monkeypatch):
    values = [1, 1.0, True, "1", None, (1,), ((1,),), (1, 1), ("1", "1"), ("11",), ("1 1",), {"1": 1}]
    values += [np.ones(1), np.ones(2), np.ones((1, 2)), np.ones(2, np.float32), torch.ones(2).cfloat()]
    assert len({digest_of(value) for value in values}) == len(values)
    assert digest_of(1, 2) != digest_of((1, 2), ())
    with pytest.raises(TypeError, match="object: has no digest"):
        digest_of(object())
    monkeypatch.syspath_prepend(tmp_path)
    code = "from dataclasses import dataclass\n@dataclass(frozen=True)\nclass Own:\n    size: float\n"
    digests = []
    for name, more in (("a", ""), ("b", ""), ("c", "    def twice(self): return 2 * self.size\n")):
        (tmp_path / f"own_{name}.py").write_text(code + more, encoding="utf-8")
        digests.append(digest_of(importlib.import_module(f"own_{name}").Own(1.0)))
    assert digests[0] == digests[1] != digests[2]


def test_what_has_not_settled_is_not_kept(tmp_path):
    propagator = prepared(small_scene((CUBE,)), tmp_path, tolerance=1e-6, max_periods=12)
    with pytest.warns(SteadyStateWarning):
        propagator.transfer_matrix()
    assert not files(tmp_path)


ONE = np.arange(6.0).reshape(2, 3)


def test_a_damaged_file_is_computed_again(tmp_path):
    """Cut, extended, with a flipped bit anywhere, under another name, of another shape, not finite."""
    cache = Store(tmp_path)
    cache.save("one", ONE, 0.5)
    assert cache.load("one", (3, 2), 1) is None
    (path,) = files(tmp_path)
    content = path.read_bytes()
    flipped = [
        content[:place] + bytes([byte ^ 1 << place % 8]) + content[place + 1 :]
        for place, byte in enumerate(content)
    ]
    bodies = (b"", b"\0" * 15, np.zeros(6, complex).tobytes(), np.zeros(8, complex).tobytes(), b"\xff" * 112)
    forged = [_with_checksum("one", (2, 3), body) for body in bodies]
    for damaged in (b"", content[:40], content[:-1], content + b"\0", b"\n" + content, *flipped, *forged):
        path.write_bytes(damaged)
        assert cache.load("one", (2, 3), 1) is None
    path.with_stem("two").write_bytes(content)
    assert cache.load("two", (2, 3), 1) is None
    cache.save("one", ONE, 0.5)
    matrix, (number,) = cache.load("one", (2, 3), 1)
    assert np.array_equal(matrix, ONE)
    assert number == 0.5


def test_a_folder_that_cannot_be_used_costs_no_result(tmp_path):
    cache = Store(tmp_path / "folder")
    (tmp_path / "folder").write_text("a file now")
    cache.save("one", np.ones((2, 3)), 0.0)
    assert cache.load("one", (2, 3), 1) is None
    (tmp_path / "folder").unlink()
    (tmp_path / "folder" / f"one{SUFFIX}").mkdir(parents=True)
    assert cache.load("one", (2, 3), 1) is None
    cache.save("one", np.ones(3), 0.0)
    assert not list((tmp_path / "folder").glob(f"*{PARTIAL}"))


def test_a_folder_keeps_what_was_used_last(tmp_path):
    """Four matrices of 200 numbers fit, of the bytes that five take; a larger one is not kept."""
    cache = Store(tmp_path, most_saved=5 * 200 * 16)
    (tmp_path / "mine.npz").write_bytes(bytes(100_000))  # other files neither count nor go
    for number, name in enumerate("abcd"):
        cache.save(name, np.full(199, number), number)
        os.utime(tmp_path / f"{name}{SUFFIX}", (number, number))
    assert cache.load("a", (199,), 1) is not None  # used again
    cache.save("e", np.full(199, 4.0), 4)
    cache.save("whole", np.ones(1000), 0)
    assert [path.stem for path in files(tmp_path)] == ["a", "c", "d", "e"]
    assert (tmp_path / "mine.npz").exists()


def test_a_folder_that_is_too_small_for_a_study_is_told_once(tmp_path, monkeypatch, caplog):
    """Matrices of 200 numbers, of which 12 fit into 40 kB; a day later none is missed."""
    monkeypatch.setenv("AUTDTORCH_CACHE_GB", "4e-5")
    cache = store_in(tmp_path)
    for number in range(16):
        cache.save(str(number), np.full(199, number), number)
        if number == 11:
            assert len(files(tmp_path)) == 12
            assert not caplog.messages
    assert len(files(tmp_path)) == 12
    (told,) = caplog.messages
    assert str(tmp_path) in told
    assert "limit of 4e-05 GB" in told
    assert "AUTDTORCH_CACHE_GB=10" in told
    other, long_ago = tmp_path / "other", time.time() - 1e5
    caplog.clear()
    cache = store_in(other)
    for number in range(16):
        cache.save(str(number), np.full(199, number), number)
        os.utime(other / f"{number}{SUFFIX}", (long_ago, long_ago + number))
    assert not caplog.messages
    for refused in ("ten", "0", "-1", "nan", "inf"):
        monkeypatch.setenv("AUTDTORCH_CACHE_GB", refused)
        with pytest.raises(ValueError, match=r"AUTDTORCH_CACHE_GB: .* must be a number > 0"):
            store_in(tmp_path)


def test_small_matrices_seldom_list_a_folder(tmp_path, monkeypatch):
    """Once for a 64th of the limit: 400 of 64 kB for 1 GB are expected 1.6 times, and 9 times once in 1e4."""
    listed = []
    monkeypatch.setattr("autdtorch.propagators.store.Store._remove_oldest", lambda *_: listed.append(1))
    cache, random = Store(tmp_path), np.random.default_rng(0)
    for number in range(400):
        cache.save(str(number % 4), random.random(4000), 0.0)
    assert len(listed) < 9
    cache.save("large", np.zeros(1_000_000), 0.0)
    assert listed


@needs_fork
@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")
def test_writers_that_run_together_and_are_killed(tmp_path):
    """Two processes write one matrix over and over, each with values of its own, until they are killed."""
    cache, seen = Store(tmp_path), set()

    def both_are_seen():
        matrix, (number,) = cache.load("shared", (200_000,), 1)
        assert (matrix == number).all()
        seen.add(number)
        return len(seen) == 2

    with killed(*((write_for_ever, tmp_path, number) for number in (0.0, 1.0))):
        wait_for(lambda: files(tmp_path))
        wait_for(both_are_seen)
    matrix, (number,) = cache.load("shared", (200_000,), 1)
    assert (matrix == number).all()


@needs_fork
@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")
def test_a_writer_killed_before_it_is_done_leaves_nothing_that_is_read(tmp_path):
    stopped = tmp_path / "stopped"
    with killed((write_until_half_done, tmp_path, stopped)):
        wait_for(stopped.exists)
    cache = Store(tmp_path)
    (left,) = tmp_path.glob(f"*{PARTIAL}")
    assert cache.load("shared", (200_000,), 1) is None
    cache.save("shared", np.ones(200_000), 0.0)
    assert left.exists()  # another process may be writing it
    old = time.time() - 2 * ABANDONED
    os.utime(left, (old, old))
    cache.save("shared", np.ones(200_000), 0.0)
    assert not left.exists()
    assert cache.load("shared", (200_000,), 1) is not None
