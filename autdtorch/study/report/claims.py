"""The paper's claims (sections IV and V), each judged by the results of a study.

The comparisons are of means over the trials. A comparison is clear if its 95 % confidence interval lies
entirely on one side of the threshold.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TypeAlias

import torch

from autdtorch.methods.catalogue import label_of
from autdtorch.study.results import MethodResult, SceneResult, StudyResult
from autdtorch.study.statistics import Interval, bootstrap, share_interval

Quantity: TypeAlias = Callable[[MethodResult], torch.Tensor]

Comparison: TypeAlias = tuple[str, list[Interval]]
"""Our numbers in one scene as text, and margins that are all positive if the claim holds there."""

LSSG, BO, GABS = "lssg", "bayes_opt", "gabs"

MUCH_WEAKER = 1 / math.sqrt(2)
"""Below this share of another pressure (half the intensity), a pressure is much weaker; above it, kept."""

SAME_LEVEL = 0.1
"""Areas are at the same level if they differ by less than this share of the larger one."""

CONVERGED = 0.01
"""A trial has converged if its last `LAST_PART` of evaluations raises the score by at most this share."""

LAST_PART = 0.1
"""See `CONVERGED`."""

FORMED = 0.5
"""Foci have formed if the weakest has at least this share of their mean pressure."""


@dataclass(frozen=True)
class Verdict:
    """The outcome of a claim.

    Attributes:
        holds: whether every comparison comes out as claimed.
        clear: whether the confidence intervals of the decisive comparisons leave no doubt.
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
        reading: the comparison, with the threshold where the paper's words are vague.
        methods: names of the methods it compares; scenes without them are left out.
        scenes: whether the claim is about a scene, from its name and result.
        compare: compares in one scene, given the result of the first scene without obstacles.
        heading: first line of the evidence.
        needs_empty: whether `compare` needs a scene without obstacles.
    """

    text: str
    reading: str
    methods: tuple[str, ...]
    scenes: Callable[[str, SceneResult], bool]
    compare: Callable[[SceneResult, SceneResult], Comparison]
    heading: str = ""
    needs_empty: bool = False

    def judge(self, results: StudyResult) -> Verdict | None:
        """Return the verdict of the results, or None if they lack methods or scenes of the claim."""
        usable = {
            name: scene for name, scene in results.scenes.items() if set(self.methods) <= scene.methods.keys()
        }
        chosen = {name: scene for name, scene in usable.items() if self.scenes(name, scene)}
        empty = [scene for scene in usable.values() if scene.obstacles == 0]
        if not chosen or (self.needs_empty and not empty):
            return None
        found = {name: self.compare(scene, (empty or [scene])[0]) for name, scene in chosen.items()}
        margins = [margin for _, one in found.values() for margin in one]
        holds = all(margin.value > 0 for margin in margins)
        if holds:
            clear = all(margin.low > 0 for margin in margins)
        else:
            clear = any(margin.high <= 0 for margin in margins)
        lines = [f"{name}: {text}" for name, (text, _) in found.items()]
        return Verdict(holds, clear, tuple([self.heading, *lines] if self.heading else lines))


def judge_claims(results: StudyResult) -> list[tuple[Claim, Verdict | None]]:
    """Return every claim with its verdict, None if the results have no data on it."""
    return [(claim, claim.judge(results)) for claim in CLAIMS]


def _every(_: str, __: SceneResult) -> bool:
    return True


def _obstructed(_: str, scene: SceneResult) -> bool:
    return scene.obstacles > 0


def _three_cubes(name: str, scene: SceneResult) -> bool:
    return name == "three_cubes" and scene.obstacles > 0


def _empty_with_area(_: str, scene: SceneResult) -> bool:
    return scene.obstacles == 0 and _has_area(scene)


def _obstructed_with_area(_: str, scene: SceneResult) -> bool:
    return scene.obstacles > 0 and _has_area(scene)


def _has_area(scene: SceneResult) -> bool:
    return all(method.metrics.area is not None for method in scene.methods.values())


def _mean_pressure(method: MethodResult) -> torch.Tensor:
    return method.metrics.mean


def _area(method: MethodResult) -> torch.Tensor:
    """Return the area per focus [mm^2]."""
    assert method.metrics.area is not None  # see `_has_area`
    return 1e6 * method.metrics.area


def _std(method: MethodResult) -> torch.Tensor:
    return method.metrics.std


def _weakest_share(method: MethodResult) -> torch.Tensor:
    return method.metrics.min / method.metrics.mean


def _evaluations(method: MethodResult) -> torch.Tensor:
    return method.solution.evaluations.double()


def _converged(method: MethodResult) -> torch.Tensor:
    """Return for each trial whether it converged before its end."""
    history, evaluations = method.solution.history, method.solution.evaluations
    end = evaluations.long() - 1  # entries after it are padding
    before = ((1 - LAST_PART) * evaluations).ceil().long() - 1
    return history.gather(1, before[:, None]) >= (1 - CONVERGED) * history.gather(1, end[:, None])


def _values(scene: SceneResult, method: str, quantity: Quantity) -> torch.Tensor | float:
    """Return a quantity of each trial, or a single number if it is exact."""
    values = quantity(scene.methods[method])
    exact = quantity is _evaluations or (method == LSSG and len(values) == 1)
    return float(values.mean()) if exact else values


def _means(scene: SceneResult, methods: Iterable[str], quantity: Quantity, unit: str) -> str:
    parts = []
    for method in methods:
        values = _values(scene, method, quantity)
        mean = Interval.exact(values) if isinstance(values, float) else Interval.unknown(float(values.mean()))
        parts.append(f"{label_of(method)} {mean}")
    return f"{', '.join(parts)} {unit}".rstrip()


def _above(number: Interval, threshold: float) -> Interval:
    return number.mapped(lambda value: value - threshold)


def _below(number: Interval, threshold: float) -> Interval:
    return number.mapped(lambda value: threshold - value)


def _ordered(
    smaller: str, larger: tuple[str, ...], quantity: Quantity, unit: str
) -> Callable[[SceneResult, SceneResult], Comparison]:
    """Compare a quantity: that of one method must be smaller than that of each of the others."""

    def compare(scene: SceneResult, _: SceneResult) -> Comparison:
        parts, margins = [_means(scene, (smaller, *larger), quantity, unit)], []
        for name in larger:
            both = (_values(scene, method, quantity) for method in (name, smaller))
            margins.append(bootstrap(*both, combine=operator.sub))
            parts.append(f"{label_of(name)} - {label_of(smaller)} {margins[-1]}")
        return "; ".join(parts), margins

    return compare


def _share_of_empty(
    methods: tuple[str, ...], margin: Callable[[Interval, float], Interval]
) -> Callable[[SceneResult, SceneResult], Comparison]:
    """Compare the mean pressure with that without obstacles; `margin` is `_above` or `_below`."""

    def compare(scene: SceneResult, empty: SceneResult) -> Comparison:
        shares = {
            label_of(method): bootstrap(
                *(_values(one, method, _mean_pressure) for one in (scene, empty)), combine=operator.truediv
            )
            for method in methods
        }
        return _listed(shares), [margin(share, MUCH_WEAKER) for share in shares.values()]

    return compare


def _listed(numbers: dict[str, Interval]) -> str:
    return ", ".join(f"{label} {number}" for label, number in numbers.items())


def _same_area(scene: SceneResult, _: SceneResult) -> Comparison:
    both = (_values(scene, method, _area) for method in (GABS, BO))
    ratio = bootstrap(*both, combine=operator.truediv)
    text = f"{_means(scene, (GABS, BO), _area, 'mm²')}; GABS / BO {ratio}"
    return text, [_above(ratio, 1 - SAME_LEVEL), _below(ratio, 1 / (1 - SAME_LEVEL))]


def _convergence(scene: SceneResult, _: SceneResult) -> Comparison:
    bo, gabs = (share_interval(_converged(scene.methods[method])) for method in (BO, GABS))
    return _listed({"BO": bo, "GABS": gabs}), [_above(bo, 0.5), _below(gabs, 0.5)]


def _foci_form(scene: SceneResult, _: SceneResult) -> Comparison:
    bo, gabs = (bootstrap(_values(scene, method, _weakest_share)) for method in (BO, GABS))
    return _listed({"BO": bo, "GABS": gabs}), [_above(bo, FORMED), _above(gabs, FORMED)]


_SHARE = "share of the pressure without obstacles"

CLAIMS = (
    Claim(
        "LSSG gives weaker foci than BO and GABS, without and with obstacles.",
        "mean pressure of the foci, in every scene",
        (LSSG, BO, GABS),
        _every,
        _ordered(LSSG, (BO, GABS), _mean_pressure, "Pa"),
    ),
    Claim(
        "With three cubes, the pressure of LSSG is much weaker than without obstacles.",
        f"much weaker: mean pressure below {MUCH_WEAKER:.2f} (half the intensity) of that without obstacles",
        (LSSG,),
        _three_cubes,
        _share_of_empty((LSSG,), _below),
        heading=_SHARE,
        needs_empty=True,
    ),
    Claim(
        "With obstacles in general, the mean pressure of LSSG is much weaker than without.",
        "as claim 2, in every scene with obstacles",
        (LSSG,),
        _obstructed,
        _share_of_empty((LSSG,), _below),
        heading=_SHARE,
        needs_empty=True,
    ),
    Claim(
        "BO and GABS keep a strong pressure with obstacles.",
        f"kept: mean pressure above {MUCH_WEAKER:.2f} of that without obstacles by the same method, in every "
        "scene with obstacles",
        (BO, GABS),
        _obstructed,
        _share_of_empty((BO, GABS), _above),
        heading=_SHARE,
        needs_empty=True,
    ),
    Claim(
        "The mean pressure of GABS is higher than that of BO.",
        "in every scene",
        (BO, GABS),
        _every,
        _ordered(BO, (GABS,), _mean_pressure, "Pa"),
    ),
    Claim(
        "Without obstacles, the foci of GABS and BO have areas at the same level.",
        f"same level: less than {SAME_LEVEL:.0%} apart",
        (BO, GABS),
        _empty_with_area,
        _same_area,
    ),
    Claim(
        "With obstacles, the foci of GABS have a smaller area than those of BO.",
        "in every scene with obstacles",
        (BO, GABS),
        _obstructed_with_area,
        _ordered(GABS, (BO,), _area, "mm²"),
    ),
    Claim(
        "The standard deviation among the foci is lower for BO than for GABS.",
        "in every scene",
        (BO, GABS),
        _every,
        _ordered(BO, (GABS,), _std, "Pa"),
    ),
    Claim(
        "BO may converge within the evaluations it is given, GABS needs all of its own.",
        f"converged: the last {LAST_PART:.0%} of the evaluations raise the score by at most {CONVERGED:.0%}; "
        "more than half of the trials of BO, less than half of those of GABS, in every scene",
        (BO, GABS),
        _every,
        _convergence,
        heading="share of the trials that converged",
    ),
    Claim(
        "LSSG needs the fewest evaluations.",
        "in every scene (the paper: LSSG 64, BO 256, GABS 256)",
        (LSSG, BO, GABS),
        _every,
        _ordered(LSSG, (BO, GABS), _evaluations, ""),
    ),
    Claim(
        "With BO and GABS the foci form, without and with obstacles.",
        f"formed: the weakest focus has over {FORMED:.0%} of the mean pressure of the foci, in every scene",
        (BO, GABS),
        _every,
        _foci_form,
        heading="weakest focus over mean",
    ),
)
"""The paper's claims, in its order."""
