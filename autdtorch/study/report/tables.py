"""Tables of a study: those of its report as rows of cells, header first, and ``summary.csv``."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from autdtorch.methods.catalogue import label_of
from autdtorch.propagators import Run
from autdtorch.scene.reflectors import kinds_of
from autdtorch.scene.scene import Scene, obstacle_kinds
from autdtorch.study.report.claims import Claim, Verdict
from autdtorch.study.results import MethodResult, SceneResult, StudyResult, column_decimals
from autdtorch.study.statistics import NEAR_BOUND, Interval, bound_gap, has_shares
from autdtorch.study.sweeps import Sweep
from autdtorch.utils.files import replacing
from autdtorch.utils.text import counted, in_digits

SUMMARY_FILE = "summary.csv"
BASELINE = "gradient_ascent"  # not a competitor: it knows the transfer matrix
NEAR = f"{100 * NEAR_BOUND:.0f} %"
_MOST_POINTS = 8  # control points, whose pressures have a column each


def is_baseline(method: str) -> bool:
    """Return whether a method is the baseline, with any settings."""
    return method.partition(",")[0] == BASELINE


def competitors(scene: SceneResult) -> Mapping[str, MethodResult]:
    """Return all methods except the baseline, which stays if it is the only one."""
    methods = {name: method for name, method in scene.methods.items() if not is_baseline(name)}
    return methods or scene.methods


def median_score(method: MethodResult) -> float:
    """Return the median score of the trials; of an even number, the mean of the middle two."""
    return float(np.median(method.solution.score.numpy()))


def claim_rows(judged: Iterable[tuple[Claim, Verdict | None]]) -> list[list[str]]:
    """Return the claims that have a verdict."""
    rows = [["no.", "the paper's claim", "verdict"]]
    for number, (claim, verdict) in enumerate(judged, start=1):
        if verdict is not None:
            outcome = "**reproduced**" if verdict.holds else "**not reproduced**"
            rows.append([str(number), claim.text, outcome + ("" if verdict.clear else ", but not clearly")])
    return rows


def evidence_rows(judged: Iterable[tuple[Claim, Verdict | None]]) -> list[list[str]]:
    """Return the reading of each claim that has a verdict, with our numbers."""
    rows = [["no.", "our reading", "our numbers"]]
    for number, (claim, verdict) in enumerate(judged, start=1):
        if verdict is not None:
            rows.append([str(number), claim.reading, "<br>".join(verdict.evidence)])
    return rows


def room_rows(scenes: Mapping[str, Scene]) -> list[list[str]]:
    """Return obstacles and reflectors of every scene; nothing where none reflects or absorbs."""
    if not any(
        scene.reflectors or any(body.is_lossy for body in scene.obstacles) for scene in scenes.values()
    ):
        return []
    rows = [["scene", "obstacles", "reflectors"]]
    for name, scene in scenes.items():
        kinds = obstacle_kinds(scene.obstacles), kinds_of(scene.reflectors)
        rows.append([name, *(", ".join(each) or "none" for each in kinds)])
    return rows


def focus_rows(results: StudyResult) -> list[list[str]]:
    """Return the pressure at each control point in the trials that are shown; nothing of many points."""
    scenes = {name: scene for name, scene in results.scenes.items() if scene.of_pressures}
    most = max((len(scene.transfer_matrix) for scene in scenes.values()), default=0)
    if not 0 < most <= _MOST_POINTS:
        return []
    rows = [["scene", "method", *(f"point {number} [Pa]" for number in range(1, most + 1))]]
    decimals = column_decimals(results, lambda method: method.solution.pressure)
    for name, scene in scenes.items():
        for method, result in scene.methods.items():
            pressures = result.solution.pressure[result.shown_trial].tolist()
            cells = [f"{pressure:.{decimals}f}" for pressure in pressures]
            rows.append([name, label_of(method), *cells, *["-"] * (most - len(cells))])
    return rows


def gap_rows(results: StudyResult) -> list[list[str]]:
    """Return score, gap to the bound and cost of every method."""
    head = ["scene", "method", "score", "gap to the bound", "evaluations"]
    rows = [[*head, f"to {NEAR} of the bound", "s per trial"]]
    form = f".{column_decimals(results, lambda method: method.solution.score)}f"
    for scene_name, scene in results.scenes.items():
        bound = scene.in_unit(f"{scene.bound:{form}}") if math.isfinite(scene.bound) else "no bound"
        rows.append([scene_name, "*bound*", bound, "-", "-", "-", "-"])
        for name, method in scene.methods.items():
            gap = bound_gap(method, scene.bound)
            scores = [scene.in_unit(f"{gap.score:{form}}"), _gap(gap.gap, scene, form)]
            evaluations = f"{np.median(method.solution.evaluations.numpy()):.0f}"
            near = _median_of_reached(gap.evaluations) if has_shares(scene.bound) else "-"
            counts = ["-", "-"] if is_baseline(name) else [evaluations, near]
            seconds = in_digits(float(method.seconds.median()), 2)
            rows.append([scene_name, label_of(name), *scores, *counts, seconds])
    return rows


def _gap(gap: Interval, scene: SceneResult, form: str) -> str:
    """Return the gap to the bound in percent, or as a difference where scores are no shares of the bound."""
    if has_shares(scene.bound):
        return f"{gap.mapped(lambda share: 100 * share):.1f} %"
    return scene.in_unit(f"{gap:{form}}") if math.isfinite(scene.bound) else "-"


def _median_of_reached(evaluations: torch.Tensor) -> str:
    """Return the median, and the number of trials that got there if not all did (inf otherwise)."""
    median, reached = float(np.median(evaluations.numpy())), int(evaluations.isfinite().sum())
    shown = f"{median:.0f}" if math.isfinite(median) else "-"
    return shown if len(evaluations) in (1, reached) else f"{shown} ({reached} of {len(evaluations)})"


def simulation_rows(results: StudyResult) -> list[list[str]]:
    """Return the simulation of every scene."""
    head = ["scene", "method", "spacing [mm]", "cells per wavelength", "runs", "periods", "to steady state"]
    rows = [[*head, "reached", "matrix [s]", "plane [s]"]]
    spacings = [scene.simulation.spacing for scene in results.scenes.values()]
    # As many decimals as the spacing with most of them has.
    decimals = max(len(f"{1e3 * (spacing or 0):g}".partition(".")[2]) for spacing in spacings)
    for name, scene in results.scenes.items():
        simulation, runs = scene.simulation, scene.simulation.runs
        if simulation.spacing is None:
            cells = [f"{simulation.method} (exact)", *["-"] * 6]
        else:
            a_wavelength = simulation.wavelength / simulation.spacing
            cells = [simulation.method, f"{1e3 * simulation.spacing:.{decimals}f}", f"{a_wavelength:.1f}"]
            cells += _run_cells(runs) if runs else ["0, kept on disk", "-", "-", "-"]
        seconds = (simulation.matrix_seconds, simulation.plane_seconds)
        rows.append([name, *cells, *(f"{duration:.2f}" for duration in seconds)])
    return rows


def _run_cells(runs: Sequence[Run]) -> list[str]:
    missed = sum(not run.reached for run in runs)
    reached = f"not in {counted(missed, 'run')}" if missed else "yes"
    remaining = f"{max(run.remaining for run in runs):.1e}"
    return [str(len(runs)), extent([run.periods for run in runs]), remaining, reached]


def extent(counts: Sequence[int]) -> str:
    """Return "3", or "3 to 5" if the counts differ."""
    low, high = min(counts), max(counts)
    return str(low) if low == high else f"{low} to {high}"


def save_summary(sweep: Sweep, path: Path) -> None:
    """Write a CSV table, one line for each method in each scene.

    The swept settings are columns and are left out of the names.
    """
    keys = sorted({key for settings in sweep.swept.values() for key in settings})
    rows = []
    for (name, method), settings in sweep.swept.items():
        scene = sweep.results.scenes[name]
        row: dict[str, object] = {"scene": name.partition(",")[0], "method": method.partition(",")[0]}
        row |= {key: settings.get(key) for key in keys} | _numbers(scene.methods[method], scene)
        rows.append(row)
    with replacing(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        lines = csv.DictWriter(file, list(rows[0]))
        lines.writeheader()
        lines.writerows(rows)


def _numbers(method: MethodResult, scene: SceneResult) -> dict[str, object]:
    gap = bound_gap(method, scene.bound)
    foci = {name: method.of_foci(name) for name in ("mean", "std", "area")}
    means = {name: None if values is None else float(values.mean()) for name, values in foci.items()}
    return {
        "goal": scene.goal["name"],
        "unit": scene.unit,
        "trials": method.trials,
        "median score": gap.score.value,
        "best score": float(method.solution.score.max()),
        "bound": scene.bound if math.isfinite(scene.bound) else None,
        "gap to the bound": gap.gap.value if has_shares(scene.bound) else None,
        "mean of the foci [Pa]": means["mean"],
        "std among the foci [Pa]": means["std"],
        "area a focus [m^2]": means["area"],
        "evaluations": float(method.solution.evaluations.double().mean()),
        "median seconds a trial": float(method.seconds.median()),
    }
