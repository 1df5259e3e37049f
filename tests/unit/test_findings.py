"""Gap to the bound and evaluations to 90 % of it, from histories made by hand."""

import math
from dataclasses import replace

import pytest
import torch

from autdtorch.methods.solution import Solution
from autdtorch.objectives.metrics import FocusMetrics
from autdtorch.study.results import MethodResult
from autdtorch.study.statistics import bound_gap, evaluations_to

HISTORY = [
    [1.0, 2.0, 9.0, 9.5],
    [9.0, 9.0, 9.0, 9.0],
    [1.0, 1.0, 1.0, 8.9],
    [2.0, 9.5, 9.5, 9.5],  # ended after two evaluations
]


def method_result(history: list[list[float]]) -> MethodResult:
    best = torch.tensor(history, dtype=torch.float64)
    trials, evaluations = best.shape
    drive = torch.ones(trials, 1, dtype=torch.complex128)
    solution = Solution(drive, best[:, -1:], best[:, -1], torch.full((trials,), evaluations), best)
    metrics = FocusMetrics(best[:, -1], best[:, -1], *torch.zeros(2, trials, dtype=torch.float64), None)
    return MethodResult(solution, metrics, torch.ones(trials, dtype=torch.float64), 0, None)


def test_evaluations_are_counted_to_the_first_that_reaches_the_level() -> None:
    solution = method_result(HISTORY).solution
    assert evaluations_to(solution, 9.0).tolist() == [3, 1, math.inf, 2]
    assert evaluations_to(solution, 9.6).tolist() == [math.inf] * 4
    assert evaluations_to(solution, 0.5).tolist() == [1] * 4


def test_what_pads_the_history_of_a_trial_that_ended_is_no_evaluation() -> None:
    method = method_result(HISTORY)
    counts = torch.tensor([4, 4, 4, 2])
    solution = replace(method.solution, evaluations=counts)
    reached = evaluations_to(solution, 9.0)
    assert torch.equal(reached, evaluations_to(method.solution, 9.0))
    assert (reached[reached.isfinite()] <= counts[reached.isfinite()]).all()


def test_the_gap_is_what_the_median_score_lacks_to_the_bound() -> None:
    # Scores 1 to 9, of median 5: the gap to 10 is a half, its ends are those of the score turned around.
    finding = bound_gap(method_result([[float(score)] for score in range(1, 10)]), 10.0)
    assert finding.score.value == 5.0
    assert finding.gap.value == 0.5
    assert finding.gap.low == pytest.approx(1 - finding.score.high / 10)
    assert finding.gap.high == pytest.approx(1 - finding.score.low / 10)
    assert 0 < finding.gap.low < 0.5 < finding.gap.high < 1
    assert finding.evaluations.tolist() == [math.inf] * 8 + [1]


def test_a_single_trial_has_a_gap_without_interval() -> None:
    finding = bound_gap(method_result([[4.0, 8.0]]), 10.0)
    assert finding.gap.value == pytest.approx(0.2)
    assert math.isinf(finding.gap.low)


def test_where_nothing_can_be_heard_there_is_no_gap() -> None:
    assert bound_gap(method_result([[0.0, 0.0]]), 0.0).gap.value == 0.0
