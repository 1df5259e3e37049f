"""The calculations of a live view: what comes first, what ends at once, what is said at the end."""

import queue
import time

import numpy as np
import pytest
import torch
from small_scenes import CUBE, small_scene

import autdtorch as at
from autdtorch.plot.explore import calculation
from autdtorch.plot.explore.calculation import Calculator, Finished, Request, Result
from autdtorch.plot.explore.situation import Situation, in_phase

PATIENCE = 60  # s; the machine may be busy


@pytest.fixture
def calculator():
    """A calculator of small cells, and the queue of what it reports."""
    reports = queue.SimpleQueue()
    made = Calculator(2e-3, reports.put)
    yield made, reports
    made.close()


def until_finished(reports, number):
    """Results of a request, up to its end."""
    results = []
    while True:
        report = reports.get(timeout=PATIENCE)
        if isinstance(report, Finished) and report.request.number == number:
            return results
        if isinstance(report, Result):
            results.append(report)


def test_a_plane_that_takes_long_is_shown_coarse_before_the_error_and_sharp_after(calculator, monkeypatch):
    monkeypatch.setattr(calculation, "_MOST_PAIRS", 2e4)
    monkeypatch.setattr(calculation, "_REST", 0.01)
    made, reports = calculator
    scene = small_scene((CUBE,))
    made.ask(Request(1, Situation.of(scene, in_phase(scene))))
    first, second, last = until_finished(reports, 1)
    assert (first.error, second.error, last.error) == (None, last.error, pytest.approx(second.error))
    assert first.field.shape == second.field.shape
    assert last.field.size > 2 * first.field.size
    assert torch.equal(second.pressure, last.pressure)  # the picture alone is sharper
    largest = [np.nanmax(np.abs(one.field)) for one in (first, last)]
    assert largest[0] == pytest.approx(largest[1], rel=0.3)  # a cell apart


def test_a_newer_request_and_the_end_stop_what_is_calculated():
    reports = queue.SimpleQueue()
    made = Calculator(0.35e-3, reports.put)  # takes ten times as long as what is waited for
    scene = at.load_scene("configs/scene/two_cubes.yaml")
    made.ask(Request(1, Situation.of(scene, in_phase(scene))))
    time.sleep(0.1)
    made.ask(Request(2, Situation.of(scene, in_phase(scene)), fine=False))
    assert [one.request.number for one in until_finished(reports, 2)] == [2]
    made.ask(Request(3, Situation.of(scene, in_phase(scene))))
    time.sleep(0.2)
    made.close()
    while not reports.empty():
        assert not isinstance(reports.get(), Result)
