"""Confidence intervals of trials, and the gap to the bound, on data with known answers."""

import math
import operator

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from autdtorch.methods.solution import Solution
from autdtorch.objectives.metrics import FocusMetrics
from autdtorch.study import statistics
from autdtorch.study.results import MethodResult
from autdtorch.study.statistics import CONFIDENCE, FEWEST_TRIALS, Interval, bootstrap, bound_gap
from autdtorch.utils.text import decimals_of, in_digits

DRAWS = 200
# Each draw covers the truth with 95 %; fewer or more of 200 draws do so in 1 of 1000 cases.
LEAST, MOST = (int(stats.binom.ppf(tail, DRAWS, CONFIDENCE)) for tail in (1e-3, 1 - 1e-3))


@pytest.mark.parametrize("trials", [FEWEST_TRIALS, 30])
def test_intervals_cover_the_truth_as_often_as_they_say(trials, monkeypatch):
    monkeypatch.setattr("autdtorch.study.statistics._RESAMPLES", 999)  # enough, and quick
    generator = torch.Generator().manual_seed(3)
    covered = np.zeros(4, int)
    truth = np.array([5.0, 5.0, 0.0, 1.0])
    for _ in range(DRAWS):
        first, second = 5 + torch.randn(2, trials, dtype=torch.float64, generator=generator)
        found = [bootstrap(first), bootstrap(first, average=np.median)]
        found += [bootstrap(first, second, combine=by) for by in (operator.sub, operator.truediv)]
        assert all(one.low <= one.value <= one.high for one in found)
        covered += [one.low <= true <= one.high for one, true in zip(found, truth, strict=True)]
    assert ((covered >= LEAST) & (covered <= MOST)).all(), covered


def test_exact_numbers_add_no_uncertainty_and_equal_data_give_equal_intervals():
    values = torch.rand(20, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert bootstrap(values) == bootstrap(values)
    assert bootstrap(2.0, 3.0, combine=operator.sub) == Interval(-1.0, -1.0, -1.0)
    alone, shifted = bootstrap(values), bootstrap(values, 2.0, combine=operator.sub)
    for end in ("value", "low", "high"):
        assert getattr(shifted, end) == pytest.approx(getattr(alone, end) - 2.0, rel=1e-12)
    assert bootstrap(torch.full((20,), 3.0)) == Interval(3.0, 3.0, 3.0)


def test_too_few_trials_have_no_interval():
    many, few = torch.arange(20.0), torch.arange(FEWEST_TRIALS - 1.0)
    assert (bootstrap(few).low, bootstrap(few).high) == (-math.inf, math.inf)
    assert bootstrap(many, few, combine=operator.sub).high == math.inf
    assert math.isfinite(bootstrap(torch.arange(float(FEWEST_TRIALS))).high)


def test_a_share_of_all_trials_is_not_certain():
    # Wilson's interval of n of n is [n / (n + z^2), 1].
    every = statistics.share_interval(torch.ones(50, dtype=torch.bool))
    assert (every.value, every.low, every.high) == pytest.approx((1.0, 50 / (50 + 1.96**2), 1.0), rel=1e-4)
    none = statistics.share_interval(torch.zeros(50, dtype=torch.bool))
    assert (none.low, none.high) == pytest.approx((0.0, 1 - every.low), abs=1e-12)


@pytest.mark.parametrize(
    ("interval", "text"),
    [
        (Interval(1.2345, 1.1, 1.3), "1.23 [1.10, 1.30]"),
        (Interval(6.0), "6.00"),
        (Interval(241.0, 241.0, 241.0), "241.00"),
    ],
)
def test_an_interval_has_equal_decimals(interval, text):
    assert f"{interval:.2f}" == text


@given(st.lists(st.floats(-1e9, 1e9), max_size=5), st.integers(1, 5))
def test_the_largest_number_has_its_digits(numbers, digits):
    decimals = decimals_of([*numbers, math.inf], digits)
    largest = max(map(abs, numbers), default=0.0)
    if largest == 0 or largest >= 10.0 ** (digits - 1):
        assert decimals == 0
    else:
        shown = f"{largest:.{decimals}f}".replace(".", "").lstrip("0")
        assert len(shown) in (digits, digits + 1)  # 9.996 becomes 10.00
        assert "e" not in in_digits(largest, digits)


def method_result(history):
    best = torch.tensor(history, dtype=torch.float64)
    trials, evaluations = best.shape
    drive = torch.ones(trials, 1, dtype=torch.complex128)
    solution = Solution(drive, best[:, -1:], best[:, -1], torch.full((trials,), evaluations), best)
    metrics = FocusMetrics(best[:, -1], best[:, -1], *torch.zeros(2, trials, dtype=torch.float64), None)
    return MethodResult(solution, metrics, torch.ones(trials, dtype=torch.float64), 0, None)


def test_evaluations_are_counted_to_the_first_near_the_bound():
    ended_early = [2.0, 9.5, 9.5, 9.5]
    history = [[1.0, 2.0, 9.0, 9.5], [9.0] * 4, [1.0, 1.0, 1.0, 8.9], ended_early]
    for bound, wanted in ((10.0, [3, 1, math.inf, 2]), (11.0, [math.inf] * 4), (0.5, [1] * 4)):
        assert bound_gap(method_result(history), bound).evaluations.tolist() == wanted


def test_the_gap_is_that_of_the_median_score():
    # Scores 1 to 9 have the median 5: the gap to 10 is a half, its ends are mirrored.
    finding = bound_gap(method_result([[float(score)] for score in range(1, 10)]), 10.0)
    assert finding.score.value == 5.0
    assert finding.gap.value == 0.5
    assert finding.gap.low == pytest.approx(1 - finding.score.high / 10)
    assert finding.gap.high == pytest.approx(1 - finding.score.low / 10)
    assert finding.evaluations.tolist() == [math.inf] * 8 + [1]
    single = bound_gap(method_result([[4.0, 8.0]]), 10.0)
    assert single.gap.value == pytest.approx(0.2)
    assert math.isinf(single.gap.low)
    assert bound_gap(method_result([[0.0, 0.0]]), 0.0).gap.value == 0.0
