"""What a console and a notebook show of scenes, propagators and results: short, with units, and escaped."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from small_scenes import CUBE, scene_of_all_kinds, small_scene

from autdtorch.conditions import Noise
from autdtorch.metrics import focus_metrics
from autdtorch.objective import SimulatedObjective
from autdtorch.obstacles import Obstacle, VoxelMask
from autdtorch.optim.gabs import gabs
from autdtorch.plot.style import ShownFigure
from autdtorch.propagator import make_propagator
from autdtorch.results import MethodResult, Provenance, SceneResult, Simulation, StudyResult
from autdtorch.scene import Scene
from autdtorch.sketch import _outlines

RING = VoxelMask(np.pad(np.ones((1, 1, 2), bool), 1) ^ np.ones((3, 3, 4), bool), 2e-3, rigid=True)


@pytest.fixture
def objective() -> SimulatedObjective:
    scene = small_scene()
    return SimulatedObjective(scene, make_propagator(scene, "free_space"))


@pytest.fixture
def results(objective: SimulatedObjective) -> StudyResult:
    solution = gabs(objective, levels=4, trials=3)
    method = MethodResult(solution, focus_metrics(solution.pressure), torch.ones(3), 0, None)
    simulation = Simulation("free_space", 8.5e-3, None, None, (), 0.1, 0.2)
    scene = SceneResult(0, torch.ones(3, 4, dtype=torch.complex128), 2.0, simulation, {"gabs": method})
    return StudyResult(Provenance("a: 1\n", 0, {}, "", "2026-01-01"), {"a<b": scene})


def test_reprs_are_short_and_hold_no_tensors(objective: SimulatedObjective, results: StudyResult) -> None:
    scene = results.scenes["a<b"]
    method = scene.methods["gabs"]
    box = make_propagator(small_scene((CUBE,)), "box", spacing=2e-3)
    noisy = Noise(objective, snr=30.0)
    whole = [results, results.provenance, scene, scene.simulation, method, method.solution, method.metrics]
    for thing in (box, objective, noisy, *whole):
        assert len(repr(thing)) < 200  # characters, two lines of a console
        assert "tensor(" not in repr(thing)
    assert repr(box) == "BoxPropagator(scene 'scene', spacing 2 mm, tolerance 0.002, 0 runs)"


def test_tables_tell_what_was_reached_and_escape_names(results: StudyResult) -> None:
    solution = results.scenes["a<b"].methods["gabs"].solution
    assert f"best {solution.score.max():.4g} Pa" in solution._repr_html_()
    table = ElementTree.fromstring(results._repr_html_())  # refuses what is not escaped
    assert [cell.text for cell in table.iter("td")][:3] == ["a<b", "GABS", "3"]


def test_a_scene_shows_all_it_holds(tmp_path: Path) -> None:
    given = scene_of_all_kinds(tmp_path)
    scene = Scene(given.array, given.medium, 40e3, given.control_points, given.obstacles, name="<b>")
    shown = ElementTree.fromstring(scene._repr_html_())
    assert "<b>" in "".join(shown.itertext())
    paths = list(shown.iter("{http://www.w3.org/2000/svg}path"))
    # In each of two views the obstacles, the transducers and the control points
    assert len(paths) == 2 * (len(scene.obstacles) + 2)
    assert sum(path.get("d", "").count("h0") for path in paths) == 2 * (len(scene.array) + 1)


def projected_area(obstacle: Obstacle, axes: list[int]) -> float:
    """Of the triangles that face the viewer [mm^2]."""
    vertices, faces = obstacle.surface()
    corners = 1e3 * vertices[:, axes][faces]
    edges = corners[:, 1:] - corners[:, :1]
    return float(torch.linalg.det(edges).clamp(min=0).sum() / 2)


@pytest.mark.parametrize("axes", [[0, 1], [1, 2], [0, 2]])
def test_outlines_go_around_what_faces_the_viewer(axes: list[int], tmp_path: Path) -> None:
    for obstacle in (*scene_of_all_kinds(tmp_path).obstacles, RING):
        area = 0.0
        for x, y in (polygon.T for polygon in _outlines(obstacle, axes)):
            area += float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2  # Green's theorem
        # The outline's winding number is the sum of the triangles': the areas differ by rounding alone.
        assert area == pytest.approx(projected_area(obstacle, axes), rel=1e-9)


def test_a_notebook_shows_figures_by_itself() -> None:
    picture, shown = ShownFigure(figsize=(2.0, 1.0))._repr_png_()
    assert picture.startswith(b"\x89PNG")
    assert shown == {"width": 2 * 96}  # CSS pixels in an inch
