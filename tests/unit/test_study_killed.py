"""Killed at any moment, a study goes on where it was and ends with the same numbers."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from filelock import FileLock
from small_scenes import small_scene

from autdtorch.optim.gabs import gabs
from autdtorch.results import StudyResult, load_results
from autdtorch.study import run_study
from autdtorch.trial_file import TRIALS_FILE

STUDY = Path(__file__).parent.parent / "slow_study.py"


def start(folder: Path) -> subprocess.Popen[str]:
    process = subprocess.Popen(  # forked nowhere: Numba's threads do not survive it
        [sys.executable, str(STUDY), str(folder)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def finish(process: subprocess.Popen[str]) -> None:
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors


def lines(folder: Path) -> int:
    path = folder / TRIALS_FILE
    return path.read_bytes().count(b"\n") if path.exists() else 0


def assert_same_numbers(one: StudyResult, other: StudyResult) -> None:
    assert list(one.scenes) == list(other.scenes)
    for name, scene in one.scenes.items():
        twin = other.scenes[name]
        assert torch.equal(scene.transfer_matrix, twin.transfer_matrix)
        assert list(scene.methods) == list(twin.methods)
        for method, result in scene.methods.items():
            solution, same = result.solution, twin.methods[method].solution
            for key in ("drive", "pressure", "score", "evaluations", "history"):
                assert torch.equal(getattr(solution, key), getattr(same, key))
            assert torch.equal(result.plane_pressure, twin.methods[method].plane_pressure)
            assert torch.equal(result.metrics.area, twin.methods[method].metrics.area)


@pytest.mark.skipif(os.name != "posix", reason="SIGKILL is of POSIX")
def test_killed_again_and_again_a_study_ends_with_the_same_numbers(tmp_path: Path) -> None:
    calm, killed = tmp_path / "calm", tmp_path / "killed"
    calm.mkdir()
    finish(start(calm))
    for trials in (2, 8):  # in the midst of either scene
        process = start(killed)
        deadline = time.monotonic() + 60
        while lines(killed) < trials and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert process.returncode == -signal.SIGKILL
    assert lines(killed) < 12
    finish(start(killed))
    assert_same_numbers(load_results(calm), load_results(killed))
    rows = [json.loads(line) for line in (killed / TRIALS_FILE).read_text(encoding="utf-8").splitlines()]
    # Nothing is done twice: a line a trial.
    assert len({(row["scene"], row["trial"]) for row in rows}) == len(rows) == 12


def test_a_second_process_on_the_same_folder_is_refused(tmp_path: Path) -> None:
    with FileLock(tmp_path / ".lock"), pytest.raises(ValueError, match="another process writes there"):
        run_study({"a": small_scene()}, {"gabs": gabs}, solver={"method": "free_space"}, folder=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]
    results = run_study({"a": small_scene()}, {"gabs": gabs}, folder=tmp_path, config="a: 1")
    assert list(results.scenes) == ["a"]
