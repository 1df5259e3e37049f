"""The report of a study: the paper's figures and claims with our numbers, and the gaps to the bound."""

from __future__ import annotations

import itertools
import math
import tempfile
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import torch
from PIL import Image, ImageOps

from autdtorch.io.goal_section import goal_label, score_label
from autdtorch.methods.catalogue import label_of
from autdtorch.plot.cost_figures import plot_pareto
from autdtorch.plot.plane_maps import plot_planes
from autdtorch.plot.scene_figure import plot_scene
from autdtorch.plot.trials import plot_convergence, plot_trials
from autdtorch.plot.view3d import rendering_problem, view3d
from autdtorch.scene.arrays import radii_of
from autdtorch.scene.scene import Scene
from autdtorch.study.folder import TRIALS_FILE
from autdtorch.study.report import alt_texts, tables
from autdtorch.study.report.claims import BO, GABS, judge_claims
from autdtorch.study.report.document import as_page, picture, rendered
from autdtorch.study.report.findings import LEVEL, findings, gaps
from autdtorch.study.results import (
    MethodResult,
    SceneResult,
    StudyResult,
    area_of,
    summary_rows,
    with_foci,
    with_prefixes,
)
from autdtorch.study.results_file import RESULTS_FILE
from autdtorch.study.statistics import FEWEST_TRIALS, NEAR_BOUND, has_shares

REPORT_FILE = "report.md"
HTML_FILE = "report.html"

_Key = TypeVar("_Key")

_FEW_TRIALS = 20  # with fewer, the spread of a method is not well known
_PLANES_A_FIGURE = 4
_MOST_MAPS = 4  # methods; of more, some with equal scores are folded away


def write_report(
    results: StudyResult,
    scenes: Mapping[str, Scene],
    folder: Path,
    command: str,
    seeds: Sequence[int] = (),
    unfinished: Sequence[str] = (),
) -> Path:
    """Write `report.md` and its figures, and both as one file `report.html`, whose path is returned.

    `scenes` are those of the results, by name. `seeds` are those of the studies that the results were merged
    from; there are none for a single study in `folder`. `unfinished` names the studies that were left out.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".report-") as name:
        new = Path(name)
        text = _markdown(results, scenes, new, command, seeds, unfinished)
        (new / REPORT_FILE).write_text(text, encoding="utf-8")
        (new / HTML_FILE).write_text(as_page(text, new), encoding="utf-8")
        # A file replaces an older one, or a link: nothing is written through a link.
        for file in new.iterdir():
            file.replace(folder / file.name)
    return folder / HTML_FILE


def _markdown(
    results: StudyResult,
    scenes: Mapping[str, Scene],
    folder: Path,
    command: str,
    seeds: Sequence[int],
    unfinished: Sequence[str],
) -> str:
    """Draw the figures into a folder; return the text of the report."""
    results = with_prefixes(results)
    scenes = {name: scenes[name] for name in results.scenes}
    counts: dict[str, list[int]] = {}
    for scene in results.scenes.values():
        for name, method in scene.methods.items():
            counts.setdefault(name, []).append(method.trials)
    judged = judge_claims(results)
    shown = _without_alike(results, counts)
    trials_picture, quantities = _draw_trials(results, folder)
    tolerances = {scene.simulation.tolerance for scene in results.scenes.values()}
    return rendered(
        "study.md",
        findings=findings(results, judged),
        gaps_in_methods=gaps(results),
        unfinished=unfinished,
        command=command,
        provenance=results.provenance,
        versions=", ".join(f"{name} {version}" for name, version in results.provenance.versions.items()),
        seeds=seeds,
        trials=", ".join(f"{label_of(name)} {tables.extent(numbers)}" for name, numbers in counts.items()),
        few=[label_of(name) for name in (BO, GABS) if max(counts.get(name, [_FEW_TRIALS])) < _FEW_TRIALS],
        fewest_trials=FEWEST_TRIALS,
        most_trials=max(itertools.chain(*counts.values())),
        rendering_problem=_draw_scenes(scenes, folder),
        scenes=[
            (name, picture(f"fig1_{name}.png", alt_texts.of_scene(name, scenes[name]))) for name in scenes
        ],
        room=tables.room_rows(scenes),
        foci=with_foci(results),
        reflecting=any(scene.reflectors for scene in scenes.values()),
        of_points=any((radii_of(scene.array) == 0).any() for scene in scenes.values()),
        planes=_draw_planes(results, scenes, folder, "fig2", shown),
        alike=[label_of(name) for name in counts if name not in shown],
        alike_planes=_draw_planes(
            results, scenes, folder, "fig2_alike", [name for name in counts if name not in shown]
        ),
        points=tables.focus_rows(results),
        goals=list(dict.fromkeys(scene.score_label for scene in results.scenes.values())),
        differences=not all(has_shares(scene.bound) for scene in results.scenes.values()),
        convergence=_draw_convergence(results, folder),
        costs=_draw_costs(results, folder),
        trials_picture=trials_picture,
        quantities=quantities,
        summary=summary_rows(results),
        claims=tables.claim_rows(judged),
        evidence=tables.evidence_rows(judged),
        paper=any(verdict for _, verdict in judged),
        claims_in_all=len(judged),
        claims_without_data=[n for n, (_, verdict) in enumerate(judged, start=1) if verdict is None],
        gaps=tables.gap_rows(results),
        near=tables.NEAR,
        baseline=label_of(tables.BASELINE) if any(map(tables.is_baseline, counts)) else "",
        simulations=tables.simulation_rows(results),
        missed=sum(not run.reached for scene in results.scenes.values() for run in scene.simulation.runs),
        tolerances=[
            f"{tolerance:g}"
            for tolerance in sorted(tolerance for tolerance in tolerances if tolerance is not None)
        ],
        results_file=RESULTS_FILE,
        trials_file=TRIALS_FILE,
    )


def _draw_scenes(scenes: Mapping[str, Scene], folder: Path) -> str | None:
    """Return why the scenes are not rendered in 3D, or None."""
    problem = rendering_problem()
    for name, scene in scenes.items():
        file = folder / f"fig1_{name}.png"
        if problem is None:
            view3d(scene, save=file).close()
            _trim(file)
        else:
            plot_scene(scene).savefig(file)
    return problem


def _trim(file: Path) -> None:
    """Cut the white margin of a picture, which would make its labels small on a page."""
    with Image.open(file) as picture:
        box = ImageOps.invert(picture.convert("RGB")).getbbox()
        picture.crop(box).save(file)


def _without_alike(results: StudyResult, methods: Iterable[str]) -> list[str]:
    """Return the methods whose maps are shown: of many, one of those that are level in every scene."""
    every, shown = list(methods), list[str]()
    for name in every:
        if len(every) <= _MOST_MAPS or not any(_always_level(results, name, other) for other in shown):
            shown.append(name)
    return shown


def _always_level(results: StudyResult, name: str, other: str) -> bool:
    """Return whether two methods have the same scenes, with median scores that are level."""
    for scene in results.scenes.values():
        if (name in scene.methods) != (other in scene.methods):
            return False
        if name in scene.methods:
            scores = [tables.median_score(scene.methods[method]) for method in (name, other)]
            if max(scores) - min(scores) > LEVEL * max(map(abs, scores)):
                return False
    return True


def _draw_planes(
    results: StudyResult, scenes: Mapping[str, Scene], folder: Path, name: str, methods: Collection[str]
) -> list[str]:
    """Return the pictures of some methods, in files of a name."""
    every = _by_method(results, lambda result: result.plane_pressure)
    chosen = {
        scene: {method: maps[method] for method in maps if method in methods} for scene, maps in every.items()
    }
    pressure = {scene: maps for scene, maps in chosen.items() if maps}
    planes = {name: plane for name in pressure if (plane := scenes[name].observation_plane) is not None}
    names = list(planes)
    pictures: list[str] = []
    for start in range(0, len(names), _PLANES_A_FIGURE):
        part = {name: pressure[name] for name in names[start : start + _PLANES_A_FIGURE]}
        points = {name: scenes[name].control_points for name in part}
        obstacles = {name: scenes[name].obstacles for name in part}
        file = _numbered(name, pictures)
        reflectors = {name: scenes[name].reflectors for name in part}
        plot_planes(part, planes, points, obstacles, reflectors=reflectors).savefig(folder / file)
        pictures.append(picture(file, alt_texts.of_planes(part)))
    return pictures


def _draw_trials(results: StudyResult, folder: Path) -> tuple[str, list[str]]:
    """Return the picture and the labels of the quantities; both are empty if each has a single value."""
    quantities = {
        "mean pressure of the foci [Pa]": _by_method(results, lambda metrics: metrics.of_foci("mean")),
        "area per focus [mm²]": _by_method(results, area_of),
        "std among the foci [Pa]": _by_method(results, lambda metrics: metrics.of_foci("std")),
    }
    forces = _grouped(results, lambda scene: "" if scene.of_pressures else scene.score_label)
    for label, scenes in forces.items():
        if label:
            part = replace(results, scenes=scenes)
            quantities[label] = _by_method(part, lambda result: result.solution.score)
    quantities = {label: values for label, values in quantities.items() if values}
    counts = [method.trials for scene in results.scenes.values() for method in scene.methods.values()]
    if counts == [1]:  # the table says it
        return "", []
    plot_trials(quantities).savefig(folder / "fig3abc.png")
    return picture("fig3abc.png", alt_texts.of_trials(quantities)), list(quantities)


def _by_method(
    results: StudyResult, quantity: Callable[[MethodResult], torch.Tensor | None]
) -> dict[str, dict[str, torch.Tensor]]:
    """Return a quantity by scene and method, without methods and scenes that lack it."""
    values: dict[str, dict[str, torch.Tensor]] = {}
    for scene, result in results.scenes.items():
        for name, method in result.methods.items():
            if (value := quantity(method)) is not None:
                values.setdefault(scene, {})[name] = value
    return values


def _numbered(name: str, before: Sequence[str]) -> str:
    return f"{name}_{len(before) + 1}.png" if before else f"{name}.png"


def _draw_convergence(results: StudyResult, folder: Path) -> list[str]:
    """Return the pictures, one for each goal and unit."""
    pictures: list[str] = []
    for (goal, unit), scenes in _grouped(results, lambda scene: (goal_label(scene.goal), scene.unit)).items():
        history, levels = {}, {}
        for name, scene in scenes.items():
            competitors = tables.competitors(scene)
            history[name] = {method: result.solution.history for method, result in competitors.items()}
            levels[name] = _bounds(scene.bound) | {
                label_of(method): float(result.solution.score.median())
                for method, result in scene.methods.items()
                if method not in competitors
            }
        file, label = _numbered("fig3d", pictures), score_label(f"{goal}, best so far", unit)
        plot_convergence(history, levels, label=label).savefig(folder / file)
        pictures.append(picture(file, alt_texts.of_convergence(scenes)))
    return pictures


def _bounds(bound: float) -> dict[str, float]:
    """Return the bound, if it is known, and a score near it, by label."""
    near = {f"{tables.NEAR} of the bound": NEAR_BOUND * bound} if has_shares(bound) else {}
    return {"bound": bound} | near if math.isfinite(bound) else {}


def _draw_costs(results: StudyResult, folder: Path) -> list[str]:
    """Return the pictures: one for shares of the bound, and one for each other score.

    There are none where no scene has methods to compare.
    """
    if all(len(tables.competitors(scene)) == 1 for scene in results.scenes.values()):
        return []
    pictures: list[str] = []
    share = "score / bound [%]"
    groups = _grouped(results, lambda scene: share if has_shares(scene.bound) else scene.score_label)
    for label, scenes in groups.items():
        points = {
            name: {
                method: [(float(result.seconds.median()), _shown_score(result, scene.bound))]
                for method, result in tables.competitors(scene).items()
            }
            for name, scene in scenes.items()
        }
        file, time = _numbered("fig4", pictures), "median search time [s]"
        plot_pareto(points, time, label, higher_is_better=True).savefig(folder / file)
        pictures.append(picture(file, alt_texts.of_costs(scenes)))
    return pictures


def _shown_score(method: MethodResult, bound: float) -> float:
    """Return the median score, in percent of the bound where it is a share of it."""
    score = tables.median_score(method)
    return 100 * score / bound if has_shares(bound) else score


def _grouped(results: StudyResult, key: Callable[[SceneResult], _Key]) -> dict[_Key, dict[str, SceneResult]]:
    groups: dict[_Key, dict[str, SceneResult]] = {}
    for name, scene in results.scenes.items():
        groups.setdefault(key(scene), {})[name] = scene
    return groups
