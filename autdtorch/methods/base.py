"""Methods as ask and tell: settings, problem and state, and the interface that all methods share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any, ClassVar, NamedTuple

import torch

from autdtorch.methods.doubtful_readings import log_doubts, lone_score
from autdtorch.methods.further_readings import LOUDEST, answered, fitting, joined
from autdtorch.methods.problem import Problem, starts_of
from autdtorch.methods.seeds import Trials, trial_seeds
from autdtorch.methods.solution import Solution
from autdtorch.objectives.goals import scores_of
from autdtorch.objectives.objective import GoalFunction
from autdtorch.objectives.readings import Readings
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.process import require_memory
from autdtorch.utils.validation import integer_at_least, invalid, real_tensor, require_kind, require_one_of

_OBSERVED = "pressure of the objective"

NEAR_TIE = 1e-5
"""Relative difference below which scores count as equal. Symmetric scenes have many equal scores, and the
rounding of the simulation, which differs between machines, must not decide between them."""


class Step(NamedTuple):
    """The next step of a method.

    Attributes:
        drives: B drives to observe for each of the L trials that go on (L, B, M); B = 0 at the end.
        search: tensors by name, from which the method goes on.
        goes_on: True for those of the observed trials that go on, bool; None for all.
        chosen: indices of the observed drives that take the place of the best so far (L',), of the L' trials
            that were observed; -1 leaves it, and None all.
    """

    drives: torch.Tensor
    search: Mapping[str, torch.Tensor]
    goes_on: torch.Tensor | None = None
    chosen: torch.Tensor | None = None


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
        pressure: magnitudes (L, B, P) [Pa] of `drives`, NaN where they were not observed yet.
        readings: of drives that the method did not ask for, besides those of the problem.
    """

    method: Method
    problem: Problem
    seeds: tuple[int, ...]
    trials: torch.Tensor
    drives: torch.Tensor
    search: Mapping[str, torch.Tensor]
    best: Solution
    pressure: torch.Tensor
    readings: Readings | None = None

    @property
    def waiting(self) -> torch.Tensor:
        """The asked drives that were not observed yet (L, B), bool."""
        return self.pressure[..., 0].isnan()

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
    return setting(default, partial(require_one_of, accepted=(default, *others)))


def setting(default: object, check: Callable[[str, Any], object]) -> Any:
    """Return the field of a setting that a function of its name and value checks, and may convert."""
    return field(default=default, metadata={"check": check})


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
        if problem.readings is not None:
            whole["readings"] = len(problem.readings)
        largest = max(whole, key=whole.__getitem__)
        require_memory(largest, whole[largest], 8 * trials * self.numbers_kept(problem))

    def start(
        self, problem: Problem, seed: int = 0, trials: Trials = 1, readings: Readings | None = None
    ) -> State:
        """Begin T trials.

        Args:
            problem: of all trials.
            seed: of the random choices, >= 0. Trial t has the same seed for every number of trials.
            trials: number of trials T, or their numbers.
            readings: earlier ones, in place of the problem's; see `Problem`.

        Returns:
            A state whose drives wait to be observed.
        """
        require_kind("problem", problem, Problem)
        if readings is not None:
            problem = replace(problem, readings=readings)
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
        best = _with_readings(empty, problem.readings, problem.goal)
        places, pressure = torch.arange(count, device="cpu"), _unread(step.drives, problem)
        state = State(self, problem, tuple(seeds), places, step.drives, step.search, best, pressure)
        if problem.readings is not None:
            log_doubts(self.label, self._doubts(state))
        return state

    def ask(self, state: State) -> torch.Tensor:
        """Return the drives (B, M), complex128, to observe next; none when the method is done."""
        self._require_state(state)
        return state.drives[state.waiting]

    def tell(self, state: State, pressure: torch.Tensor, drives: torch.Tensor | None = None) -> State:
        """Return the state after drives were observed: those of `ask`, or others.

        The method goes on when all drives of `ask` are observed, in one call or in several. A drive answers
        one of `ask` if it equals it, or if it is what a device played for it: as many drives as were asked,
        in their order, each off by no more than rounding to 6 phases. Drives that answer none are further
        readings. They are no evaluations: `Identify` and `BayesOpt` use them from the next step on, and for
        all methods the best of them counts.

        Args:
            state: whose drives were observed.
            pressure: magnitudes at the control points (B, P) [Pa]; of a further reading, NaN is a gap.
            drives: (B, M) that were played; None for all drives of `ask`.

        Raises:
            ValueError: a state of another method, or one that is done without `drives`; pressures of another
                shape or that cannot be magnitudes; or scores that are not finite.
        """
        self._require_state(state)
        if drives is not None:
            return self._told(state, Readings(drives, pressure))
        if state.done:
            raise ValueError("state: it is done, and no drive was asked for; take best(state)")
        pressure = real_tensor(_OBSERVED, pressure, "Pa").detach().cpu()
        if pressure.shape != (shape := (int(state.waiting.sum()), state.problem.foci)):
            raise ValueError(f"{_OBSERVED}: shape {tuple(pressure.shape)}; must be {shape}")
        if len(wrong := ((pressure < 0) | (pressure > LOUDEST)).nonzero()):
            place, value = wrong[0].tolist(), float(pressure[tuple(wrong[0])])
            accepted = f"must be a magnitude from 0 to {LOUDEST:g}, not a level in dB or a signed sample"
            raise invalid(f"{_OBSERVED}{place}", value, accepted, "Pa")
        complete = state.pressure.clone()
        complete[state.waiting] = pressure
        return self._advanced(replace(state, pressure=complete))

    def _told(self, state: State, readings: Readings) -> State:
        """Return the state after readings of any drives."""
        problem = state.problem
        readings = fitting(readings, None, problem.transducers, problem.foci, where="")
        places = answered(state.drives[state.waiting], readings.drives)
        waiting = state.waiting.nonzero().tolist()
        drives, pressure = state.drives.clone(), state.pressure.clone()
        for row, place in enumerate(places):
            if place is not None:
                if readings.pressure[row].isnan().any():
                    accepted = "must have no gap, as the drive was asked for; leave it out to be asked again"
                    raise invalid(f"pressure[{row}]", readings.pressure[row].tolist(), accepted, "Pa")
                index = tuple(waiting[place])
                drives[index], pressure[index] = readings.drives[row], readings.pressure[row]
        if others := [row for row, place in enumerate(places) if place is None]:
            more = readings[others]
            best = _with_readings(state.best, more, problem.goal)
            state = replace(state, best=best, readings=joined(state.readings, more))
        if len(others) == len(places):
            return state
        state = replace(state, drives=drives, pressure=pressure)
        return state if state.waiting.any() else self._advanced(state)

    def _advanced(self, state: State) -> State:
        """Return the state after all its drives were observed."""
        pressure = state.pressure
        score = scores_of(state.problem.goal, pressure)
        state = replace(state, best=_improved(state, pressure, score))
        step = self.advance(state, pressure, score)
        if step.chosen is not None:
            state = replace(state, best=_chosen(state, step.chosen, score))
        trials = state.trials if step.goes_on is None else state.trials[step.goes_on]
        unread = _unread(step.drives, state.problem)
        state = replace(state, trials=trials, drives=step.drives, search=step.search, pressure=unread)
        log_doubts(self.label, self._doubts(state))
        return state

    def best(self, state: State) -> Solution:
        """Return the best drive of each trial so far; `ValueError` before the first evaluation."""
        self._require_state(state)
        if state.best.score.isneginf().any():
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


def _unread(drives: torch.Tensor, problem: Problem) -> torch.Tensor:
    """Return pressures (L, B, P) of drives (L, B, M) that were not observed yet."""
    return torch.full((*drives.shape[:2], problem.foci), torch.nan, **REAL)


def _with_readings(best: Solution, readings: Readings | None, goal: GoalFunction) -> Solution:
    """Return the best drives after readings without gaps of drives that were not asked for."""
    complete = None if readings is None else ~readings.pressure.isnan().any(dim=1)
    if readings is None or complete is None or not complete.any():
        return best
    drives, pressure = readings.drives[complete], readings.pressure[complete]
    score = scores_of(goal, pressure)
    index = first_of_best(score[None])
    better = score[index] - NEAR_TIE * score[index].abs() > best.score
    return replace(
        best,
        drive=torch.where(better[:, None], drives[index], best.drive),
        pressure=torch.where(better[:, None], pressure[index], best.pressure),
        score=torch.where(better, score[index], best.score),
    )


def _chosen(state: State, index: torch.Tensor, score: torch.Tensor) -> Solution:
    """Return the best drives with those of indices (L,) of the last step, if >= 0, in place of others."""
    row = torch.nonzero(index >= 0)[:, 0]
    trials, index = state.trials[row], index[row]
    return replace(
        state.best,
        drive=state.best.drive.index_copy(0, trials, state.drives[row, index]),
        pressure=state.best.pressure.index_copy(0, trials, state.pressure[row, index]),
        score=state.best.score.index_copy(0, trials, score[row, index]),
    )


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
