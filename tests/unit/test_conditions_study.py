from __future__ import annotations

from pathlib import Path

import pytest
import torch
from conditions_report import AXES, Outcome, curse, plot_conditions, tables
from small_scenes import small_scene
from study_conditions import CONDITIONS, METHODS, Method, outcome
from study_searches import best_of

from autdtorch.objectives.simulated import SimulatedObjective
from autdtorch.propagators import FreeSpacePropagator


def outcomes() -> dict[tuple[str, str, str], Outcome]:
    """Two scenes, two methods; what was observed is a fifth too high but without disturbance."""
    true = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    return {
        (scene, condition, method): Outcome(true, true * (1 if condition == "undisturbed" else 1.2))
        for scene in ("a", "b_c")
        for condition in dict.fromkeys(name for ticks in AXES.values() for name in ticks.values())
        for method in ("GABS", "LSS")
    }


@pytest.fixture
def objective() -> SimulatedObjective:
    scene = small_scene()
    return SimulatedObjective(scene, FreeSpacePropagator(scene))


@pytest.mark.parametrize("condition", CONDITIONS)
def test_trials_together_are_those_one_by_one(condition: str, objective: SimulatedObjective) -> None:
    settings = {"levels": 4}
    found = [
        outcome(Method("gabs", settings, together), objective, CONDITIONS[condition], trials=3)
        for together in (False, True)
    ]
    # A walk is the same sum in the same groups: all trials take the same steps.
    assert torch.equal(found[0].true, found[1].true)
    assert torch.equal(found[0].observed, found[1].observed)
    if condition == "undisturbed":
        assert torch.equal(found[0].true, found[0].observed)


def test_labels_tell_the_settings() -> None:
    assert METHODS["gabs"].label == "GABS"
    assert METHODS["lssg_5_passes"].label == "LSSG, 5 passes"
    assert METHODS["random_search"].label == "random search"


def test_tables_have_a_row_a_condition() -> None:
    title, first, *_ = tables(outcomes())
    assert title == "A (standard errors up to 0.58 Pa)"  # the deviation 1, by the root of 3
    assert "| SNR 10 dB | 2.00 | 2.00 |" in first
    assert "undisturbed" not in curse(outcomes())
    assert "| SNR 10 dB | 1.20 | 1.20 |" in curse(outcomes())


def test_figure_has_a_panel_for_each_axis_and_scene(tmp_path: Path) -> None:
    figure = plot_conditions(outcomes(), "python it.py")
    assert len(figure.axes) == 4
    assert [ax.get_title() for ax in figure.axes[:2]] == ["a", "b c"]
    figure.savefig(tmp_path / "figure.png")


def test_best_of_a_group_costs_all_of_it() -> None:
    scores, evaluations = best_of((torch.tensor([1.0, 3.0, 2.0, 0.0]), torch.full((4,), 10)), group=2)
    assert scores.tolist() == [3.0, 2.0]
    assert evaluations.tolist() == [20, 20]
