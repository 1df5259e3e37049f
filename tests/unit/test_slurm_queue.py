"""The watcher of a sweep's jobs reads the answers of `squeue`, and notices failures."""

import logging

import pytest

pytest.importorskip("submitit")

from autdtorch.cli import slurm
from autdtorch.cli.slurm import QueueWatcher


@pytest.fixture
def squeue(tmp_path, monkeypatch):
    """Puts a shell script in the place of `squeue`; there is none before."""
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(slurm, "_PAUSE", (0.0, 0.0))

    def install(script):
        (tmp_path / "squeue").write_text(f"#!/bin/sh\n{script}\n", encoding="utf-8")
        (tmp_path / "squeue").chmod(0o755)

    return install


@pytest.fixture
def watcher():
    watcher = QueueWatcher("logs/%j")
    watcher.register_job("7_0")
    return watcher


def answering(*rows):
    """A script that fills each row into the format that it is given, as `squeue` does."""
    lines = ['for format; do case "$format" in --format=*) format=${format#--format=};; esac; done']
    for row in rows:
        lines.append("line=$format")
        for field, value in zip(("%F", "%T", "%r"), row, strict=True):
            lines.append(f'line="${{line%%{field}*}}{value}${{line#*{field}}}"')
        lines.append('echo "$line"')
    return "\n".join(lines)


def test_a_job_without_a_reason_is_in_the_queue(squeue, watcher):
    squeue(answering(("7", "RUNNING", ""), ("8", "PENDING", "Priority")))
    assert not watcher.is_done("7_0")
    squeue(answering(("8", "PENDING", "")))
    assert watcher.is_done("7_0")


def test_why_jobs_wait_is_told_with_all_words_of_the_reason(squeue, watcher, caplog):
    squeue(answering(("7", "PENDING", "ReqNodeNotAvail, Reserved | for maintenance")))
    with caplog.at_level(logging.INFO):
        assert not watcher.is_done("7_0")
    assert caplog.messages == ["jobs wait in the queue: ReqNodeNotAvail, Reserved | for maintenance"]


REFUSE = "echo 'slurm_load_jobs error:' >&2\necho 'no controller' >&2\nexit 1"


@pytest.mark.parametrize(
    ("script", "reason"),
    [(None, "No such file or directory: 'squeue'"), (REFUSE, "error: no controller")],
    ids=["missing", "refused"],
)
def test_a_squeue_that_fails_for_good_ends_the_wait_in_a_line_that_says_what_to_do(
    squeue, watcher, caplog, script, reason
):
    if script is not None:
        squeue(script)
    with caplog.at_level(logging.INFO):
        for _ in range(slurm._MOST_FAILURES - 1):
            assert not watcher.is_done("7_0")
    (told,) = caplog.messages
    assert reason in told
    with pytest.raises(OSError, match=rf"{reason}.* jobs 7 may still run; .* the same command") as caught:
        watcher.is_done("7_0")
    assert "\n" not in str(caught.value) + told


def test_failures_are_counted_anew_after_an_answer(squeue, watcher):
    for _ in range(2):
        squeue("exit 1")
        for _ in range(slurm._MOST_FAILURES - 1):
            assert not watcher.is_done("7_0")
        squeue(answering(("7", "RUNNING", "None")))
        assert not watcher.is_done("7_0")
