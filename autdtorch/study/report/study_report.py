"""The report of a study: figures of the paper, a check of its claims, and what is beyond it."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from autdtorch.plot.fields import plot_planes
from autdtorch.plot.pareto import plot_pareto
from autdtorch.plot.scene import plot_scene
from autdtorch.plot.style import label_of
from autdtorch.plot.trials import plot_convergence, plot_trials
from autdtorch.plot.view3d import rendering_problem, view3d
from autdtorch.scene.scene import Scene
from autdtorch.study.report.claims import BO, GABS
from autdtorch.study.report.document import as_page
from autdtorch.study.report.tables import (
    NEAR,
    claims,
    code,
    extent,
    fenced,
    findings,
    is_baseline,
    simulations,
    summary,
    table,
)
from autdtorch.study.results import MethodResult, SceneResult, StudyResult
from autdtorch.study.results_file import RESULTS_FILE
from autdtorch.study.statistics import NEAR_BOUND, bound_gap
from autdtorch.study.trial_file import TRIALS_FILE

REPORT_FILE = "report.md"

HTML_FILE = "report.html"
"""Stands beside `REPORT_FILE`: the same in one file, its figures inside."""

_SCENES_A_ROW = 2  # more would make the labels too small to read
_PLANES_A_FIGURE = 4
_FEW_TRIALS = 20  # below this, the spread of a method is not well known
_FIG2 = """## Fig. 2: pressure on the observation plane

{images}

|p| of the trial of median score, the control points circled and obstacles outlined. A scene has one colour
scale for all methods."""

_FIG3 = """## Fig. 3: the trials

![trials](fig3abc.png)

{letters}. Boxes span the quartiles of the trials with a line at the median; a diamond is a single trial.

![convergence](fig3d.png)

(d) best score so far against evaluations; a dot marks where a method ends."""

_FIG4 = """![score and time](fig4.png)

Score over bound against the time of the search, medians and means over the trials as in the table. The grey
line is the front: the best score that a method comes to in that time. On a device the
evaluations take time of their own, see (d)."""

_READINGS = """## How the paper was read

- **Area per focus**: the cells of the observation plane where |p| is at least the mean pressure of the foci
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

_ORIGIN = """## Origin

- versions: {versions}
- {seeds}
- source digest: {digest}
- everything behind this report{where}: `{results}` (HDF5); a line a trial: `{trials}`

<details><summary>all settings</summary>

{config}

</details>"""


def write_report(
    results: StudyResult,
    scenes: Mapping[str, Scene],
    folder: str | os.PathLike[str],
    command: str,
    seeds: Sequence[int] = (),
) -> Path:
    """Write `report.md` and its figures, and all of it as one file `report.html`.

    Args:
        results: what is reported.
        scenes: the scenes of `results`, by the same names.
        folder: for the report and its figures; made if need be.
        command: the command line that repeats the study.
        seeds: of the studies that `results` were merged from; none if they are of one study, in `folder`.

    Returns:
        The path of `report.html`.

    Raises:
        OSError: the folder cannot be made or written.
        ValueError: a scene of `results` is missing in `scenes`.
    """
    if missing := results.scenes.keys() - scenes.keys():
        raise ValueError(f"scenes: none for {sorted(missing)}; must have every scene of the results")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    scenes = {name: scenes[name] for name in results.scenes}
    with tempfile.TemporaryDirectory(dir=folder, prefix=".report-") as new:
        _write(results, scenes, Path(new), command, seeds)
        # A file takes the place of one that is there, and of a link: none is written through.
        for file in Path(new).iterdir():
            file.replace(folder / file.name)
    return folder / HTML_FILE


def _write(
    results: StudyResult, scenes: Mapping[str, Scene], folder: Path, command: str, seeds: Sequence[int]
) -> None:
    parts = [
        _head(results, command),
        _scene_figures(scenes, folder),
        _plane_figures(results, scenes, folder),
        _trial_figures(results, folder),
        summary(results),
        claims(results),
        findings(results),
        _cost_figure(results, folder),
        _READINGS,
        simulations(results),
        _origin(results, seeds),
    ]
    text = "\n\n".join(part for part in parts if part) + "\n"
    (folder / REPORT_FILE).write_text(text, encoding="utf-8")
    (folder / HTML_FILE).write_text(as_page(text, folder), encoding="utf-8")


def _by_method(results: StudyResult) -> dict[str, dict[str, MethodResult]]:
    return {name: scene.methods for name, scene in results.scenes.items()}


def _head(results: StudyResult, command: str) -> str:
    counts = _trial_counts(results)
    lines = [
        "# Foci behind obstacles",
        f"Made by {code(command)} with autdtorch {code(results.provenance.versions['autdtorch'])}, begun "
        f"{code(results.provenance.date)}.",
        "Trials: "
        + ", ".join(f"{label_of(name)} {extent(numbers)}" for name, numbers in counts.items())
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


def _scene_figures(scenes: Mapping[str, Scene], folder: Path) -> str:
    problem = rendering_problem()
    images = {}
    for name, scene in scenes.items():
        file = f"fig1_{name}.png"
        if problem is None:
            view3d(scene, save=folder / file).close()
        else:
            plot_scene(scene).savefig(folder / file)
        images[name] = f"![{name}]({file})"
    rows = [table([part, [images[name] for name in part]]) for part in _parts(list(scenes), _SCENES_A_ROW)]
    below = [] if problem is None else [f"Drawn with Matplotlib. {problem}."]
    return "\n\n".join(["## Fig. 1: the scenes", *rows, *below])


def _parts(names: Sequence[str], most: int) -> list[Sequence[str]]:
    return [names[start : start + most] for start in range(0, len(names), most)]


def _plane_figures(results: StudyResult, scenes: Mapping[str, Scene], folder: Path) -> str:
    pressure = {
        name: {
            method: result.plane_pressure
            for method, result in methods.items()
            if result.plane_pressure is not None
        }
        for name, methods in _by_method(results).items()
    }
    planes = {name: plane for name in pressure if (plane := scenes[name].observation_plane) is not None}
    images: list[str] = []
    for part in _parts([name for name in planes if pressure[name]], _PLANES_A_FIGURE):
        images.append(f"fig2_{len(images) + 1}.png" if images else "fig2.png")
        figure = plot_planes(
            {name: pressure[name] for name in part},
            planes,
            {name: scenes[name].control_points for name in part},
            {name: scenes[name].obstacles for name in part},
        )
        figure.savefig(folder / images[-1])
    shown = "\n\n".join(f"![pressure on the observation plane]({image})" for image in images)
    return _FIG2.format(images=shown) if images else ""


def _trial_figures(results: StudyResult, folder: Path) -> str:
    methods = _by_method(results)
    quantities = {"mean pressure of the foci [Pa]": _metric(methods, "mean")}
    if areas := _metric(methods, "area", scale=1e6):
        quantities["area per focus [mm²]"] = areas
    quantities["std among the foci [Pa]"] = _metric(methods, "std")
    plot_trials(quantities).savefig(folder / "fig3abc.png")
    history = {
        scene: {name: method.solution.history for name, method in _competitors(by_name).items()}
        for scene, by_name in methods.items()
    }
    levels = {name: _levels(scene) for name, scene in results.scenes.items()}
    plot_convergence(history, levels).savefig(folder / "fig3d.png")
    letters = ", ".join(f"({letter}) {label}" for letter, label in zip("abc", quantities, strict=False))
    return _FIG3.format(letters=letters)


def _levels(scene: SceneResult) -> dict[str, float]:
    """Scores that methods are compared with, by label."""
    levels = {"bound": scene.bound, f"{NEAR} of the bound": NEAR_BOUND * scene.bound}
    for name in scene.methods:
        if name not in _competitors(scene.methods):
            levels[label_of(name)] = float(scene.methods[name].solution.score.median())
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


def _cost_figure(results: StudyResult, folder: Path) -> str:
    points = {
        scene: {
            name: [(float(method.seconds.median()), 100 * (1 - bound_gap(method, found.bound).gap.value))]
            for name, method in _competitors(found.methods).items()
        }
        for scene, found in results.scenes.items()
    }
    figure = plot_pareto(
        points, "median time of the search [s per trial]", "score / bound [%]", higher_is_better=True
    )
    figure.savefig(folder / "fig4.png")
    return _FIG4


def _competitors(methods: Mapping[str, MethodResult]) -> Mapping[str, MethodResult]:
    """All but the baseline, which stays where it is alone."""
    return {name: method for name, method in methods.items() if not is_baseline(name)} or methods


def _origin(results: StudyResult, seeds: Sequence[int]) -> str:
    provenance = results.provenance
    return _ORIGIN.format(
        versions=code(", ".join(f"{name} {version}" for name, version in provenance.versions.items())),
        seeds=f"seeds: {', '.join(map(str, seeds))}" if seeds else f"seed: {provenance.seed}",
        where=", in the folders that the settings name" if seeds else "",
        digest=code(provenance.source_digest),
        results=RESULTS_FILE,
        trials=TRIALS_FILE,
        config=fenced(provenance.config.strip(), "yaml"),
    )
