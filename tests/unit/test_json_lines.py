"""A line, or a trial of a study, comes back as it was written or not at all, and costs no other."""

import errno
import json
import os
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from autdtorch.methods.base import NEAR_TIE
from autdtorch.methods.solution import Solution
from autdtorch.study.folder import TRIALS_FILE, TrialFile
from autdtorch.utils.files import SET_ASIDE, JsonLines, line_of, row_of

ROWS = [{"number": 0, "text": "°\n"}, {"number": 1, "values": [0.1, -0.0, 5e-324]}, {"number": 2}]
HEAD = line_of({"origin": "here"}) + b"\n"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "rows.jsonl"


def read(path: Path, key: str = "key", head: bytes = b"") -> tuple[JsonLines, list[dict[str, Any]]]:
    rows: list[dict[str, Any]] = []
    return JsonLines(path, key, rows.append, head), rows


def written(path: Path, head: bytes = b"") -> bytes:
    lines, _ = read(path, head=head)
    lines.mend()
    for row in ROWS:
        lines.append(row)
    return path.read_bytes()


def full(*_: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("head", [b"", HEAD], ids=["no head", "head"])
def test_rows_come_back_and_others_follow(path: Path, head: bytes) -> None:
    content = written(path, head)
    lines, rows = read(path, head=head)
    assert rows == ROWS
    lines.mend()
    assert path.read_bytes() == content
    lines.append(*ROWS)
    assert read(path, head=head)[1] == ROWS + ROWS


def test_a_line_is_on_disk_when_append_returns(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[bytes] = []
    monkeypatch.setattr(os, "fsync", lambda _: synced.append(path.read_bytes()))
    lines, _ = read(path)
    for row in ROWS:
        lines.append(row)
        assert synced[-1] == path.read_bytes()
    assert len(synced) == len(ROWS)


def test_a_flipped_bit_anywhere_is_noticed_and_costs_the_lines_it_touches_alone(path: Path) -> None:
    content = written(path, HEAD)
    for place, byte in enumerate(content):
        flipped = content[:place] + bytes([byte ^ 1 << place % 8]) + content[place + 1 :]
        path.write_bytes(flipped)
        _, rows = read(path, head=HEAD)
        assert rows == [row for row in ROWS if line_of(row, "key") in flipped]
        assert len(rows) == len(ROWS) - (place >= len(HEAD) and byte != ord("\n"))


@given(
    cuts=st.lists(st.integers(0, 600), min_size=2, max_size=2),
    rubbish=st.one_of(
        st.binary(max_size=200),
        st.sampled_from([b"\n", b"\r\n", b"{}\n", b"\0" * 99, b"[" * 99_999 + b"\n", b'{"a": 1' + b"0" * 99]),
        st.integers(0, 2).map(lambda number: line_of(ROWS[number], "another key") + b"\n"),
    ),
)
def test_whatever_was_put_into_a_file_is_set_aside_once_and_the_whole_rows_are_used(
    tmp_path_factory: pytest.TempPathFactory, cuts: list[int], rubbish: bytes
) -> None:
    path = tmp_path_factory.mktemp("damage") / "rows.jsonl"
    content = written(path)
    begin, end = sorted(min(cut, len(content)) for cut in cuts)
    damaged = content[:begin] + rubbish + content[end:]
    path.write_bytes(damaged)
    lines, rows = read(path)
    used = [line_of(row, "key") for row in rows]
    assert used == re.findall(b"|".join(re.escape(line_of(row, "key")) for row in ROWS), damaged)
    assert path.read_bytes() == damaged
    lines.mend()
    aside = path.with_name(path.name + SET_ASIDE)
    refused = aside.read_bytes() if aside.exists() else b""
    kept = refused + b"".join(used)
    assert sorted(kept.replace(b"\n", b"")) == sorted(damaged.replace(b"\n", b""))
    lines.append(ROWS[0])
    lines, again = read(path)
    assert again == [*rows, ROWS[0]]
    content = path.read_bytes()
    lines.mend()
    assert path.read_bytes() == content


def test_damaged_lines_are_set_aside_with_a_log_line(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    first, second, third = written(path).splitlines(keepends=True)
    path.write_bytes(first + b"\xff" + second[1:] + third + first[:-2])
    lines, rows = read(path)
    assert rows == [ROWS[0], ROWS[2]]
    assert not caplog.messages
    lines.mend()
    assert path.read_bytes() == first + third
    assert path.with_name(path.name + SET_ASIDE).read_bytes() == b"\xff" + second[1:] + first[:-2] + b"\n"
    (told,) = caplog.messages
    assert "line 2 and 1 more: set aside" in told
    assert told.endswith(": its checksum is wrong; the last line broke off")
    caplog.clear()
    read(path)[0].mend()
    assert not caplog.messages


@pytest.mark.parametrize("head", [b"", HEAD], ids=["no head", "head"])
def test_the_end_of_a_line_costs_no_row(path: Path, head: bytes, caplog: pytest.LogCaptureFixture) -> None:
    """The end may be missing, another byte, or between other bytes."""
    content = written(path, head)
    aside = path.with_name(path.name + SET_ASIDE)
    for place in (place for place, byte in enumerate(content) if byte == ord("\n")):
        for end in (b"", b"\x0b", b"{", b'"', b"\0" * 8, b'{"torn": 1', b"\r\n", b"\n\n"):
            path.write_bytes(content[:place] + end + content[place + 1 :])
            caplog.clear()
            lines, rows = read(path, head=head)
            assert rows == ROWS
            lines.mend()
            assert path.read_bytes() == content
            debris = end.replace(b"\n", b"")
            assert len(caplog.messages) == 1
            assert not debris or debris in aside.read_bytes()


def test_whatever_is_in_a_line_it_takes_no_time_to_take_it_apart(path: Path) -> None:
    content = written(path)
    path.write_bytes(b'{"' * 200_000 + content.replace(b"\n", b"") + b'"}' * 200_000)
    assert read(path)[1] == ROWS


def test_lines_are_set_aside_on_disk_before_they_leave_the_file(path, monkeypatch, caplog):
    damaged = b"damaged\n" + written(path, HEAD)
    path.write_bytes(damaged)
    aside = path.with_name(path.name + SET_ASIDE)
    synced: list[tuple[bytes, bytes]] = []
    monkeypatch.setattr(os, "fsync", lambda _: synced.append((aside.read_bytes(), path.read_bytes())))
    read(path, head=HEAD)[0].mend()
    assert synced[0] == (b"damaged\n" + HEAD, damaged)
    assert "line 1 and 1 more" in caplog.text
    path.write_bytes(path.read_bytes().replace(HEAD, b"damaged\n"))
    read(path, head=HEAD)[0].mend()
    assert f"line 1: set aside in {aside}" in caplog.text
    assert read(path, head=HEAD)[1] == ROWS


def test_nothing_follows_half_a_line_or_is_lost_on_a_full_disk(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = written(path)
    lines, _ = read(path)
    with monkeypatch.context() as context:
        context.setattr(os, "fsync", full)
        with pytest.raises(OSError, match=r"No space left on device: '.*rows\.jsonl"):
            lines.append(ROWS[0])
    assert path.read_bytes() == content
    lines.append(ROWS[0])
    assert read(path)[1] == [*ROWS, ROWS[0]]
    path.unlink()
    damaged = b"damaged\n" + written(path)
    path.write_bytes(damaged)
    lines, _ = read(path)
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*rows\.jsonl"):
        lines.mend()
    assert path.read_bytes() == damaged
    monkeypatch.undo()
    read(path)[0].mend()
    assert read(path)[1] == ROWS


def test_a_row_that_its_reader_refuses_is_set_aside_with_the_reason(path, caplog):
    def use(row: dict[str, Any]) -> None:
        if row["number"] == 1:
            row["missing"]

    written(path)
    JsonLines(path, "key", use).mend()
    assert caplog.messages[0].endswith("it has no 'missing'")
    assert read(path)[1] == [ROWS[0], ROWS[2]]


def test_a_file_that_was_removed_or_changed_meanwhile_is_left_alone(path: Path) -> None:
    lines, other = read(path)[0], read(path)[0]
    other.append(ROWS[0])
    content = path.read_bytes()
    with pytest.raises(ValueError, match=r"rows\.jsonl: has changed meanwhile"):
        lines.append(ROWS[1])
    assert path.read_bytes() == content
    lines = read(path)[0]
    lines.append(ROWS[0])
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"rows\.jsonl"):
        lines.append(ROWS[1])
    assert not path.exists()


ORIGIN = "the study's"
SHAPES = {"a": (3, 2)}


def opened(trial_path, seed=0):
    file = TrialFile(trial_path, ORIGIN, seed, SHAPES)
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
def trial_path(tmp_path):
    return tmp_path / TRIALS_FILE


def test_trials_come_back_bit_for_bit_in_their_order(trial_path):
    solution = found(4, 5)
    order = torch.tensor([2, 0, 3, 1])
    parts = [order[:3], order[3:]]
    file = opened(trial_path, 7)
    for part in parts:
        columns = [getattr(solution, name)[part] for name in ("drive", "pressure", "score", "evaluations")]
        file.append("a", "gabs", part.tolist(), Solution(*columns, solution.history[part]), 6.0)
    for read in (file, opened(trial_path, 7)):
        assert read.missing("a", "gabs", 6) == [4, 5]
        assert read.missing("a", "lssg", 1) == [0]
        back, seconds = read.solution("a", "gabs", 4)
        assert_equal(back, solution)
        assert seconds.dtype == torch.float64
        assert seconds.tolist() == [2.0, 6.0, 2.0, 2.0]


def test_trials_that_ended_early_go_on_with_their_last_value(trial_path):
    file = opened(trial_path)
    file.append("a", "gabs", [0], found(1, 3), 1.0)
    file.append("a", "gabs", [1], found(1, 5, seed=1), 1.0)
    back, _ = opened(trial_path).solution("a", "gabs", 2)
    assert back.evaluations.tolist() == [3, 5]
    assert back.history.shape == (2, 5)
    assert back.history[0, 3:].tolist() == [back.score[0].item()] * 2


def test_a_line_a_trial_with_its_figures(trial_path):
    opened(trial_path, 3).append("a", "lssg", [0], found(1, 2), 1.5)
    row = json.loads(trial_path.read_text(encoding="utf-8"))
    weakest, strongest = sorted(row["pressure"])
    assert (row["scene"], row["method"], row["trial"], row["seed"]) == ("a", "lssg", 0, 3)
    assert (row["evaluations"], row["seconds"]) == (2, 1.5)
    assert row["min"] == weakest
    assert row["mean"] == pytest.approx((weakest + strongest) / 2, rel=1e-15)
    assert row["std"] == pytest.approx((strongest - weakest) / 2, rel=1e-12)
    assert row["score"] == row["history"][-1]


@pytest.fixture
def lines(trial_path):
    opened(trial_path).append("a", "gabs", range(3), found(3, 4), 3.0)
    return trial_path.read_bytes().splitlines()


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
def test_a_row_that_no_method_can_have_written_does_not_count(trial_path, lines, change):
    row = row_of(lines[1], ORIGIN)
    changed = (
        row | change if isinstance(change, dict) else {name: row[name] for name in row if name != change}
    )
    lines[1] = line_of(changed, ORIGIN)
    trial_path.write_bytes(b"\n".join([*lines, b""]))
    file = opened(trial_path)
    assert file.missing("a", "gabs", 3) == [1]
    assert len(file) == 2
    assert trial_path.with_name(trial_path.name + SET_ASIDE).read_bytes() == lines[1] + b"\n"


def test_the_trials_of_another_study_or_scene_do_not_count(trial_path, lines, caplog):
    assert len(TrialFile(trial_path, "another", 0, SHAPES)) == 0
    assert trial_path.read_bytes().splitlines() == lines
    TrialFile(trial_path, ORIGIN, 0, {"b": (3, 2)}).mend()
    assert caplog.messages[-1].endswith("scene: 'a'; must be one of this study: b")


@pytest.mark.parametrize("score", [0.5, 1 + NEAR_TIE / 2])
def test_a_last_drive_that_scored_below_the_best_or_near_it_comes_back(trial_path, score):
    """`identify` returns such a drive."""
    solution = found(1, 4)
    solution.score[0] = score * solution.history[0, -1]
    opened(trial_path).append("a", "identify", [0], solution, 1.0)
    assert_equal(opened(trial_path).solution("a", "identify", 1)[0], solution)
