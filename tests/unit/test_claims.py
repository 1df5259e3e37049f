"""Verdicts on the paper's claims follow the data; confidence intervals, and the gap to the bound."""

import math
import operator
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from autdtorch.methods.solution import Solution
from autdtorch.objectives.metrics import FocusMetrics
from autdtorch.study import statistics
from autdtorch.study.report.claims import CLAIMS, judge_claims
from autdtorch.study.results import MethodResult, Provenance, SceneResult, SceneSimulation, StudyResult
from autdtorch.study.statistics import CONFIDENCE, FEWEST_TRIALS, Interval, bootstrap, bound_gap
from autdtorch.utils.text import decimals_of, in_digits

SIMULATION = SceneSimulation("free_space", 8.5e-3, None, None, (), 0.0, 0.0)

# Data as in the paper's claims: mean pressure and standard deviation [Pa], area [mm^2], weakest
# focus over mean, gain by the last tenth of the evaluations.
LSSG = {"evaluations": 64, "std": 0.1, "area": 400.0, "weakest": 0.5, "gain": 0.05}
BO = {"evaluations": 256, "std": 0.2, "area": 600.0, "weakest": 0.9, "gain": 0.0}
GABS = {"evaluations": 241, "std": 0.3, "area": 500.0, "weakest": 0.8, "gain": 0.05}
AS_CLAIMED = {
    scene: {"lssg": LSSG | {"mean": lssg}, "bayes_opt": BO | bo, "gabs": GABS | {"mean": gabs}}
    for scene, lssg, bo, gabs in (
        ("homogeneous", 6.0, {"mean": 7.0, "area": 520.0}, 8.0),
        ("three_cubes", 3.0, {"mean": 6.0}, 7.0),
        ("two_cubes", 4.0, {"mean": 6.0}, 7.0),
    )
}


def method_result(trials, spread, values):
    """Return trials evenly spread from 1 - spread to 1 + spread times the values."""
    around = 1 + spread * torch.linspace(-1, 1, trials + 2, dtype=torch.float64)[1:-1]
    mean = values["mean"] * around
    evaluations = int(values["evaluations"])
    history = (values["weakest"] * mean)[:, None].repeat(1, evaluations)
    history[:, : math.ceil(0.9 * evaluations)] *= 1 - values["gain"]
    counts = torch.full((trials,), evaluations)
    drive = torch.ones(trials, 1, dtype=torch.complex128)
    solution = Solution(drive, mean[:, None], history[:, -1], counts, history)
    std, area = values["std"] * around, 1e-6 * values["area"] * around
    metrics = FocusMetrics(mean, history[:, -1], std, torch.ones_like(mean), area)
    return MethodResult(solution, metrics, torch.ones(trials, dtype=torch.float64), 0, None)


def study(changes=None, trials=7, spread=0.001):
    scenes = {}
    for scene, methods in AS_CLAIMED.items():
        results = {}
        for name, values in methods.items():
            changed = values | (changes or {}).get((scene, name), {})
            results[name] = method_result(1 if name == "lssg" else trials, spread, changed)
        obstacles = 0 if scene == "homogeneous" else 2
        scenes[scene] = SceneResult(obstacles, torch.ones(1, 1), 10.0, SIMULATION, results)
    return StudyResult(Provenance("", 0, {}, "", ""), scenes)


def test_every_claim_holds_for_data_as_claimed_but_not_clearly_after_a_few_trials():
    judged = judge_claims(study())
    assert len(judged) == len(CLAIMS)
    assert all(verdict.holds and verdict.clear for _, verdict in judged)
    judged = judge_claims(study(trials=FEWEST_TRIALS - 1))
    clear = [number for number, (_, verdict) in enumerate(judged, start=1) if verdict.clear]
    # Of LSSG, which has no randomness, and of numbers of evaluations; shares need no resampling.
    assert clear == [2, 3, 9, 10]


@pytest.mark.parametrize(
    ("broken", "scene", "method", "change"),
    [
        ([1, 3], "two_cubes", "lssg", {"mean": 6.1}),
        ([2, 3], "three_cubes", "lssg", {"mean": 4.5}),
        ([3], "two_cubes", "lssg", {"mean": 4.5}),
        ([4], "two_cubes", "bayes_opt", {"mean": 4.9}),
        ([4, 5], "two_cubes", "gabs", {"mean": 5.5}),
        ([5], "three_cubes", "gabs", {"mean": 5.9}),
        ([6], "homogeneous", "gabs", {"area": 450.0}),
        ([6], "homogeneous", "gabs", {"area": 600.0}),
        ([7], "two_cubes", "gabs", {"area": 610.0}),
        ([8], "three_cubes", "bayes_opt", {"std": 0.31}),
        ([9], "homogeneous", "bayes_opt", {"gain": 0.02}),
        ([9], "homogeneous", "gabs", {"gain": 0.005}),
        ([10], "three_cubes", "bayes_opt", {"evaluations": 60}),
        ([11], "three_cubes", "gabs", {"weakest": 0.4}),
    ],
)
def test_a_claim_fails_on_contrary_data(broken, scene, method, change):
    verdicts = [verdict for _, verdict in judge_claims(study({(scene, method): change}))]
    assert [number for number, verdict in enumerate(verdicts, start=1) if not verdict.holds] == broken
    assert all(verdict.clear for verdict in verdicts)


def test_a_difference_has_an_interval_and_is_clear_where_it_excludes_zero():
    _, verdict = judge_claims(study(spread=0.3, trials=15))[4]
    line = verdict.evidence[2]
    start = "two_cubes: BO 6.00, GABS 7.00 Pa; GABS minus BO: 1.00 ["
    assert line.startswith(start)
    # The trials are at 1, 1 +- 0.3/8, ... 1 +- 7/8 0.3 of the mean: their standard deviation is 0.168 of it.
    half = 1.96 * 0.168 * math.hypot(6, 7) / math.sqrt(15)
    low, high = map(float, line.removeprefix(start).rstrip("]").split(", "))
    # The expanded level is Student's, 2.14 instead of 1.96, and percentiles of 4999 resamples are not exact.
    assert (low, high) == pytest.approx((1 - half, 1 + half), abs=0.2 * half)
    for spread, clear in ((0.5, False), (0.1, True)):
        _, verdict = judge_claims(study(spread=spread))[4]
        assert (verdict.holds, verdict.clear) == (True, clear)


def changed(change):
    results = study()
    for scene in results.scenes.values():
        scene.methods.update({name: change(method) for name, method in scene.methods.items()})
    return results


def padded(method):
    history = method.solution.history
    history = torch.cat([history, history[:, -1:].repeat(1, 300)], dim=1)
    return replace(method, solution=replace(method.solution, history=history))


def test_what_pads_a_history_is_no_convergence_and_claims_without_data_have_no_verdict():
    assert judge_claims(changed(padded))[8][1] == judge_claims(study())[8][1]
    results = study()
    del results.scenes["homogeneous"]
    assert undecided(results) == [2, 3, 4, 6]
    del results.scenes["three_cubes"].methods["gabs"]
    assert undecided(results) == [2, 3, 4, 6]
    del results.scenes["two_cubes"].methods["gabs"]
    assert undecided(results) == list(range(1, 12))
    results = study()
    del results.scenes["three_cubes"], results.scenes["two_cubes"]
    assert undecided(results) == [2, 3, 4, 7]
    without_area = changed(lambda method: replace(method, metrics=replace(method.metrics, area=None)))
    assert undecided(without_area) == [6, 7]


def undecided(results):
    return [number for number, (_, verdict) in enumerate(judge_claims(results), start=1) if verdict is None]


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


def test_exact_numbers_add_no_uncertainty_and_too_few_trials_have_no_interval():
    values = torch.rand(20, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert bootstrap(values) == bootstrap(values)
    assert bootstrap(2.0, 3.0, combine=operator.sub) == Interval(-1.0, -1.0, -1.0)
    alone, shifted = bootstrap(values), bootstrap(values, 2.0, combine=operator.sub)
    for end in ("value", "low", "high"):
        assert getattr(shifted, end) == pytest.approx(getattr(alone, end) - 2.0, rel=1e-12)
    assert bootstrap(torch.full((20,), 3.0)) == Interval(3.0, 3.0, 3.0)
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


def of_history(history):
    best = torch.tensor(history, dtype=torch.float64)
    trials, evaluations = best.shape
    drive = torch.ones(trials, 1, dtype=torch.complex128)
    solution = Solution(drive, best[:, -1:], best[:, -1], torch.full((trials,), evaluations), best)
    metrics = FocusMetrics(best[:, -1], best[:, -1], *torch.zeros(2, trials, dtype=torch.float64), None)
    return MethodResult(solution, metrics, torch.ones(trials, dtype=torch.float64), 0, None)


def test_gaps_and_evaluations_to_the_bound():
    ended_early = [2.0, 9.5, 9.5, 9.5]
    history = [[1.0, 2.0, 9.0, 9.5], [9.0] * 4, [1.0, 1.0, 1.0, 8.9], ended_early]
    for bound, wanted in ((10.0, [3, 1, math.inf, 2]), (11.0, [math.inf] * 4), (0.5, [1] * 4)):
        assert bound_gap(of_history(history), bound).evaluations.tolist() == wanted
    # Scores 1 to 9 have the median 5: the gap to 10 is a half, its ends are mirrored.
    finding = bound_gap(of_history([[float(score)] for score in range(1, 10)]), 10.0)
    assert finding.score.value == 5.0
    assert finding.gap.value == 0.5
    assert finding.gap.low == pytest.approx(1 - finding.score.high / 10)
    assert finding.gap.high == pytest.approx(1 - finding.score.low / 10)
    assert finding.evaluations.tolist() == [math.inf] * 8 + [1]
    single = bound_gap(of_history([[4.0, 8.0]]), 10.0)
    assert single.gap.value == pytest.approx(0.2)
    assert math.isinf(single.gap.low)
    assert bound_gap(of_history([[0.0, 0.0]]), 0.0).gap.value == 0.0
