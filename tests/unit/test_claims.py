"""Verdicts on the paper's claims come from the data: they turn where the data turn."""

import math

import pytest
import torch

from autdtorch.claims import CLAIMS, judge_claims
from autdtorch.metrics import FocusMetrics
from autdtorch.optim.base import Solution
from autdtorch.results import MethodResult, Provenance, SceneResult, Simulation, StudyResult

SIMULATION = Simulation("free_space", 8.5e-3, None, None, (), 0.0, 0.0)

# Data as the paper claims them: mean pressure and standard deviation among the foci [Pa], area [mm^2], the
# weakest focus over the mean, and the gain by the last tenth of the evaluations.
LSSG = {"evaluations": 64, "std": 0.1, "area": 400.0, "weakest": 0.5, "gain": 0.05}
BO = {"evaluations": 256, "std": 0.2, "area": 600.0, "weakest": 0.9, "gain": 0.0}
GABS = {"evaluations": 241, "std": 0.3, "area": 500.0, "weakest": 0.8, "gain": 0.05}
AS_CLAIMED = {
    "homogeneous": {
        "lssg": LSSG | {"mean": 6.0},
        "bayes_opt": BO | {"mean": 7.0, "area": 520.0},
        "gabs": GABS | {"mean": 8.0},
    },
    "three_cubes": {
        "lssg": LSSG | {"mean": 3.0},
        "bayes_opt": BO | {"mean": 6.0},
        "gabs": GABS | {"mean": 7.0},
    },
    "two_cubes": {
        "lssg": LSSG | {"mean": 4.0},
        "bayes_opt": BO | {"mean": 6.0},
        "gabs": GABS | {"mean": 7.0},
    },
}


def method_result(trials: int, spread: float, values: dict[str, float]) -> MethodResult:
    """Trials around the `values`, evenly spread from 1 - spread to 1 + spread."""
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


def study(
    changes: dict[tuple[str, str], dict[str, float]] | None = None, trials: int = 5, spread: float = 0.001
) -> StudyResult:
    """Data as claimed, but for the changes by scene and method."""
    scenes = {}
    for scene, methods in AS_CLAIMED.items():
        results = {
            name: method_result(
                1 if name == "lssg" else trials, spread, values | (changes or {}).get((scene, name), {})
            )
            for name, values in methods.items()
        }
        scenes[scene] = SceneResult(
            0 if scene == "homogeneous" else 2, torch.ones(1, 1), None, SIMULATION, results
        )
    return StudyResult(Provenance("", 0, {}, "", ""), scenes)


def numbers_not_holding(results: StudyResult) -> list[int]:
    return [number for number, (_, verdict) in enumerate(judge_claims(results), start=1) if not verdict.holds]


def test_every_claim_holds_where_the_data_are_as_claimed() -> None:
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
def test_a_claim_does_not_hold_where_the_data_turn(
    broken: list[int], scene: str, method: str, change: dict[str, float]
) -> None:
    results = study({(scene, method): change})
    assert numbers_not_holding(results) == broken
    assert all(verdict.clear for _, verdict in judge_claims(results))


def test_the_evidence_gives_the_numbers_with_their_uncertainty() -> None:
    _, verdict = judge_claims(study(spread=0.3))[4]
    # Trials at 1 and 1 +- 0.1, 0.2 of the mean: their standard error is sqrt(0.025 / 5) of it.
    assert "two_cubes: BO 6.00 ± 0.42, GABS 7.00 ± 0.49 Pa" in verdict.evidence


def test_a_difference_within_the_spread_of_the_trials_is_not_clear() -> None:
    claim = 4  # GABS above BO: 7 against 6, in two of the scenes
    for spread, clear in ((0.3, False), (0.1, True)):
        _, verdict = judge_claims(study(spread=spread))[claim]
        assert verdict.holds
        # Two standard errors of the difference are 2 sqrt(0.42^2 + 0.49^2) = 1.3 and a third of it.
        assert verdict.clear is clear


def test_a_single_trial_of_a_random_method_shows_nothing_clearly_but_its_evaluations() -> None:
    judged = judge_claims(study(trials=1))
    clear = [number for number, (_, verdict) in enumerate(judged, start=1) if verdict.clear]
    assert clear == [2, 3, 10]  # of LSSG, which has no randomness, and of numbers of evaluations


def test_claims_without_data_have_no_verdict() -> None:
    def undecided(results: StudyResult) -> list[int]:
        return [
            number for number, (_, verdict) in enumerate(judge_claims(results), start=1) if verdict is None
        ]

    results = study()
    del results.scenes["homogeneous"]
    assert undecided(results) == [2, 3, 4, 6]
    del results.scenes["three_cubes"].methods["gabs"]
    assert undecided(results) == list(range(1, 12))
    results = study()
    del results.scenes["three_cubes"], results.scenes["two_cubes"]
    assert undecided(results) == [2, 3, 4, 7]
    results = study()
    for scene in results.scenes.values():
        for name, method in scene.methods.items():
            metrics = FocusMetrics(
                *(getattr(method.metrics, key) for key in ("mean", "min", "std", "uniformity")), None
            )
            scene.methods[name] = MethodResult(method.solution, metrics, method.seconds, 0, None)
    assert undecided(results) == [6, 7]
