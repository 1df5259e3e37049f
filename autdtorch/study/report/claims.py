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

from autdtorch.io.goal_section import PAPERS_GOAL
from autdtorch.methods.catalogue import label_of
from autdtorch.methods.solution import Solution
from autdtorch.study.results import SceneResult, StudyResult, area_of
from autdtorch.study.statistics import Interval, bootstrap, share_interval
from autdtorch.utils.text import decimals_of

Comparison: TypeAlias = tuple[str, list[Interval]]
"""Our numbers in one scene as text, and margins that are all positive if the claim holds there."""

Margin: TypeAlias = Callable[[Interval, float], Interval]
Compare: TypeAlias = Callable[[SceneResult, SceneResult], Comparison]

LSSG, BO, GABS = "lssg", "bayes_opt", "gabs"

MUCH_WEAKER = 1 / math.sqrt(2)  # half the intensity; a pressure above this share of another is kept
SAME_LEVEL = 0.1  # areas are at the same level if they differ by less than this share of the larger one
LAST_PART = 0.1  # last share of the evaluations
CONVERGED = 0.01  # a trial has converged if its last part raises the score by at most this share
FORMED = 0.5  # foci have formed if the weakest has at least this share of their mean pressure

_SHARE = ".2f"  # form of shares and ratios
_UNITS = {"mean": ("Pa", 1.0), "std": ("Pa", 1.0), "area": ("mm²", 1e6), "evaluations": ("", 1.0)}


@dataclass(frozen=True)
class Verdict:
    """The outcome of a claim."""

    holds: bool  # every comparison comes out as claimed
    clear: bool  # the confidence intervals of the decisive comparisons leave no doubt
    evidence: tuple[str, ...]  # our numbers, line by line


@dataclass(frozen=True)
class Claim:
    """A claim of the paper."""

    text: str
    reading: str  # the comparison, with the threshold where the paper's words are vague
    compare: Compare  # compares in one scene, with the result of the first scene without obstacles
    methods: tuple[str, ...] = (BO, GABS)  # scenes without them are left out
    obstacles: bool | None = None  # about scenes with or without obstacles; None for both
    scene: str = ""  # name of the only scene it is about
    area: bool = False  # needs the area of the foci
    needs_empty: bool = False  # needs a scene without obstacles
    heading: str = ""  # first line of the evidence

    def judge(self, results: StudyResult) -> Verdict | None:
        """Return the verdict of the results, or None without the methods, scenes or goal of the claim."""
        usable = {
            name: scene
            for name, scene in results.scenes.items()
            if set(self.methods) <= scene.methods.keys() and scene.goal == PAPERS_GOAL
        }
        empty = [scene for scene in usable.values() if scene.obstacles == 0]
        comparisons = {
            name: self.compare(scene, (empty or [scene])[0])
            for name, scene in usable.items()
            if self._is_about(name, scene) and (empty or not self.needs_empty)
        }
        if not comparisons:
            return None
        margins = [margin for _, comparison in comparisons.values() for margin in comparison]
        holds = all(margin.value > 0 for margin in margins)
        surely_holds = all(margin.low > 0 for margin in margins)
        clear = surely_holds if holds else any(margin.high <= 0 for margin in margins)
        heading = [self.heading] if self.heading else []
        return Verdict(
            holds, clear, (*heading, *(f"{name}: {text}" for name, (text, _) in comparisons.items()))
        )

    def _is_about(self, name: str, scene: SceneResult) -> bool:
        with_area = all(area_of(method) is not None for method in scene.methods.values())
        fits = self.obstacles in (None, scene.obstacles > 0) and self.scene in ("", name)
        return fits and (with_area or not self.area)


def judge_claims(results: StudyResult) -> list[tuple[Claim, Verdict | None]]:
    """Return every claim with its verdict, None if the results have no data on it.

    Studies that do not compare the paper's three methods are about something else, and get no verdict.
    """
    compared = any(scene.methods.keys() >= {LSSG, BO, GABS} for scene in results.scenes.values())
    return [(claim, claim.judge(results) if compared else None) for claim in CLAIMS]


def _values(scene: SceneResult, method: str, quantity: str) -> torch.Tensor | float:
    """Return a quantity of each trial, or a single number if it is exact."""
    result = scene.methods[method]
    source = result.solution if quantity == "evaluations" else result.metrics
    assert source is not None  # of the paper's goal
    values: torch.Tensor = _UNITS[quantity][1] * getattr(source, quantity).double()
    exact = quantity == "evaluations" or (method == LSSG and len(values) == 1)
    return float(values.mean()) if exact else values


def _means(scene: SceneResult, methods: Iterable[str], quantity: str) -> tuple[str, str]:
    """Return the means of methods as text, and the form of their numbers."""
    means = {}
    for method in methods:
        values = _values(scene, method, quantity)
        means[label_of(method)] = values if isinstance(values, float) else float(values.mean())
    form = ".0f" if quantity == "evaluations" else f".{decimals_of(means.values())}f"
    texts = ", ".join(f"{label} {mean:{form}}" for label, mean in means.items())
    return f"{texts} {_UNITS[quantity][0]}".rstrip(), form


def _above(number: Interval, threshold: float) -> Interval:
    return number.mapped(lambda value: value - threshold)


def _below(number: Interval, threshold: float) -> Interval:
    return number.mapped(lambda value: threshold - value)


def _ordered(smaller: str, larger: tuple[str, ...], quantity: str) -> Compare:
    """Compare a quantity, which must be smaller for one method than for each of the others."""

    def compare(scene: SceneResult, _: SceneResult) -> Comparison:
        means, form = _means(scene, (smaller, *larger), quantity)
        parts, margins = [means], []
        for name in larger:
            both = (_values(scene, method, quantity) for method in (name, smaller))
            margins.append(bootstrap(*both, combine=operator.sub))
            parts.append(f"{label_of(name)} minus {label_of(smaller)}: {margins[-1]:{form}}")
        return "; ".join(parts), margins

    return compare


def _listed(numbers: dict[str, Interval]) -> str:
    return ", ".join(f"{label} {number:{_SHARE}}" for label, number in numbers.items())


def _same_area(scene: SceneResult, _: SceneResult) -> Comparison:
    both = (_values(scene, method, "area") for method in (GABS, BO))
    ratio = bootstrap(*both, combine=operator.truediv)
    text = f"{_means(scene, (GABS, BO), 'area')[0]}; GABS / BO {ratio:{_SHARE}}"
    return text, [_above(ratio, 1 - SAME_LEVEL), _below(ratio, 1 / (1 - SAME_LEVEL))]


def _convergence(scene: SceneResult, _: SceneResult) -> Comparison:
    bo, gabs = (share_interval(_converged(scene.methods[method].solution)) for method in (BO, GABS))
    return _listed({"BO": bo, "GABS": gabs}), [_above(bo, 0.5), _below(gabs, 0.5)]


def _converged(solution: Solution) -> torch.Tensor:
    """Return for each trial whether it converged before its end."""
    history, evaluations = solution.history, solution.evaluations
    end = evaluations.long() - 1  # entries after it are padding
    before = ((1 - LAST_PART) * evaluations).ceil().long() - 1
    return history.gather(1, before[:, None]) >= (1 - CONVERGED) * history.gather(1, end[:, None])


def _foci_form(scene: SceneResult, _: SceneResult) -> Comparison:
    metrics = (scene.methods[method].metrics for method in (BO, GABS))
    bo, gabs = (bootstrap(foci.min / foci.mean) for foci in metrics if foci is not None)
    return _listed({"BO": bo, "GABS": gabs}), [_above(bo, FORMED), _above(gabs, FORMED)]


def _compared_with_empty(
    text: str, reading: str, margin: Margin, methods: tuple[str, ...], name: str = ""
) -> Claim:
    """Return a claim on shares of the mean pressure without obstacles, in all scenes or the one of a name."""

    def compare(scene: SceneResult, empty: SceneResult) -> Comparison:
        shares = {}
        for method in methods:
            both = (_values(result, method, "mean") for result in (scene, empty))
            shares[label_of(method)] = bootstrap(*both, combine=operator.truediv)
        return _listed(shares), [margin(share, MUCH_WEAKER) for share in shares.values()]

    heading = "share of the pressure without obstacles"
    return Claim(text, reading, compare, methods, True, name, needs_empty=True, heading=heading)


CLAIMS = (
    Claim(
        "LSSG gives weaker foci than BO and GABS, without and with obstacles.",
        "mean pressure of the foci, in every scene",
        _ordered(LSSG, (BO, GABS), "mean"),
        (LSSG, BO, GABS),
    ),
    _compared_with_empty(
        "With three cubes, the pressure of LSSG is much weaker than without obstacles.",
        f"much weaker: mean pressure below {MUCH_WEAKER:.2f} (half the intensity) of that without obstacles",
        _below,
        (LSSG,),
        "three_cubes",
    ),
    _compared_with_empty(
        "With obstacles in general, the mean pressure of LSSG is much weaker than without.",
        "as claim 2, in every scene with obstacles",
        _below,
        (LSSG,),
    ),
    _compared_with_empty(
        "BO and GABS keep a strong pressure with obstacles.",
        f"kept: mean pressure above {MUCH_WEAKER:.2f} of that without obstacles by the same method, "
        "in every scene with obstacles",
        _above,
        (BO, GABS),
    ),
    Claim(
        "The mean pressure of GABS is higher than that of BO.",
        "in every scene",
        _ordered(BO, (GABS,), "mean"),
    ),
    Claim(
        "Without obstacles, the foci of GABS and BO have areas at the same level.",
        f"same level: less than {100 * SAME_LEVEL:.0f} % apart",
        _same_area,
        obstacles=False,
        area=True,
    ),
    Claim(
        "With obstacles, the foci of GABS have a smaller area than those of BO.",
        "in every scene with obstacles",
        _ordered(GABS, (BO,), "area"),
        obstacles=True,
        area=True,
    ),
    Claim(
        "The standard deviation among the foci is lower for BO than for GABS.",
        "in every scene",
        _ordered(BO, (GABS,), "std"),
    ),
    Claim(
        "BO may converge within the evaluations it is given, GABS needs all of its own.",
        f"converged: the last {100 * LAST_PART:.0f} % of the evaluations raise the score by at most "
        f"{100 * CONVERGED:.0f} %; "
        "more than half of the trials of BO, less than half of those of GABS, in every scene",
        _convergence,
        heading="share of the trials that converged",
    ),
    Claim(
        "LSSG needs the fewest evaluations.",
        "in every scene (the paper: LSSG 64, BO 256, GABS 256)",
        _ordered(LSSG, (BO, GABS), "evaluations"),
        (LSSG, BO, GABS),
    ),
    Claim(
        "With BO and GABS the foci form, without and with obstacles.",
        f"formed: the weakest focus has over {100 * FORMED:.0f} % of the mean pressure of the foci, "
        "in every scene",
        _foci_form,
        heading="weakest focus over mean",
    ),
)
"""The paper's claims, in its order."""
