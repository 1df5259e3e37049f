from __future__ import annotations

import pytest
import torch
from small_scenes import small_scene
from studies.conditions import (
    AXES,
    CONDITIONS,
    METHODS,
    Method,
    Outcome,
    outcome,
    plot_conditions,
    true_scores,
)

from autdtorch.objectives.simulated import SimulatedObjective
from autdtorch.propagators import FreeSpacePropagator


@pytest.mark.parametrize("condition", CONDITIONS)
def test_trials_together_are_those_one_by_one(condition: str) -> None:
    scene = small_scene()
    objective = SimulatedObjective(scene, FreeSpacePropagator(scene))
    found = [
        outcome(Method("gabs", {"levels": 4}, together), objective, CONDITIONS[condition], trials=3)
        for together in (False, True)
    ]
    # GABS sums in equal groups, as all trials take the same steps.
    assert torch.equal(found[0].true, found[1].true)
    assert torch.equal(found[0].observed, found[1].observed)
    if condition == "undisturbed":
        assert torch.equal(found[0].true, found[0].observed)


def test_table_and_figure_show_every_scene_and_condition() -> None:
    true = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    conditions = dict.fromkeys(name for ticks in AXES.values() for name in ticks.values())
    outcomes = {
        (scene, condition, METHODS[method].label): Outcome(true, 1.2 * true)
        for scene in ("a", "b")
        for condition in conditions
        for method in ("gabs", "lssg")
    }
    assert "| SNR 10 dB | 2.00 | 2.00 |" in true_scores(outcomes, "a")
    assert len(plot_conditions(outcomes).axes) == 4
