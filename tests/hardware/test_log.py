"""Logs of trials: damage, locks, and refusals."""

from pathlib import Path

import pytest
import torch
from faulty_bus import Disturbed
from filelock import FileLock, Timeout

from autdtorch.hardware import EmulatedSensor, HardwareObjective, LogError
from autdtorch.utils.digest import digest_of
from autdtorch.utils.files import SET_ASIDE, line_of, row_of


def full_on(rows: int = 1) -> torch.Tensor:
    return torch.ones(rows, 16, dtype=torch.complex128)


@pytest.fixture
def bench(trial):
    return trial.bench()


@pytest.fixture
def begin(trial, bench):
    """Return a function that begins a trial on the bench, or takes its log up."""
    with trial.link(bench) as link:
        yield lambda sensor=None, **settings: trial.objective(
            link, sensor or EmulatedSensor(bench), **settings
        )


def continued(objective: HardwareObjective, drives: torch.Tensor, number: int = 0) -> torch.Tensor:
    """Observe drives as evaluations from a number on, as an interrupted method that goes on."""
    with objective.continued(number):
        return objective(drives)


SCOPE = {"microphone": "scope", "captures": 4}


@pytest.mark.parametrize(
    ("logged", "settings", "message"),
    [
        ({"seed": 2}, {"seed": 1}, "of another trial, whose seed is 2, not 1"),
        ({"seed": 1.0}, {"seed": 1}, r"whose seed is 1\.0, not 1;"),
        ({"seed": True}, {"seed": 1}, "whose seed is True, not 1;"),
        ({"seed": 1, "failed": []}, {"seed": 1}, r"whose failed is \[\], not absent"),
        ({"seed": 1, "failed": None}, {"seed": 1}, "whose failed is None, not absent"),
        ({}, {"seed": 1}, "whose seed is absent, not 1"),
        (SCOPE, {"microphone": "file"}, "whose microphone is scope, not file"),  # the first that differs
        (SCOPE, {"microphone": "scope"}, "whose captures is 4, not absent"),
        (SCOPE, dict(reversed(SCOPE.items())), "settings come in another order: .*microphone, captures;"),
    ],
)
def test_the_log_of_another_trial_is_refused_and_left_as_it_is(trial, begin, logged, settings, message: str):
    begin(**logged)(full_on())
    content = trial.log.read_bytes()
    with pytest.raises(LogError, match=message):
        begin(**settings)
    assert trial.log.read_bytes() == content


def drives() -> torch.Tensor:
    return torch.linspace(0.5, 1, 6)[:, None] * full_on()


class Noisy(Disturbed):
    """Its readings are all different."""

    def read(self) -> torch.Tensor:
        return super().read() + self.readings


@pytest.mark.parametrize(
    "change",
    [
        {"pressure": [1.0, float("nan")]},
        {"pressure": [1.0, -1.0]},
        {"pressure": [1.0]},
        {"drive": [[1.0, 0.0]] * 15},
        {"drive": [[1.0, 0.0]] * 15 + [[1.0, 1.0]]},
        {"seconds_on": -1.0},
        {"seconds_on": 10**400},
        {"time": "noon"},
        {"time": 12},
        {"evaluation": -1},
        {"evaluation": 2.0},
    ],
)
def test_an_evaluation_that_cannot_have_been_measured_is_measured_again(trial, bench, begin, change):
    continued(begin(), drives())
    key = digest_of(begin().log.origin)
    lines = trial.log.read_bytes().splitlines()
    whole, lines[3] = lines[3], line_of(row_of(lines[3], key) | change, key)
    trial.log.write_bytes(b"\n".join([*lines, b""]))
    sensor = Noisy(bench)
    continued(begin(sensor), drives())
    assert sensor.readings == 1
    assert trial.log.with_name(trial.log.name + SET_ASIDE).read_bytes() == lines[3] + b"\n"
    again = row_of(trial.log.read_bytes().splitlines()[-1], key)
    assert again["evaluation"] == row_of(whole, key)["evaluation"]


@pytest.mark.parametrize(
    "damage",
    [
        lambda lines: lines[1:],  # the first line says what the trial is
        lambda lines: [lines[3], *lines[1:3], lines[0], *lines[4:]],
        lambda lines: [*lines[:3], b"\0" * 99, *lines[4:]],
        lambda lines: [*lines[:3], lines[5], lines[4], lines[3], *lines[6:]],
        lambda lines: [*lines, *lines],
    ],
)
def test_damage_costs_the_evaluations_it_touches_alone(trial, bench, begin, damage, caplog):
    measured = continued(begin(), drives())
    lines = trial.log.read_bytes().splitlines()
    damaged = damage(lines)
    trial.log.write_bytes(b"\n".join([*damaged, b""]))
    sensor = Noisy(bench)
    again = continued(begin(sensor), drives())
    assert sensor.readings == len(set(lines[1:]) - set(damaged))
    same = (again == measured).all(dim=1)
    assert int(same.sum()) == len(set(lines[1:]) & set(damaged))
    caplog.clear()
    assert torch.equal(continued(begin(sensor), drives()), again)
    assert not caplog.messages
    with pytest.raises(LogError, match="evaluation 1 is of another drive"):
        continued(begin(sensor), 0.5 * drives())


def test_where_a_reading_made_again_leads_elsewhere_the_trial_follows_it(trial, bench, begin):
    others = drives()
    others[4:] *= 0.5
    continued(begin(), drives())
    lines = trial.log.read_bytes().splitlines(keepends=True)
    trial.log.write_bytes(b"".join([*lines[:3], *lines[4:]]))
    sensor = Noisy(bench)
    objective = begin(sensor)
    pressure = [continued(objective, others[:4]), continued(objective, others[4:], 4)]
    assert sensor.readings == 1 + 2
    assert torch.equal(continued(begin(sensor), others), torch.cat(pressure))
    assert sensor.readings == 1 + 2


@pytest.mark.parametrize(
    "content",
    [
        b"a week's notes",
        b'{"origin": "Kyoto"}\n',
        line_of({"origin": "Kyoto"}) + b'\n{"evaluation": 0}\n',  # with a digest
        b'{"origin": {}}\n{"notes": 1}\n',
        b'{"origin": {"a',
        b"[" * 10**6 + b"\n",
    ],
)
def test_a_file_that_is_no_log_is_refused_and_left_as_it_is(trial, begin, content: bytes):
    trial.log.write_bytes(content)
    with pytest.raises(LogError, match=r"trial\.jsonl.* trial"):
        begin()
    assert trial.log.read_bytes() == content


@pytest.mark.parametrize("ended", [True, False])
def test_a_log_without_evaluations_is_begun_anew_by_other_settings(trial, begin, ended: bool, caplog):
    first = begin(seed=1)
    assert not first.log.goes_on
    assert begin(seed=1).log.goes_on  # as if killed before its first evaluation
    if ended:
        first.log.end(seconds_on=1.0)
    second = begin(seed=2)
    assert not second.log.goes_on
    second(full_on())
    assert second.log.seconds_on < 1
    assert len(begin(seed=2).log.evaluations) == 1
    assert not caplog.messages
    assert [path.name for path in trial.log.parent.iterdir() if path.suffix == SET_ASIDE] == []


def test_an_objective_that_failed_goes_on_where_its_log_ends(trial, bench, begin):
    def interrupt(reading: int) -> None:
        if reading == 3:
            raise KeyboardInterrupt

    sensor = Noisy(bench, interrupt)
    objective = begin(sensor)
    with pytest.raises(KeyboardInterrupt):
        objective(drives())
    pressure = continued(objective, drives())
    assert sensor.readings == 6 + 1
    assert torch.equal(continued(begin(), drives()), pressure)
    assert trial.log.read_bytes().count(b"\n") == 1 + 6


def lock_of(log: Path) -> Path:
    return log.with_name(f".{log.name}.lock")


def test_a_log_is_open_in_one_process_alone(trial, begin):
    with FileLock(lock_of(trial.log)), pytest.raises(LogError, match="another process has it open for a tri"):
        begin()
    assert not trial.log.exists()
    begin()(full_on())


def test_a_log_is_free_once_it_has_ended_or_its_objective_is_gone(trial, begin):
    def is_free() -> bool:
        try:
            with stranger.acquire(timeout=0):
                return True
        except Timeout:
            return False

    stranger = FileLock(lock_of(trial.log))  # as another process has it
    ended = begin()
    ended.log.end(seconds_on=0.0)
    assert is_free()
    gone = begin()
    assert not is_free()
    del gone
    assert is_free()
