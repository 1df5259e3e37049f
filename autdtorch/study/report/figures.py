"""Figures of the report of a study, written as PNG files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from autdtorch.methods.catalogue import label_of
from autdtorch.plot.pareto import plot_pareto
from autdtorch.plot.pressure_maps import plot_planes
from autdtorch.plot.scene_figure import plot_scene
from autdtorch.plot.trials import plot_convergence, plot_trials
from autdtorch.plot.view3d import rendering_problem, view3d
from autdtorch.scene.scene import Scene
from autdtorch.study.report.tables import NEAR, is_baseline
from autdtorch.study.results import MethodResult, SceneResult, StudyResult
from autdtorch.study.statistics import NEAR_BOUND, bound_gap

_PLANES_A_FIGURE = 4


def draw_figures(results: StudyResult, scenes: Mapping[str, Scene], folder: Path) -> dict[str, Any]:
    """Draw all figures of a study into a folder.

    Returns:
        The values that the template of the report needs: `scenes`, names with their Markdown images;
        `problem`, why these are not rendered in 3D, or None; `planes`, names of files; `quantities`, labels.
    """
    problem = rendering_problem()
    for name, scene in scenes.items():
        if problem is None:
            view3d(scene, save=folder / f"fig1_{name}.png").close()
        else:
            plot_scene(scene).savefig(folder / f"fig1_{name}.png")
    _draw_convergence(results, folder)
    _draw_costs(results, folder)
    return {
        "scenes": [(name, f"![{name}](fig1_{name}.png)") for name in scenes],
        "problem": problem,
        "planes": _draw_planes(results, scenes, folder),
        "quantities": _draw_trials(results, folder),
    }


def _draw_planes(results: StudyResult, scenes: Mapping[str, Scene], folder: Path) -> list[str]:
    pressure = {
        name: {
            method: result.plane_pressure
            for method, result in found.methods.items()
            if result.plane_pressure is not None
        }
        for name, found in results.scenes.items()
    }
    planes = {name: plane for name in pressure if (plane := scenes[name].observation_plane) is not None}
    names = [name for name in planes if pressure[name]]
    files: list[str] = []
    for start in range(0, len(names), _PLANES_A_FIGURE):
        part = names[start : start + _PLANES_A_FIGURE]
        files.append(f"fig2_{len(files) + 1}.png" if files else "fig2.png")
        figure = plot_planes(
            {name: pressure[name] for name in part},
            planes,
            {name: scenes[name].control_points for name in part},
            {name: scenes[name].obstacles for name in part},
        )
        figure.savefig(folder / files[-1])
    return files


def _draw_trials(results: StudyResult, folder: Path) -> list[str]:
    quantities = {"mean pressure of the foci [Pa]": _metric(results, "mean")}
    if areas := _metric(results, "area", scale=1e6):
        quantities["area per focus [mm²]"] = areas
    quantities["std among the foci [Pa]"] = _metric(results, "std")
    plot_trials(quantities).savefig(folder / "fig3abc.png")
    return list(quantities)


def _metric(results: StudyResult, name: str, scale: float = 1.0) -> dict[str, dict[str, torch.Tensor]]:
    """Return a figure of merit by scene and method, without scenes that lack it."""
    values = {
        scene: {
            method: scale * value
            for method, result in found.methods.items()
            if (value := getattr(result.metrics, name)) is not None
        }
        for scene, found in results.scenes.items()
    }
    return {scene: by_method for scene, by_method in values.items() if by_method}


def _draw_convergence(results: StudyResult, folder: Path) -> None:
    history, levels = {}, {}
    for scene, found in results.scenes.items():
        competitors = _competitors(found)
        history[scene] = {name: method.solution.history for name, method in competitors.items()}
        levels[scene] = {"bound": found.bound, f"{NEAR} of the bound": NEAR_BOUND * found.bound}
        levels[scene] |= {
            label_of(name): float(method.solution.score.median())
            for name, method in found.methods.items()
            if name not in competitors
        }
    plot_convergence(history, levels).savefig(folder / "fig3d.png")


def _draw_costs(results: StudyResult, folder: Path) -> None:
    points = {
        scene: {
            name: [(float(method.seconds.median()), 100 * (1 - bound_gap(method, found.bound).gap.value))]
            for name, method in _competitors(found).items()
        }
        for scene, found in results.scenes.items()
    }
    time, score = "median time of the search [s per trial]", "score / bound [%]"
    plot_pareto(points, time, score, higher_is_better=True).savefig(folder / "fig4.png")


def _competitors(scene: SceneResult) -> Mapping[str, MethodResult]:
    """Return all methods except the baseline, which stays if it is the only one."""
    methods = {name: method for name, method in scene.methods.items() if not is_baseline(name)}
    return methods or scene.methods
