"""What the paper claims (sections IV and V), each claim judged by the stored results of a study.

Means over trials are compared. A difference is clear where it exceeds two of its standard errors; that of a
mean is taken as infinite where there is a single trial of a method with random choices.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeAlias

import torch

from autdtorch.optim import METHOD_LABELS
from autdtorch.results import MethodResult, StudyResult

Scenes: TypeAlias = Callable[[StudyResult], list[str]]
Quantity: TypeAlias = Callable[[MethodResult], torch.Tensor]

LSSG, BO, GABS = "lssg", "bayes_opt", "gabs"

MUCH_WEAKER = 1 / math.sqrt(2)
"""A pressure is much weaker than another below this share of it (half the intensity), and kept above it."""

SAME_LEVEL = 0.1
"""Areas are at the same level where they differ by less than this share of the larger one."""

CONVERGED = 0.01
"""A trial has converged where its last `LAST_PART` of evaluations raises the score by at most this share."""

LAST_PART = 0.1
"""See `CONVERGED`."""

FORMED = 0.5
"""Foci have formed where the weakest has at least this share of their mean pressure."""

_CLEAR = 2.0  # standard errors


@dataclass(frozen=True)
class Verdict:
    """What the results say about a claim.

    Attributes:
        holds: whether every comparison comes out as claimed.
        clear: whether the differences that decide this exceed the uncertainty of so few trials.
        evidence: our numbers.
    """

    holds: bool
    clear: bool
    evidence: str


@dataclass(frozen=True)
class Claim:
    """A claim of the paper.

    Attributes:
        text: the claim.
        reading: what is compared, with the threshold where the paper's words are vague.
        methods: names of the methods it is about.
        needs: kinds of scenes it is about: each gives their names.
        judge: the verdict of results that have those methods in all scenes, and scenes of every kind.
    """

    text: str
    reading: str
    methods: tuple[str, ...]
    needs: tuple[Scenes, ...]
    judge: Callable[[StudyResult], Verdict]


@dataclass(frozen=True)
class _Estimate:
    """A mean over trials and its standard error."""

    value: float
    error: float

    def __str__(self) -> str:
        if self.error == 0 and self.value.is_integer():
            return f"{self.value:.0f}"
        digits = max(0, 2 - math.floor(math.log10(abs(self.value)))) if self.value else 2
        value = f"{self.value:.{digits}f}"
        return value if self.error in (0, math.inf) else f"{value} ± {self.error:.{digits}f}"

    def __sub__(self, other: _Estimate) -> _Estimate:
        return _Estimate(self.value - other.value, math.hypot(self.error, other.error))

    def __mul__(self, factor: float) -> _Estimate:
        return _Estimate(factor * self.value, abs(factor) * self.error)


def judge_claims(results: StudyResult) -> list[tuple[Claim, Verdict | None]]:
    """Every claim with its verdict; None where the results lack a method or a kind of scene it is about."""
    return [(claim, claim.judge(results) if _has_data(claim, results) else None) for claim in CLAIMS]


def _has_data(claim: Claim, results: StudyResult) -> bool:
    methods = all(method in scene.methods for scene in results.scenes.values() for method in claim.methods)
    return methods and all(scenes(results) for scenes in claim.needs)


def _all(results: StudyResult) -> list[str]:
    return list(results.scenes)


def _empty(results: StudyResult) -> list[str]:
    return [name for name, scene in results.scenes.items() if scene.obstacles == 0]


def _obstructed(results: StudyResult) -> list[str]:
    return [name for name, scene in results.scenes.items() if scene.obstacles > 0]


def _three_cubes(results: StudyResult) -> list[str]:
    return [name for name in _obstructed(results) if name == "three_cubes"]


def _empty_with_area(results: StudyResult) -> list[str]:
    return [name for name in _empty(results) if _has_area(results, name)]


def _obstructed_with_area(results: StudyResult) -> list[str]:
    return [name for name in _obstructed(results) if _has_area(results, name)]


def _has_area(results: StudyResult, scene: str) -> bool:
    return all(method.metrics.area is not None for method in results.scenes[scene].methods.values())


def _mean_pressure(method: MethodResult) -> torch.Tensor:
    return method.metrics.mean


def _area(method: MethodResult) -> torch.Tensor:
    """Area a focus [mm^2]."""
    if method.metrics.area is None:
        raise ValueError("area: None; must be of a scene with an observation plane")
    return 1e6 * method.metrics.area


def _spread(method: MethodResult) -> torch.Tensor:
    return method.metrics.std


def _weakest_share(method: MethodResult) -> torch.Tensor:
    return method.metrics.min / method.metrics.mean


def _evaluations(method: MethodResult) -> torch.Tensor:
    return method.solution.evaluations.double()


def _converged(method: MethodResult) -> torch.Tensor:
    """1 for a trial that has converged before its end, 0 for another."""
    history = method.solution.history
    before = history[:, math.ceil((1 - LAST_PART) * history.shape[1]) - 1]
    return (before >= (1 - CONVERGED) * history[:, -1]).double()


def _estimate(results: StudyResult, scene: str, method: str, quantity: Quantity) -> _Estimate:
    values = quantity(results.scenes[scene].methods[method])
    if len(values) > 1:
        return _Estimate(float(values.mean()), float(values.std()) / math.sqrt(len(values)))
    exact = method == LSSG or quantity is _evaluations
    return _Estimate(float(values[0]), 0.0 if exact else math.inf)


def _verdict(margins: Iterable[_Estimate], evidence: str) -> Verdict:
    """A claim holds where all `margins` are positive."""
    margins = list(margins)
    holds = all(margin.value > 0 for margin in margins)
    if holds:
        clear = all(margin.value > _CLEAR * margin.error for margin in margins)
    else:
        clear = any(not margin.value > -_CLEAR * margin.error for margin in margins)
    return Verdict(holds, clear, evidence)


def _evidence(
    results: StudyResult, scenes: Iterable[str], methods: tuple[str, ...], quantity: Quantity, unit: str
) -> str:
    parts = []
    for scene in scenes:
        numbers = [f"{METHOD_LABELS[name]} {_estimate(results, scene, name, quantity)}" for name in methods]
        parts.append(f"{scene}: {', '.join(numbers)} {unit}".rstrip())
    return "; ".join(parts)


def _ordered(
    smaller: str, larger: tuple[str, ...], quantity: Quantity, unit: str, scenes: Scenes
) -> Callable[[StudyResult], Verdict]:
    """In each of the `scenes`, `quantity` of one method is smaller than that of each of the `larger`."""

    def judge(results: StudyResult) -> Verdict:
        margins = [
            _estimate(results, scene, name, quantity) - _estimate(results, scene, smaller, quantity)
            for scene in scenes(results)
            for name in larger
        ]
        return _verdict(margins, _evidence(results, scenes(results), (smaller, *larger), quantity, unit))

    return judge


def _share_of_empty(
    methods: tuple[str, ...], weaker: bool, scenes: Scenes
) -> Callable[[StudyResult], Verdict]:
    """In each of the `scenes` the mean pressure is much weaker than without obstacles, or is kept."""

    def judge(results: StudyResult) -> Verdict:
        margins, parts = [], []
        for method in methods:
            empty = _estimate(results, _empty(results)[0], method, _mean_pressure)
            for scene in scenes(results):
                pressure = _estimate(results, scene, method, _mean_pressure)
                margin = pressure - empty * MUCH_WEAKER
                margins.append(margin * (-1 if weaker else 1))
                parts.append(f"{METHOD_LABELS[method]} in {scene}: {pressure.value / empty.value:.2f}")
        return _verdict(margins, "share of the pressure without obstacles: " + "; ".join(parts))

    return judge


def _same_area(results: StudyResult) -> Verdict:
    margins = []
    for scene in _empty_with_area(results):
        gabs, bo = (_estimate(results, scene, method, _area) for method in (GABS, BO))
        difference = gabs - bo
        allowed = SAME_LEVEL * max(gabs.value, bo.value)
        margins.append(_Estimate(allowed - abs(difference.value), difference.error))
    return _verdict(margins, _evidence(results, _empty_with_area(results), (GABS, BO), _area, "mm²"))


def _convergence(results: StudyResult) -> Verdict:
    margins = []
    half = _Estimate(0.5, 0.0)
    for scene in results.scenes:
        margins.append(_estimate(results, scene, BO, _converged) - half)
        margins.append(half - _estimate(results, scene, GABS, _converged))
    evidence = _evidence(results, results.scenes, (BO, GABS), _converged, "")
    return _verdict(margins, f"share of the trials that converged: {evidence}")


def _foci_form(results: StudyResult) -> Verdict:
    threshold = _Estimate(FORMED, 0.0)
    margins = [
        _estimate(results, scene, method, _weakest_share) - threshold
        for scene in results.scenes
        for method in (BO, GABS)
    ]
    evidence = _evidence(results, results.scenes, (BO, GABS), _weakest_share, "")
    return _verdict(margins, f"weakest focus over mean: {evidence}")


CLAIMS = (
    Claim(
        "LSSG gives weaker foci than BO and GABS, without and with obstacles.",
        "mean pressure of the foci, in every scene",
        (LSSG, BO, GABS),
        (_all,),
        _ordered(LSSG, (BO, GABS), _mean_pressure, "Pa", _all),
    ),
    Claim(
        "With three cubes, the pressure of LSSG is much weaker than without obstacles.",
        f"much weaker: mean pressure below {MUCH_WEAKER:.2f} (half the intensity) of that without obstacles",
        (LSSG,),
        (_empty, _three_cubes),
        _share_of_empty((LSSG,), weaker=True, scenes=_three_cubes),
    ),
    Claim(
        "With obstacles in general, the mean pressure of LSSG is much weaker than without.",
        "the same, in every scene with obstacles",
        (LSSG,),
        (_empty, _obstructed),
        _share_of_empty((LSSG,), weaker=True, scenes=_obstructed),
    ),
    Claim(
        "BO and GABS keep a strong pressure with obstacles.",
        f"kept: mean pressure above {MUCH_WEAKER:.2f} of the same method's without obstacles, in every scene "
        "with obstacles",
        (BO, GABS),
        (_empty, _obstructed),
        _share_of_empty((BO, GABS), weaker=False, scenes=_obstructed),
    ),
    Claim(
        "The mean pressure of GABS is higher than that of BO.",
        "in every scene",
        (BO, GABS),
        (_all,),
        _ordered(BO, (GABS,), _mean_pressure, "Pa", _all),
    ),
    Claim(
        "Without obstacles, the foci of GABS and BO have areas at the same level.",
        f"same level: less than {SAME_LEVEL:.0%} apart",
        (BO, GABS),
        (_empty_with_area,),
        _same_area,
    ),
    Claim(
        "With obstacles, the foci of GABS have a smaller area than those of BO.",
        "in every scene with obstacles",
        (BO, GABS),
        (_obstructed_with_area,),
        _ordered(GABS, (BO,), _area, "mm²", _obstructed_with_area),
    ),
    Claim(
        "The standard deviation among the foci is lower for BO than for GABS.",
        "in every scene",
        (BO, GABS),
        (_all,),
        _ordered(BO, (GABS,), _spread, "Pa", _all),
    ),
    Claim(
        "BO may converge within the evaluations it is given, GABS needs all of its own.",
        f"converged: the last {LAST_PART:.0%} of the evaluations raise the score by at most {CONVERGED:.0%}; "
        "more than half of the trials of BO, less than half of those of GABS, in every scene",
        (BO, GABS),
        (_all,),
        _convergence,
    ),
    Claim(
        "LSSG needs the fewest evaluations.",
        "in every scene (the paper: LSSG 64, BO 256, GABS 256)",
        (LSSG, BO, GABS),
        (_all,),
        _ordered(LSSG, (BO, GABS), _evaluations, "", _all),
    ),
    Claim(
        "With BO and GABS the foci form, without and with obstacles.",
        f"formed: the weakest focus has over {FORMED:.0%} of the mean pressure of the foci, in every scene",
        (BO, GABS),
        (_all,),
        _foci_form,
    ),
)
"""The paper's claims, in its order."""
