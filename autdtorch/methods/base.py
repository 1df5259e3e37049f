"""Methods as ask and tell: settings, problem and state, and the interface that all methods share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any, ClassVar, NamedTuple

import torch

from autdtorch.methods.doubtful_readings import log_doubts, lone_score
from autdtorch.methods.seeds import Trials, trial_seeds
from autdtorch.methods.solution import Solution
from autdtorch.objectives.goals import WEAKEST_FOCUS, Goal, goal_of, scores_of
from autdtorch.objectives.objective import (
    GoalFunction,
    Objective,
    require_objective,
    validate_drives,
    validate_matrix,
)
from autdtorch.objectives.perturbations import quantised, simulated_matrix
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.process import require_memory
from autdtorch.utils.validation import (
    complex_tensor,
    integer_at_least,
    invalid,
    real_tensor,
    require_callable,
    require_kind,
    require_one_of,
    within,
)

_LOUDEST = 1e9  # Largest pressure [Pa] that is no error of a program; air has 1e5 Pa

NEAR_TIE = 1e-5
"""Relative difference below which scores count as equal. Symmetric scenes have many equal scores, and the
rounding of the simulation, which differs between machines, must not decide between them."""


@dataclass(frozen=True, eq=False)
class Problem:
    """The problem that a method solves: transducers, foci, the goal, and further knowledge.

    A method that sees magnitudes only needs no more than the two numbers.

    Attributes:
        transducers: number M of entries of a drive.
        foci: number P of control points.
        goal: such as `WeakestFocus`, or a function of pressures (..., P) [Pa] that gives the scores (...) to
            maximise.
        scene: geometry, for methods that start from free-space phases (`LSS`, `LSSG`).
        transfer_matrix: simulated G (P, M) [Pa], for `GradientAscent` and as a `Prior` of what is measured.
        quantise: function of drives (..., M) that gives the drives which the device plays.
        start: drive (M,) that was good before, such as at the last pose of an obstacle, or one for each trial
            (T, M); `BayesOpt`, `GABS` and `GradientAscent` begin there.
    """

    transducers: int
    foci: int
    goal: GoalFunction = WEAKEST_FOCUS
    scene: Scene | None = None
    transfer_matrix: torch.Tensor | None = None
    quantise: Callable[[torch.Tensor], torch.Tensor] = field(default=lambda drive: drive)
    start: torch.Tensor | None = None

    def __post_init__(self) -> None:
        """Check the fields."""
        for name in ("transducers", "foci"):
            object.__setattr__(self, name, integer_at_least(name, getattr(self, name), 1))
        require_callable("goal", self.goal)
        object.__setattr__(self, "goal", goal_of(self.goal))
        if isinstance(self.goal, Goal):
            self.goal.check(self.foci)
        require_callable("quantise", self.quantise)
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

    @classmethod
    def of(
        cls, objective: Objective, goal: GoalFunction = WEAKEST_FOCUS, start: torch.Tensor | None = None
    ) -> Problem:
        """Return the problem that an objective poses, with the transfer matrix that it has inside, if any.

        Args:
            objective: simulated or measured.
            goal: function of pressures (..., P) [Pa] that gives the scores (...) to maximise.
            start: drive (M,) or (T, M) to start from, if any.
        """
        require_objective(objective)
        scene, matrix = objective.scene, simulated_matrix(objective)
        counts = len(scene.array), len(scene.control_points)
        return cls(*counts, goal, scene, matrix, lambda drive: quantised(objective, drive), start)


def starts_of(problem: Problem, trials: int) -> torch.Tensor | None:
    """Return the drive (T, M) that each of some trials begins at, if any."""
    start = problem.start
    if start is None or start.ndim == 1:
        return None if start is None else start.expand(trials, -1)
    if len(start) != trials:
        raise ValueError(f"start: {len(start)} drives; must be one for each of {trials} trials")
    return start


def known_matrix(problem: Problem) -> torch.Tensor:
    """Return the transfer matrix (P, M) [Pa] of a problem, which must have one."""
    if problem.transfer_matrix is None:
        accepted = 'must have a transfer matrix, as SimulatedObjective has in mode "transfer"'
        raise invalid("objective", None, accepted)
    return problem.transfer_matrix


class Step(NamedTuple):
    """The next step of a method.

    Attributes:
        drives: B drives to observe for each of the L trials that go on (L, B, M); B = 0 at the end.
        search: tensors by name, from which the method goes on.
        goes_on: True for those of the observed trials that go on, bool; None for all.
    """

    drives: torch.Tensor
    search: Mapping[str, torch.Tensor]
    goes_on: torch.Tensor | None = None


@dataclass(frozen=True, eq=False)
class State:
    """The state of T trials of a method. `save_state` and `load_state` keep it in a file.

    Attributes:
        method: of the trials.
        problem: of the trials.
        seeds: of the T trials.
        trials: indices of the L trials that go on (L,), of 0 to T - 1.
        drives: B drives for each of them to observe next (L, B, M), complex128.
        search: tensors by name, from which the method goes on.
        best: the best drive of each trial so far, with its history.
    """

    method: Method
    problem: Problem
    seeds: tuple[int, ...]
    trials: torch.Tensor
    drives: torch.Tensor
    search: Mapping[str, torch.Tensor]
    best: Solution

    @property
    def done(self) -> bool:
        """True when no drive is left to observe."""
        return self.drives.shape[:2].numel() == 0

    @property
    def evaluations(self) -> int:
        """Evaluations of all trials so far."""
        return int(self.best.evaluations.sum())


def whole(default: int | None, least: int) -> Any:
    """Return the field of a setting that is an integer >= `least`, or None where that is the default."""
    return setting(default, partial(integer_at_least, minimum=least))


def choice(default: str, *others: str) -> Any:
    """Return the field of a setting that is one of these texts, the default first."""
    return setting(default, partial(_one_of, accepted=(default, *others)))


def setting(default: object, check: Callable[[str, Any], object]) -> Any:
    """Return the field of a setting that a function of its name and value checks, and may convert."""
    return field(default=default, metadata={"check": check})


def _one_of(name: str, value: object, accepted: Sequence[str]) -> object:
    require_one_of(name, value, accepted)
    return value


@dataclass(frozen=True)
class Method(ABC):
    """Base of all methods: a frozen dataclass of settings that are checked when it is made.

    A user's method adds its settings as fields and implements `begin`, `advance` and
    `most_evaluations`; ``docs/extending.md`` has an example.

    Attributes:
        name: of the method in results and files.
        label: name of the method in figures and tables.
        random: whether trials differ by random choices; otherwise there is one trial.
        block: number of trials that a study runs and saves together.
    """

    name: ClassVar[str]
    label: ClassVar[str]
    random: ClassVar[bool] = True
    block: ClassVar[int] = 10

    def __init_subclass__(cls) -> None:
        """Name a method without a name after its class."""
        cls.name = cls.__dict__.get("name", cls.__name__)
        cls.label = cls.__dict__.get("label", cls.name)

    def __post_init__(self) -> None:
        """Check the fields made by `setting`, `whole` and `choice`."""
        for entry in fields(self):
            value = getattr(self, entry.name)
            if (check := entry.metadata.get("check")) and not (value is None is entry.default):
                object.__setattr__(self, entry.name, check(entry.name, value))

    def most_evaluations(self, problem: Problem) -> int:
        """Return the most evaluations that a trial can take: the setting `evaluations`, or 1."""
        return int(getattr(self, "evaluations", 1))

    @abstractmethod
    def begin(self, problem: Problem, seeds: Sequence[int]) -> Step:
        """Return the first step of the trials, one for each seed."""

    def advance(self, state: State, pressure: torch.Tensor, score: torch.Tensor) -> Step:
        """Return the next step; the end by default.

        Args:
            state: with the drives (L, B, M) that were observed.
            pressure: magnitudes (L, B, P) [Pa], float64.
            score: scores (L, B), float64.
        """
        return Step(state.drives[:, :0], {})

    def check(self, problem: Problem) -> None:  # noqa: B027 - most methods have nothing to check
        """Check the settings against the problem; `ValueError` where one does not fit."""

    def most_at_once(self, problem: Problem) -> int:
        """Return the largest number of drives that a trial has observed in one step."""
        return self.most_evaluations(problem)

    def numbers_kept(self, problem: Problem) -> float:
        """Estimate the float64 numbers that a trial stores, to refuse settings that need too many."""
        drive = 4.0 * problem.transducers + 2.0 * problem.foci
        # Besides the drives of a step: the score of each evaluation, and the history made of the scores
        return 4.0 * self.most_evaluations(problem) + drive * self.most_at_once(problem)

    def require_fit(self, problem: Problem, trials: int) -> None:
        """Check settings and memory against a problem; `ValueError` where they do not fit."""
        self.check(problem)
        whole = {name: value for name, value in vars(self).items() if isinstance(value, int)}
        whole = whole or {"evaluations": self.most_evaluations(problem)}
        largest = max(whole, key=whole.__getitem__)
        require_memory(largest, whole[largest], 8 * trials * self.numbers_kept(problem))

    def start(self, problem: Problem, seed: int = 0, trials: Trials = 1) -> State:
        """Begin T trials.

        Args:
            problem: of all trials.
            seed: of the random choices, >= 0. Trial t has the same seed for every number of trials.
            trials: number of trials T, or their numbers.

        Returns:
            A state whose drives wait to be observed.
        """
        require_kind("problem", problem, Problem)
        seeds = trial_seeds(seed, trials)
        if not self.random and len(seeds) > 1:
            raise invalid("trials", trials, f"must be 1: {self.label} has no random choices")
        count = len(seeds)
        self.require_fit(problem, count)
        starts_of(problem, count)
        step = self.begin(problem, seeds)
        empty = Solution(
            torch.zeros(count, problem.transducers, **COMPLEX),
            torch.zeros(count, problem.foci, **REAL),
            torch.full((count,), -torch.inf, **REAL),
            torch.zeros(count, dtype=torch.int64, device="cpu"),
            torch.empty(count, 0, **REAL),
        )
        places = torch.arange(count, device="cpu")
        return State(self, problem, tuple(seeds), places, step.drives, step.search, empty)

    def ask(self, state: State) -> torch.Tensor:
        """Return the drives (B, M), complex128, to observe next; none when the method is done."""
        self._require_state(state)
        return state.drives.flatten(0, 1).clone()

    def tell(self, state: State, pressure: torch.Tensor) -> State:
        """Return the state after the drives of `ask` were observed.

        Args:
            state: whose drives were observed.
            pressure: magnitudes at the control points (B, P) [Pa].

        Raises:
            ValueError: a state that is done or of another method, pressures of another shape or that cannot
                be magnitudes, or scores that are not finite.
        """
        self._require_state(state)
        if state.done:
            raise ValueError("state: it is done, and no drive was asked for; take best(state)")
        batch = state.drives.shape[:2]
        name = "pressure of the objective"
        pressure = real_tensor(name, pressure, "Pa").detach().cpu()
        if pressure.shape != (shape := (batch.numel(), state.problem.foci)):
            raise ValueError(f"{name}: shape {tuple(pressure.shape)}; must be {shape}")
        if len(wrong := ((pressure < 0) | (pressure > _LOUDEST)).nonzero()):
            place, value = wrong[0].tolist(), float(pressure[tuple(wrong[0])])
            accepted = f"must be a magnitude from 0 to {_LOUDEST:g}, not a level in dB or a signed sample"
            raise invalid(f"{name}{place}", value, accepted, "Pa")
        pressure = pressure.reshape(*batch, -1)
        score = scores_of(state.problem.goal, pressure)
        state = replace(state, best=_improved(state, pressure, score))
        step = self.advance(state, pressure, score)
        trials = state.trials if step.goes_on is None else state.trials[step.goes_on]
        state = replace(state, trials=trials, drives=step.drives, search=step.search)
        log_doubts(self.label, self._doubts(state))
        return state

    def best(self, state: State) -> Solution:
        """Return the best drive of each trial so far; `ValueError` before the first evaluation."""
        self._require_state(state)
        if not state.best.history.shape[1]:
            raise ValueError("state: nothing was observed yet; tell what the drives of ask give first")
        history = state.best.history.cummax(dim=1).values.minimum(state.best.score[:, None])
        missing = max(0, self.most_evaluations(state.problem) - history.shape[1]) if state.done else 0
        history = torch.cat([history, history[:, -1:].expand(-1, missing)], dim=1)
        return replace(state.best, drive=state.problem.quantise(state.best.drive), history=history)

    def _doubts(self, state: State) -> Sequence[Iterable[str]]:
        """Describe doubtful readings of each trial after `tell`: a lone highest score."""
        return [lone_score(score) for score in state.best.history] if state.done else []

    def _require_state(self, state: State) -> None:
        require_kind("state", state, State)
        if state.method != self:
            raise invalid("state", f"of {state.method}", f"must be of {self}")


def _improved(state: State, pressure: torch.Tensor, score: torch.Tensor) -> Solution:
    """Return the best drives after another observation, pressures (L, B, P) and scores (L, B)."""
    best, trials = state.best, state.trials
    index = first_of_best(score)[:, None]
    highest = score.gather(1, index)[:, 0]
    row = torch.nonzero(highest - NEAR_TIE * highest.abs() > best.score[trials])[:, 0]
    better, index = trials[row], index[row, 0]
    scores = score.new_full((len(best.score), score.shape[1]), -torch.inf).index_copy(0, trials, score)
    return Solution(
        drive=best.drive.index_copy(0, better, state.drives[row, index]),
        pressure=best.pressure.index_copy(0, better, pressure[row, index]),
        score=best.score.index_copy(0, better, highest[row]),
        evaluations=best.evaluations.index_add(0, trials, torch.full_like(trials, score.shape[1])),
        history=torch.cat([best.history, scores], dim=1),
    )


def first_of_best(score: torch.Tensor) -> torch.Tensor:
    """Return the index (T,) of the first of scores (T, B) within `NEAR_TIE` of the best."""
    best = score.amax(dim=1, keepdim=True)
    return (score >= best - NEAR_TIE * best.abs()).byte().argmax(dim=1)
