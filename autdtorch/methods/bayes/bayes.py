"""Bayesian optimisation of the phases (Algorithm 1), many trials at once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal

import torch

from autdtorch.methods.base import Method, Problem, State, Step, Trials
from autdtorch.methods.driver import run
from autdtorch.methods.solution import Solution
from autdtorch.objectives.objective import Objective, Score, weakest_focus
from autdtorch.scene.drive import drive_from_phases
from autdtorch.utils.threads import spread
from autdtorch.utils.validation import integer_at_least, invalid, number_between, require_kind, require_one_of

if TYPE_CHECKING:
    from autdtorch.methods.bayes.trial import BayesTrial

NOISE = 1e-4
"""Variance of the observation noise that the Gaussian process assumes, in its own variances. A fitted one
would take the kinks of the minimum over the foci for noise, and the search would end lower."""


@dataclass(frozen=True)
class BayesOpt(Method):
    """Maximise the score over the phases by Bayesian optimisation (Algorithm 1), all amplitudes being 1.

    A Gaussian process with zero mean and an isotropic Matern 5/2 kernel is fitted to the standardised scores;
    the next phases maximise the expected improvement (Eq. 7). As in the paper, the process does not know by
    default that phases are periodic. Trials search for their next phases side by side, on as many threads as
    PyTorch has.

    Attributes:
        evaluations: number of evaluations of a trial, > `initial`.
        initial: number of them, >= 2, that are spread over all phases before the search.
        fixed_transducer: index of the transducer whose phase stays 0, since a common offset of all phases
            changes no magnitude; 6 is the paper's 7th.
        acquisition: "ei", the expected improvement, or "log_ei", its logarithm (Ament et al. 2023), which has
            a slope also where the improvement itself rounds to 0.
        embedding: space in which the kernel measures distances: the "phases" as numbers from 0 to 2 pi, or
            their points (cos, sin) on the "circle", which makes the process periodic.
        initial_points: a scrambled "sobol" sequence, or independent "random" points.
        noise: variance of the observations, in variances of the process, from 1e-6 to 1; "inferred" fits it.

    Raises:
        ValueError: a setting out of range.
    """

    name: ClassVar[str] = "bayes_opt"
    label: ClassVar[str] = "BO"

    evaluations: int = 256
    initial: int = 16
    fixed_transducer: int = 6
    acquisition: Literal["ei", "log_ei"] = "ei"
    embedding: Literal["phases", "circle"] = "phases"
    initial_points: Literal["sobol", "random"] = "sobol"
    noise: float | Literal["inferred"] = NOISE

    def __post_init__(self) -> None:
        """Check the settings."""
        object.__setattr__(self, "initial", integer_at_least("initial", self.initial, 2))
        evaluations = integer_at_least("evaluations", self.evaluations, self.initial + 1)
        object.__setattr__(self, "evaluations", evaluations)
        fixed = integer_at_least("fixed_transducer", self.fixed_transducer, 0)
        object.__setattr__(self, "fixed_transducer", fixed)
        require_one_of("acquisition", self.acquisition, ("ei", "log_ei"))
        require_one_of("embedding", self.embedding, ("phases", "circle"))
        require_one_of("initial_points", self.initial_points, ("sobol", "random"))
        if isinstance(self.noise, str):
            require_one_of("noise", self.noise, ("inferred",))
        else:
            object.__setattr__(self, "noise", number_between("noise", self.noise, 1e-6, 1))

    def check(self, problem: Problem) -> None:
        """Check the number of transducers."""
        transducers = integer_at_least("transducers of the objective's array", problem.transducers, 2)
        if self.fixed_transducer >= transducers:
            accepted = f"must be an integer from 0 to {transducers - 1}"
            raise invalid("fixed_transducer", self.fixed_transducer, accepted)

    def most_evaluations(self, problem: Problem) -> int:
        """Return `evaluations`."""
        return self.evaluations

    def numbers_kept(self, problem: Problem) -> float:
        """Return the numbers of the process: a matrix of all pairs of evaluations."""
        return 2.0 * self.evaluations**2

    def begin(self, problem: Problem, seeds: Sequence[int]) -> Step:
        """Observe the initial points."""
        trials = self._trials(problem, seeds)
        points = torch.stack([trial.initial_points() for trial in trials])
        search = {
            "points": points[:, :0],
            "scores": points[:, :0, 0],
            "next": points,
        }
        return Step(drives_at(points, self.fixed_transducer), search)

    def tell(self, state: State, pressure: torch.Tensor) -> State:
        """Return the state after an observation; its processes are kept in `scratch`."""
        require_kind("state", state, State)
        count = state.search["points"].shape[1]
        if state.scratch is None or any(trial.count != count for trial in state.scratch):
            state = replace(state, scratch=self._rebuilt(state))
        return super().tell(state, pressure)

    def advance(self, state: State, pressure: torch.Tensor, score: torch.Tensor) -> Step:
        """Fit the processes, and observe the points of the largest expected improvement."""
        told = state.search["next"]
        search = {
            **state.search,
            "points": torch.cat([state.search["points"], told], dim=1),
            "scores": torch.cat([state.search["scores"], score], dim=1),
        }
        if search["scores"].shape[1] >= self.evaluations:
            return Step(state.drives[:, :0], search)
        observed = zip(state.scratch, told, score, strict=True)
        points = torch.stack(spread(lambda one: one[0].next_point(*one[1:]), observed))[:, None]
        return Step(drives_at(points, self.fixed_transducer), {**search, "next": points})

    def _trials(self, problem: Problem, seeds: Sequence[int]) -> list[BayesTrial]:
        from autdtorch.methods.bayes.trial import BayesTrial, Settings  # loads Numba

        settings = Settings(
            dimensions=problem.transducers - 1,
            evaluations=self.evaluations,
            initial=self.initial,
            log=self.acquisition == "log_ei",
            circle=self.embedding == "circle",
            sobol=self.initial_points == "sobol",
            noise=None if isinstance(self.noise, str) else self.noise,
        )
        return [BayesTrial(settings, seed) for seed in seeds]

    def _rebuilt(self, state: State) -> list[BayesTrial]:
        """Return the trials after the observations so far, as their search left them."""
        points, scores = state.search["points"], state.search["scores"]
        trials = self._trials(state.problem, state.seeds)
        for trial in trials:
            trial.initial_points()  # draws from the generator
        ends = [self.initial, *range(self.initial + 1, points.shape[1] + 1)] if points.shape[1] else []
        for begin, end in zip([0, *ends], ends, strict=False):
            for trial, own_points, own_scores in zip(trials, points, scores, strict=True):
                trial.next_point(own_points[begin:end], own_scores[begin:end])
        return trials


def bayes_opt(
    objective: Objective,
    evaluations: int = 256,
    initial: int = 16,
    trials: Trials = 1,
    seed: int = 0,
    fixed_transducer: int = 6,
    score: Score = weakest_focus,
    *,
    acquisition: Literal["ei", "log_ei"] = "ei",
    embedding: Literal["phases", "circle"] = "phases",
    initial_points: Literal["sobol", "random"] = "sobol",
    noise: float | Literal["inferred"] = NOISE,
) -> Solution:
    """Run `BayesOpt` on an objective.

    Args:
        objective: what is evaluated.
        evaluations: number of evaluations of a trial, > `initial`.
        initial: number of evaluations, >= 2, before the search.
        trials: number of trials T, >= 1, or their numbers.
        seed: of the random choices, >= 0.
        fixed_transducer: index of the transducer whose phase stays 0.
        score: function that is maximised.
        acquisition: "ei" or "log_ei".
        embedding: "phases" or "circle".
        initial_points: "sobol" or "random".
        noise: variance of the observations, from 1e-6 to 1, or "inferred".

    Returns:
        The best drive observed in each trial.

    Raises:
        ValueError: an argument out of range, an array of one transducer, or pressures or scores that are not
            finite.
    """
    method = BayesOpt(evaluations, initial, fixed_transducer, acquisition, embedding, initial_points, noise)
    return run(method, objective, trials, seed, score=score)


def drives_at(points: torch.Tensor, fixed_transducer: int) -> torch.Tensor:
    """Return drives (..., M) of points (..., M - 1) in turns; the fixed transducer has phase 0."""
    before, after = points[..., :fixed_transducer], points[..., fixed_transducer:]
    return drive_from_phases(
        2 * math.pi * torch.cat([before, torch.zeros_like(points[..., :1]), after], dim=-1)
    )
