"""Identification: fit the transfer matrix to observed magnitudes, then maximise on the matrix.

Enough magnitudes determine each row of the matrix up to a phase (docs/decisions/identify.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch

from autdtorch.methods.base import Method, Problem, State, Step, Trials, generators_of, restored, states_of
from autdtorch.methods.driver import run
from autdtorch.methods.gradient import climb, random_drives
from autdtorch.methods.solution import Solution
from autdtorch.objectives.objective import Objective
from autdtorch.utils.threads import one_torch_thread
from autdtorch.utils.validation import integer_at_least, invalid

_GUESSES = 16  # rows from which the search for each row begins
_SEARCH_STEPS = 300
_FIT_STEPS = 100
_STARTS = 16  # drives from which the fitted matrix is climbed
_CLIMB_STEPS = 300
_ROUNDS = 3  # times that the fit is refined by drives near the best one
_SPREAD = 0.5  # their distance from it: standard deviation of the phases [rad]


@dataclass(frozen=True)
class Identify(Method):
    """Fit the transfer matrix to observed magnitudes, and maximise the weakest focus on the matrix.

    The first max(3 M - 2, evaluations / 2) drives have random phases. The others lie around the best drive of
    the matrix fitted so far, in a few rounds, each after a new fit, so that noise averages out there. The
    solution is the best drive of the last fit, since the highest of many noisy readings is a lucky one.

    Attributes:
        evaluations: number of evaluations of a trial, >= 3 M - 1. More of them average noise.
    """

    name: ClassVar[str] = "identify"
    label: ClassVar[str] = "identify"

    evaluations: int = 64

    def __post_init__(self) -> None:
        """Check the setting."""
        object.__setattr__(self, "evaluations", integer_at_least("evaluations", self.evaluations, 1))

    def check(self, problem: Problem) -> None:
        """Check that there are enough evaluations for the number of transducers."""
        least = 3 * problem.transducers - 1
        if self.evaluations < least:
            accepted = f"must be an integer >= {least}, to identify {problem.transducers} transducers"
            raise invalid("evaluations", self.evaluations, accepted)

    def begin(self, problem: Problem, seeds: Sequence[int]) -> Step:
        """Observe random phases."""
        generators = generators_of(seeds)
        count = self._first(problem)
        drives = torch.stack([random_drives(count, problem.transducers, own) for own in generators])
        return Step(problem.quantise(drives), {"generators": states_of(generators)})

    def advance(self, state: State, pressure: torch.Tensor, score: torch.Tensor) -> Step:
        """Fit the matrix, and observe drives near the best one; the best one itself at the end."""
        search = dict(state.search)
        if "last" in search:
            return Step(state.drives[:, :0], {**search, "pressure": pressure[:, 0], "score": score[:, 0]})
        generators = restored(search["generators"])
        if "rows" in search:
            drives = torch.cat([search["drives"], state.drives], dim=1)
            observed = torch.cat([search["observed"], pressure], dim=1)
            fits = [_fit(*seen) for seen in zip(drives, observed, search["rows"], strict=True)]
        else:
            drives, observed = state.drives, pressure
            fits = [_search(*seen) for seen in zip(drives, observed, generators, strict=True)]
        starts = [random_drives(_STARTS, state.problem.transducers, own) for own in generators]
        climbs = zip(fits, starts, strict=True)
        best = torch.stack([climb(rows.T, start, _CLIMB_STEPS) for rows, start in climbs])
        search |= {"drives": drives, "observed": observed, "rows": torch.stack(fits)}
        count = self._near(state.problem, drives.shape[1])
        if count == 0:
            return Step(best[:, None], {**search, "last": best})
        near = torch.stack([_nearby(*of, count) for of in zip(best, generators, strict=True)])
        return Step(state.problem.quantise(near), {**search, "generators": states_of(generators)})

    def best(self, state: State) -> Solution:
        """Return the last drive of each trial once it was observed, and the best one before."""
        found = super().best(state)
        if not state.done:
            return found
        last = state.problem.quantise(state.search["last"])
        return replace(found, drive=last, pressure=state.search["pressure"], score=state.search["score"])

    def _first(self, problem: Problem) -> int:
        return max(3 * problem.transducers - 2, self.evaluations // 2)

    def _near(self, problem: Problem, observed: int) -> int:
        """Return how many drives the next round observes after so many; 0 when all rounds are over."""
        first = self._first(problem)
        left = self.evaluations - first - 1
        ends = [first + left * rounds // _ROUNDS for rounds in range(1, _ROUNDS + 1)]
        return next((end - observed for end in ends if end > observed), 0)


def identify(objective: Objective, evaluations: int = 64, trials: Trials = 1, seed: int = 0) -> Solution:
    """Run `Identify` with these settings on an objective; see `Identify` and `run`."""
    return run(Identify(evaluations), objective, trials, seed)


@one_torch_thread()
def _search(drives: torch.Tensor, observed: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Return rows of the transfer matrix (M, P) that explain magnitudes (N, P) observed for `drives` (N, M).

    Douglas-Rachford splitting seeks phasors that have the observed magnitudes and that some row produces. It
    leaves the local minima that trap a fit. The rows are then fitted, and the best fit is taken.
    """
    transducers, foci = drives.shape[1], observed.shape[1]
    size = transducers, foci * _GUESSES
    guesses = torch.randn(size, dtype=torch.complex128, generator=generator, device="cpu")
    magnitudes = observed.repeat_interleave(_GUESSES, dim=1)
    inverse = torch.linalg.pinv(drives)
    phasors = drives @ guesses
    for _ in range(_SEARCH_STEPS):
        right = magnitudes * phasors.sgn()
        phasors = phasors + drives @ (inverse @ (2 * right - phasors)) - right
    rows = _fit(drives, magnitudes, inverse @ phasors)
    misfit = ((drives @ rows).abs() - magnitudes).square().sum(dim=0).reshape(foci, _GUESSES)
    every = torch.arange(foci, device="cpu")
    return rows.reshape(transducers, foci, _GUESSES)[:, every, misfit.argmin(dim=1)]


@one_torch_thread()
def _fit(drives: torch.Tensor, observed: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
    """Return the least-squares fit of rows (M, K) to magnitudes (N, K): phases and rows in turn."""
    inverse = torch.linalg.pinv(drives)
    for _ in range(_FIT_STEPS):
        rows = inverse @ (observed * (drives @ rows).sgn())
    return rows


def _nearby(drive: torch.Tensor, generator: torch.Generator, count: int) -> torch.Tensor:
    """Return the `drive` (M,) itself, and count - 1 others around it."""
    turns = _SPREAD * torch.randn(count, len(drive), dtype=torch.float64, generator=generator, device="cpu")
    turns[0] = 0
    return drive * torch.polar(torch.ones_like(turns), turns)
