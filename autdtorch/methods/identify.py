"""Identification: fit the transfer matrix to observed magnitudes, then maximise on the matrix.

Enough magnitudes determine each row of the matrix up to a phase (docs/decisions/identify.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch

from autdtorch.methods.base import Method, Problem, State, Step, Trials, generators_of, restored, states_of
from autdtorch.methods.driver import run
from autdtorch.methods.gradient import climb, climbed, random_drives
from autdtorch.methods.matrix_posterior import MatrixPosterior, kept, posteriors
from autdtorch.methods.prior import Prior, best_simulated_drives, matrix_prior, prior_mean, prior_of
from autdtorch.methods.solution import Solution
from autdtorch.objectives.goals import WEAKEST_FOCUS
from autdtorch.objectives.objective import Objective, Score
from autdtorch.utils.hints import suggesting
from autdtorch.utils.threads import one_library_thread
from autdtorch.utils.validation import integer_at_least, invalid

_LEAST = 64  # evaluations without the setting; more where transducers need them
_LEAST_READINGS = 2.3  # for each transducer, to find a row by its magnitudes
_STARTS = 16  # drives from which the fitted matrix is climbed
_CLIMB_STEPS = 300
_SAMPLE_STEPS = 60  # of the climb on a sample of the matrix, from the best drive
_GROWTH = 24  # a round observes one drive for so many that were observed


@suggesting
@dataclass(frozen=True)
class Identify(Method):
    """Fit the transfer matrix to observed magnitudes, and maximise the goal on the matrix.

    Without a prior, the first max(3 M - 2, evaluations / 2) drives, or all but the last, have random phases.
    With one, the first is the best drive of the simulation. Each of the others is the best drive of a sample
    of the matrix, from its posterior (Thompson 1933). The last one is the best drive of the likeliest matrix.
    It is the solution, since the highest of many noisy readings is a lucky one.

    Attributes:
        evaluations: number of evaluations of a trial, > 2.3 M, or >= 2 with a prior. With fewer than 3 M - 1
            the search takes long, and noise harms more. None: 64 with a prior, or else the larger of 64 and
            4 M. More of them average noise.
        prior: what a simulation says of the transfer matrix.
    """

    name: ClassVar[str] = "identify"
    label: ClassVar[str] = "identify"

    evaluations: int | None = None
    prior: Prior | None = None

    def __post_init__(self) -> None:
        """Check the settings."""
        if self.evaluations is not None:
            object.__setattr__(self, "evaluations", integer_at_least("evaluations", self.evaluations, 2))
        object.__setattr__(self, "prior", prior_of("prior", self.prior))

    def check(self, problem: Problem) -> None:
        """Check that there are enough evaluations for the number of transducers, or that the prior fits."""
        if self.prior is not None:
            prior_mean(self.prior, problem)
            return
        transducers = problem.transducers
        least = min(3 * transducers - 1, math.ceil(_LEAST_READINGS * transducers) + 1)
        if self.most_evaluations(problem) < least:
            accepted = f"must be an integer >= {least}, to identify {problem.transducers} transducers"
            raise invalid("evaluations", self.evaluations, accepted)

    def most_evaluations(self, problem: Problem) -> int:
        """Return `evaluations`, or what they are by default."""
        if self.evaluations is not None:
            return self.evaluations
        return _LEAST if self.prior is not None else max(_LEAST, 4 * problem.transducers)

    def numbers_kept(self, problem: Problem) -> float:
        """Return the numbers of the fit, too: derivatives, and with a prior all pairs of readings."""
        readings = float(self.most_evaluations(problem) * problem.foci)
        pairs = 3 * readings**2 if self.prior is not None else 0.0
        return super().numbers_kept(problem) + 6 * readings * problem.transducers + pairs

    def begin(self, problem: Problem, seeds: Sequence[int]) -> Step:
        """Observe random phases, or the best drive of the prior."""
        generators = generators_of(seeds)
        if self.prior is None:
            most = self.most_evaluations(problem)
            count = min(max(3 * problem.transducers - 2, most // 2), most - 1)
            drives = torch.stack([random_drives(count, problem.transducers, own) for own in generators])
        else:
            drives = best_simulated_drives(self.prior, problem, generators)[:, None]
        return Step(problem.quantise(drives), {"generators": states_of(generators)})

    @one_library_thread()
    def advance(self, state: State, pressure: torch.Tensor, score: torch.Tensor) -> Step:
        """Fit the matrix, and observe the best drives of samples of it; that of the fit at the end."""
        search = dict(state.search)
        if "last" in search:
            return Step(state.drives[:, :0], {**search, "pressure": pressure[:, 0], "score": score[:, 0]})
        drives, observed = state.drives, pressure
        if "drives" in search:
            drives = torch.cat([search["drives"], drives], dim=1)
            observed = torch.cat([search["observed"], observed], dim=1)
        generators = restored(search["generators"])
        prior = None if self.prior is None else matrix_prior(self.prior, state.problem)
        fits = posteriors(prior, search, drives, observed, generators)
        apart = [own.clone() for own in drives]  # their products must not round by the place in memory
        goal = state.problem.goal
        best = torch.stack([_highest(goal, *of) for of in zip(fits, apart, generators, strict=True)])
        search |= {"drives": drives, "observed": observed, **kept(fits)}
        left = self.most_evaluations(state.problem) - drives.shape[1] - 1
        if left == 0:
            return Step(best[:, None], {**search, "last": best})
        count = min(left, max(1, drives.shape[1] // _GROWTH))
        each = zip(fits, apart, best, generators, strict=True)
        chosen = torch.stack([_sampled(goal, *of, count) for of in each])
        return Step(state.problem.quantise(chosen), {**search, "generators": states_of(generators)})

    def best(self, state: State) -> Solution:
        """Return the last drive of each trial once it was observed, and the best one before."""
        found = super().best(state)
        if not state.done:
            return found
        last = state.problem.quantise(state.search["last"])
        return replace(found, drive=last, pressure=state.search["pressure"], score=state.search["score"])


@suggesting
def identify(
    objective: Objective,
    evaluations: int | None = None,
    trials: Trials = 1,
    seed: int = 0,
    *,
    prior: Prior | None = None,
    score: Score = WEAKEST_FOCUS,
) -> Solution:
    """Run `Identify` with these settings on an objective; see `Identify` and `run`."""
    return run(Identify(evaluations, prior), objective, trials, seed, score=score)


def _highest(
    goal: Score, fit: MatrixPosterior, drives: torch.Tensor, generator: torch.Generator
) -> torch.Tensor:
    """Return the best drive (M,) of a fitted matrix, which was fitted to drives (N, M)."""
    seen = drives[goal((drives @ fit.matrix.T).abs()).argmax()]
    starts = random_drives(_STARTS, len(seen), generator)
    return climb(goal, fit.matrix, torch.cat([seen[None], starts]), _CLIMB_STEPS)


def _sampled(
    goal: Score,
    fit: MatrixPosterior,
    drives: torch.Tensor,
    best: torch.Tensor,
    generator: torch.Generator,
    count: int,
) -> torch.Tensor:
    """Return the best drives (count, M) of samples of the matrix, near the best of the fitted one."""
    samples = torch.stack([fit.sample(drives, generator) for _ in range(count)])
    return climbed(goal, samples, best.expand(count, -1), _SAMPLE_STEPS)
