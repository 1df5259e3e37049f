"""The problems of a study: what its goal and scenarios make of a scene."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from autdtorch.methods.problem import Problem
from autdtorch.objectives.forces import ForceGoal, ForceObjective, LeastForm
from autdtorch.objectives.goals import Goal
from autdtorch.objectives.objective import SimulatedObjective
from autdtorch.objectives.over_scenes import OverScenes
from autdtorch.objectives.scenarios import Scenarios
from autdtorch.propagators import Propagator
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.validation import integer_at_least, invalid, require_known, within


def scenes_of(scenarios: Mapping[str, Any] | None, goal: Goal | ForceGoal) -> OverScenes | ForceGoal:
    """Return the goal over the scenes that stand for each, after checking the settings of the scenarios."""
    if isinstance(goal, ForceGoal):
        if scenarios is not None:
            accepted = "must be null: a goal of force is of one scene; Scenarios joins ForceObjectives"
            raise invalid("scenarios", dict(scenarios), accepted)
        return goal
    if scenarios is None:
        return OverScenes(goal, 1)
    taken = dict(inspect.signature(Scenarios.around).parameters)
    del taken["propagator"]
    require_known("scenarios", scenarios, taken)
    with within("scenarios"):
        settings = {name: scenarios.get(name, taken[name].default) for name in ("count", "by")}
        return OverScenes(goal, integer_at_least("count", settings["count"], 1), settings["by"])


def method_for_bodies(solver: Mapping[str, Any]) -> str:
    """Return the solver's method for the force on a body, which T-matrices alone give."""
    if (method := solver.get("method", "auto")) not in ("auto", "tmatrix"):
        raise invalid("method", method, 'must be "auto" or "tmatrix", for the force on a body')
    return "tmatrix"


def blank_problem(scene: Scene, goal: Goal | ForceGoal) -> Problem:
    """Return the problem of a scene that is not simulated yet, with a blank matrix: a prior needs one."""
    transducers = len(scene.array)
    if isinstance(goal, ForceGoal):  # a push has at most so many readings
        goal = LeastForm(goal, np.ones((1, transducers)))
    points = goal.scenes * len(scene.control_points) if isinstance(goal, OverScenes) else transducers
    return Problem(transducers, points, goal, scene, torch.ones(points, transducers, **COMPLEX))


def objective_of(
    propagator: Propagator, goal: Goal | ForceGoal, scenarios: Mapping[str, Any] | None
) -> SimulatedObjective | Scenarios | ForceObjective:
    """Return the objective that the methods work on."""
    if isinstance(goal, ForceGoal):
        with within("goal"):
            return ForceObjective(propagator, goal)
    if scenarios is None:
        return SimulatedObjective(propagator.scene, propagator)
    with within("scenarios"):
        return Scenarios.around(propagator, **scenarios)
