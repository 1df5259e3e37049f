"""What the optimisers share: the ledger of evaluations, the solution, and the seeds of the trials."""

from __future__ import annotations

import numbers
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch

from autdtorch.objectives.perturbations import playable
from autdtorch.objectives.simulated import Objective, Score, require_objective
from autdtorch.scene.drive import amplitudes_of, phases_of
from autdtorch.utils.html import html_facts
from autdtorch.utils.memory import require_memory
from autdtorch.utils.validation import integer_at_least, integers, invalid, real_tensor, require_callable

Trials: TypeAlias = int | Sequence[int]
"""A number of trials T, or the numbers of the T trials to run, so that a study can be run in parts."""


@dataclass(frozen=True, eq=False)
class Solution:
    """The drive that each of T trials chose: the best it observed, but where a method says otherwise.

    Attributes:
        drive: (T, M), complex128, as it was played: on the device's levels, if the objective knows them.
        pressure: magnitudes at the P control points (T, P) [Pa], as observed for `drive`.
        score: (T,), as observed for `drive`; in Pa for the weakest focus.
        evaluations: number of evaluations (T,), int64.
        history: best score so far after each evaluation (T, E). E is the most evaluations that the settings
            allow; a trial that ended before keeps its last score.
    """

    drive: torch.Tensor
    pressure: torch.Tensor
    score: torch.Tensor
    evaluations: torch.Tensor
    history: torch.Tensor

    @property
    def phases(self) -> torch.Tensor:
        """Phases in [0, 2 pi) of the drive (T, M) [rad]."""
        return phases_of(self.drive)

    @property
    def amplitudes(self) -> torch.Tensor:
        """Amplitudes of the drive (T, M)."""
        return amplitudes_of(self.drive)

    def __repr__(self) -> str:
        """Counts and what was reached, with units."""
        return f"Solution({', '.join(f'{name} {value}' for name, value in self._facts())})"

    def _repr_html_(self) -> str:
        """For Jupyter: a table of what was reached."""
        return html_facts("Solution", self._facts())

    def _facts(self) -> list[tuple[str, str]]:
        weakest = self.pressure.amin(dim=1)
        reached = f"{weakest.max():.4g} Pa"
        if len(weakest) > 1:
            reached = f"best {reached}, median {weakest.quantile(0.5):.4g} Pa, worst {weakest.min():.4g} Pa"
        low, high = int(self.evaluations.min()), int(self.evaluations.max())
        return [
            ("trials", str(len(weakest))),
            ("transducers", str(self.drive.shape[1])),
            ("foci", str(self.pressure.shape[1])),
            ("weakest focus", reached),
            ("evaluations", str(low) if low == high else f"{low} to {high}"),
        ]


def joined(solutions: Sequence[Solution]) -> Solution:
    """The trials of several solutions as those of one; shorter histories go on with their last value."""
    longest = max(solution.history.shape[1] for solution in solutions)
    histories = [
        torch.cat([history, history[:, -1:].expand(-1, longest - history.shape[1])], dim=1)
        for history in (solution.history for solution in solutions)
    ]
    columns = {
        name: torch.cat([getattr(solution, name) for solution in solutions])
        for name in ("drive", "pressure", "score", "evaluations")
    }
    return Solution(history=torch.cat(histories), **columns)


NEAR_TIE = 1e-5
"""Relative difference of scores that count as equal. In symmetric scenes many are, but for the rounding of
the simulation, which another machine does otherwise."""


TRIAL_BYTES = 6_000.0
"""Memory [bytes] of a trial: its generator of random numbers above all."""

_SCORE_NUMBERS = 4.0
"""Numbers for each evaluation: its score, and those from which a history is made."""


def first_of_best(score: torch.Tensor) -> torch.Tensor:
    """Return the index (T,) of the first of scores (T, B) within `NEAR_TIE` of the best."""
    best = score.amax(dim=1, keepdim=True)
    return (score >= best - NEAR_TIE * best.abs()).byte().argmax(dim=1)


def best_first(score: torch.Tensor) -> torch.Tensor:
    """Return the indices (T, B) of scores (T, B) from the best on, near ties in ascending order."""
    order = score.argsort(dim=1, descending=True, stable=True)
    ranked = score.gather(1, order)
    apart = ranked[:, :-1] - ranked[:, 1:] > NEAR_TIE * ranked[:, :-1].abs()
    group = torch.nn.functional.pad(apart.cumsum(dim=1), (1, 0))
    return order.gather(1, (group * score.shape[1] + order).argsort(dim=1))


class Ledger:
    """Evaluates drives for several trials at once, and keeps what was found.

    Optimisers evaluate through a ledger only, so that every evaluation is counted and none is forgotten.

    Attributes:
        transducers: their number M.
    """

    transducers: int

    def __init__(self, objective: Objective, trials: int, score: Score) -> None:
        """Open the ledger.

        Args:
            objective: what is evaluated.
            trials: number of trials T.
            score: what is maximised.

        Raises:
            ValueError: no objective, or a score that is no function.
        """
        require_objective(objective)
        require_callable("score", score)
        self.transducers, foci = len(objective.scene.array), len(objective.scene.control_points)
        self._objective = objective
        self._score = score
        self._drive = torch.zeros(trials, self.transducers, dtype=torch.complex128, device="cpu")
        self._pressure = torch.zeros(trials, foci, dtype=torch.float64, device="cpu")
        self._best = torch.full((trials,), -torch.inf, dtype=torch.float64, device="cpu")
        self._evaluations = torch.zeros(trials, dtype=torch.int64, device="cpu")
        self._scores: list[torch.Tensor] = []

    def require_memory(self, evaluations: float, at_once: float = 1.0, /, **counts: int) -> None:
        """Refuse counts that lead to more evaluations than there is memory for.

        Args:
            evaluations: of each trial.
            at_once: of these in one call of the objective.
            **counts: arguments that decide, by name; of equal ones the first is blamed.

        Raises:
            ValueError: names the largest of the counts.
        """
        field = max(counts, key=counts.__getitem__)
        called = at_once * (4 * self.transducers + 2 * self._pressure.shape[1])
        needed = 8 * len(self._best) * (_SCORE_NUMBERS * evaluations + called)
        require_memory(field, counts[field], needed)

    def evaluate(self, drive: torch.Tensor, trials: torch.Tensor | None = None) -> torch.Tensor:
        """Scores (T, B), float64, of drives (T, B, M): `observe`, where only the score counts."""
        self.observe(drive, trials)
        scores = self._scores[-1]
        return scores if trials is None else scores[trials]

    def observe(self, drive: torch.Tensor, trials: torch.Tensor | None = None) -> torch.Tensor:
        """Evaluate B drives for each trial, all in one call of the objective.

        Args:
            drive: (T, B, M), complex128, B >= 1.
            trials: places of the T trials that go on, all by default. One that is left out has ended.

        Returns:
            Pressure magnitudes (T, B, P) [Pa], float64.

        Raises:
            ValueError: the objective gave pressures, or the score function gave scores, that are not finite
                real numbers or have the wrong shape.
        """
        batch = drive.shape[:2]
        pressure = _observed("pressure of the objective", self._objective(drive.flatten(0, 1)), "Pa")
        _require_shape("pressure of the objective", pressure, (batch.numel(), self._pressure.shape[1]))
        pressure = pressure.reshape(*batch, -1)
        score = _observed("score", self._score(pressure))
        _require_shape("score", score, batch)

        trials = torch.arange(len(self._best), device="cpu") if trials is None else trials
        index = first_of_best(score)
        best = score.gather(1, index[:, None])[:, 0]
        row = torch.nonzero(best - NEAR_TIE * best.abs() > self._best[trials])[:, 0]
        better = trials[row]
        self._best[better] = best[row]
        self._drive[better] = drive[row, index[row]]
        self._pressure[better] = pressure[row, index[row]]
        self._evaluations[trials] += batch[1]
        everyone = torch.full((len(self._best), batch[1]), -torch.inf, dtype=torch.float64, device="cpu")
        everyone[trials] = score
        self._scores.append(everyone)
        return pressure

    @property
    def evaluations(self) -> int:
        """Evaluations so far of a trial that has not ended."""
        return int(self._evaluations.max())

    def solution(self, most: int | None = None) -> Solution:
        """The best drive of each trial; at least one evaluation must have been made.

        Args:
            most: evaluations that a trial could have made, where trials may end early: with it the history
                of a trial is as long whatever trials are run beside it.
        """
        history = torch.cat(self._scores, dim=1).cummax(dim=1).values.minimum(self._best[:, None])
        if most is not None:
            ended = history[:, -1:].expand(-1, most - history.shape[1])
            history = torch.cat([history, ended], dim=1)
        drive = playable(self._objective, self._drive)
        return Solution(drive, self._pressure.clone(), self._best.clone(), self._evaluations.clone(), history)


def trial_seeds(seed: int, trials: Trials) -> list[int]:
    """Seed of each trial, the same whatever trials are run beside it; different ones are unrelated.

    Raises:
        ValueError: a seed below 0, no trial, a trial twice, or a trial below 0.
    """
    seed = integer_at_least("seed", seed, 0)
    if isinstance(trials, numbers.Integral):
        count = integer_at_least("trials", trials, 1)
        require_memory("trials", count, TRIAL_BYTES * count)
        chosen = list(range(count))
    else:
        accepted = "must be an integer >= 1, or trial numbers, each once"
        if isinstance(trials, Sequence):
            require_memory("trials", f"{len(trials)} numbers", TRIAL_BYTES * len(trials))
        chosen = integers("trials", trials, 0, accepted)
        if not chosen or len(set(chosen)) < len(chosen):
            raise invalid("trials", chosen, accepted)
    return [trial_seed(seed, trial) for trial in chosen]


def trial_seed(seed: int, trial: int) -> int:
    """Seed of one trial."""
    # Half the range of uint64: torch takes seeds as signed.
    return int(np.random.SeedSequence((seed, trial)).generate_state(1, np.uint64)[0] >> np.uint64(1))


def _observed(name: str, value: torch.Tensor, unit: str = "") -> torch.Tensor:
    return real_tensor(name, value, unit).detach().cpu()


def _require_shape(name: str, value: torch.Tensor, shape: tuple[int, ...]) -> None:
    if value.shape != shape:
        raise ValueError(f"{name}: shape {tuple(value.shape)}; must be {tuple(shape)}")
