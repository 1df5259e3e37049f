"""The tables of the report of a study, as Markdown."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence

import numpy as np
import torch

from autdtorch.plot.style import label_of
from autdtorch.study.report.claims import CLAIMS, judge_claims
from autdtorch.study.results import MethodResult, SceneResult, StudyResult, summary_rows
from autdtorch.study.statistics import FEWEST_TRIALS, NEAR_BOUND, bound_gap

BASELINE = "gradient_ascent"
"""The method that is no competitor but a line to compare with: it knows the transfer matrix."""

NEAR = f"{100 * NEAR_BOUND:.0f} %"

_NO_NUMBER = "-"

_BELOW_SUMMARY = """Mean over the trials ± their standard deviation. *mean*, *weakest* and *std* are taken
over the foci of a trial.

Pressures are amplitudes, for transducers of pressure S/r with the source strength S of the scene's array.
The paper's scenes have that of its Eq. 2, S = 1/(4π) Pa m."""

_BELOW_CLAIMS = f"""Computed from the data: means over the trials, and in brackets the 95 % confidence
interval of each difference, ratio or share (bootstrap over the trials; Wilson's for shares of trials). LSSG
has no chance in it: its one trial is exact. *Not clearly*: an interval leaves the verdict open, or there are
fewer than {FEWEST_TRIALS} trials, which have no interval. Every interval is of one comparison alone."""

_NO_CLAIM = """No data: they are of LSSG, BO and GABS, each in the same scenes without and with obstacles."""

_BELOW_FINDINGS = f"""*Score*: pressure of the weakest focus, its median over the trials, in brackets with its
95 % confidence interval (bootstrap; none for fewer than {FEWEST_TRIALS} trials). *s per trial*: median time
of the search alone, without simulation."""

_ABOUT_BOUND = f"""*Bound*: certified upper bound on the score of any drive with amplitudes up to 1, by the
semidefinite relaxation. No method can be better, and the best drive may lie below it. *Gap*: 1 - score/bound.
*To {NEAR} of the bound*: evaluations until the best score so far was there, the median over the trials; in
parentheses how many of them got there, if not all. A trial that did not counts as later than all that did;
where that leaves the median open, there is a dash."""

_ABOUT_BASELINE = """{label} is a line to compare with and no competitor: it reads gradients off the transfer
matrix, which the others do not know, so that its evaluations are not listed."""

_BELOW_SIMULATION = """A run ends when its estimated relative distance to the steady state is at most
{tolerance}; *to steady state* is the largest of a scene's runs. That says nothing of the error of the
grid: repeat the study with a smaller `solver.spacing` to see it."""


def is_baseline(method: str) -> bool:
    """Whether a method is the baseline, with whatever settings."""
    return method.partition(",")[0] == BASELINE


def finding_rows(results: StudyResult) -> list[list[str]]:
    """A table of how near to the bound the methods come and at what cost, its head first."""
    head = ["scene", "method", "score [Pa]", "gap to the bound [%]", "evaluations"]
    rows = [[*head, f"to {NEAR} of the bound", "s per trial"]]
    for scene_name, scene in results.scenes.items():
        rows.append([scene_name, "*bound*", f"{scene.bound:.3g}", "0", *[_NO_NUMBER] * 3])
        for name, method in scene.methods.items():
            rows.append([scene_name, label_of(name), *_finding_cells(name, method, scene.bound)])
    return rows


def _finding_cells(name: str, method: MethodResult, bound: float) -> list[str]:
    finding = bound_gap(method, bound)
    gap = f"{finding.gap.mapped(lambda share: 100 * share):.1f}"
    evaluations = f"{method.solution.evaluations.double().mean():.0f}"
    near = _median_of_reached(finding.evaluations)
    if is_baseline(name):
        evaluations = near = _NO_NUMBER
    return [str(finding.score), gap, evaluations, near, f"{method.seconds.median():.2g}"]


def _median_of_reached(evaluations: torch.Tensor) -> str:
    """The median, and how many trials got there if not all did; inf is a trial that did not."""
    median, reached = float(np.median(evaluations.numpy())), int(evaluations.isfinite().sum())
    shown = f"{median:g}" if math.isfinite(median) else _NO_NUMBER
    every = len(evaluations) in (1, reached)
    return shown if every else f"{shown} ({reached} of {len(evaluations)})"


def extent(counts: Sequence[int]) -> str:
    """One number where all are alike, else from the least to the largest."""
    low, high = min(counts), max(counts)
    return str(low) if low == high else f"{low} to {high}"


def table(rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table, its head first."""
    head, *body = rows
    lines = [head, ["---"] * len(head), *body]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def code(text: str) -> str:
    """Return text as a code span, where neither Markdown nor HTML means anything."""
    line = re.sub(r"[\r\n]+", " ", text)
    ticks = _longer_than_any(line, 0)
    pad = " " if line.startswith("`") or line.endswith("`") else ""
    return f"{ticks}{pad}{line}{pad}{ticks}"


def fenced(text: str, language: str = "") -> str:
    """Return text as a code block, where neither Markdown nor HTML means anything."""
    ticks = _longer_than_any(text, 2)
    return f"{ticks}{language}\n{text}\n{ticks}"


def _longer_than_any(text: str, least: int) -> str:
    """More backticks than stand together anywhere in the text, and more than `least`."""
    return "`" * (1 + max([least, *map(len, re.findall("`+", text))]))


def summary(results: StudyResult) -> str:
    """The section of the results: the metrics of the methods."""
    return "\n\n".join(["## Results", table(summary_rows(results)), _BELOW_SUMMARY])


def claims(results: StudyResult) -> str:
    """The section of the paper's claims: those of what the results hold, each with its verdict."""
    rows = [["", "the paper's claim", "our reading", "our numbers", "verdict"]]
    missing = []
    for number, (claim, verdict) in enumerate(judge_claims(results), start=1):
        if verdict is None:
            missing.append(str(number))
            continue
        evidence = "<br>".join(verdict.evidence)
        outcome = "**reproduced**" if verdict.holds else "**not reproduced**"
        outcome += "" if verdict.clear else ", but not clearly"
        rows.append([str(number), claim.text, claim.reading, evidence, outcome])
    if len(rows) == 1:
        return f"## The paper's claims\n\n{_NO_CLAIM}"
    text = ["## The paper's claims", table(rows), _BELOW_CLAIMS]
    if missing:
        text.append(f"No data on the claims {', '.join(missing)} of {len(CLAIMS)}.")
    return "\n\n".join(text)


def findings(results: StudyResult) -> str:
    """The section of what the paper does not have: gaps to the bound."""
    text = ["## Beyond the paper", table(finding_rows(results)), _BELOW_FINDINGS, _ABOUT_BOUND]
    if any(is_baseline(name) for scene in results.scenes.values() for name in scene.methods):
        text.append(_ABOUT_BASELINE.format(label=label_of(BASELINE).capitalize()))
    return "\n\n".join(text)


def simulations(results: StudyResult) -> str:
    """The section of the simulations behind the results."""
    head = ["scene", "method", "spacing [mm]", "cells per wavelength", "runs", "periods", "to steady state"]
    rows = [[*head, "reached", "matrix [s]", "plane [s]"]]
    rows += [[name, *_simulation_cells(scene)] for name, scene in results.scenes.items()]
    text = ["## Simulation", table(rows)]
    tolerances = {scene.simulation.tolerance for scene in results.scenes.values()}
    if given := sorted(tolerance for tolerance in tolerances if tolerance is not None):
        text.append(_BELOW_SIMULATION.format(tolerance=" or ".join(f"{one:g}" for one in given)))
    return "\n\n".join(text)


def _simulation_cells(scene: SceneResult) -> list[str]:
    simulation = scene.simulation
    seconds = [f"{simulation.matrix_seconds:.1f}", f"{simulation.plane_seconds:.1f}"]
    if simulation.spacing is None:
        return [f"{simulation.method} (exact)", *["-"] * 6, *seconds]
    cells = simulation.wavelength / simulation.spacing
    head = [simulation.method, f"{1e3 * simulation.spacing:g}", f"{cells:.1f}"]
    runs = simulation.runs
    if not runs:
        return [*head, "0, kept on disk", *["-"] * 3, *seconds]
    return [
        *head,
        str(len(runs)),
        extent([run.periods for run in runs]),
        f"{max(run.remaining for run in runs):.1e}",
        "yes" if all(run.reached for run in runs) else f"not in {sum(not run.reached for run in runs)} runs",
        *seconds,
    ]
