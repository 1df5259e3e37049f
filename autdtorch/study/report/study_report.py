"""The report of a study: the paper's figures and claims with our numbers, and the gaps to the bound."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from autdtorch.io.goal_section import score_label
from autdtorch.methods.catalogue import label_of
from autdtorch.plot.costs import plot_pareto
from autdtorch.plot.pressure_maps import plot_planes
from autdtorch.plot.scene_figure import plot_scene
from autdtorch.plot.trials import plot_convergence, plot_trials
from autdtorch.plot.view3d import rendering_problem, view3d
from autdtorch.scene.scene import Scene
from autdtorch.study.report import tables
from autdtorch.study.report.claims import BO, GABS, judge_claims
from autdtorch.study.report.document import as_page, rendered
from autdtorch.study.results import MethodResult, SceneResult, StudyResult, summary_rows
from autdtorch.study.results_file import RESULTS_FILE
from autdtorch.study.statistics import FEWEST_TRIALS, NEAR_BOUND, has_shares
from autdtorch.study.trial_file import TRIALS_FILE

REPORT_FILE = "report.md"
HTML_FILE = "report.html"

_Key = TypeVar("_Key")

_FEW_TRIALS = 20  # with fewer, the spread of a method is not well known
_PLANES_A_FIGURE = 4


def write_report(
    results: StudyResult, scenes: Mapping[str, Scene], folder: Path, command: str, seeds: Sequence[int] = ()
) -> Path:
    """Write `report.md` and its figures, and both as one file `report.html`, whose path is returned.

    `scenes` are those of the results, by name. `seeds` are those of the studies that the results were merged
    from; there are none for a single study in `folder`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".report-") as name:
        new = Path(name)
        text = _markdown(results, scenes, new, command, seeds)
        (new / REPORT_FILE).write_text(text, encoding="utf-8")
        (new / HTML_FILE).write_text(as_page(text, new), encoding="utf-8")
        # A file replaces an older one, or a link: nothing is written through a link.
        for file in new.iterdir():
            file.replace(folder / file.name)
    return folder / HTML_FILE


def _markdown(
    results: StudyResult, scenes: Mapping[str, Scene], folder: Path, command: str, seeds: Sequence[int]
) -> str:
    """Draw the figures into a folder; return the text of the report."""
    counts: dict[str, list[int]] = {}
    for scene in results.scenes.values():
        for name, method in scene.methods.items():
            counts.setdefault(name, []).append(method.trials)
    judged = judge_claims(results)
    tolerances = {scene.simulation.tolerance for scene in results.scenes.values()}
    return rendered(
        "study.md",
        command=command,
        provenance=results.provenance,
        versions=", ".join(f"{name} {version}" for name, version in results.provenance.versions.items()),
        seeds=seeds,
        trials=", ".join(f"{label_of(name)} {tables.extent(numbers)}" for name, numbers in counts.items()),
        few=[label_of(name) for name in (BO, GABS) if max(counts.get(name, [_FEW_TRIALS])) < _FEW_TRIALS],
        fewest_trials=FEWEST_TRIALS,
        rendering_problem=_draw_scenes(scenes, folder),
        scenes=[(name, f"![{name}](fig1_{name}.png)") for name in scenes],
        planes=_draw_planes(results, scenes, folder),
        goals=list(dict.fromkeys(scene.score_label for scene in results.scenes.values())),
        differences=not all(has_shares(scene.bound) for scene in results.scenes.values()),
        convergence=_draw_convergence(results, folder),
        costs=_draw_costs(results, folder),
        quantities=_draw_trials(results, folder),
        summary=summary_rows(results),
        claims=tables.claim_rows(judged),
        claims_in_all=len(judged),
        claims_without_data=[n for n, (_, verdict) in enumerate(judged, start=1) if verdict is None],
        gaps=tables.gap_rows(results),
        near=tables.NEAR,
        baseline=label_of(tables.BASELINE) if any(map(tables.is_baseline, counts)) else "",
        simulations=tables.simulation_rows(results),
        tolerances=[f"{one:g}" for one in sorted(one for one in tolerances if one is not None)],
        results_file=RESULTS_FILE,
        trials_file=TRIALS_FILE,
    )


def _draw_scenes(scenes: Mapping[str, Scene], folder: Path) -> str | None:
    """Return why the scenes are not rendered in 3D, or None."""
    problem = rendering_problem()
    for name, scene in scenes.items():
        if problem is None:
            view3d(scene, save=folder / f"fig1_{name}.png").close()
        else:
            plot_scene(scene).savefig(folder / f"fig1_{name}.png")
    return problem


def _draw_planes(results: StudyResult, scenes: Mapping[str, Scene], folder: Path) -> list[str]:
    """Return the names of the files."""
    pressure = _by_method(results, lambda result: result.plane_pressure)
    planes = {name: plane for name in pressure if (plane := scenes[name].observation_plane) is not None}
    names = list(planes)
    files: list[str] = []
    for start in range(0, len(names), _PLANES_A_FIGURE):
        part = names[start : start + _PLANES_A_FIGURE]
        files.append(_numbered("fig2", files))
        points = {name: scenes[name].control_points for name in part}
        obstacles = {name: scenes[name].obstacles for name in part}
        figure = plot_planes({name: pressure[name] for name in part}, planes, points, obstacles)
        figure.savefig(folder / files[-1])
    return files


def _draw_trials(results: StudyResult, folder: Path) -> list[str]:
    """Return the labels of the quantities."""
    areas = _by_method(
        results, lambda result: None if result.metrics.area is None else 1e6 * result.metrics.area
    )
    quantities = {
        "mean pressure of the foci [Pa]": _by_method(results, lambda result: result.metrics.mean),
        **({"area per focus [mm²]": areas} if areas else {}),
        "std among the foci [Pa]": _by_method(results, lambda result: result.metrics.std),
    }
    plot_trials(quantities).savefig(folder / "fig3abc.png")
    return list(quantities)


def _by_method(
    results: StudyResult, quantity: Callable[[MethodResult], torch.Tensor | None]
) -> dict[str, dict[str, torch.Tensor]]:
    """Return a quantity by scene and method, without methods and scenes that lack it."""
    found: dict[str, dict[str, torch.Tensor]] = {}
    for scene, result in results.scenes.items():
        for name, method in result.methods.items():
            if (value := quantity(method)) is not None:
                found.setdefault(scene, {})[name] = value
    return found


def _numbered(name: str, files: Sequence[str]) -> str:
    """Return the name of the file of a figure after those that it has."""
    return f"{name}_{len(files) + 1}.png" if files else f"{name}.png"


def _draw_convergence(results: StudyResult, folder: Path) -> list[str]:
    """Return the names of the files, one for each goal and unit."""
    files: list[str] = []
    for (goal, unit), scenes in _grouped(results, lambda scene: (scene.goal["name"], scene.unit)).items():
        history, levels = {}, {}
        for name, scene in scenes.items():
            competitors = _competitors(scene)
            history[name] = {method: found.solution.history for method, found in competitors.items()}
            levels[name] = _bounds(scene.bound) | {
                label_of(method): float(found.solution.score.median())
                for method, found in scene.methods.items()
                if method not in competitors
            }
        files.append(_numbered("fig3d", files))
        label = score_label(f"{goal}, best so far", unit)
        plot_convergence(history, levels, label=label).savefig(folder / files[-1])
    return files


def _bounds(bound: float) -> dict[str, float]:
    """Return the bound, if it is known, and a score near it, by label."""
    near = {f"{tables.NEAR} of the bound": NEAR_BOUND * bound} if has_shares(bound) else {}
    return {"bound": bound} | near if math.isfinite(bound) else {}


def _draw_costs(results: StudyResult, folder: Path) -> list[str]:
    """Return the names of the files: one for shares of the bound, and one for each other score."""
    files: list[str] = []
    share = "score / bound [%]"
    groups = _grouped(results, lambda scene: share if has_shares(scene.bound) else scene.score_label)
    for label, scenes in groups.items():
        points = {
            name: {
                method: [(float(found.seconds.median()), _median_score(found, scene.bound))]
                for method, found in _competitors(scene).items()
            }
            for name, scene in scenes.items()
        }
        files.append(_numbered("fig4", files))
        time = "median time of the search [s per trial]"
        plot_pareto(points, time, label, higher_is_better=True).savefig(folder / files[-1])
    return files


def _median_score(method: MethodResult, bound: float) -> float:
    """Return the median score, in percent of the bound where it is a share of it."""
    score = float(np.median(method.solution.score.numpy()))
    return 100 * score / bound if has_shares(bound) else score


def _grouped(results: StudyResult, key: Callable[[SceneResult], _Key]) -> dict[_Key, dict[str, SceneResult]]:
    """Return the scenes by a key, and by name."""
    found: dict[_Key, dict[str, SceneResult]] = {}
    for name, scene in results.scenes.items():
        found.setdefault(key(scene), {})[name] = scene
    return found


def _competitors(scene: SceneResult) -> Mapping[str, MethodResult]:
    """Return all methods except the baseline, which stays if it is the only one."""
    methods = {name: method for name, method in scene.methods.items() if not tables.is_baseline(name)}
    return methods or scene.methods
