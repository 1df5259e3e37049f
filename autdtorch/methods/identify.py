"""Identification: fit the transfer matrix to observed magnitudes, then maximise on the matrix.

Enough magnitudes determine each row of the matrix up to a phase (docs/decisions/identify.md).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch

from autdtorch.methods.base import Method, State, Step, setting, whole
from autdtorch.methods.doubtful_readings import Magnitudes, reading_doubts, sensor_doubts
from autdtorch.methods.further_readings import independent_readings
from autdtorch.methods.gain_trend import GainTrend, trends_of
from autdtorch.methods.gradient import climbed, highest_drive, random_drives
from autdtorch.methods.matrix_fit import MatrixFit, least_readings, posteriors, tensors_of
from autdtorch.methods.prior import (
    Prior,
    best_simulated_drives,
    matrix_prior,
    numbers_of_factors,
    prior_mean,
    prior_of,
)
from autdtorch.methods.problem import Problem, require_pressures
from autdtorch.methods.seeds import generators_of, restored, states_of
from autdtorch.methods.solution import Solution
from autdtorch.objectives.goals import scores_of
from autdtorch.objectives.objective import GoalFunction
from autdtorch.objectives.readings import Readings
from autdtorch.utils.process import one_library_thread
from autdtorch.utils.validation import invalid

_LEAST = 64  # evaluations without the setting; more where transducers need them
_SAMPLE_STEPS = 60  # of the climb on a sample of the matrix, from the best drive
_GROWTH = 24  # a round observes one drive for so many that were observed
_WORSE = 9.0  # The last drive is not the solution if so many median deviations (6 sigma) below another one,
_LEAST_WORSE = 0.05  # and by this share of the score, or of its distance from the median, as targets score 0


@dataclass(frozen=True)
class Identify(Method):
    """Fit the transfer matrix to observed magnitudes, and maximise the goal on the matrix.

    Without a prior, the first max(3 M - 2, evaluations / 2) drives, or all but the last, have random phases.
    With one, the first is the best drive of the simulation. Each of the others is the best drive of a sample
    of the matrix, from its posterior (Thompson 1933). The last one is the best drive of the likeliest matrix.
    It is the solution, since the highest of many noisy readings is a lucky one; unless it reads far worse
    than another drive whose readings the matrix explains.

    Earlier readings of the problem, and drives told that were not asked for, are fitted together with the
    others. They replace random drives where these would show nothing new of the matrix.

    Readings far from the fit of the others are left out, and readings at the end of a sensor's range are
    taken as lower limits. Both are logged, like a sensor that does not respond to the drives, and a gain
    that drifts.

    Attributes:
        evaluations: number of evaluations of a trial, > 2.3 M, or >= 2 with a prior. With fewer than 3 M - 1
            noise harms more. None: 64 with a prior, or else the larger of 64 and 4 M. More of them average
            noise.
        prior: what a simulation says of the transfer matrix.
    """

    name: ClassVar[str] = "identify"
    label: ClassVar[str] = "identify"

    evaluations: int | None = whole(None, least=2)
    prior: Prior | None = setting(None, prior_of)

    def check(self, problem: Problem) -> None:
        """Check that there are enough evaluations for the number of transducers, or that the prior fits."""
        require_pressures(problem, self.name)
        if self.prior is not None:
            prior_mean(self.prior, problem)
            return
        least = max(2, least_readings(problem.transducers) + 1 - _independent(problem))
        if self.most_evaluations(problem) < least:
            accepted = f"must be an integer >= {least}, to identify {problem.transducers} transducers"
            raise invalid("evaluations", self.evaluations, accepted)

    def most_evaluations(self, problem: Problem) -> int:
        """Return `evaluations`, or their default."""
        if self.evaluations is not None:
            return self.evaluations
        return _LEAST if self.prior is not None else max(_LEAST, 4 * problem.transducers)

    def numbers_kept(self, problem: Problem) -> float:
        """Add the numbers of the fit: derivatives, or pairs of the readings of each point with a prior."""
        earlier = 0 if problem.readings is None else len(problem.readings)
        drives = self.most_evaluations(problem) + earlier
        each = 6.0 * problem.transducers
        if self.prior is not None and drives <= 2 * problem.transducers:
            each = 6.0 + 3 * drives
        factors = 0.0 if self.prior is None else numbers_of_factors(self.prior, problem)
        return super().numbers_kept(problem) + each * drives * problem.foci + factors

    @one_library_thread()
    def begin(self, problem: Problem, seeds: Sequence[int]) -> Step:
        """Observe random phases, or the best drive of the prior, or of what earlier readings show."""
        generators = generators_of(seeds)
        search = {} if problem.readings is None else _added({}, problem.readings, len(seeds))
        random = self._random_drives(problem)
        search["random"] = torch.full((len(seeds),), random, dtype=torch.int64, device="cpu")
        if random:
            drives = torch.stack([random_drives(random, problem.transducers, draws) for draws in generators])
        elif problem.readings is not None:
            return self._next(problem, search, generators, self.most_evaluations(problem) - 1)
        else:
            assert self.prior is not None
            drives = best_simulated_drives(self.prior, problem, generators)[:, None]
        return Step(problem.quantise(drives), {**search, "generators": states_of(generators)})

    @one_library_thread()
    def advance(self, state: State, pressure: torch.Tensor, score: torch.Tensor) -> Step:
        """Fit the matrix, and observe the best drives of samples of it, or of the fit at the end."""
        done = state.best.history.shape[1]
        numbers = torch.arange(done - pressure.shape[1], done, device="cpu").expand(pressure.shape[:2])
        search = _with(state.search, state.drives, pressure, numbers)
        left = self.most_evaluations(state.problem) - done - 1
        if left < 0:
            return Step(state.drives[:, :0], {**search, "answer": _answer(state.problem.goal, search)})
        if state.readings is not None:
            # Number -1 - k is the k-th of the problem's readings and the further ones.
            joined = int((search["numbers"][0] < 0).sum())
            earlier = 0 if state.problem.readings is None else len(state.problem.readings)
            if joined < earlier + len(state.readings):
                search = _added(search, state.readings[joined - earlier :], len(pressure), joined)
        return self._next(state.problem, search, restored(search["generators"]), left)

    def _next(
        self,
        problem: Problem,
        search: Mapping[str, torch.Tensor],
        generators: Sequence[torch.Generator],
        left: int,
    ) -> Step:
        """Fit the matrix to all readings, and observe the best drives of samples of it, or of the fit."""
        drives, observed = search["drives"], search["observed"]
        prior = None if self.prior is None else matrix_prior(self.prior, problem)
        deviation = None if problem.deviation is None else problem.deviation(observed)
        fits = posteriors(prior, search, drives, observed, generators, deviation=deviation)
        copies = [played.clone() for played in drives]  # products must not round by the place in memory
        trials = list(zip(fits, copies, generators, strict=True))
        best = torch.stack(
            [highest_drive(problem.goal, fit.posterior.matrix, draws, seen) for fit, seen, draws in trials]
        )
        search = {**search, **tensors_of(fits)}
        if left == 0:
            last = problem.quantise(best)[:, None]
            trend = trends_of(fits, drives)
            fitted = _magnitudes(fits, torch.cat([drives, last], dim=1))
            return Step(last, {**search, "fitted": fitted, "trend": trend})
        count = min(left, max(1, drives.shape[1] // _GROWTH))
        chosen = []  # the best drives of samples of the matrix, near the best of the fitted one
        for (fit, played, draws), start in zip(trials, best, strict=True):
            samples = fit.posterior.samples(played, fit.read, draws, count)
            chosen.append(climbed(problem.goal, samples, start.expand(count, -1), _SAMPLE_STEPS))
        search |= {"fitted": _magnitudes(fits, drives), "generators": states_of(generators)}
        return Step(problem.quantise(torch.stack(chosen)), search)

    def best(self, state: State) -> Solution:
        """Return the solution of each trial; before the last evaluation, the best one that is no outlier."""
        solution, search, goal = super().best(state), state.search, state.problem.goal
        if "outliers" not in search:
            return solution
        believed = _believed_scores(goal, search)
        if not state.done and believed.isnan().all(dim=1).any():
            return solution
        answer = search["answer"] if state.done else _best_believed(believed)
        chosen = torch.arange(len(answer), device="cpu"), answer
        pressure = search["observed"][chosen]
        score = scores_of(goal, pressure)
        return replace(solution, drive=search["drives"][chosen], pressure=pressure, score=score)

    def _doubts(self, state: State) -> Sequence[Iterable[str]]:
        """Describe doubtful sensors after the random drives, in time to mend them, and all at the end."""
        random = state.best.history.shape[1] == int(state.search["random"][0])
        looked = "fitted" in state.search and (random or state.done)
        return [self._doubts_of(state, trial) for trial in range(len(state.seeds))] if looked else []

    def _doubts_of(self, state: State, trial: int) -> Iterator[str]:
        """Describe the doubtful sensors of a trial, and at the end its doubtful readings."""
        search = {name: tensor[trial] for name, tensor in state.search.items()}
        drives, observed, fitted = search["drives"], search["observed"], search["fitted"]
        count = len(search["outliers"])  # of readings that were fitted
        outliers = torch.nn.functional.pad(search["outliers"], (0, 0, 0, len(drives) - count))
        read = Magnitudes.of(observed, outliers, search["ends"])
        yield from sensor_doubts(drives[:count], read.rows(slice(count)), fitted[:count])
        if state.done:
            numbers = search["numbers"].tolist()
            names = [f"evaluation {n}" if n >= 0 else f"earlier reading {-1 - n}" for n in numbers]
            yield from reading_doubts(
                names, observed, read, fitted, search["variance"].sqrt(), prior=self.prior is not None
            )
            yield from GainTrend(*search["trend"].tolist()).doubts()
            if int(search["answer"]) < count:
                yield f"the last drive is far worse than the solution, {names[int(search['answer'])]}"

    def _random_drives(self, problem: Problem) -> int:
        """Return the number of random drives of a trial, none with a prior or with enough readings."""
        if self.prior is not None:
            return 0
        most, earlier = self.most_evaluations(problem), problem.readings
        needed = 3 * problem.transducers - 2 - _independent(problem)
        half = most // 2 - (0 if earlier is None else len(earlier))
        return max(0, min(max(needed, half), most - 1))


def _independent(problem: Problem) -> int:
    """Return how many random drives the earlier readings of a problem stand for, at the point with fewest."""
    if problem.readings is None:
        return 0
    drives, read = problem.readings.drives, ~problem.readings.pressure.isnan()
    return min(independent_readings(drives[column]) for column in read.T)


def _with(
    search: Mapping[str, torch.Tensor], drives: torch.Tensor, observed: torch.Tensor, numbers: torch.Tensor
) -> dict[str, torch.Tensor]:
    """Return the search with further drives (T, N, M), what they gave (T, N, P), and their numbers (T, N).

    Evaluations count from 0; other readings have the numbers -1, -2, and so on.
    """
    more = {"drives": drives, "observed": observed, "numbers": numbers}
    if "drives" in search:
        more = {name: torch.cat([search[name], tensor], dim=1) for name, tensor in more.items()}
    return {**search, **more}


def _added(
    search: Mapping[str, torch.Tensor], readings: Readings, trials: int, before: int = 0
) -> dict[str, torch.Tensor]:
    """Return the search of some trials with readings that are no evaluations, after some `before` them."""
    numbers = -1 - torch.arange(before, before + len(readings), device="cpu")
    parts = readings.drives, readings.pressure, numbers
    return _with(search, *(part.expand(trials, *part.shape) for part in parts))


def _magnitudes(fits: Sequence[MatrixFit], drives: torch.Tensor) -> torch.Tensor:
    """Return the magnitudes (T, N, P) [Pa] that fitted matrices give for drives (T, N, M)."""
    pairs = zip(fits, drives, strict=True)
    return torch.stack([(played @ fit.posterior.matrix.T).abs() for fit, played in pairs])


def _believed_scores(goal: GoalFunction, search: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Return the scores (T, N) of the evaluations that were fitted, NaN where a reading is an outlier."""
    outliers = search["outliers"]  # gaps among them
    score = scores_of(goal, search["observed"][:, : outliers.shape[1]].nan_to_num())
    return score.masked_fill(outliers.any(dim=-1), torch.nan)


def _best_believed(score: torch.Tensor) -> torch.Tensor:
    """Return the index (T,) of the highest of scores (T, N) that are not NaN."""
    return score.nan_to_num(-torch.inf).argmax(dim=1)


def _answer(goal: GoalFunction, search: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Return the index (T,) of the solution: the last evaluation, or the best before where it is far worse.

    Deviations of scores from the fitted matrix's set the scale.
    """
    score = _believed_scores(goal, search)
    last = scores_of(goal, search["observed"][:, -1])
    off = (score - scores_of(goal, search["fitted"][:, :-1])).abs().nanmedian(dim=1).values
    index = _best_believed(score)
    highest = score.gather(1, index[:, None])[:, 0]
    scale = torch.maximum(highest.abs(), highest - score.nanmedian(dim=1).values)
    worse = last < highest - torch.maximum(_WORSE * off, _LEAST_WORSE * scale)
    return torch.where(worse, index, score.shape[1])
