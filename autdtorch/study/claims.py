"""What the paper claims (sections IV and V), each claim judged by the stored results of a study.

Means over trials are compared. A comparison is clear where its 95 % confidence interval is all on one side of
what decides it.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TypeAlias

import torch

from autdtorch.methods import METHOD_LABELS
from autdtorch.study.intervals import Interval, bootstrap, share_interval
from autdtorch.study.results import MethodResult, StudyResult

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


@dataclass(frozen=True)
class Verdict:
    """What the results say about a claim.

    Attributes:
        holds: whether every comparison comes out as claimed.
        clear: whether the confidence intervals of the comparisons that decide this leave no doubt of it.
        evidence: our numbers, line by line.
    """

    holds: bool
    clear: bool
    evidence: tuple[str, ...]


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


def judge_claims(results: StudyResult) -> list[tuple[Claim, Verdict | None]]:
    """Every claim with its verdict on the scenes that have the methods it is about.

    None where these lack a kind of scene that it is about.
    """
    verdicts = []
    for claim in CLAIMS:
        scenes = {
            name: scene
            for name, scene in results.scenes.items()
            if set(claim.methods) <= scene.methods.keys()
        }
        told = replace(results, scenes=scenes)
        has_data = all(kind(told) for kind in claim.needs)
        verdicts.append((claim, claim.judge(told) if has_data else None))
    return verdicts


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
    """Whether each trial has converged before its end."""
    history, evaluations = method.solution.history, method.solution.evaluations
    end = evaluations.long() - 1  # what is stored after it is padding
    before = ((1 - LAST_PART) * evaluations).ceil().long() - 1
    return history.gather(1, before[:, None]) >= (1 - CONVERGED) * history.gather(1, end[:, None])


def _values(results: StudyResult, scene: str, method: str, quantity: Quantity) -> torch.Tensor | float:
    """The quantity of the trials; one number where no chance is in it."""
    values = quantity(results.scenes[scene].methods[method])
    exact = quantity is _evaluations or (method == LSSG and len(values) == 1)
    return float(values.mean()) if exact else values


def _means(results: StudyResult, scene: str, methods: Iterable[str], quantity: Quantity, unit: str) -> str:
    parts = []
    for method in methods:
        values = _values(results, scene, method, quantity)
        mean = Interval.exact(values) if isinstance(values, float) else Interval.unknown(float(values.mean()))
        parts.append(f"{METHOD_LABELS[method]} {mean}")
    return f"{', '.join(parts)} {unit}".rstrip()


def _verdict(margins: Iterable[Interval], evidence: Iterable[str]) -> Verdict:
    """A claim holds where all `margins` are positive."""
    margins = list(margins)
    holds = all(margin.value > 0 for margin in margins)
    if holds:
        clear = all(margin.low > 0 for margin in margins)
    else:
        clear = any(margin.high <= 0 for margin in margins)
    return Verdict(holds, clear, tuple(evidence))


def _above(number: Interval, threshold: float) -> Interval:
    return number.mapped(lambda value: value - threshold)


def _below(number: Interval, threshold: float) -> Interval:
    return number.mapped(lambda value: threshold - value)


def _ordered(
    smaller: str, larger: tuple[str, ...], quantity: Quantity, unit: str, scenes: Scenes
) -> Callable[[StudyResult], Verdict]:
    """In each of the `scenes`, `quantity` of one method is smaller than that of each of the `larger`."""

    def judge(results: StudyResult) -> Verdict:
        margins, lines = [], []
        for scene in scenes(results):
            parts = [_means(results, scene, (smaller, *larger), quantity, unit)]
            for name in larger:
                both = (_values(results, scene, method, quantity) for method in (name, smaller))
                margins.append(bootstrap(*both, combine=operator.sub))
                parts.append(f"{METHOD_LABELS[name]} - {METHOD_LABELS[smaller]} {margins[-1]}")
            lines.append(f"{scene}: {'; '.join(parts)}")
        return _verdict(margins, lines)

    return judge


def _share_of_empty(
    methods: tuple[str, ...], weaker: bool, scenes: Scenes
) -> Callable[[StudyResult], Verdict]:
    """In each of the `scenes` the mean pressure is much weaker than without obstacles, or is kept."""

    def judge(results: StudyResult) -> Verdict:
        margins, lines = [], ["share of the pressure without obstacles"]
        for scene in scenes(results):
            parts = []
            for method in methods:
                both = (
                    _values(results, name, method, _mean_pressure) for name in (scene, _empty(results)[0])
                )
                share = bootstrap(*both, combine=operator.truediv)
                margins.append((_below if weaker else _above)(share, MUCH_WEAKER))
                parts.append(f"{METHOD_LABELS[method]} {share}")
            lines.append(f"{scene}: {', '.join(parts)}")
        return _verdict(margins, lines)

    return judge


def _same_area(results: StudyResult) -> Verdict:
    margins, lines = [], []
    for scene in _empty_with_area(results):
        both = (_values(results, scene, method, _area) for method in (GABS, BO))
        ratio = bootstrap(*both, combine=operator.truediv)
        margins += [_above(ratio, 1 - SAME_LEVEL), _below(ratio, 1 / (1 - SAME_LEVEL))]
        lines.append(f"{scene}: {_means(results, scene, (GABS, BO), _area, 'mm²')}; GABS / BO {ratio}")
    return _verdict(margins, lines)


def _convergence(results: StudyResult) -> Verdict:
    margins, lines = [], ["share of the trials that converged"]
    for scene in results.scenes:
        bo, gabs = (
            share_interval(_converged(results.scenes[scene].methods[method])) for method in (BO, GABS)
        )
        margins += [_above(bo, 0.5), _below(gabs, 0.5)]
        lines.append(f"{scene}: BO {bo}, GABS {gabs}")
    return _verdict(margins, lines)


def _foci_form(results: StudyResult) -> Verdict:
    margins, lines = [], ["weakest focus over mean"]
    for scene in results.scenes:
        bo, gabs = (bootstrap(_values(results, scene, method, _weakest_share)) for method in (BO, GABS))
        margins += [_above(bo, FORMED), _above(gabs, FORMED)]
        lines.append(f"{scene}: BO {bo}, GABS {gabs}")
    return _verdict(margins, lines)


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
