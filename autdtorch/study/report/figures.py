"""Figures of the report of a study, written as PNG files."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from autdtorch.methods.catalogue import label_of
from autdtorch.plot.costs import plot_pareto
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
    """Draw all figures of a study into a folder; return the values that the template of the report needs."""
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
        "problem": problem,  # why the scenes are not rendered in 3D, or None
        "planes": _draw_planes(results, scenes, folder),
        "quantities": _draw_trials(results, folder),
    }


def _draw_planes(results: StudyResult, scenes: Mapping[str, Scene], folder: Path) -> list[str]:
    pressure = _by_method(results, lambda result: result.plane_pressure)
    planes = {name: plane for name in pressure if (plane := scenes[name].observation_plane) is not None}
    names = list(planes)
    files: list[str] = []
    for start in range(0, len(names), _PLANES_A_FIGURE):
        part = names[start : start + _PLANES_A_FIGURE]
        files.append(f"fig2_{len(files) + 1}.png" if files else "fig2.png")
        points = {name: scenes[name].control_points for name in part}
        obstacles = {name: scenes[name].obstacles for name in part}
        figure = plot_planes({name: pressure[name] for name in part}, planes, points, obstacles)
        figure.savefig(folder / files[-1])
    return files


def _draw_trials(results: StudyResult, folder: Path) -> list[str]:
    quantities = {"mean pressure of the foci [Pa]": _by_method(results, lambda result: result.metrics.mean)}
    if areas := _by_method(results, _area_in_mm2):
        quantities["area per focus [mm²]"] = areas
    quantities["std among the foci [Pa]"] = _by_method(results, lambda result: result.metrics.std)
    plot_trials(quantities).savefig(folder / "fig3abc.png")
    return list(quantities)


def _area_in_mm2(method: MethodResult) -> torch.Tensor | None:
    return None if method.metrics.area is None else 1e6 * method.metrics.area


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
