"""Alternative texts of the figures: what a figure shows, with its main result in numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from string import ascii_lowercase

import numpy as np
import torch

from autdtorch.methods.calibration.calibration import Calibration
from autdtorch.methods.catalogue import label_of
from autdtorch.scene.scene import Scene
from autdtorch.study.report.findings import MOST_NAMED
from autdtorch.study.report.tables import competitors, median_score
from autdtorch.study.results import SceneResult
from autdtorch.utils.text import counted

Spread = Mapping[str, Mapping[str, torch.Tensor]]
"""Values by scene and method."""

_ZERO = 1e-4  # share of the largest value, below which a value is shown as 0


def of_scene(name: str, scene: Scene) -> str:
    """Return the text of the drawing of a scene."""
    obstacles = counted(len(scene.obstacles), "obstacle") if scene.obstacles else "no obstacles"
    points = counted(len(scene.control_points), "control point")
    shown = f"{counted(len(scene.array), 'transducer')}, {obstacles}, {points}"
    if scene.reflectors:
        shown += f", {counted(len(scene.reflectors), 'reflector')}"
    return f"Scene {name} in 3D: {shown}"


def of_calibration(calibration: Calibration) -> str:
    """Return the text of the figure of a calibration: errors before and after, spread of gains and phases."""
    held, gain, phase = calibration.held_back, calibration.gain, calibration.phase
    errors = f", {held.before:.1%} off before and {held.error:.1%} after" if held is not None else ""
    gains = f"gains of the transducers from {gain.min():.2f} to {gain.max():.2f}"
    phases = f"phases from {phase.min():z.2f} to {phase.max():z.2f} rad"
    return f"Predictions against readings{errors}; {gains}, {phases}"


def of_planes(pressure: Spread) -> str:
    """Return the text of the pressure maps: the highest pressure in each, from lowest to highest."""
    peaks = {
        scene: _span({method: float(field.abs().max()) for method, field in maps.items()}, " Pa")
        for scene, maps in pressure.items()
    }
    return (
        f"Maps of the pressure magnitude by scene and method. Highest pressure in a map: {_by_scene(peaks)}"
    )


def of_measured(measured: torch.Tensor, simulated: torch.Tensor) -> str:
    """Return the text of the maps of the plane of a camera: the highest pressures."""
    peaks = f"up to {measured.max():.4g} Pa as measured, up to {simulated.max():.4g} Pa as simulated"
    return f"Maps of the pressure on the plane of the camera: {peaks}"


def of_trials(quantities: Mapping[str, Spread]) -> str:
    """Return the text of the panels over the trials: the medians, from the lowest to the highest."""
    panels = []
    for letter, (label, values) in zip(ascii_lowercase, quantities.items(), strict=False):
        medians = {
            scene: _span({method: _median(values) for method, values in by_method.items()})
            for scene, by_method in values.items()
        }
        panels.append(f"({letter}) {label}: {_by_scene(medians)}")
    return f"Values of the trials by scene and method, medians here. {'. '.join(panels)}"


def of_convergence(scenes: Mapping[str, SceneResult]) -> str:
    """Return the text of the convergence: the scores at the end, the evaluations used, and the bound."""
    ends = {}
    for name, scene in scenes.items():
        solutions = {method: result.solution for method, result in competitors(scene).items()}
        scores = {method: _median(solution.history[:, -1]) for method, solution in solutions.items()}
        used = int(solutions[max(scores, key=lambda method: scores[method])].evaluations.max())
        bound = f", bound {scene.bound:.3g}" if math.isfinite(scene.bound) else ""
        unit = f" {scene.unit}".rstrip()
        ends[name] = (
            f"{_span(scores, unit)}, the highest after {used} evaluations{bound}{unit if bound else ''}"
        )
    return f"Best score so far against evaluations, which ends at: {_by_scene(ends)}"


def of_costs(scenes: Mapping[str, SceneResult]) -> str:
    """Return the text of scores against times: the fastest and the best method."""
    texts = {}
    for name, scene in scenes.items():
        methods = competitors(scene)
        seconds = {method: _median(result.seconds) for method, result in methods.items()}
        fastest = min(methods, key=lambda method: seconds[method])
        best = max(methods, key=lambda method: median_score(methods[method]))
        places = (
            f"{text} {label_of(method)}, {scene.in_unit(f'{median_score(methods[method]):.3g}')} "
            f"in {seconds[method]:.2g} s"
            for text, method in (("fastest", fastest), ("best", best))
        )
        texts[name] = ", ".join(places)
    return f"Median score against median time of the search. {_by_scene(texts)}"


def of_bench(histories: Mapping[str, torch.Tensor], unit: str) -> str:
    """Return the text of the convergence on the bench, and in the simulation."""
    scores = {name: f"{float(history[0, -1]):.4g} {unit}".rstrip() for name, history in histories.items()}
    ends = (f"the {name} ends at {score}" for name, score in scores.items())
    return f"Best score so far against evaluations: {', '.join(ends)}"


def _span(values: Mapping[str, float], unit: str = "") -> str:
    """Return the lowest and the highest value with their methods."""
    ranked = sorted(values, key=lambda name: values[name])
    ends = ranked if len(ranked) == 1 else [ranked[0], ranked[-1]]
    least = _ZERO * max(map(abs, values.values()))
    shown = {name: f"{values[name]:.3g}" if abs(values[name]) >= least else "0" for name in ends}
    return " to ".join(f"{text}{unit} ({label_of(name)})" for name, text in shown.items())


def _median(values: torch.Tensor) -> float:
    return float(np.median(values.numpy()))


def _by_scene(texts: Mapping[str, str]) -> str:
    """Return a text for each of the first scenes, and the number of the others."""
    shown = [f"{scene} {text}" for scene, text in list(texts.items())[:MOST_NAMED]]
    rest = len(texts) - len(shown)
    return "; ".join([*shown, *([f"and {rest} more scenes"] if rest else [])])
