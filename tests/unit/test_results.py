"""What a study found comes back from disk as it was."""

import dataclasses
import errno
import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from autdtorch.methods.solution import Solution
from autdtorch.objectives.metrics import focus_metrics
from autdtorch.propagators import Run
from autdtorch.study.provenance import (
    PROVENANCE_FILE,
    Provenance,
    load_provenance,
    provenance_now,
    save_provenance,
)
from autdtorch.study.results import MethodResult, SceneResult, Simulation, StudyResult
from autdtorch.study.results_file import RESULTS_FILE, load_results, save_results
from autdtorch.utils.json_lines import line_of

FREE_SPACE = Simulation("free_space", 8.5e-3, None, None, (), 0.25, 0.5)
FULL = Simulation(
    "full", 8.5e-3, 1e-3, 2e-3, (Run(183, 1.9e-3, True, 4.5), Run(600, 3e-2, False, 9.0)), 20.0, 80.0
)


def method_result(trials: int, plane: bool, seed: int) -> MethodResult:
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
def results() -> StudyResult:
    provenance = Provenance(
        "seed: 3\ntext: |\n  °µ\n", 3, {"autdtorch": "0", "torch": "2"}, "abc", "2026-01-01T00:00:00"
    )
    matrix = torch.randn(2, 3, dtype=torch.complex128, generator=torch.Generator().manual_seed(0))
    # Not in alphabetical order, which HDF5 would restore.
    with_plane = {"lssg": method_result(1, True, 1), "bayes_opt": method_result(4, True, 2)}
    scenes = {
        "two_cubes": SceneResult(2, matrix, 1.25, FULL, with_plane),
        "empty": SceneResult(0, 2 * matrix, 0.75, FREE_SPACE, {"gabs": method_result(2, False, 3)}),
    }
    return StudyResult(provenance, scenes)


def assert_same(first: object, second: object) -> None:
    assert type(first) is type(second)
    if isinstance(first, torch.Tensor):
        assert first.dtype == second.dtype
        assert torch.equal(first, second)
    elif isinstance(first, dict):
        assert list(first) == list(second)
        for key, value in first.items():
            assert_same(value, second[key])
    elif dataclasses.is_dataclass(first):
        for field in dataclasses.fields(first):
            assert_same(getattr(first, field.name), getattr(second, field.name))
    else:
        assert first == second


def test_everything_comes_back(results: StudyResult, tmp_path: Path) -> None:
    save_results(results, tmp_path / "new" / "folder")
    assert_same(load_results(tmp_path / "new" / "folder"), results)
    assert_same(load_results(tmp_path / "new" / "folder" / RESULTS_FILE), results)


def test_saving_again_replaces_what_was_there_and_leaves_nothing_else(
    results: StudyResult, tmp_path: Path
) -> None:
    save_results(results, tmp_path)
    fewer = dataclasses.replace(results, scenes={"empty": results.scenes["empty"]})
    save_results(fewer, tmp_path)
    assert list(load_results(tmp_path).scenes) == ["empty"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [RESULTS_FILE]


def test_a_full_disk_is_told_with_the_name_of_the_file(
    results: StudyResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_results(results, tmp_path)

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", refuse)
    with pytest.raises(OSError, match=r"No space left on device: '.*results\.h5'"):
        save_results(results, tmp_path)
    assert load_results(tmp_path).scenes.keys() == results.scenes.keys()


def test_the_provenance_comes_back_or_is_refused_by_name(results: StudyResult, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=PROVENANCE_FILE):
        load_provenance(tmp_path)
    save_provenance(results.provenance, tmp_path)
    assert load_provenance(tmp_path) == results.provenance
    for wrong in ("", '{"config": "a"}', '{"config": '):
        (tmp_path / PROVENANCE_FILE).write_text(wrong, encoding="utf-8")
        with pytest.raises(ValueError, match=rf"{PROVENANCE_FILE}: .*must be a provenance file"):
            load_provenance(tmp_path)


@pytest.mark.parametrize(
    "change",
    [{"config": 3}, {"seed": "3"}, {"seed": True}, {"versions": []}, {"date": None}, {"more": 1}],
)
def test_a_provenance_of_other_fields_or_types_is_refused(
    results: StudyResult, tmp_path: Path, change: dict[str, object]
) -> None:
    row = dataclasses.asdict(results.provenance) | change
    (tmp_path / PROVENANCE_FILE).write_bytes(line_of(row) + b"\n")
    with pytest.raises(ValueError, match=PROVENANCE_FILE):
        load_provenance(tmp_path)


@pytest.mark.parametrize("name", [RESULTS_FILE, PROVENANCE_FILE])
def test_a_flipped_bit_anywhere_is_noticed(results: StudyResult, tmp_path: Path, name: str) -> None:
    save_results(results, tmp_path)
    save_provenance(results.provenance, tmp_path)
    content = (tmp_path / name).read_bytes()
    for place in range(0, len(content), 1 + len(content) // 500):
        flipped = bytes([content[place] ^ 1 << place % 8])
        (tmp_path / name).write_bytes(content[:place] + flipped + content[place + 1 :])
        with pytest.raises(ValueError, match=f"{name}: its checksum is wrong"):
            load_results(tmp_path) if name == RESULTS_FILE else load_provenance(tmp_path)


def test_a_file_is_on_disk_before_it_takes_its_place(
    results: StudyResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[int] = []
    replace = Path.replace

    def check(self: Path, target: Path) -> Path:
        assert synced == [self.stat().st_size]
        return replace(self, target)

    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.append(os.fstat(descriptor).st_size))
    monkeypatch.setattr(Path, "replace", check)
    save_results(results, tmp_path)
    assert synced


def test_other_programs_read_the_file_as_any_of_hdf5(results: StudyResult, tmp_path: Path) -> None:
    save_results(results, tmp_path)
    with h5py.File(tmp_path / RESULTS_FILE) as file:
        matrix = file["scenes/two_cubes/transfer_matrix"][()]
    assert np.array_equal(matrix, results.scenes["two_cubes"].transfer_matrix.numpy())


def a_dataset(file: h5py.File, name: str, values: object = (1.0, 2.0)) -> None:
    del file[name]
    file[name] = values


def an_entry(file: h5py.File, name: str, place: tuple[int, ...], value: complex) -> None:
    file[name][place] = value


def of_another_file(file: h5py.File, name: str) -> None:
    del file[name]
    file.create_dataset(name, (2, 3), "c16", external=[(__file__, 0, 96)])


METHOD = "scenes/empty/methods/gabs"  # of 2 trials, 3 transducers, 2 points


def an_attribute(file: h5py.File, name: str, value: object) -> None:
    file.attrs[name] = value


def with_checksum(path: Path) -> None:
    body = path.read_bytes()[512:]
    path.write_bytes(hashlib.sha256(body).hexdigest().encode().ljust(512, b"\0") + body)


@pytest.mark.parametrize(
    "change",
    [
        lambda file: file.pop("scenes"),
        lambda file: a_dataset(file, "scenes"),
        lambda file: a_dataset(file, "scenes/empty"),
        lambda file: a_dataset(file, "scenes/empty/methods"),
        lambda file: a_dataset(file, "scenes/empty/methods/gabs"),
        lambda file: file.pop("scenes/empty/transfer_matrix"),
        lambda file: file.pop("scenes/two_cubes/runs/seconds"),
        lambda file: a_dataset(file, "scenes/empty/runs/seconds"),  # of another length
        lambda file: file["scenes/empty"].attrs.pop("bound"),
        lambda file: an_attribute(file["scenes/empty"], "bound", "high"),
        lambda file: an_attribute(file["scenes/empty"], "bound", np.ones(2)),
        lambda file: an_attribute(file["scenes/empty"], "obstacles", np.inf),
        lambda file: an_attribute(file, "config", np.bytes_(b"\xff")),
        lambda file: an_attribute(file, "date", 3),
        lambda file: an_attribute(file, "seed", "three"),
        lambda file: file.attrs.pop("source_digest"),
        lambda file: an_attribute(file, "seed", 1.5),
        lambda file: an_attribute(file["scenes/empty"], "obstacles", -(10**9)),
        lambda file: an_attribute(file["scenes/empty"], "obstacles", 0.5),
        lambda file: an_attribute(file["scenes/empty"], "bound", np.nan),
        lambda file: an_attribute(file["scenes/empty"], "bound", -1.0),
        lambda file: an_attribute(file["scenes/empty"], "wavelength", 0.0),
        lambda file: an_attribute(file["scenes/empty"], "plane_seconds", -1.0),
        lambda file: an_attribute(file["scenes/two_cubes"], "spacing", np.inf),
        lambda file: an_attribute(file["scenes/two_cubes"], "tolerance", -1.0),
        lambda file: an_entry(file, "scenes/two_cubes/runs/periods", (0,), -1),
        lambda file: an_entry(file, "scenes/two_cubes/runs/seconds", (0,), np.nan),
        lambda file: a_dataset(file, "scenes/two_cubes/runs/remaining", [0.1, np.nan]),
        lambda file: a_dataset(file, "scenes/two_cubes/runs/reached", [2, 3]),
        lambda file: an_attribute(file[METHOD], "shown_trial", 2),
        lambda file: an_attribute(file[METHOD], "shown_trial", -1),
        lambda file: a_dataset(file, "scenes/empty/transfer_matrix", np.ones((3, 3), complex)),
        lambda file: a_dataset(file, "scenes/empty/transfer_matrix", np.ones((2, 4), complex)),
        lambda file: a_dataset(file, "scenes/empty/transfer_matrix", np.ones((2, 3))),
        lambda file: an_entry(file, "scenes/empty/transfer_matrix", (0, 0), np.inf),
        lambda file: a_dataset(file, f"{METHOD}/drive", np.ones((1, 1), complex)),
        lambda file: a_dataset(file, f"{METHOD}/drive", np.ones((3, 3), complex)),
        lambda file: an_entry(file, f"{METHOD}/drive", (0, 0), 7),
        lambda file: a_dataset(file, f"{METHOD}/pressure", np.ones((2, 3))),
        lambda file: an_entry(file, f"{METHOD}/pressure", (0, 0), -1),
        lambda file: a_dataset(file, f"{METHOD}/score", np.zeros(7)),
        lambda file: an_entry(file, f"{METHOD}/score", (0,), np.nan),
        lambda file: an_entry(file, f"{METHOD}/score", (0,), 2.0),  # the history's are below 1
        lambda file: a_dataset(file, f"{METHOD}/evaluations", [2.0, 2.0]),
        lambda file: a_dataset(file, f"{METHOD}/evaluations", [2, 2, 2]),
        lambda file: an_entry(file, f"{METHOD}/evaluations", (0,), 0),
        lambda file: an_entry(file, f"{METHOD}/evaluations", (0,), 3),  # the history has 2
        lambda file: a_dataset(file, f"{METHOD}/history", np.ones((3, 2))),
        lambda file: an_entry(file, f"{METHOD}/history", (0, 0), 2.0),
        lambda file: a_dataset(file, f"{METHOD}/seconds", np.ones(3)),
        lambda file: an_entry(file, f"{METHOD}/seconds", (0,), -1.0),
        lambda file: a_dataset(file, f"{METHOD}/mean", np.ones(3)),
        lambda file: an_entry(file, f"{METHOD}/std", (1,), np.nan),
        lambda file: a_dataset(file, "scenes/two_cubes/methods/lssg/area", np.ones(2)),
        lambda file: a_dataset(file, "scenes/two_cubes/methods/lssg/plane_pressure", np.ones(2, complex)),
        lambda file: an_entry(file, "scenes/two_cubes/methods/lssg/plane_pressure", (0, 0), np.nan),
        lambda file: of_another_file(file, "scenes/empty/transfer_matrix"),
        lambda file: a_dataset(
            file, "scenes/empty/transfer_matrix", h5py.SoftLink("/scenes/two_cubes/transfer_matrix")
        ),
        lambda file: a_dataset(file, "scenes/empty", h5py.SoftLink("/scenes/two_cubes")),
        lambda file: a_dataset(file, "scenes/empty/methods", h5py.SoftLink("/scenes/two_cubes/methods")),
        lambda file: a_dataset(file, "scenes/empty/runs", h5py.SoftLink("/scenes/two_cubes/runs")),
    ],
)
def test_a_file_of_other_content_is_refused_in_one_line(
    results: StudyResult, tmp_path: Path, change: Callable[[h5py.File], object]
) -> None:
    path = tmp_path / RESULTS_FILE
    save_results(results, tmp_path)
    with h5py.File(path, "r+") as file:
        change(file)
    with_checksum(path)
    with pytest.raises(ValueError, match=rf"^.*{RESULTS_FILE}: .*; must be a results file of .*$"):
        load_results(path)


@pytest.mark.parametrize("side", [10**6, 10**3])
def test_a_small_file_that_claims_to_hold_much_is_refused_before_it_is_read(
    results: StudyResult, tmp_path: Path, side: int
) -> None:
    path = tmp_path / RESULTS_FILE
    save_results(results, tmp_path)
    with h5py.File(path, "r+") as file:
        for name in ("transfer_matrix", "runs/seconds", "methods/gabs/score"):
            del file["scenes/empty"][name]
            file["scenes/empty"].create_dataset(name, (side, side), "c16", chunks=(100, 100))
    with_checksum(path)
    with pytest.raises(ValueError, match=rf"{16 * side * side} bytes; must be at most \d+"):
        load_results(path)


def test_only_the_date_may_differ_between_results_of_the_same_origin(results: StudyResult) -> None:
    first = results.provenance
    assert first.same_origin(dataclasses.replace(first, date="2027-01-01T00:00:00"))
    for other in ({"config": "x"}, {"seed": 4}, {"source_digest": "x"}, {"versions": {"autdtorch": "1"}}):
        assert not first.same_origin(dataclasses.replace(first, **other))


def test_the_provenance_of_now_names_what_computes() -> None:
    provenance = provenance_now("a: 1\n", 5)
    packages = {"torch", "numpy", "scipy", "libigl", "numba"}
    extras = {"triton"}  # named where it is installed
    assert set(provenance.versions) - extras == {"autdtorch", "python", "platform"} | packages
    assert provenance.same_origin(provenance_now("a: 1\n", 5))
    assert provenance.date.endswith("+00:00")


def test_what_is_not_there_or_not_complete_is_refused_by_name(results: StudyResult, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=RESULTS_FILE):
        load_results(tmp_path)
    save_results(results, tmp_path)
    content = (tmp_path / RESULTS_FILE).read_bytes()
    for wrong in (content[: len(content) // 2], b"", b"text"):
        (tmp_path / RESULTS_FILE).write_bytes(wrong)
        with pytest.raises(ValueError, match=rf"{RESULTS_FILE}: .*must be a results file"):
            load_results(tmp_path)
