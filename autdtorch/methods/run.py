"""The driver: runs a method on an objective, simulated or on the bench."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import cast, overload

import torch

from autdtorch.methods.base import Method, State
from autdtorch.methods.catalogue import METHODS
from autdtorch.methods.problem import Problem
from autdtorch.methods.seeds import Trials, trial_seeds
from autdtorch.methods.solution import Solution
from autdtorch.methods.state_file import load_state, save_state
from autdtorch.objectives.goals import WEAKEST_FOCUS
from autdtorch.objectives.objective import GoalFunction, Objective, require_objective
from autdtorch.objectives.perturbations import continued
from autdtorch.objectives.readings import Readings
from autdtorch.utils.files import path_of
from autdtorch.utils.hints import nearest_name, renamed_keywords
from autdtorch.utils.progress import show_progress
from autdtorch.utils.validation import invalid, require_callable, within


@overload
def run(
    method: Method,
    objective: Objective,
    trials: Trials = 1,
    seed: int = 0,
    *,
    goal: GoalFunction = WEAKEST_FOCUS,
    stop: Callable[[State], bool] | None = None,
    state_file: str | Path | None = None,
    start: torch.Tensor | None = None,
    readings: Readings | None = None,
) -> Solution: ...
@overload
def run(
    method: Method,
    objective: Sequence[Objective],
    trials: Trials = 1,
    seed: int = 0,
    *,
    goal: GoalFunction = WEAKEST_FOCUS,
    stop: Callable[[State], bool] | None = None,
    start: torch.Tensor | None = None,
) -> list[Solution]: ...
@renamed_keywords(score="goal")
def run(
    method: Method,
    objective: Objective | Sequence[Objective],
    trials: Trials = 1,
    seed: int = 0,
    *,
    goal: GoalFunction = WEAKEST_FOCUS,
    stop: Callable[[State], bool] | None = None,
    state_file: str | Path | None = None,
    start: torch.Tensor | None = None,
    readings: Readings | None = None,
) -> Solution | list[Solution]:
    """Run a method on an objective: ask, observe and tell until the method is done.

    Progress and a forecast are shown when it takes longer than a few seconds. An objective with a log (a
    `HardwareObjective`) is not asked for evaluations that the log holds, so that an interrupted run goes on
    where it ended.

    Args:
        method: such as ``GABS(levels=16)``.
        objective: simulated or measured; or a list of objectives, such as the poses of an obstacle, each of
            which starts at the drives chosen for the one before.
        trials: number of trials T, >= 1, or their numbers.
        seed: of the random choices, >= 0. A trial's random choices do not depend on the other trials.
        goal: function of pressures (..., P) [Pa] that is maximised.
        stop: function of the state that ends the run when it returns True; called after every step.
        state_file: file that keeps the state after every step. If it exists, the run goes on from it. Only
            of one objective.
        start: drive (M,) that was good before, or one for each trial (T, M); see `Problem`.
        readings: earlier ones of the array and the control points, which `Identify` and `BayesOpt` go on
            from; see `Problem`. Only of one objective.

    Returns:
        The drive that each trial chose; of a list, a list of these.

    Raises:
        ValueError: an argument out of range, pressures or scores that are not finite, or a state file of
            another method, problem, seed or other trials.
        OSError: the state file cannot be read or written.
    """
    require_method(method)
    require_callable("goal", goal)
    if stop is not None:
        require_callable("stop", stop)
    path = None if state_file is None else path_of("state_file", state_file)
    if not isinstance(objective, list | tuple):
        problem = Problem.of(cast(Objective, objective), goal, start, readings)
        return _run(method, cast(Objective, objective), problem, trials, seed, stop, path)
    if path is not None:
        raise invalid("state_file", str(path), "must be None for a sequence of objectives")
    if readings is not None:
        raise invalid("readings", readings, "must be None for a sequence of objectives")
    if not objective:
        raise invalid("objective", objective, "must have at least one")
    for number, pose in enumerate(objective):
        with within(f"objective[{number}]"):
            require_objective(pose)
    solutions: list[Solution] = []
    for pose in objective:
        solutions.append(_run(method, pose, Problem.of(pose, goal, start), trials, seed, stop))
        start = solutions[-1].drive
    return solutions


def require_method(method: object) -> None:
    """Refuse what is no method: a name, a class that is not called, or a function that runs one."""
    if isinstance(method, Method):
        return
    text = method if isinstance(method, str) else getattr(method, "__name__", "")
    classes = {word: kind.__name__ for name, kind in METHODS.items() for word in (name, kind.__name__)}
    meant = classes[nearest_name(text, classes) or "gabs"]
    raise invalid("method", method, f"must be a Method, such as {meant}()")


def _run(
    method: Method,
    objective: Objective,
    problem: Problem,
    trials: Trials,
    seed: int,
    stop: Callable[[State], bool] | None,
    path: Path | None = None,
) -> Solution:
    if path is not None and path.exists():
        state = load_state(path, method, problem)
        if state.seeds != tuple(trial_seeds(seed, trials)):
            raise invalid("state_file", str(path), "must be the state of the same seed and trials")
    else:
        state = method.start(problem, seed, trials)
    most = method.most_evaluations(problem) * len(state.best.score)
    logged = continued(objective, state.evaluations)
    with logged, show_progress(most, f"{method.label}, evaluations") as progress:
        progress.advance(state.evaluations)
        while not state.done and not (stop is not None and state.evaluations and stop(state)):
            drives = method.ask(state)
            state = method.tell(state, objective(drives))
            progress.advance(len(drives))
            if path is not None:
                save_state(path, method, state)
    return method.best(state)
