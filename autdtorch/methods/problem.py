"""The problem that a method solves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import torch

from autdtorch.methods.further_readings import fitting
from autdtorch.objectives.goals import WEAKEST_FOCUS, Goal, goal_of, scores_pressures
from autdtorch.objectives.objective import (
    GoalFunction,
    Objective,
    require_objective,
    validate_drives,
    validate_matrix,
)
from autdtorch.objectives.perturbations import deviation_of, quantised, simulated_matrix
from autdtorch.objectives.readings import Readings
from autdtorch.objectives.scenarios import observed_goal
from autdtorch.scene.scene import Scene
from autdtorch.utils.validation import (
    complex_tensor,
    integer_at_least,
    invalid,
    require_callable,
    require_kind,
    within,
)

FOR_FORCE = "take gradient_ascent, or gabs and bayes_opt, which see scores alone"
"""Advice for a method that cannot take a force."""


@dataclass(frozen=True, eq=False)
class Problem:
    """The problem that a method solves: transducers, foci, the goal, and further knowledge.

    A method that sees magnitudes only needs no more than the two numbers.

    Attributes:
        transducers: number M of entries of a drive.
        foci: number P of control points, of all scenes of `Scenarios`.
        goal: such as `WeakestFocus`, or a function of pressures (..., P) [Pa] that gives the scores (...) to
            maximise.
        scene: geometry, for methods that start from free-space phases (`LSS`, `LSSG`).
        transfer_matrix: simulated G (P, M) [Pa], for `GradientAscent` and as a `Prior` of what is measured.
        quantise: function of drives (..., M) that gives the drives which the device plays.
        start: drive (M,) that was good before, such as at the last pose of an obstacle, or one for each trial
            (T, M); `BayesOpt`, `GABS`, `GradientAscent` and `PhaseStepping` begin there.
        readings: earlier ones of the same array and control points. `Identify` and `BayesOpt` go on from
            them; for all methods, their best drive counts. They are no evaluations.
        deviation: function of readings (..., P) [Pa], earlier ones included, that gives their standard
            deviations, as `Readings.deviation`; None if they are unknown, and alike.
    """

    transducers: int
    foci: int
    goal: GoalFunction = WEAKEST_FOCUS
    scene: Scene | None = None
    transfer_matrix: torch.Tensor | None = None
    quantise: Callable[[torch.Tensor], torch.Tensor] = field(default=lambda drive: drive)
    start: torch.Tensor | None = None
    readings: Readings | None = None
    deviation: Callable[[torch.Tensor], torch.Tensor] | None = None

    def __post_init__(self) -> None:
        for name in ("transducers", "foci"):
            object.__setattr__(self, name, integer_at_least(name, getattr(self, name), 1))
        require_callable("goal", self.goal)
        object.__setattr__(self, "goal", goal_of(self.goal))
        if isinstance(self.goal, Goal):
            self.goal.check(self.foci)
        require_callable("quantise", self.quantise)
        if self.deviation is not None:
            require_callable("deviation", self.deviation)
        if self.scene is not None:
            require_kind("scene", self.scene, Scene)
        if self.transfer_matrix is not None:
            matrix = validate_matrix("transfer_matrix", self.transfer_matrix, self.foci, self.transducers)
            object.__setattr__(self, "transfer_matrix", matrix)
        if self.start is not None:
            start = complex_tensor("start", self.start)
            if start.ndim not in (1, 2) or start.shape[-1] != self.transducers:
                accepted = f"must be ({self.transducers},) or (T, {self.transducers})"
                raise ValueError(f"start: shape {tuple(start.shape)}; {accepted}")
            with within("start"):
                start = validate_drives(start, self.transducers).clone()
            object.__setattr__(self, "start", start)
        if self.readings is not None:
            readings = fitting(self.readings, self.scene, self.transducers, self.foci)
            if readings.deviation is not None and self.deviation is None:
                accepted = "must be None, as the objective has no `deviation` of the readings to come"
                raise invalid("readings.deviation", "given", accepted)
            object.__setattr__(self, "readings", readings)

    @classmethod
    def of(
        cls,
        objective: Objective,
        goal: GoalFunction = WEAKEST_FOCUS,
        start: torch.Tensor | None = None,
        readings: Readings | None = None,
    ) -> Problem:
        """Return the problem that an objective poses, with the transfer matrix that it has inside, if any.

        Args:
            objective: simulated or measured.
            goal: function of pressures (..., P) [Pa] that gives the scores (...) to maximise; the
                default gives way to a goal of the objective.
            start: drive (M,) or (T, M) to start from, if any.
            readings: earlier ones, if any.
        """
        require_objective(objective)
        scene, matrix = objective.scene, simulated_matrix(objective)
        goal, foci = observed_goal(objective, goal)
        quantise, deviation = partial(quantised, objective), deviation_of(objective)
        return cls(len(scene.array), foci, goal, scene, matrix, quantise, start, readings, deviation)


def starts_of(problem: Problem, trials: int) -> torch.Tensor | None:
    """Return the drive (T, M) that each of some trials begins at, if any."""
    start = problem.start
    if start is None or start.ndim == 1:
        return None if start is None else start.expand(trials, -1)
    if len(start) != trials:
        raise ValueError(f"start: {len(start)} drives; must be one for each of {trials} trials")
    return start


def require_pressures(problem: Problem, method: str) -> None:
    """Refuse a goal of force, for a method that fits the pressures of control points."""
    if not scores_pressures(problem.goal):
        accepted = f"must be of pressures at control points, which {method} fits; for a force {FOR_FORCE}"
        raise invalid("goal", getattr(problem.goal, "name", problem.goal), accepted)


def known_matrix(problem: Problem) -> torch.Tensor:
    """Return the transfer matrix (P, M) [Pa] of a problem, which must have one."""
    if problem.transfer_matrix is None:
        accepted = 'must have a transfer matrix, as SimulatedObjective has in mode "transfer"'
        if not scores_pressures(problem.goal):
            accepted += "; without one of what a sensor reads, take gabs or bayes_opt, which see scores alone"
        raise invalid("objective", None, accepted)
    return problem.transfer_matrix
