"""What a study found comes back from disk as it was."""

import dataclasses
import errno
import os
from pathlib import Path

import pytest
import torch

from autdtorch.metrics import focus_metrics
from autdtorch.optim.base import Solution
from autdtorch.propagator import Run
from autdtorch.results import (
    PROVENANCE_FILE,
    RESULTS_FILE,
    MethodResult,
    Provenance,
    SceneResult,
    Simulation,
    StudyResult,
    load_provenance,
    load_results,
    provenance_now,
    save_provenance,
    save_results,
)

FREE_SPACE = Simulation("free_space", 8.5e-3, None, None, (), 0.25, 0.5)
FULL = Simulation(
    "full", 8.5e-3, 1e-3, 2e-3, (Run(183, 1.9e-3, True, 4.5), Run(600, 3e-2, False, 9.0)), 20.0, 80.0
)


def method_result(trials: int, plane: bool, seed: int) -> MethodResult:
    generator = torch.Generator().manual_seed(seed)
    drive = torch.randn(trials, 3, dtype=torch.complex128, generator=generator)
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
