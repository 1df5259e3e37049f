"""The problems of a study and its methods: each a `Method` or a function, with its trials and its goal."""

from __future__ import annotations

import functools
import inspect
import warnings
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import numpy as np
import torch

from autdtorch.io.goal_section import require_score
from autdtorch.methods.base import Method
from autdtorch.methods.problem import Problem
from autdtorch.methods.run import run
from autdtorch.methods.seeds import TRIAL_BYTES, Trials
from autdtorch.methods.solution import Solution
from autdtorch.objectives.forces import ForceGoal, ForceObjective, LeastForm
from autdtorch.objectives.goals import WEAKEST_FOCUS, Goal
from autdtorch.objectives.objective import Objective, SimulatedObjective
from autdtorch.objectives.over_scenes import OverScenes
from autdtorch.objectives.perturbations import innermost
from autdtorch.objectives.quiet import QuietPoints, SeenPoints
from autdtorch.objectives.readings import Readings
from autdtorch.objectives.scenarios import Scenarios
from autdtorch.propagators import Propagator
from autdtorch.scene.scene import Scene
from autdtorch.study.results import stored_solution
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.process import require_memory
from autdtorch.utils.validation import integer_at_least, invalid, require_kind, require_known, within

StudyMethod: TypeAlias = Method | Callable[..., Solution]
"""A `Method`, or a function of an objective with its settings bound. A function that has parameters `trials`
and `seed` gets the numbers of the trials to run, as many as it must return, and the study's seed. One
that has a parameter `goal` gets the goal."""


def counts_of(
    methods: Mapping[str, StudyMethod], trials: int | Mapping[str, int], seed: int
) -> dict[str, int]:
    """Check the seed, and return the number of trials of each method."""
    integer_at_least("seed", seed, 0)
    random = [name for name, method in methods.items() if _is_random(method)]
    if not isinstance(trials, Mapping):
        trials = dict.fromkeys(random, integer_at_least("trials", trials, 1))
    require_known("trials", trials, random, "random method")
    if absent := [name for name in random if name not in trials]:
        raise invalid("trials", dict(trials), f"must also give the number for {', '.join(absent)}")
    counts = {name: integer_at_least(f"trials.{name}", trials.get(name, 1), 1) for name in methods}
    for name, count in counts.items():
        require_memory(f"trials.{name}", count, TRIAL_BYTES * count)
    return counts


def check_goal(
    goal: Goal | ForceGoal, scenes: Mapping[str, Scene], methods: Mapping[str, StudyMethod]
) -> None:
    """Check the goal against all scenes, and that every method can maximise it."""
    if not isinstance(goal, ForceGoal):
        require_kind("goal", goal, Goal)
    require_score(goal.name, goal.unit)
    for scene in scenes.values():
        with within("goal"):
            goal.check(scene) if isinstance(goal, ForceGoal) else goal.check(len(scene.control_points))
    for name, method in methods.items():
        if goal == WEAKEST_FOCUS or isinstance(method, Method):
            continue
        if goal_keyword(method) is None:
            accepted = f"must have a parameter `goal`, for the goal {goal.name}"
            raise invalid(f"method {name}", name_of(method), accepted)


def goal_keyword(method: Callable[..., Solution]) -> str | None:
    """Return the name of the parameter for the goal of a function, if it has one."""
    taken = inspect.signature(method).parameters
    if "goal" in taken or "score" not in taken:
        return "goal" if "goal" in taken else None
    warnings.warn(f"{name_of(method)}: the parameter `score` is now `goal`", DeprecationWarning, stacklevel=2)
    return "score"


def goals_of(goal: Goal | ForceGoal) -> list[Goal | ForceGoal]:
    """Return a goal, and the goals that it is made of."""
    return [goal, *goals_of(goal.goal)] if isinstance(goal, QuietPoints | SeenPoints) else [goal]


def _is_random(method: StudyMethod) -> bool:
    return method.random if isinstance(method, Method) else "trials" in inspect.signature(method).parameters


def name_of(method: StudyMethod) -> str:
    """Return the name of a method, or of the function that it is."""
    return method.name if isinstance(method, Method) else str(code_of(method).__name__)


def code_of(method: StudyMethod) -> Any:
    """Return the class of a method, or the function behind it."""
    if isinstance(method, Method):
        return type(method)
    return method.func if isinstance(method, functools.partial) else method


def solve(
    method: StudyMethod,
    objective: Objective,
    trials: Trials,
    seed: int,
    goal: Goal,
    start: torch.Tensor | None = None,
    readings: Readings | None = None,
    name: str | None = None,
) -> Solution:
    """Run trials of a method on an objective, from drives (T, M) and readings where it begins at any.

    Raises:
        ValueError: a method that is a function returns another number of trials, no `Solution`, or one whose
            fields do not fit the objective. The message has the `name`, by default the function's.
    """
    if isinstance(method, Method):
        return run(method, objective, trials, seed, goal=goal, start=start, readings=readings)
    taken = inspect.signature(method).parameters
    if readings is not None:
        accepted = "must be None: only a Method goes on from them, no function"
        raise invalid("readings", readings, accepted)
    arguments = {"trials": trials, "seed": seed, goal_keyword(method) or "goal": goal}
    solution = method(objective, **{key: value for key, value in arguments.items() if key in taken})
    _require_returned(f"method {name or name_of(method)}", solution, objective, trials)
    return solution


def _require_returned(where: str, solution: Solution, objective: Objective, trials: Trials) -> None:
    """Check what the function of a user returned for trials on an objective."""
    if not isinstance(solution, Solution):
        raise invalid(where, solution, "must return a Solution")
    numbers = range(trials) if isinstance(trials, int) else list(trials)
    if len(solution.score) != len(numbers):
        accepted = f"must be the trials {list(numbers)}, or one where it has no random choices"
        raise invalid(where, len(solution.score), accepted, "trials")
    with within(where):
        points = len(objective.scene.control_points)
        if isinstance(innermost(objective), Scenarios | ForceObjective):
            points = solution.pressure.shape[-1]  # of all scenes, or readings of a force
        stored_solution(vars(solution), len(objective.scene.array), points)


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
