"""The report of a study: ``report.md`` with the figures of the paper and a check of its claims."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from autdtorch.claims import BO, GABS, judge_claims
from autdtorch.findings import NEAR_BOUND, find
from autdtorch.intervals import FEWEST_TRIALS
from autdtorch.plot import plot_convergence, plot_planes, plot_scene, plot_trials
from autdtorch.plot.style import label_of
from autdtorch.results import RESULTS_FILE, MethodResult, SceneResult, StudyResult, summary_rows
from autdtorch.scene import Scene
from autdtorch.trial_file import TRIALS_FILE
from autdtorch.view3d import rendering_problem, view3d

REPORT_FILE = "report.md"

_FEW_TRIALS = 20  # below this, the spread of a method is not well known
_NO_NUMBER = "-"
_NEAR = f"{100 * NEAR_BOUND:.0f} %"

_BASELINE = "gradient_ascent"
"""The method that is no competitor but a line to compare with: it knows the transfer matrix."""

_FIG2 = """## Fig. 2: pressure on the observation plane

![pressure on the observation plane](fig2.png)

|p| of the trial of median score, the control points circled and obstacles outlined. A scene has one colour
scale for all methods."""

_FIG3 = """## Fig. 3: the trials

![trials](fig3abc.png)

{letters}. Boxes span the quartiles of the trials with a line at the median; a diamond is a single trial.

![convergence](fig3d.png)

(d) best score so far against evaluations; a dot marks where a method ends."""

_BELOW_SUMMARY = """Mean over the trials ± their standard deviation. *mean*, *weakest* and *std* are taken
over the foci of a trial.

Pressures are amplitudes, for transducers of pressure S/r with the source strength S of the scene's array.
The paper's scenes have that of its Eq. 2, S = 1/(4π) Pa m."""

_BELOW_CLAIMS = f"""Computed from the data: means over the trials, and in brackets the 95 % confidence
interval of each difference, ratio or share (bootstrap over the trials; Wilson's for shares of trials). LSSG
has no chance in it: its one trial is exact. *Not clearly*: an interval leaves the verdict open, or there are
fewer than {FEWEST_TRIALS} trials, which have no interval. Every interval is of one comparison alone."""

_BELOW_FINDINGS = f"""*Score*: pressure of the weakest focus, its median over the trials, in brackets with its
95 % confidence interval (bootstrap; none for fewer than {FEWEST_TRIALS} trials). *s a trial*: mean time of
the search alone, without simulation."""

_ABOUT_BOUND = f"""*Bound*: certified upper bound on the score of any drive with amplitudes up to 1, by the
semidefinite relaxation. No method can be better, and the best drive may lie below it. *Gap*: 1 - score/bound.
*To {_NEAR} of the bound*: evaluations until the best score so far was there, the median over the trials; in
parentheses how many of them got there, if not all. A trial that did not counts as later than all that did;
where that leaves the median open, there is a dash."""

_ABOUT_BASELINE = """{label} is a line to compare with and no competitor: it reads gradients off the transfer
matrix, which the others do not know, so that its evaluations are not listed."""

_READINGS = """## How the paper was read

- **Area a focus**: the cells of the observation plane where |p| is at least the mean pressure of the foci
  over √2 (half the intensity), divided by the number of foci. The paper's words, a threshold "above √2 of
  the average sound pressure", taken as a factor would leave nearly no area.
- **Evaluations** are those made, each an observation of all control points. GABS makes 1 + (M - 1) L of
  them for M transducers and L levels, since the phase of the first transducer alone changes no magnitude:
  241 for M = L = 16, where the paper counts 256. LSSG makes one pass of L offsets over the foci, the
  paper's 64. BO has a set number, its random start included.
- **Objective**: the pressure of the weakest focus, as in the paper. A trial returns the best drive it
  observed.
- **Frequency** (40 kHz) and **angle of the foci** on their circle are not in the paper; see the scenes'
  settings."""

_BELOW_SIMULATION = """A run ends when its estimated relative distance to the steady state is at most
{tolerance:g}; *to steady state* is the largest of a scene's runs. That says nothing of the error of the
grid: repeat the study with a smaller `solver.spacing` to see it."""

_ORIGIN = """## Origin

- versions: {versions}
- seed: {seed}
- source digest: `{digest}`
- everything behind this report: `{results}` (HDF5); a line a trial: `{trials}`

<details><summary>all settings</summary>

```yaml
{config}
```

</details>"""


def write_report(
    results: StudyResult, scenes: Mapping[str, Scene], folder: str | os.PathLike[str], command: str
) -> Path:
    """Write `report.md` and its figures.

    Args:
        results: what is reported.
        scenes: the scenes of `results`, by the same names.
        folder: for the report and its figures; made if need be.
        command: the command line that repeats the study.

    Returns:
        The report.

    Raises:
        OSError: the folder cannot be made or written.
        ValueError: a scene of `results` is missing in `scenes`.
    """
    if missing := results.scenes.keys() - scenes.keys():
        raise ValueError(f"scenes: none for {sorted(missing)}; must have every scene of the results")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    scenes = {name: scenes[name] for name in results.scenes}
    parts = [
        _head(results, command),
        _scene_figures(scenes, folder),
        _plane_figure(results, scenes, folder),
        _trial_figures(results, folder),
        _summary(results),
        _claims(results),
        _findings(results),
        _READINGS,
        _simulations(results),
        _origin(results),
    ]
    report = folder / REPORT_FILE
    report.write_text("\n\n".join(part for part in parts if part) + "\n", encoding="utf-8")
    return report


def finding_rows(results: StudyResult) -> list[list[str]]:
    """A table of how near to the bound the methods come and at what cost, its head first."""
    head = ["scene", "method", "score [Pa]", "gap to the bound [%]", "evaluations"]
    rows = [[*head, f"to {_NEAR} of the bound", "s a trial"]]
    for scene_name, scene in results.scenes.items():
        rows.append([scene_name, "*bound*", f"{scene.bound:.3g}", "0", *[_NO_NUMBER] * 3])
        for name, method in scene.methods.items():
            rows.append([scene_name, label_of(name), *_finding_cells(name, method, scene.bound)])
    return rows


def _finding_cells(name: str, method: MethodResult, bound: float) -> list[str]:
    finding = find(method, bound)
    gap = f"{finding.gap.mapped(lambda share: 100 * share):.1f}"
    evaluations = f"{method.solution.evaluations.double().mean():.0f}"
    near = _median_of_reached(finding.evaluations_near)
    if name == _BASELINE:
        evaluations = near = _NO_NUMBER
    return [str(finding.score), gap, evaluations, near, f"{method.seconds.mean():.2g}"]


def _median_of_reached(evaluations: torch.Tensor) -> str:
    """The median, and how many trials got there if not all did; inf is a trial that did not."""
    median, reached = float(np.median(evaluations.numpy())), int(evaluations.isfinite().sum())
    shown = f"{median:g}" if math.isfinite(median) else _NO_NUMBER
    every = len(evaluations) in (1, reached)
    return shown if every else f"{shown} ({reached} of {len(evaluations)})"


def _table(rows: Iterable[Sequence[str]]) -> str:
    head, *body = rows
    lines = [head, ["---"] * len(head), *body]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def _by_method(results: StudyResult) -> dict[str, dict[str, MethodResult]]:
    return {name: scene.methods for name, scene in results.scenes.items()}


def _head(results: StudyResult, command: str) -> str:
    counts = _trial_counts(results)
    lines = [
        "# Foci behind obstacles",
        f"Made by `{command}` with autdtorch {results.provenance.versions['autdtorch']}, begun "
        f"{results.provenance.date}.",
        "Trials: "
        + ", ".join(f"{label_of(name)} {_range(numbers)}" for name, numbers in counts.items())
        + ".",
    ]
    few = [label_of(name) for name in (BO, GABS) if max(counts.get(name, [_FEW_TRIALS])) < _FEW_TRIALS]
    if few:
        lines[-1] += f" Few of {' and '.join(few)}, where the paper has 50: read close comparisons with care."
    return "\n\n".join(lines)


def _trial_counts(results: StudyResult) -> dict[str, list[int]]:
    counts: dict[str, list[int]] = {}
    for scene in results.scenes.values():
        for name, method in scene.methods.items():
            counts.setdefault(name, []).append(method.trials)
    return counts


def _range(numbers: Sequence[int]) -> str:
    low, high = min(numbers), max(numbers)
    return str(low) if low == high else f"{low} to {high}"


def _scene_figures(scenes: Mapping[str, Scene], folder: Path) -> str:
    problem = rendering_problem()
    for name, scene in scenes.items():
        if problem is None:
            view3d(scene, save=folder / f"fig1_{name}.png").close()
        else:
            plot_scene(scene).savefig(folder / f"fig1_{name}.png")
    images = [f"![{name}](fig1_{name}.png)" for name in scenes]
    below = [] if problem is None else [f"Drawn with Matplotlib. {problem}."]
    return "\n\n".join(["## Fig. 1: the scenes", _table([list(scenes), images]), *below])


def _plane_figure(results: StudyResult, scenes: Mapping[str, Scene], folder: Path) -> str:
    pressure = {
        name: {
            method: result.plane_pressure
            for method, result in methods.items()
            if result.plane_pressure is not None
        }
        for name, methods in _by_method(results).items()
    }
    pressure = {name: fields for name, fields in pressure.items() if fields}
    if not pressure:
        return ""
    planes = {name: plane for name in pressure if (plane := scenes[name].observation_plane) is not None}
    points = {name: scenes[name].control_points for name in pressure}
    obstacles = {name: scenes[name].obstacles for name in pressure}
    plot_planes(pressure, planes, points, obstacles).savefig(folder / "fig2.png")
    return _FIG2


def _trial_figures(results: StudyResult, folder: Path) -> str:
    methods = _by_method(results)
    quantities = {"mean pressure of the foci [Pa]": _metric(methods, "mean")}
    if areas := _metric(methods, "area", scale=1e6):
        quantities["area a focus [mm²]"] = areas
    quantities["std among the foci [Pa]"] = _metric(methods, "std")
    plot_trials(quantities).savefig(folder / "fig3abc.png")
    history = {
        scene: {
            name: method.solution.history
            for name, method in by_name.items()
            if name != _BASELINE or len(by_name) == 1
        }
        for scene, by_name in methods.items()
    }
    levels = {name: _levels(scene) for name, scene in results.scenes.items()}
    plot_convergence(history, levels).savefig(folder / "fig3d.png")
    letters = ", ".join(f"({letter}) {label}" for letter, label in zip("abc", quantities, strict=False))
    return _FIG3.format(letters=letters)


def _levels(scene: SceneResult) -> dict[str, float]:
    """Scores that methods are compared with, by label."""
    levels = {"bound": scene.bound, f"{_NEAR} of the bound": NEAR_BOUND * scene.bound}
    if _BASELINE in scene.methods:
        levels[label_of(_BASELINE)] = float(scene.methods[_BASELINE].solution.score.median())
    return levels


def _metric(
    methods: Mapping[str, Mapping[str, MethodResult]], name: str, scale: float = 1.0
) -> dict[str, dict[str, torch.Tensor]]:
    """A figure of merit by scene and method; scenes that lack it are left out."""
    values = {
        scene: {
            method: scale * value
            for method, result in by_name.items()
            if (value := getattr(result.metrics, name)) is not None
        }
        for scene, by_name in methods.items()
    }
    return {scene: by_name for scene, by_name in values.items() if by_name}


def _summary(results: StudyResult) -> str:
    return "\n\n".join(["## Results", _table(summary_rows(results)), _BELOW_SUMMARY])


def _claims(results: StudyResult) -> str:
    rows = [["", "the paper's claim", "our reading", "our numbers", "verdict"]]
    for number, (claim, verdict) in enumerate(judge_claims(results), start=1):
        if verdict is None:
            evidence, outcome = "", "no data"
        else:
            evidence = "<br>".join(verdict.evidence)
            outcome = "**reproduced**" if verdict.holds else "**not reproduced**"
            outcome += "" if verdict.clear else ", but not clearly"
        rows.append([str(number), claim.text, claim.reading, evidence, outcome])
    return "\n\n".join(["## The paper's claims", _table(rows), _BELOW_CLAIMS])


def _findings(results: StudyResult) -> str:
    text = ["## Beyond the paper", _table(finding_rows(results)), _BELOW_FINDINGS, _ABOUT_BOUND]
    if any(_BASELINE in scene.methods for scene in results.scenes.values()):
        text.append(_ABOUT_BASELINE.format(label=label_of(_BASELINE).capitalize()))
    return "\n\n".join(text)


def _simulations(results: StudyResult) -> str:
    head = ["scene", "method", "spacing [mm]", "cells a wavelength", "runs", "periods", "to steady state"]
    rows = [[*head, "reached", "matrix [s]", "plane [s]"]]
    rows += [[name, *_simulation_cells(scene)] for name, scene in results.scenes.items()]
    text = ["## Simulation", _table(rows)]
    tolerances = [scene.simulation.tolerance for scene in results.scenes.values()]
    if given := [tolerance for tolerance in tolerances if tolerance is not None]:
        text.append(_BELOW_SIMULATION.format(tolerance=given[0]))
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
        _range([run.periods for run in runs]),
        f"{max(run.remaining for run in runs):.1e}",
        "yes" if all(run.reached for run in runs) else f"not in {sum(not run.reached for run in runs)} runs",
        *seconds,
    ]


def _origin(results: StudyResult) -> str:
    provenance = results.provenance
    return _ORIGIN.format(
        versions=", ".join(f"{name} {version}" for name, version in provenance.versions.items()),
        seed=provenance.seed,
        digest=provenance.source_digest,
        results=RESULTS_FILE,
        trials=TRIALS_FILE,
        config=provenance.config.strip(),
    )
