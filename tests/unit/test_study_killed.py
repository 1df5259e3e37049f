"""Killed at any moment, a study goes on where it was and ends with the same numbers."""

import os
import signal
from unittest.mock import Mock

import pytest
import slow_study
import torch
from checks.kills import SUBJECTS, wait
from filelock import FileLock
from small_scenes import small_scene

from autdtorch.methods.functions import gabs
from autdtorch.study.run import run_study

STUDY = SUBJECTS["study"]


@pytest.mark.skipif(os.name != "posix", reason="SIGKILL is of POSIX")
def test_killed_again_and_again_a_study_ends_with_the_same_numbers(tmp_path, monkeypatch):
    folders = calm, killed = tmp_path / "calm", tmp_path / "killed"
    for folder in folders:
        folder.mkdir()

    def finish(folder):
        """Run the study in this process, which has imported PyTorch; it need not be slow."""
        with monkeypatch.context() as patched:
            patched.setattr("sys.argv", ["slow_study.py", str(folder / "out")])
            patched.setattr("autdtorch.study.run.BLOCK", 1)  # the study sets it, too
            patched.setattr("slow_study.time", Mock())
            slow_study.main()

    finish(calm)
    undisturbed = STUDY.numbers(calm)
    for trials in (2, 8):  # in the midst of either scene
        process = STUDY.start(killed)
        wait(lambda trials=trials: STUDY.lines(killed) >= trials, process)
        process.kill()
        assert process.wait() == -signal.SIGKILL
    assert STUDY.lines(killed) < 12
    finish(killed)
    resumed = STUDY.numbers(killed)
    assert len(resumed) == len(undisturbed) > 0
    assert all(map(torch.equal, resumed, undisturbed))
    # Nothing is done twice: a line a trial.
    assert STUDY.lines(killed) == STUDY.lines(calm) == 12


def test_a_second_process_on_the_same_folder_is_refused(tmp_path):
    with FileLock(tmp_path / ".lock"), pytest.raises(ValueError, match="another process writes there"):
        run_study({"a": small_scene()}, {"gabs": gabs}, solver={"method": "free_space"}, folder=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]
    results = run_study({"a": small_scene()}, {"gabs": gabs}, folder=tmp_path, config="a: 1")
    assert list(results.scenes) == ["a"]
