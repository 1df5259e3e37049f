"""Finished trials come back bit for bit, and only what a method can have found in a scene of the study."""

import json

import pytest
import torch

from autdtorch.methods.base import NEAR_TIE
from autdtorch.methods.solution import Solution
from autdtorch.study.folder import TRIALS_FILE, TrialFile
from autdtorch.utils.files import SET_ASIDE, line_of, row_of

ORIGIN = "the study's"
SHAPES = {"a": (3, 2)}


def opened(path, seed=0):
    file = TrialFile(path, ORIGIN, seed, SHAPES)
    file.mend()
    return file


def found(trials, evaluations, seed=0):
    generator = torch.Generator().manual_seed(seed)
    drive = torch.randn(trials, 3, dtype=torch.complex128, generator=generator).sgn()
    pressure = torch.rand(trials, 2, dtype=torch.float64, generator=generator)
    history = torch.rand(trials, evaluations, dtype=torch.float64, generator=generator).cummax(dim=1).values
    score = history[:, -1].clone()
    return Solution(drive, pressure, score, torch.full((trials,), evaluations), history)


def assert_equal(one, other):
    for name in ("drive", "pressure", "score", "evaluations", "history"):
        assert torch.equal(getattr(one, name), getattr(other, name)), name


@pytest.fixture
def path(tmp_path):
    return tmp_path / TRIALS_FILE


def test_trials_come_back_bit_for_bit_in_their_order(path):
    solution = found(4, 5)
    order = torch.tensor([2, 0, 3, 1])
    parts = [order[:3], order[3:]]
    file = opened(path, 7)
    for part in parts:
        columns = [getattr(solution, name)[part] for name in ("drive", "pressure", "score", "evaluations")]
        file.append("a", "gabs", part.tolist(), Solution(*columns, solution.history[part]), 6.0)
    for read in (file, opened(path, 7)):
        assert read.missing("a", "gabs", 6) == [4, 5]
        assert read.missing("a", "lssg", 1) == [0]
        back, seconds = read.solution("a", "gabs", 4)
        assert_equal(back, solution)
        assert seconds.dtype == torch.float64
        assert seconds.tolist() == [2.0, 6.0, 2.0, 2.0]


def test_trials_that_ended_early_go_on_with_their_last_value(path):
    file = opened(path)
    file.append("a", "gabs", [0], found(1, 3), 1.0)
    file.append("a", "gabs", [1], found(1, 5, seed=1), 1.0)
    back, _ = opened(path).solution("a", "gabs", 2)
    assert back.evaluations.tolist() == [3, 5]
    assert back.history.shape == (2, 5)
    assert back.history[0, 3:].tolist() == [back.score[0].item()] * 2


def test_a_line_a_trial_with_its_figures(path):
    opened(path, 3).append("a", "lssg", [0], found(1, 2), 1.5)
    row = json.loads(path.read_text(encoding="utf-8"))
    weakest, strongest = sorted(row["pressure"])
    assert (row["scene"], row["method"], row["trial"], row["seed"]) == ("a", "lssg", 0, 3)
    assert (row["evaluations"], row["seconds"]) == (2, 1.5)
    assert row["min"] == weakest
    assert row["mean"] == pytest.approx((weakest + strongest) / 2, rel=1e-15)
    assert row["std"] == pytest.approx((strongest - weakest) / 2, rel=1e-12)
    assert row["score"] == row["history"][-1]


@pytest.fixture
def lines(path):
    opened(path).append("a", "gabs", range(3), found(3, 4), 3.0)
    return path.read_bytes().splitlines()


FIELDS = "scene", "method", "trial", "score", "evaluations", "seconds", "pressure", "drive", "history"
WRONG = {
    "drive": ([[7.0, 0.0]] + [[1.0, 0.0]] * 2, [[1.0, 0.0]] * 4, [1.0] * 3, [["1", "0"]] * 3),
    "pressure": ([1.0], [1.0, -1.0], [1.0, float("nan")]),
    "history": ([1.0] * 3, [1.0, 0.5, 1.0, 2.0], [10**400] * 4, 1.0),
    "score": (float("inf"), 10**400, 2.0),  # the history's are below 1
    "evaluations": (4.0,),
    "seconds": (-1.0, None),
    "trial": (-1, True, 0),  # 0 is there already
    "scene": ("b", ["a"]),
    "method": ({"a": 1},),
}
CHANGES = [{name: value} for name, values in WRONG.items() for value in values]


@pytest.mark.parametrize("change", [*CHANGES, *FIELDS], ids=str)
def test_a_row_that_no_method_can_have_written_does_not_count(path, lines, change):
    row = row_of(lines[1], ORIGIN)
    changed = (
        row | change if isinstance(change, dict) else {name: row[name] for name in row if name != change}
    )
    lines[1] = line_of(changed, ORIGIN)
    path.write_bytes(b"\n".join([*lines, b""]))
    file = opened(path)
    assert file.missing("a", "gabs", 3) == [1]
    assert len(file) == 2
    assert path.with_name(path.name + SET_ASIDE).read_bytes() == lines[1] + b"\n"


def test_the_trials_of_another_study_or_scene_do_not_count(path, lines, caplog):
    assert len(TrialFile(path, "another", 0, SHAPES)) == 0
    assert path.read_bytes().splitlines() == lines
    TrialFile(path, ORIGIN, 0, {"b": (3, 2)}).mend()
    assert caplog.messages[-1].endswith("scene: 'a'; must be one of this study: b")


@pytest.mark.parametrize("score", [0.5, 1 + NEAR_TIE / 2])
def test_a_last_drive_that_scored_below_the_best_or_near_it_comes_back(path, score):
    """`identify` returns such a drive."""
    solution = found(1, 4)
    solution.score[0] = score * solution.history[0, -1]
    opened(path).append("a", "identify", [0], solution, 1.0)
    assert_equal(opened(path).solution("a", "identify", 1)[0], solution)
