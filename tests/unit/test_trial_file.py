"""Finished trials come back bit for bit, whatever a killed process left at the end of the file."""

import json
from pathlib import Path

import pytest
import torch

from autdtorch.optim.base import Solution
from autdtorch.trial_file import TRIALS_FILE, TrialFile


def found(trials: int, evaluations: int, seed: int = 0) -> Solution:
    generator = torch.Generator().manual_seed(seed)
    drive = torch.randn(trials, 3, dtype=torch.complex128, generator=generator)
    pressure = torch.rand(trials, 2, dtype=torch.float64, generator=generator)
    history = torch.rand(trials, evaluations, dtype=torch.float64, generator=generator).cummax(dim=1).values
    score = history[:, -1].clone()
    return Solution(drive, pressure, score, torch.full((trials,), evaluations), history)


def assert_equal(one: Solution, other: Solution) -> None:
    for name in ("drive", "pressure", "score", "evaluations", "history"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / TRIALS_FILE


def test_trials_come_back_bit_for_bit_in_their_order(path: Path) -> None:
    solution = found(4, 5)
    order = torch.tensor([2, 0, 3, 1])
    parts = [order[:3], order[3:]]
    file = TrialFile(path, 7)
    for part in parts:
        columns = [getattr(solution, name)[part] for name in ("drive", "pressure", "score", "evaluations")]
        file.append("a", "gabs", part.tolist(), Solution(*columns, solution.history[part]), 6.0)
    for read in (file, TrialFile(path, 7)):
        assert read.missing("a", "gabs", 6) == [4, 5]
        assert read.missing("a", "lssg", 1) == [0]
        back, seconds = read.found("a", "gabs", 4)
        assert_equal(back, solution)
        assert seconds.dtype == torch.float64
        assert seconds.tolist() == [2.0, 6.0, 2.0, 2.0]


def test_trials_that_ended_early_go_on_with_their_last_value(path: Path) -> None:
    file = TrialFile(path, 0)
    file.append("a", "gabs", [0], found(1, 3), 1.0)
    file.append("a", "gabs", [1], found(1, 5, seed=1), 1.0)
    back, _ = TrialFile(path, 0).found("a", "gabs", 2)
    assert back.evaluations.tolist() == [3, 5]
    assert back.history.shape == (2, 5)
    assert back.history[0, 3:].tolist() == [back.score[0].item()] * 2


def test_a_line_a_trial_with_its_figures(path: Path) -> None:
    TrialFile(path, 3).append("two_cubes", "lssg", [0], found(1, 2), 1.5)
    row = json.loads(path.read_text(encoding="utf-8"))
    weakest, strongest = sorted(row["pressure"])
    assert (row["scene"], row["method"], row["trial"], row["seed"]) == ("two_cubes", "lssg", 0, 3)
    assert (row["evaluations"], row["seconds"]) == (2, 1.5)
    assert row["min"] == weakest
    assert row["mean"] == pytest.approx((weakest + strongest) / 2, rel=1e-15)
    assert row["std"] == pytest.approx((strongest - weakest) / 2, rel=1e-12)
    assert row["score"] == row["history"][-1]


def test_whatever_is_cut_off_costs_no_earlier_trial(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = TrialFile(path, 0)
    for trial in range(3):
        file.append("a", "gabs", [trial], found(1, 2, seed=trial), 1.0)
    content = path.read_bytes()
    first, second = (content.index(b"\n") + 1, content.rindex(b"\n", 0, -1) + 1)
    for length in (first, first + 1, (first + second) // 2, second - 1, second, len(content) - 1):
        path.write_bytes(content[:length])
        complete = content[:length].count(b"\n")
        file = TrialFile(path, 0)
        assert file.missing("a", "gabs", 3) == list(range(complete, 3))
        for trial in file.missing("a", "gabs", 3):
            file.append("a", "gabs", [trial], found(1, 2, seed=trial), 1.0)
        assert path.read_bytes() == content
    assert "is not complete: cut off there" in caplog.text


def test_without_a_path_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    file = TrialFile(None, 0)
    solution = found(2, 2)
    file.append("a", "gabs", [0, 1], solution, 1.0)
    assert_equal(file.found("a", "gabs", 2)[0], solution)
    assert list(tmp_path.iterdir()) == []
