"""Matrices on disk: found again for the same simulation only, whole or not at all."""

from __future__ import annotations

import importlib
import os
import re
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_scenes import AIR, CUBE, small_scene

from autdtorch.propagators import SimulatedPropagator, SteadyStateWarning, make_propagator
from autdtorch.propagators.cache import SUFFIX, DiskCache, _with_checksum
from autdtorch.propagators.execute import cache_key
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.obstacles import Mesh, Obstacle, Sphere, VoxelMask
from autdtorch.scene.scene import Medium, Scene
from autdtorch.utils.digest import digest_of
from autdtorch.utils.files import ABANDONED, PARTIAL

SPACING = 2.5e-3
CORNER = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"

WRITER = """
import sys, time, numpy as np
from pathlib import Path
from autdtorch.propagators.cache import DiskCache
cache, value = DiskCache(sys.argv[1]), float(sys.argv[2])
Path(sys.argv[3]).touch()
while True:
    cache.save("shared", np.full(200_000, value), value)
"""


def prepared(scene: Scene, folder: Path, **settings: object) -> SimulatedPropagator:
    arguments = {"method": "box", "spacing": SPACING, "cache": folder, **settings}
    propagator = make_propagator(scene, **arguments)  # type: ignore[arg-type]
    assert isinstance(propagator, SimulatedPropagator)
    return propagator


def files(folder: Path) -> list[Path]:
    return sorted(folder.glob(f"*{SUFFIX}"))


def key(propagator: SimulatedPropagator, points: torch.Tensor | None = None) -> str:
    return cache_key(propagator._plan, propagator.scene.control_points if points is None else points)


def wait_for(condition: object) -> None:
    end = time.monotonic() + 60
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < end
        time.sleep(0.01)


def test_what_was_simulated_is_not_simulated_again(tmp_path: Path) -> None:
    scene = small_scene((CUBE,))
    first = prepared(scene, tmp_path)
    matrix, error = first.transfer_matrix(return_error=True)
    assert first.runs
    assert len(files(tmp_path)) == 2  # that of the second grid as well
    again = prepared(
        Scene(scene.array, AIR, 40e3, scene.control_points, (CUBE,), domain=scene.domain), tmp_path
    )
    kept, kept_error = again.transfer_matrix(return_error=True)
    assert torch.equal(kept, matrix)
    assert kept_error == error
    assert not again.runs
    assert not again._second.runs
    drives = torch.ones((5, 4), dtype=torch.complex128)
    assert torch.allclose(again.field(drives, scene.control_points), matrix.sum(dim=1))
    assert not again.runs


def test_a_folder_by_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = small_scene((CUBE,))
    monkeypatch.setenv("AUTDTORCH_CACHE_DIR", str(tmp_path / "new" / "folder"))
    make_propagator(scene, "box", SPACING, cache=False).transfer_matrix()
    assert not (tmp_path / "new").exists()
    make_propagator(scene, "box", SPACING).transfer_matrix()
    assert len(files(tmp_path / "new" / "folder")) == 1
    (tmp_path / "file").touch()
    monkeypatch.setenv("AUTDTORCH_CACHE_DIR", str(tmp_path / "file"))
    with pytest.raises(ValueError, match=r"AUTDTORCH_CACHE_DIR: .* must be a folder"):
        make_propagator(scene, "box", SPACING)
    for refused in (True, 3, ""):
        with pytest.raises(ValueError, match=r"cache: .* must be the path of a folder, or False"):
            make_propagator(scene, "box", SPACING, cache=refused)  # type: ignore[arg-type]


def test_all_that_decides_a_matrix_decides_its_name(tmp_path: Path) -> None:
    """A last bit of anything, and every setting."""
    plain, above = small_scene((CUBE,)), np.nextafter
    mask = np.ones((3, 3, 3), bool)
    holed = mask.copy()
    holed[1, 1, 1] = False
    (tmp_path / "one.obj").write_text(CORNER, "utf-8")
    (tmp_path / "two.obj").write_text(CORNER.replace("v 1 0 0", "v 1.0000001 0 0"), "utf-8")

    def scene(*obstacles: Obstacle, **changes: object) -> Scene:
        parts = {"array": plain.array, "medium": AIR, "frequency": 40e3, "domain": plain.domain, **changes}
        return Scene(control_points=plain.control_points, obstacles=obstacles, **parts)  # type: ignore[arg-type]

    def mesh(name: str) -> Mesh:
        return Mesh(tmp_path / name, scale=5e-3, offset=(9e-3, 9e-3, 9e-3), rigid=True)

    array = plain.array
    x, y, z = CUBE.center
    sphere = Sphere(CUBE.center, 3e-3, density=100.0, sound_speed=340.0)
    scenes = [
        plain,
        scene(replace(CUBE, center=(above(x, 1), y, z))),
        scene(replace(CUBE, density=above(100.0, 101))),
        scene(replace(CUBE, rotation=(1e-12, 0, 0))),
        scene(sphere),
        scene(sphere, CUBE),
        scene(CUBE, sphere),
        scene(mesh("one.obj")),
        scene(mesh("two.obj")),
        scene(VoxelMask(mask, 2e-3, (9e-3,) * 3, rigid=True)),
        scene(VoxelMask(holed, 2e-3, (9e-3,) * 3, rigid=True)),
        scene(CUBE, medium=Medium(AIR.density, AIR.sound_speed, 1.3)),
        scene(CUBE, frequency=above(40e3, 41e3)),
        scene(CUBE, domain=((0, 0, 0), (24e-3, 24e-3, above(24e-3, 1)))),
        scene(CUBE, array=TransducerArray(array.positions, (1, 0.1, 0))),
        scene(CUBE, array=TransducerArray(array.positions, (1, 0, 0), 2.0)),
        scene(CUBE, array=TransducerArray(array.positions, (1, 0, 0), radius=1e-3)),
        scene(CUBE, array=TransducerArray(array.positions.flip(0), (1, 0, 0))),
    ]
    settings: list[dict[str, object]] = [
        {"method": "full"},
        {"spacing": above(SPACING, 1)},
        {"tolerance": 1e-3},
        {"dtype": "float64"},
        {"kernel": "reference"},
        {"max_periods": 599},
        {"time_step": 5e-6},
    ]
    propagators = [prepared(one, tmp_path) for one in scenes]
    propagators += [prepared(plain, tmp_path, **one) for one in settings]
    digests = [key(one) for one in propagators]
    digests += [
        key(propagators[0], points) for points in (plain.control_points.flip(0), plain.control_points[:1])
    ]
    assert len(set(digests)) == len(scenes) + len(settings) + 2
    # names, pictures and where a file lies decide nothing
    (tmp_path / "copy.obj").write_text(CORNER, "utf-8")
    assert digests.index(key(prepared(scene(mesh("copy.obj")), tmp_path))) == 7
    assert digests[0] == key(prepared(scene(CUBE, name="other"), tmp_path))


def test_another_source_or_another_package_simulates_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    propagator = prepared(small_scene((CUBE,)), tmp_path)
    digests = {key(propagator)}
    monkeypatch.setattr("autdtorch.propagators.execute.source_digest", lambda: "changed")
    digests.add(key(propagator))
    monkeypatch.setattr("autdtorch.propagators.execute.package_versions", lambda: {"torch": "0"})
    digests.add(key(propagator))
    assert len(digests) == 3


def test_values_are_not_confused() -> None:
    values = [
        1,
        1.0,
        True,
        "1",
        None,
        (1,),
        ((1,),),
        (1, 1),
        ("1", "1"),
        ("11",),
        ("1 1",),
        np.ones(1),
        np.ones(2),
    ]
    values += [np.ones((1, 2)), np.ones(2, np.float32), torch.ones(2, dtype=torch.complex64), {"1": 1}]
    assert len({digest_of(value) for value in values}) == len(values)
    assert digest_of(1, 2) != digest_of((1, 2), ())
    with pytest.raises(TypeError, match="object: has no digest"):
        digest_of(object())


def test_what_has_not_settled_is_not_kept(tmp_path: Path) -> None:
    propagator = prepared(small_scene((CUBE,)), tmp_path, tolerance=1e-6, max_periods=12)
    with pytest.warns(SteadyStateWarning):
        propagator.transfer_matrix()
    assert not files(tmp_path)


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: content[:40],
        lambda content: content[:-1],
        lambda content: content + b"\0",
        lambda content: content[:-20] + bytes([content[-20] ^ 1]) + content[-19:],
        lambda content: bytes([content[0] ^ 1]) + content[1:],
        lambda content: b"\n" + content,
    ],
)
def test_a_damaged_file_is_not_trusted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: object
) -> None:
    cache = DiskCache(tmp_path)
    cache.save("one", np.arange(6.0).reshape(2, 3), 0.5)
    (path,) = files(tmp_path)
    path.write_bytes(damage(path.read_bytes()))  # type: ignore[operator]
    assert cache.load("one", (2, 3)) is None
    assert "damaged (its checksum is wrong)" in caplog.text
    cache.save("one", np.arange(6.0).reshape(2, 3), 0.5)
    found = cache.load("one", (2, 3))
    assert found is not None
    assert np.array_equal(found[0], np.arange(6.0).reshape(2, 3))
    assert found[1] == 0.5


def test_a_matrix_of_another_shape_or_name_is_not_taken(tmp_path: Path) -> None:
    cache = DiskCache(tmp_path)
    cache.save("one", np.arange(6.0).reshape(2, 3), 0.5)
    assert cache.load("one", (3, 2)) is None
    (path,) = files(tmp_path)
    path.replace(path.with_stem("two"))
    assert cache.load("two", (2, 3)) is None


def test_a_flipped_bit_anywhere_is_noticed(tmp_path: Path) -> None:
    cache = DiskCache(tmp_path)
    cache.save("one", np.arange(6.0).reshape(2, 3), 0.5)
    (path,) = files(tmp_path)
    content = path.read_bytes()
    for place, byte in enumerate(content):
        path.write_bytes(content[:place] + bytes([byte ^ 1 << place % 8]) + content[place + 1 :])
        assert cache.load("one", (2, 3)) is None


@pytest.mark.parametrize(
    "body",
    [b"", b"\0" * 15, np.zeros(6, complex).tobytes(), np.zeros(8, complex).tobytes(), b"\xff" * 112],
)
def test_a_forged_matrix_of_another_length_or_not_finite_is_computed_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, body: bytes
) -> None:
    cache = DiskCache(tmp_path)
    (tmp_path / f"one{SUFFIX}").write_bytes(_with_checksum("one", (2, 3), body))
    assert cache.load("one", (2, 3)) is None
    assert "holds no finite matrix of shape (2, 3): computing again" in caplog.text


def test_a_folder_that_cannot_be_used_costs_no_result(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cache = DiskCache(tmp_path / "folder")
    (tmp_path / "folder").rmdir()
    cache.save("one", np.ones((2, 3)), 0.0)
    assert re.search("cannot be written .*: not kept", caplog.text)
    assert cache.load("one", (2, 3)) is None
    (tmp_path / "folder" / f"one{SUFFIX}").mkdir(parents=True)
    assert cache.load("one", (2, 3)) is None
    assert re.search("cannot be read .*: computing again", caplog.text)
    cache.save("one", np.ones(3), 0.0)
    assert not list((tmp_path / "folder").glob(f"*{PARTIAL}"))


def test_writers_that_run_together_and_are_killed(tmp_path: Path) -> None:
    """Three processes write one matrix over and over, each with values of its own, until they are killed."""
    folder, ready = tmp_path / "cache", [tmp_path / f"ready{number}" for number in range(3)]
    writers = [
        subprocess.Popen([sys.executable, "-c", WRITER, str(folder), str(number), str(flag)])
        for number, flag in enumerate(ready)
    ]
    try:
        wait_for(lambda: all(flag.exists() for flag in ready) and files(folder))
        cache, seen = DiskCache(folder), set()
        end = time.monotonic() + 60
        while len(seen) < 3 and time.monotonic() < end:
            found = cache.load("shared", (200_000,))
            assert found is not None
            assert (found[0] == found[1]).all()
            seen.add(found[1])
        assert len(seen) == 3
    finally:
        for writer in writers:
            writer.kill()
            writer.wait()
    found = cache.load("shared", (200_000,))
    assert found is not None
    assert (found[0] == found[1]).all()


def test_a_writer_killed_before_it_is_done_leaves_nothing_that_is_read(tmp_path: Path) -> None:
    stopped = tmp_path / "stopped"
    halfway = "import pathlib, time\ndef halt(*_): Path(sys.argv[3]).touch(); time.sleep(60)\n"
    code = WRITER.replace("cache, value", f"{halfway}pathlib.Path.replace = halt\ncache, value", 1)
    code = code.replace("Path(sys.argv[3]).touch()\nwhile", "while")
    writer = subprocess.Popen([sys.executable, "-c", code, str(tmp_path), "1", str(stopped)])
    try:
        wait_for(stopped.exists)
    finally:
        writer.kill()
        writer.wait()
    cache = DiskCache(tmp_path)
    (left,) = tmp_path.glob(f"*{PARTIAL}")
    assert cache.load("shared", (200_000,)) is None
    cache.save("shared", np.ones(200_000), 0.0)
    assert left.exists()  # it might be that of a process that writes
    old = time.time() - 2 * ABANDONED
    os.utime(left, (old, old))
    cache.save("shared", np.ones(200_000), 0.0)
    assert not left.exists()
    assert cache.load("shared", (200_000,)) is not None


def test_an_obstacle_of_ones_own_has_the_digest_of_its_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    code = "from dataclasses import dataclass\n@dataclass(frozen=True)\nclass Own:\n    size: float\n"
    for name, more in (
        ("own_a", ""),
        ("own_b", ""),
        ("own_c", "    def twice(self): return 2 * self.size\n"),
    ):
        (tmp_path / f"{name}.py").write_text(code + more, encoding="utf-8")
    first, same, other = (
        digest_of(importlib.import_module(name).Own(1.0)) for name in ("own_a", "own_b", "own_c")
    )
    assert first == same != other
