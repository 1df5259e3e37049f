"""Results and provenance of a study: saved, loaded, and refused if damaged."""

import dataclasses
import errno
import hashlib
import os
from pathlib import Path
from unittest.mock import Mock

import h5py
import numpy as np
import pytest
import torch

from autdtorch.io.goal_section import goal_section
from autdtorch.methods.solution import Solution
from autdtorch.objectives.goals import WEAKEST_FOCUS, TargetPressures
from autdtorch.objectives.metrics import focus_metrics
from autdtorch.propagators import Run
from autdtorch.study import results as origins
from autdtorch.study.results import (
    PROVENANCE_FILE,
    MethodResult,
    Provenance,
    SceneResult,
    SceneSimulation,
    StudyResult,
    load_provenance,
)
from autdtorch.study.results_file import RESULTS_FILE, load_results, save_results
from autdtorch.utils.files import line_of

FREE_SPACE = SceneSimulation("free_space", 8.5e-3, None, None, (), 0.25, 0.5)
RUN_PAIR = (Run(183, 1.9e-3, True, 4.5), Run(600, 3e-2, False, 9.0))
FULL = SceneSimulation("full", 8.5e-3, 1e-3, 2e-3, RUN_PAIR, 20.0, 80.0)


def method_result(trials, plane, seed):
    generator = torch.Generator().manual_seed(seed)
    drive = torch.randn(trials, 3, dtype=torch.complex128, generator=generator).sgn()
    pressure = torch.rand(trials, 2, dtype=torch.float64, generator=generator)
    field = torch.randn(trials, 4, 5, dtype=torch.complex128, generator=generator)
    history = pressure.amin(dim=1, keepdim=True) * torch.tensor([0.5, 1.0], dtype=torch.float64)
    solution = Solution(drive, pressure, pressure.amin(dim=1), torch.full((trials,), 2), history)
    metrics = focus_metrics(pressure, *((field.abs(), 1e-6) if plane else (None, None)))
    seconds = torch.rand(trials, dtype=torch.float64, generator=generator)
    return MethodResult(solution, metrics, seconds, trials - 1, field[-1] if plane else None)


@pytest.fixture
def results():
    versions = {"autdtorch": "0", "torch": "2"}
    provenance = Provenance("seed: 3\ntext: |\n  °µ\n", 3, versions, "abc", "2026-01-01T00:00:00")
    matrix = torch.randn(2, 3, dtype=torch.complex128, generator=torch.Generator().manual_seed(0))
    # Not in alphabetical order, the default of HDF5.
    with_plane = {"lssg": method_result(1, True, 1), "bayes_opt": method_result(4, True, 2)}
    scenes = {
        "two_cubes": SceneResult(2, matrix, 1.25, FULL, with_plane),
        "empty": SceneResult(0, 2 * matrix, 0.75, FREE_SPACE, {"gabs": method_result(2, False, 3)}),
    }
    return StudyResult(provenance, scenes)


def assert_same(first, second):
    assert type(first) is type(second)
    if isinstance(first, torch.Tensor):
        assert (first.dtype, first.tolist()) == (second.dtype, second.tolist())
    elif isinstance(first, dict):
        assert list(first) == list(second)
        for key, value in first.items():
            assert_same(value, second[key])
    elif dataclasses.is_dataclass(first):
        assert_same(vars(first), vars(second))
    else:
        assert first == second


def test_results_are_loaded_as_saved_and_saving_again_replaces_them(results, tmp_path):
    folder = tmp_path / "new" / "folder"
    save_results(results, folder)
    assert_same(load_results(folder), results)
    assert_same(load_results(folder / RESULTS_FILE), results)
    save_results(dataclasses.replace(results, scenes={"empty": results.scenes["empty"]}), folder)
    assert list(load_results(folder).scenes) == ["empty"]
    assert [path.name for path in folder.iterdir()] == [RESULTS_FILE]
    with h5py.File(folder / RESULTS_FILE) as file:  # other programs read it as HDF5
        matrix = file["scenes/empty/transfer_matrix"][()]
    assert np.array_equal(matrix, results.scenes["empty"].transfer_matrix.numpy())


def test_a_file_is_on_disk_before_it_is_renamed_and_a_full_disk_keeps_the_old_one(
    results, tmp_path, monkeypatch
):
    synced: list[int] = []
    replace = Path.replace

    def check(self, target):
        assert synced == [self.stat().st_size]
        return replace(self, target)

    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.append(os.fstat(descriptor).st_size))
    monkeypatch.setattr(Path, "replace", check)
    save_results(results, tmp_path)
    assert synced
    monkeypatch.setattr(Path, "write_bytes", Mock(side_effect=OSError(errno.ENOSPC, "No space left")))
    with pytest.raises(OSError, match=r"'.*results\.h5'"):
        save_results(results, tmp_path)
    assert load_results(tmp_path).scenes.keys() == results.scenes.keys()


def test_results_without_a_goal_are_of_the_papers(results, tmp_path):
    targets = goal_section(TargetPressures([4, 2]))
    scene = dataclasses.replace(results.scenes["empty"], goal=targets, unit="", bound=-0.5)
    save_results(dataclasses.replace(results, scenes={"empty": scene}), tmp_path)
    assert_same(load_results(tmp_path).scenes["empty"], scene)
    for key in ("goal", "unit"):
        changed(tmp_path / RESULTS_FILE, lambda file, key=key: put(file, f"scenes/empty@{key}", None))
    older = load_results(tmp_path).scenes["empty"]
    assert (older.goal, older.score_label) == (goal_section(WEAKEST_FOCUS), "weakest focus [Pa]")


@pytest.mark.parametrize(("name", "load"), [(RESULTS_FILE, load_results), (PROVENANCE_FILE, load_provenance)])
def test_missing_incomplete_and_damaged_files_are_refused_by_name(results, tmp_path, name, load):
    with pytest.raises(FileNotFoundError, match=name):
        load(tmp_path)
    save_results(results, tmp_path)
    origins.save_provenance(results.provenance, tmp_path)
    content = (tmp_path / name).read_bytes()
    for place in range(0, len(content), 1 + len(content) // 500):
        flipped = bytes([content[place] ^ 1 << place % 8])
        (tmp_path / name).write_bytes(content[:place] + flipped + content[place + 1 :])
        with pytest.raises(ValueError, match=f"{name}: its checksum is wrong"):
            load(tmp_path)
    for wrong in (content[: len(content) // 2], b"", b"text"):
        (tmp_path / name).write_bytes(wrong)
        with pytest.raises(ValueError, match=f"{name}: "):
            load(tmp_path)


@pytest.mark.parametrize(
    "change",
    [{}, {"config": 3}, {"seed": "3"}, {"seed": True}, {"versions": []}, {"date": None}, {"more": 1}],
)
def test_a_provenance_of_other_fields_or_types_is_refused(results, tmp_path, change):
    origins.save_provenance(results.provenance, tmp_path)
    assert load_provenance(tmp_path) == results.provenance
    row = dataclasses.asdict(results.provenance) | change if change else {"config": "a"}
    (tmp_path / PROVENANCE_FILE).write_bytes(line_of(row) + b"\n")
    with pytest.raises(ValueError, match=PROVENANCE_FILE):
        load_provenance(tmp_path)


def saved(results, folder):
    save_results(results, folder)
    return folder / RESULTS_FILE, (folder / RESULTS_FILE).read_bytes()


def changed(path, change):
    with h5py.File(path, "r+") as file:
        change(file)
    body = path.read_bytes()[512:]
    path.write_bytes(hashlib.sha256(body).hexdigest().encode().ljust(512, b"\0") + body)


def refused(path, content, change):
    """Write content with a change and a new checksum; return the message of the refusal."""
    path.write_bytes(content)
    changed(path, change)
    with pytest.raises(ValueError, match=rf"^.*{RESULTS_FILE}: .*; must be a results file of .*$") as error:
        load_results(path)
    return str(error.value)


def put(file, place, value):
    """Replace a dataset "name" or an attribute "group@name"; None removes it."""
    group, _, attribute = place.partition("@")
    holder, name = (file[group or "/"].attrs, attribute) if attribute else (file, group)
    del holder[name]
    if value is not None:
        holder[name] = value


@pytest.mark.parametrize("link", [False, True])
def test_any_dataset_that_is_missing_or_a_link_is_refused(results, tmp_path, link):
    path, content = saved(results, tmp_path)
    names: list[str] = []
    with h5py.File(path) as file:
        file.visititems(lambda name, entry: names.append(name) if hasattr(entry, "dtype") else None)
    required = [name for name in names if link or not name.endswith(("/area", "/plane_pressure"))]
    assert len(required) > 30
    for name in required:
        value = h5py.SoftLink(f"/{name}") if link else None
        refused(path, content, lambda file, name=name, value=value: put(file, name, value))


METHOD = "scenes/empty/methods/gabs"  # of 2 trials, 3 transducers, 2 points
LSSG = "scenes/two_cubes/methods/lssg"  # of 1 trial
RUNS = "scenes/two_cubes/runs"
MATRIX = "scenes/empty/transfer_matrix"
OTHER = {name: h5py.SoftLink(f"/scenes/two_cubes{name}") for name in ("", "/methods", "/runs")}


@pytest.mark.parametrize(
    ("place", "values"),
    [
        ("scenes", [None, (1.0, 2.0)]),
        *((f"scenes/empty{name}", [(1.0, 2.0), other]) for name, other in OTHER.items()),
        (METHOD, [(1.0, 2.0)]),
        ("@config", [np.bytes_(b"\xff"), None]),
        ("@date", [3, None]),
        ("@seed", ["three", 1.5, None]),
        ("scenes/empty@obstacles", [np.inf, -(10**9), 0.5, None]),
        ("scenes/empty@bound", ["high", np.ones(2), np.nan, -np.inf, None]),
        ("scenes/empty@goal", ["loud", "[]", "{}", '{"name": "<b>"}', '{"name": "target_pressures"}', 3]),
        ("scenes/empty@unit", ["<b>", 3, None]),
        ("scenes/empty@method", ["guess", None]),
        ("scenes/empty@wavelength", [0.0, None]),
        ("scenes/two_cubes@spacing", [np.inf]),
        (f"{METHOD}@shown_trial", [2, -1, None]),
        (f"{RUNS}/periods", [[-1, 600], [1]]),
        (f"{RUNS}/seconds", [[np.nan, 1.0], [1.0]]),
        (f"{RUNS}/remaining", [[0.1, np.nan]]),
        (f"{RUNS}/reached", [[2, 3]]),
        (MATRIX, [np.ones((3, 3), complex), np.ones((2, 4), complex)]),
        (MATRIX, [np.ones((2, 3)), [[np.inf + 0j] * 3] * 2]),
        (f"{METHOD}/drive", [np.ones((1, 1), complex), np.ones((3, 3), complex), np.full((2, 3), 7.0 + 0j)]),
        (f"{METHOD}/pressure", [np.ones((2, 3)), -np.ones((2, 2))]),
        (f"{METHOD}/score", [np.zeros(7), [0.0, np.nan], [0.0, 2.0]]),  # the history's are below 1
        (f"{METHOD}/evaluations", [[2.0, 2.0], [2, 2, 2], [0, 2], [3, 2]]),  # the history has 2
        (f"{METHOD}/history", [np.ones((3, 2)), [[2.0, 1.0], [1.0, 1.0]]]),
        (f"{METHOD}/std", [[0.0, np.nan]]),
        (f"{LSSG}/area", [np.ones(2)]),
        (f"{LSSG}/plane_pressure", [np.ones(2, complex), [[np.nan + 0j]]]),
    ],
)
def test_other_content_is_refused(results, tmp_path, place, values):
    path, content = saved(results, tmp_path)
    for value in values:
        refused(path, content, lambda file, value=value: put(file, place, value))


@pytest.mark.parametrize("side", [10**6, 10**3])
def test_data_that_the_file_cannot_hold_or_that_are_elsewhere_are_refused_before_they_are_read(
    results, tmp_path, side
):
    def change(file):
        for name in (MATRIX, "scenes/empty/runs/seconds", f"{METHOD}/score"):
            del file[name]
            file.create_dataset(name, (side, side), "c16", chunks=(100, 100))

    def elsewhere(file):
        del file[MATRIX]
        file.create_dataset(MATRIX, (2, 3), "c16", external=[(__file__, 0, 96)])

    path, content = saved(results, tmp_path)
    assert f"{16 * side * side} bytes; must be at most" in refused(path, content, change)
    assert "another file" in refused(path, content, elsewhere)


def test_the_provenance_of_now_names_the_numerical_packages():
    provenance = origins.provenance_now("a: 1\n", 5)
    packages = {"torch", "numpy", "scipy", "libigl", "numba", "botorch", "gpytorch"}
    extras = {"triton"}  # if installed
    assert set(provenance.versions) - extras == {"autdtorch", "python", "platform"} | packages
    assert provenance.origin == origins.provenance_now("a: 1\n", 5).origin
    assert provenance.date.endswith("+00:00")
    assert provenance.origin == dataclasses.replace(provenance, date="2027-01-01T00:00:00").origin
    for other in ({"config": "x"}, {"seed": 4}, {"source_digest": "x"}, {"versions": {"autdtorch": "1"}}):
        assert provenance.origin != dataclasses.replace(provenance, **other).origin
