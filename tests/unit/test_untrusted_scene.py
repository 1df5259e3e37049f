"""A scene that somebody sent, and the arrays it names, read no variable, run nothing and stay small."""

import io
import pickle
import re
import struct
import time
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf
from wrong_values import holding_itself, sharing

from autdtorch.io.array_file import load_array
from autdtorch.io.drive_file import load_drive
from autdtorch.io.scene_file import load_scene
from autdtorch.io.yaml_file import parse_yaml
from autdtorch.scene.obstacles import VoxelMask

SCENE = """
frequency: 40e3
medium: {density: 1.293, sound_speed: 340.0}
array: {type: positions, positions: [[0, 0, 0], [0, 10e-3, 0]], normals: [1, 0, 0]}
control_points: {type: points, positions: [[80e-3, 0, 0]]}
"""


def scene() -> dict[Any, Any]:
    container: dict[Any, Any] = OmegaConf.to_container(OmegaConf.create(SCENE))
    return container


def given(kind: str, mapping: dict[Any, Any], folder: Path) -> tuple[Any, str]:
    """A scene as a file, a mapping or a node, and what messages call it."""
    if kind == "file":
        path = folder / "sent.yaml"
        OmegaConf.save(mapping, path)
        return path, str(path)
    return (OmegaConf.create(mapping) if kind == "node" else mapping), "scene mapping"


def levels(line: str) -> str:
    """Ten lines, in each of which `line` names the one before ten times."""
    return "\n".join(line.format(this=n, before=", ".join([f"*a{n - 1}"] * 10)) for n in range(1, 11))


LARGE = {
    "aliases": "a0: &a0 [lol, lol]\n" + levels("a{this}: &a{this} [{before}]"),
    "merged mappings": "a0: &a0 {x: 1}\n" + levels("a{this}: &a{this} {{<<: [{before}]}}"),
    "long text in aliases": f"a0: &a0 {'x' * 9_000}\n" + levels("a{this}: &a{this} [{before}]"),
    "an alias in itself": "a: &a {b: *a}\n",
    "depth": f"a: {'[' * 10_000}",
    "depth by aliases": "a0: &a0 []\n" + "\n".join(f"a{n}: &a{n} [*a{n - 1}]" for n in range(1, 200)),
    "YAML in a text": f'"a: {"[" * 9_000}"',
    "a huge file": "a: 1\n" * 1_000_000,
    "a huge number": f"frequency: {'1:' * 4_000}1\n",
    "references": "a0: [lol, lol]\n" + "\n".join(f"a{n}: {[f'${{a{n - 1}}}'] * 10}" for n in range(1, 11)),
    "a chain of references": "".join(f"a{n}: ${{a{n + 1}}}\n" for n in range(1_000)),
}


@pytest.mark.parametrize("text", LARGE.values(), ids=LARGE.keys())
def test_what_expands_is_refused_before_it_does(tmp_path: Path, text: str) -> None:
    refused(tmp_path, SCENE + "x: 1\n")  # what has to be imported, is
    begin = time.process_time()
    refused(tmp_path, text)
    assert time.process_time() - begin < 2  # at most 0.5; expanded, it would take hours
    tracemalloc.start()
    try:
        refused(tmp_path, text)
        assert tracemalloc.get_traced_memory()[1] < 30e6  # of it, 10 MB are the largest text that is read
    finally:
        tracemalloc.stop()


def refused(folder: Path, text: str) -> str:
    path = folder / "sent.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=r"sent\.yaml") as caught:
        load_scene(path)
    return one_line(caught.value)


def one_line(error: Exception) -> str:
    text = str(error)
    assert "\n" not in text
    return text


@pytest.mark.parametrize("value", [sharing(list), holding_itself(1)], ids=["shared", "itself"])
def test_a_mapping_that_expands_is_refused(value: object) -> None:
    with pytest.raises(ValueError, match=r"scene mapping: domain\.\d") as caught:
        load_scene({**scene(), "domain": value})
    one_line(caught.value)


@pytest.mark.parametrize("kind", ["file", "mapping", "node"])
@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ("???", "Missing mandatory value: array"),
        ("${array}", "Recursive interpolation detected"),
        ("${array.type}", "RecursionError"),
        ("${x}", "Interpolation key 'x' not found"),
        ("${medium.a}", "Interpolation key 'medium.a' not found"),
    ],
)
def test_a_missing_value_is_reported_in_a_line_with_its_key(tmp_path, kind, value, reason):
    source, where = given(kind, scene() | {"array": value}, tmp_path)
    with pytest.raises(ValueError, match=re.escape(f"{where}: array: {reason}")) as caught:
        load_scene(source)
    one_line(caught.value)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"array": np.zeros(3)}, "array: Value 'ndarray'"),
        ({"array": object()}, "array: Value 'object'"),
        ({"reflectors": [np.zeros(3)]}, "reflectors[0]: Value 'ndarray'"),
        ({"reflectors": [{"type": "panel", "point": object()}]}, "reflectors[0].point: Value 'object'"),
        ({"domain": [[0, 0, 0], np.ones(3)]}, r"domain[1]: Value 'ndarray'"),
        ({object(): 1}, "Incompatible key type 'object'"),
        ({("array",): 1}, "unhashable type"),
    ],
)
def test_a_mapping_that_holds_objects_is_refused_in_a_line(changes: dict[Any, Any], reason: str) -> None:
    with pytest.raises(ValueError, match=re.escape(f"scene mapping: {reason}")) as caught:
        load_scene(scene() | changes)
    one_line(caught.value)


def test_moderate_aliases_and_a_thousand_transducers_are_read() -> None:
    config = parse_yaml("a: &a {x: 1, y: [2, 3]}\nb: *a\nc: {<<: *a, x: 4}\n", "text")
    assert config == {"a": {"x": 1, "y": [2, 3]}, "b": {"x": 1, "y": [2, 3]}, "c": {"x": 4, "y": [2, 3]}}
    positions = [[0.0, 1.0 * n, 0.012345678901234] for n in range(1_000)]
    text = OmegaConf.to_yaml({"array": {"positions": positions}})
    assert parse_yaml(text, "text").array.positions == positions


READS = ["${oc.env:SECRET}", "${oc.env:SECRET,none}", "${${kind}:SECRET}", "x${oc.env:SECRET}"]
READS += [r"\${oc.env:SECRET}", "${oc.decode:SECRET}", "${name}${name}"]  # the last grows without limit


@pytest.mark.parametrize("kind", ["file", "mapping", "node"])
@pytest.mark.parametrize("text", READS)
def test_an_interpolation_is_a_whole_key_without_resolver(tmp_path, monkeypatch, kind, text):
    monkeypatch.setenv("SECRET", "hunter2")
    source, _ = given(kind, scene() | {"name": text, "array": {"path": "x"}}, tmp_path)
    with pytest.raises(ValueError, match=": name: ") as caught:
        load_scene(source)
    assert "hunter2" not in one_line(caught.value)


@pytest.mark.parametrize(
    "entry",
    [
        "{_target_: os.system}", "{type: _target_}", "{type: panel, array: x}", "[[[]]]",
        "{point: [.inf, 0, 0], normal: [1, 0, 0]}", "{point: 1, normal: [1, 0, 0]}",
        "{point: [0, 0, 0], normal: [1, 0, 0], reflection: 1e999j}",
        "{point: [0, 0, 0], normal: [1, 0, 0], reflection: __import__('os')}",
    ],
)  # fmt: skip
def test_a_reflector_is_a_few_checked_numbers(tmp_path: Path, entry: str) -> None:
    assert "reflectors" in refused(tmp_path, f"{SCENE}reflectors: [{entry}]\n")


@pytest.mark.parametrize("tag", ["!!python/object/apply:pathlib.Path", "!!python/name:os.system", "!mine"])
def test_tags_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tag: str) -> None:
    monkeypatch.chdir(tmp_path)
    assert "line 1" in refused(tmp_path, f"x: {tag} [canary]\n")
    assert not (tmp_path / "canary").exists()


class Touch:
    """When it is unpickled, it leaves a file."""

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (Path("canary"),)


def npy(header: str, body: bytes = b"") -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + body


def npz(content: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("positions.npy", "normals.npy", "drive.npy"):
            archive.writestr(name, content)
    return file.getvalue()


def declared(shape: str, dtype: str = "|b1") -> str:
    return f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': ({shape}), }}\n"


def objects() -> bytes:
    file = io.BytesIO()
    np.save(file, np.array([Touch()], object), allow_pickle=True)
    return file.getvalue()


ARRAYS = {
    "pickle": pickle.dumps(Touch()),
    "pickled objects": objects(),
    "more than it holds": npy(declared("10000000000,"), b"\x01"),
    "more than memory has": npy(declared("1000000, 1000000, 1000000")),
    "nothing of many": npy(declared("100000000000,", "|V0")),
    "a header that is code": npy("__import__('pathlib').Path('canary').touch()"),
    "a header that does not end": npy("(" * 900),
    "negative": npy(declared("-1,"), b"\x01"),
    "a type of nothing": npy("{'descr': (), 'fortran_order': False, 'shape': (1,), }\n", b"\x01"),
    "keys of two kinds": npy("{'descr': '|b1', 1: False, 'shape': (1,), }\n", b"\x01"),
    "a boolean as a length": npy(declared("True,"), b"\x01"),
}


@pytest.mark.parametrize("content", ARRAYS.values(), ids=ARRAYS.keys())
def test_arrays_in_files_are_checked_before_they_are_allocated(tmp_path, monkeypatch, content):
    monkeypatch.chdir(tmp_path)
    Path("mask.npy").write_bytes(content)
    Path("array.npz").write_bytes(npz(content))
    tracemalloc.start()
    try:
        for load, name in ((load_array, "array.npz"), (load_drive, "array.npz")):
            with pytest.raises(ValueError, match=name) as caught:
                load(name)
            one_line(caught.value)
        for name in ("mask.npy", "array.npz"):
            with pytest.raises(ValueError, match=rf"VoxelMask\.path: .*{name}") as caught:
                VoxelMask.load(name, 1e-3, rigid=True)
            one_line(caught.value)
        assert tracemalloc.get_traced_memory()[1] < 5e6
    finally:
        tracemalloc.stop()
    assert not Path("canary").exists()


def test_a_small_file_of_many_zeros_is_not_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("autdtorch.utils.files._LARGEST", 10**6)
    np.savez_compressed(tmp_path / "zeros.npz", mask=np.ones((100, 100, 101), bool))
    with pytest.raises(ValueError, match=r"zeros\.npz.*1010128 bytes"):
        VoxelMask.load(tmp_path / "zeros.npz", 1e-3, rigid=True)
