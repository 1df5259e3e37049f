"""Texts of scenes, propagators and results in a console and a notebook: short, with units, and escaped."""

from dataclasses import replace
from xml.etree import ElementTree

import pytest
import torch
from small_scenes import CUBE, small_scene

from autdtorch.methods.functions import gabs
from autdtorch.objectives.metrics import focus_metrics
from autdtorch.objectives.objective import SimulatedObjective
from autdtorch.objectives.perturbations import Noise
from autdtorch.plot.style import ShownFigure
from autdtorch.propagators import make_propagator
from autdtorch.scene.obstacles import Sphere
from autdtorch.study.results import MethodResult, Provenance, SceneResult, SceneSimulation, StudyResult


@pytest.fixture
def objective() -> SimulatedObjective:
    scene = small_scene()
    return SimulatedObjective(scene, make_propagator(scene, "free_space"))


@pytest.fixture
def results(objective: SimulatedObjective) -> StudyResult:
    solution = gabs(objective, levels=4, trials=3)
    method = MethodResult(solution, focus_metrics(solution.pressure), torch.ones(3), 0, None)
    simulation = SceneSimulation("free_space", 8.5e-3, None, None, (), 0.1, 0.2)
    scene = SceneResult(0, torch.ones(3, 4, dtype=torch.complex128), 2.0, simulation, {"gabs": method})
    return StudyResult(Provenance("a: 1\n", 0, {}, "", "2026-01-01"), {"a<b": scene})


def test_reprs_are_short_and_hold_no_tensors(objective: SimulatedObjective, results: StudyResult) -> None:
    scene = results.scenes["a<b"]
    method = scene.methods["gabs"]
    given = small_scene((CUBE,), radius=1e-3)
    box = make_propagator(given, "box", spacing=2e-3)
    noisy = Noise(objective, snr=30.0)
    parts = [given.array, results.provenance, scene.simulation, method.solution, method.metrics]
    for thing in (given, results, scene, method, box, objective, noisy, *parts):
        assert len(repr(thing)) < 200  # characters, two lines of a console
        assert "tensor(" not in repr(thing)
    assert repr(box) == "SimulatedPropagator(scene 'scene', box, spacing 2 mm, steady to 0.002, 0 runs)"
    ball = Sphere((12e-3, 12e-3, 12e-3), 2e-3, rigid=True)
    waves = [repr(make_propagator(small_scene((body,)), "tmatrix", 2e-3)) for body in (ball, CUBE)]
    assert "exact waves" in waves[0]
    assert "spacing" not in waves[0]
    assert "spacing 2 mm" in waves[1]


def test_tables_tell_what_was_reached_and_figures_show_themselves(results: StudyResult) -> None:
    solution = results.scenes["a<b"].methods["gabs"].solution
    assert f"best {solution.score.max():.4g} Pa" in solution._repr_html_()
    table = ElementTree.fromstring(results._repr_html_())  # refuses what is not escaped
    assert [cell.text for cell in table.iter("td")][:3] == ["a<b", "GABS", "3"]
    scene = replace(small_scene((CUBE,)), name="<b>")
    assert "<b>" in "".join(ElementTree.fromstring(scene._repr_html_()).itertext())
    picture, shown = ShownFigure(figsize=(2.0, 1.0))._repr_png_()
    assert picture.startswith(b"\x89PNG")
    assert shown == {"width": 2 * 96}  # CSS pixels in an inch
