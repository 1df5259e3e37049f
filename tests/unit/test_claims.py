"""Verdicts on the paper's claims follow the data."""

import math
from dataclasses import replace

import pytest
import torch

from autdtorch.methods.solution import Solution
from autdtorch.objectives.metrics import FocusMetrics
from autdtorch.study.report.claims import CLAIMS, judge_claims
from autdtorch.study.results import MethodResult, Provenance, SceneResult, Simulation, StudyResult
from autdtorch.study.statistics import FEWEST_TRIALS

SIMULATION = Simulation("free_space", 8.5e-3, None, None, (), 0.0, 0.0)

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
    """Return data as claimed, with changes by scene and method."""
    scenes = {}
    for scene, methods in AS_CLAIMED.items():
        results = {}
        for name, values in methods.items():
            changed = values | (changes or {}).get((scene, name), {})
            results[name] = method_result(1 if name == "lssg" else trials, spread, changed)
        obstacles = 0 if scene == "homogeneous" else 2
        scenes[scene] = SceneResult(obstacles, torch.ones(1, 1), 10.0, SIMULATION, results)
    return StudyResult(Provenance("", 0, {}, "", ""), scenes)


def test_every_claim_holds_for_data_as_claimed():
    judged = judge_claims(study())
    assert len(judged) == len(CLAIMS)
    assert all(verdict.holds and verdict.clear for _, verdict in judged)


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


def test_a_few_trials_of_random_methods_show_nothing_clearly_but_their_evaluations():
    judged = judge_claims(study(trials=FEWEST_TRIALS - 1))
    clear = [number for number, (_, verdict) in enumerate(judged, start=1) if verdict.clear]
    # Of LSSG, which has no randomness, and of numbers of evaluations; shares need no resampling.
    assert clear == [2, 3, 9, 10]


def changed(change):
    results = study()
    for scene in results.scenes.values():
        scene.methods.update({name: change(method) for name, method in scene.methods.items()})
    return results


def padded(method):
    history = method.solution.history
    history = torch.cat([history, history[:, -1:].repeat(1, 300)], dim=1)
    return replace(method, solution=replace(method.solution, history=history))


def test_what_pads_a_history_is_no_convergence():
    assert judge_claims(changed(padded))[8][1] == judge_claims(study())[8][1]


def undecided(results):
    return [number for number, (_, verdict) in enumerate(judge_claims(results), start=1) if verdict is None]


def test_claims_without_data_have_no_verdict():
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
