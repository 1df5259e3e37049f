"""What a log is refused for, and what is done to its file."""

import errno
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from filelock import FileLock, Timeout

from autdtorch.hardware import EmulatedSensor, LogError


def full_on(rows: int = 1) -> torch.Tensor:
    return torch.ones(rows, 16, dtype=torch.complex128)


@pytest.mark.parametrize("failing", ["write", "fsync"])
def test_a_full_disk_leaves_no_half_line_to_go_on_after(trial, monkeypatch, failing: str):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    def observe() -> None:
        objective(full_on())

    bench = trial.bench()
    with trial.link(bench) as link:
        objective = trial.objective(link, EmulatedSensor(bench))
        objective(full_on())
        whole = trial.log.read_bytes()
        with monkeypatch.context() as context:
            if failing == "fsync":
                context.setattr("os.fsync", full)
                with pytest.raises(OSError, match=r"No space left on device: .*trial\.jsonl"):
                    observe()
            else:
                resource = pytest.importorskip("resource", reason="limits of processes are POSIX's")
                most = resource.getrlimit(resource.RLIMIT_FSIZE)
                before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                resource.setrlimit(resource.RLIMIT_FSIZE, (len(whole) + 10, most[1]))  # ten bytes are left
                try:
                    with pytest.raises(OSError, match=r"File too large: .*trial\.jsonl"):
                        observe()
                finally:
                    resource.setrlimit(resource.RLIMIT_FSIZE, most)
                    signal.signal(signal.SIGXFSZ, before)
        assert trial.log.read_bytes() == whole
        observe()  # out of the log
        observe()
    assert trial.log.read_bytes().count(b"\n") == 1 + 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda log: log.replace('"seed": 1', '"seed": 2'), "of another trial, whose seed is 2, not 1"),
        (lambda log: log.replace("SonicSurface", "OpenMPD"), "whose device is OpenMPD, not SonicSurface"),
        (lambda log: log.replace('"scene": "', '"scene": "x'), "of another trial, whose scene is x"),
        (lambda log: "time,drive\n1,2\n", "must be the log of a hardware trial"),
        (lambda log: log + "{}\n" + log, "must be the log of a hardware trial"),
    ],
)
def test_the_log_of_another_trial_is_refused(trial, change, message: str):
    bench = trial.bench()
    with trial.link(bench) as link:
        trial.objective(link, EmulatedSensor(bench), seed=1)(full_on())
        trial.log.write_text(change(trial.log.read_text()))
        with pytest.raises(ValueError, match=message):
            trial.objective(link, EmulatedSensor(bench), seed=1)


def test_a_log_of_other_drives_is_refused(trial):
    bench = trial.bench()
    with trial.link(bench) as link:
        trial.objective(link, EmulatedSensor(bench))(full_on())
        with pytest.raises(ValueError, match="evaluation 1 is of another drive"):
            trial.objective(link, EmulatedSensor(bench))(0.5 * full_on())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pressure": [1.0, float("nan")]}, "pressure"),
        ({"pressure": [1.0, float("inf")]}, "pressure"),
        ({"pressure": [1.0, -1.0]}, r"pressure: .* must be 2 numbers >= 0"),
        ({"pressure": [1.0]}, r"must be 2 numbers >= 0"),
        ({"drive": [[1.0, 0.0]] * 15}, r"drive: shape \(15,\)"),
        ({"drive": [[1.0, 0.0]] * 15 + [[1.0, 1.0]]}, r"every \|q\| must be in \[0, 1\]"),
        ({"drive": [1.0] * 16}, ""),
        ({"seconds_on": -1.0}, "seconds_on"),
        ({"time": "noon"}, "noon"),
    ],
)
def test_a_line_that_cannot_have_been_measured_is_refused_by_its_number(trial, change, message: str):
    bench = trial.bench()
    with trial.link(bench) as link:
        trial.objective(link, EmulatedSensor(bench))(full_on(2))
        *lines, last = trial.log.read_text().splitlines()
        trial.log.write_text("\n".join([*lines, json.dumps(json.loads(last) | change), ""]))
        with pytest.raises(LogError, match=rf"trial\.jsonl, line 3: .*{message}"):
            trial.objective(link, EmulatedSensor(bench))


@pytest.mark.parametrize(
    "content",
    [
        "a week's notes",
        '{"origin": "Kyoto"}\n',
        '{"origin": {}}\n{"notes": 1}\n',
        "notes\n",
        '{"origin": {"a',
    ],
)
def test_a_file_that_is_no_log_is_refused_and_left_as_it_is(trial, content: str):
    trial.log.write_text(content)
    bench = trial.bench()
    with trial.link(bench) as link, pytest.raises(LogError, match=r"trial\.jsonl.* trial"):
        trial.objective(link, EmulatedSensor(bench))
    assert trial.log.read_text() == content


@pytest.mark.parametrize("ended", [True, False])
def test_a_log_without_evaluations_is_begun_anew_by_other_settings(trial, ended: bool):
    bench = trial.bench()
    with trial.link(bench) as link:
        first = trial.objective(link, EmulatedSensor(bench), seed=1)
        if ended:
            first.log.end(seconds_on=1.0)
        second = trial.objective(link, EmulatedSensor(bench), seed=2)
        second(full_on())
        assert second.log.seconds_on < 1
        assert len(trial.objective(link, EmulatedSensor(bench), seed=2).log.evaluations) == 1


def test_another_trial_is_named_by_what_was_said_first(trial):
    bench = trial.bench()
    with trial.link(bench) as link:
        trial.objective(link, EmulatedSensor(bench), microphone="scope", captures=4)(full_on())
        with pytest.raises(LogError, match="whose microphone is scope, not file"):
            trial.objective(link, EmulatedSensor(bench), microphone="file")
        with pytest.raises(LogError, match="whose captures is 4, not None"):
            trial.objective(link, EmulatedSensor(bench), microphone="scope")


def test_an_objective_that_failed_begins_again_with_what_the_log_holds(trial):
    class Interrupted(EmulatedSensor):
        def read(self):
            heard.append(None)
            if len(heard) == 3:
                raise KeyboardInterrupt
            return super().read()

    heard: list[None] = []
    bench = trial.bench()
    drives = torch.linspace(0.5, 1, 4)[:, None] * full_on()
    with trial.link(bench) as link:
        objective = trial.objective(link, Interrupted(bench))
        with pytest.raises(KeyboardInterrupt):
            objective(drives)
        pressure = objective(drives)
        assert len(heard) == 4 + 1
        assert torch.equal(trial.objective(link, EmulatedSensor(bench))(drives), pressure)
    assert trial.log.read_bytes().count(b"\n") == 1 + 4


def test_of_two_objectives_on_one_log_the_second_to_measure_is_refused(trial):
    bench = trial.bench()
    with trial.link(bench) as link:
        one, other = (trial.objective(link, EmulatedSensor(bench)) for _ in range(2))
        one(full_on())
        whole = trial.log.read_bytes()
        with pytest.raises(LogError, match="has changed meanwhile"):
            other(full_on())
        assert trial.log.read_bytes() == whole


LOCKING = """
import sys
from filelock import FileLock
with FileLock(sys.argv[1]):
    print(flush=True)
    sys.stdin.read()
"""


def lock_of(log: Path) -> Path:
    return log.with_name(f".{log.name}.lock")


def test_a_log_is_open_in_one_process_alone_and_free_once_it_is_killed(trial):
    other = subprocess.Popen(
        [sys.executable, "-c", LOCKING, lock_of(trial.log)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    with other:
        other.stdout.readline()
        bench = trial.bench()
        with trial.link(bench) as link:
            with pytest.raises(LogError, match="another process has it open for a trial"):
                trial.objective(link, EmulatedSensor(bench))
            assert not trial.log.exists()
            other.kill()
            other.wait()
            trial.objective(link, EmulatedSensor(bench))(full_on())


def test_a_log_is_free_once_it_has_ended_or_its_objective_is_gone(trial):
    def is_free() -> bool:
        try:
            with stranger.acquire(timeout=0):
                return True
        except Timeout:
            return False

    bench = trial.bench()
    stranger = FileLock(lock_of(trial.log))  # as another process has it
    with trial.link(bench) as link:
        ended = trial.objective(link, EmulatedSensor(bench))
        ended.log.end(seconds_on=0.0)
        assert is_free()
        gone = trial.objective(link, EmulatedSensor(bench))
        assert not is_free()
        del gone
        assert is_free()
