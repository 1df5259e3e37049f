"""The methods as functions: each makes a method of its settings, and runs it on an objective.

Parameters and defaults are those of the method's class and of `run`; a test compares them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, cast

import numpy as np
import torch

from autdtorch.methods.bayes_opt import NOISE, BayesOpt
from autdtorch.methods.gabs import GABS
from autdtorch.methods.gradient import GradientAscent
from autdtorch.methods.identify import Identify
from autdtorch.methods.lssg import LSS, LSSG
from autdtorch.methods.phase_stepping import PhaseStepping
from autdtorch.methods.prior import Prior
from autdtorch.methods.problem import Problem
from autdtorch.methods.random_search import RandomSearch
from autdtorch.methods.run import run
from autdtorch.methods.seeds import Trials
from autdtorch.methods.solution import Solution
from autdtorch.objectives.bound import checked_matrix
from autdtorch.objectives.goals import WEAKEST_FOCUS
from autdtorch.objectives.objective import GoalFunction, Objective
from autdtorch.objectives.readings import Readings
from autdtorch.utils.hints import renamed_keywords
from autdtorch.utils.validation import ArrayLike


@renamed_keywords(score="goal")
def lss(objective: Objective, goal: GoalFunction = WEAKEST_FOCUS) -> Solution:
    """Run `LSS`; see `LSS` and `run`."""
    return run(LSS(), objective, goal=goal)


@renamed_keywords(score="goal")
def lssg(
    objective: Objective,
    levels: int = 16,
    order: Literal["given"] | Sequence[int] = "given",
    passes: int = 1,
    goal: GoalFunction = WEAKEST_FOCUS,
) -> Solution:
    """Run `LSSG` with these settings; see `LSSG` and `run`."""
    return run(LSSG(levels, order, passes), objective, goal=goal)


@renamed_keywords(score="goal")
def gabs(
    objective: Objective,
    levels: int = 16,
    order: Literal["random", "given", "strength"] | Sequence[int] = "random",
    first: int | None = None,
    passes: int = 1,
    trials: Trials = 1,
    seed: int = 0,
    goal: GoalFunction = WEAKEST_FOCUS,
) -> Solution:
    """Run `GABS` with these settings; see `GABS` and `run`."""
    return run(GABS(levels, order, first, passes), objective, trials, seed, goal=goal)


@renamed_keywords(score="goal")
def bayes_opt(
    objective: Objective,
    evaluations: int = 256,
    initial: int = 16,
    trials: Trials = 1,
    seed: int = 0,
    fixed_transducer: int | None = None,
    goal: GoalFunction = WEAKEST_FOCUS,
    *,
    model: Literal["weakest", "foci"] = "weakest",
    kernel: Literal["phases", "circle", "phasor"] = "phases",
    acquisition: Literal["ei", "log_ei"] = "ei",
    initial_points: Literal["sobol", "random"] = "sobol",
    noise: float | Literal["inferred"] = NOISE,
    prior: Prior | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
    readings: Readings | None = None,
) -> Solution:
    """Run `BayesOpt` with these settings; see `BayesOpt` and `run`."""
    settings = model, kernel, acquisition, initial_points, noise, prior, device
    method = BayesOpt(evaluations, initial, fixed_transducer, *settings)
    return run(method, objective, trials, seed, goal=goal, readings=readings)


@renamed_keywords(score="goal")
def bo_foci(
    objective: Objective,
    evaluations: int = 64,
    initial: int = 4,
    trials: Trials = 1,
    seed: int = 0,
    fixed_transducer: int | None = None,
    goal: GoalFunction = WEAKEST_FOCUS,
    *,
    model: Literal["weakest", "foci"] = "foci",
    kernel: Literal["phases", "circle", "phasor"] = "phasor",
    acquisition: Literal["ei", "log_ei"] = "ei",
    initial_points: Literal["sobol", "random"] = "sobol",
    noise: float | Literal["inferred"] = "inferred",
    prior: Prior | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
    readings: Readings | None = None,
) -> Solution:
    """Run `BayesOpt`, by default with a process for each focus; see `BayesOpt` and `run`."""
    settings = evaluations, initial, trials, seed, fixed_transducer, goal
    return bayes_opt(
        objective, *settings, model=model, kernel=kernel, acquisition=acquisition,
        initial_points=initial_points, noise=noise, prior=prior, device=device, readings=readings,
    )  # fmt: skip


@renamed_keywords(score="goal")
def identify(
    objective: Objective,
    evaluations: int | None = None,
    trials: Trials = 1,
    seed: int = 0,
    *,
    prior: Prior | None = None,
    goal: GoalFunction = WEAKEST_FOCUS,
    readings: Readings | None = None,
) -> Solution:
    """Run `Identify` with these settings; see `Identify` and `run`."""
    return run(Identify(evaluations, prior), objective, trials, seed, goal=goal, readings=readings)


@renamed_keywords(score="goal")
def phase_stepping(
    objective: Objective,
    rounds: int = 1,
    trials: Trials = 1,
    seed: int = 0,
    goal: GoalFunction = WEAKEST_FOCUS,
) -> Solution:
    """Run `PhaseStepping` with these settings; see `PhaseStepping` and `run`."""
    return run(PhaseStepping(rounds), objective, trials, seed, goal=goal)


@renamed_keywords(score="goal")
def random_search(
    objective: Objective,
    evaluations: int = 256,
    levels: int | None = None,
    trials: Trials = 1,
    seed: int = 0,
    goal: GoalFunction = WEAKEST_FOCUS,
) -> Solution:
    """Run `RandomSearch` with these settings; see `RandomSearch` and `run`."""
    return run(RandomSearch(evaluations, levels), objective, trials, seed, goal=goal)


@renamed_keywords(score="goal")
def gradient_ascent(
    objective: Objective | ArrayLike,
    starts: int = 32,
    steps: int = 300,
    trials: Trials = 1,
    seed: int = 0,
    goal: GoalFunction = WEAKEST_FOCUS,
) -> Solution:
    """Run `GradientAscent` with these settings; see `GradientAscent` and `run`.

    In place of the objective, it takes the transfer matrix G (P, M) [Pa] alone, too.
    """
    method = GradientAscent(starts, steps)
    is_list = isinstance(objective, list | tuple)
    are_rows = is_list and not any(isinstance(entry, Objective) for entry in cast(Any, objective))
    if not (are_rows or isinstance(objective, torch.Tensor | np.ndarray)):
        return run(method, cast(Objective, objective), trials, seed, goal=goal)
    matrix = torch.from_numpy(checked_matrix(cast(ArrayLike, objective), "objective"))
    points, transducers = matrix.shape
    state = method.start(Problem(transducers, points, goal, transfer_matrix=matrix), seed, trials)
    return method.best(method.tell(state, (method.ask(state) @ matrix.mT).abs()))
