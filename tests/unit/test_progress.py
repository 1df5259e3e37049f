"""Long work has a forecast."""

import functools
import io
import itertools
import logging
import re
import sys

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scenes import CUBE, small_scene

import autdtorch as at
from autdtorch.utils import progress


class Clock:
    """A clock that the test moves, or that moves by itself at each reading."""

    def __init__(self, step: float = 0.0) -> None:
        self.now, self.step = 100.0, step

    def monotonic(self) -> float:
        self.now += self.step
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(progress, "time", made)
    return made


def told(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.name == progress.__name__]


def lines_of(clock, caplog, steps, work):
    caplog.set_level(logging.INFO)
    with progress.show_progress(steps, "simulating") as shown:
        for seconds, done in work:
            clock.now += seconds
            shown.advance(done)
    return told(caplog)


def test_the_forecast_goes_by_what_the_last_steps_took(clock, caplog):
    # kernels are compiled in the first 20 s, which happens once
    assert lines_of(clock, caplog, 11, [(20, 1), (4, 2)]) == ["simulating: 24 s so far, about 16 s left"]


def test_work_that_ends_soon_has_no_forecast(clock, caplog):
    # after a compilation of 20 s, steps of a millisecond
    assert lines_of(clock, caplog, 100, [(20, 1), *[(1e-3, 1)] * 98]) == []


def test_short_work_says_nothing_and_long_work_ever_less(clock, caplog):
    assert lines_of(clock, caplog, 10, [(0.2, 1)] * 10) == []
    # after 3 s, and whenever it has taken four times as long
    assert 3 <= len(lines_of(clock, caplog, 3600, [(1, 1)] * 3599)) <= 7


def test_a_single_simulation_has_a_forecast(monkeypatch, caplog):
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(progress, "time", Clock(step=2.0))
    at.make_propagator(small_scene(), "full", 2e-3, cache=False).transfer_matrix()
    assert re.fullmatch("simulating scene: .* s left", told(caplog)[0])


class Writer:
    """A stream of a program with windows: it has all that `print` needs."""

    def write(self, text: str) -> int:
        return len(text)

    def flush(self) -> None:
        pass


def closed() -> io.StringIO:
    stream = io.StringIO()
    stream.close()
    return stream


@pytest.mark.parametrize("stream", [None, closed(), Writer()], ids=["none", "closed", "writer"])
def test_without_a_terminal_there_is_no_bar(monkeypatch, stream):
    monkeypatch.setattr(sys, "stderr", stream)
    with progress.show_progress(2, "simulating") as shown:
        shown.advance(2)
    assert not progress.is_terminal(stream)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_bar_on_a_terminal_names_each_task(monkeypatch):
    stream = Terminal()
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(progress, "_PATIENCE", 0.0)
    with progress.show_progress(2, "first") as shown:
        shown.begin("second")
        shown.advance(2)
    assert "first: " in stream.getvalue()
    assert "second: " in stream.getvalue()
    assert ": :" not in stream.getvalue()


@functools.cache
def propagator_and_matrix(method):
    make = functools.partial(at.make_propagator, small_scene((CUBE,)), method, 2.5e-3, cache=False)
    return make, make().transfer_matrix()


@settings(max_examples=3)
@given(st.integers(0, 30), st.sampled_from(["full", "box", "tmatrix"]))
def test_work_that_was_stopped_at_any_step_begins_again_as_if_it_had_not(step, method):
    make, expected = propagator_and_matrix(method)
    propagator, steps = make(), itertools.count()
    try:
        with progress.stopping_when(lambda: next(steps) == step):
            propagator.transfer_matrix()
    except progress.Stopped:
        assert next(steps) >= step + 1
    else:
        assert next(steps) <= step
    assert torch.equal(propagator.transfer_matrix(), expected)


def test_work_beside_is_not_stopped():
    with progress.stopping_when(lambda: True), pytest.raises(progress.Stopped):
        at.make_propagator(small_scene((CUBE,)), "box", 2.5e-3, cache=False).transfer_matrix()
    assert at.make_propagator(small_scene((CUBE,)), "box", 2.5e-3, cache=False).transfer_matrix().any()


def forecasts_of(clock, caplog, cost, count):
    """Return least and most of each forecast, and the truth [s], for steps that take `cost(step)` seconds."""
    times = [cost(step) for step in range(count)]
    found = []
    caplog.set_level(logging.INFO)
    with progress.show_progress(count, "work") as shown:
        for step, seconds in enumerate(times):
            clock.now += seconds
            before = len(told(caplog))
            shown.advance(1)
            for line in told(caplog)[before:]:
                ends = re.search(r"about (\d+)(?: to (\d+))? s left", line)
                found.append((float(ends[1]), float(ends[2] or ends[1]), sum(times[step + 1 :])))
    return found


@pytest.mark.parametrize(
    "cost",
    [
        lambda step: 1.0,
        lambda step: 0.01 + 0.02 * step,  # a process of ever more evaluations
        lambda step: 0.1 if step < 16 else 1.0,  # the first evaluations need no process
        lambda step: 1.5 if step % 2 else 0.5,
    ],
    ids=["even", "growing", "later slow", "in turns"],
)
def test_a_forecast_holds_the_truth(clock, caplog, cost):
    found = forecasts_of(clock, caplog, cost, 200)
    assert len(found) >= 3
    for least, most, truth in found:
        assert 0.65 * least <= truth <= 1.6 * most


def test_work_beyond_its_estimate_has_no_forecast(clock, caplog):
    lines = lines_of(clock, caplog, 10, [(1, 1)] * 60)
    assert re.search(r"s so far, \d\d steps where 10 were expected", lines[-1])
    assert not any("about 0 s" in line for line in lines)


def test_work_of_several_kinds_says_what_is_known_of_the_time_left(clock, caplog):
    caplog.set_level(logging.INFO)
    least = iter([(30.0, float("inf")), (20.0, 25.0), (0.1, 0.1)])
    with progress.show_progress(100, "study", lambda: next(least)) as shown:
        for seconds in (4, 100, 4000):
            clock.now += seconds
            shown.advance(1)
    assert told(caplog) == ["study: 4 s so far, at least 30 s left", "study: 104 s so far, about 22 s left"]
