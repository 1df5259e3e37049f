from __future__ import annotations

import pytest
import torch
from small_scenes import small_scene
from studies.conditions import CONDITIONS, Method, outcome

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
