"""Long work has a forecast."""

from __future__ import annotations

import logging

import pytest
from small_scenes import small_scene

import autdtorch as at
from autdtorch.utils import progress


class Clock:
    """A clock that the test moves."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(progress, "time", made)
    return made


def told(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.name == progress.__name__]


def test_the_forecast_goes_by_what_the_last_steps_took(
    clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    with progress.show_progress(11, "simulating") as shown:
        clock.now += 20  # kernels are compiled, which happens once
        shown.advance(1)
        clock.now += 4
        shown.advance(2)
        assert told(caplog) == ["simulating: 24 s so far, about 16 s left"]


def test_short_work_says_nothing(clock: Clock, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    with progress.show_progress(10, "simulating") as shown:
        for _ in range(10):
            clock.now += 0.2
            shown.advance(1)
    assert told(caplog) == []


def test_there_are_ever_fewer_lines(clock: Clock, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    with progress.show_progress(3600, "simulating") as shown:
        for _ in range(3599):
            clock.now += 1
            shown.advance(1)
    assert 3 <= len(told(caplog)) <= 7  # after 3 s, and whenever it has taken four times as long


class SlowClock(Clock):
    """A clock that moves by two seconds at each reading."""

    def monotonic(self) -> float:
        self.now += 2.0
        return self.now


def test_a_single_simulation_has_a_forecast(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(progress, "time", SlowClock())
    at.make_propagator(small_scene(), "full", 2e-3, cache=False).transfer_matrix()
    lines = told(caplog)
    assert lines
    assert lines[0].startswith("simulating scene: ")
    assert lines[0].endswith(" s left")
