"""Bayesian optimisation of the phases (Algorithm 1) with BoTorch, many trials at once."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal

import torch

from autdtorch.methods.base import Method, State, Step, choice, setting, whole
from autdtorch.methods.gain_trend import GainTrend, trends_of
from autdtorch.methods.gradient import climbed, highest_drive
from autdtorch.methods.matrix_fit import least_readings, posteriors, tensors_of
from autdtorch.methods.phase_points import (
    drives_at,
    fixed_last,
    points_of,
    require_transducer,
    sobol_points,
)
from autdtorch.methods.prior import (
    Prior,
    best_simulated_drives,
    matrix_prior,
    numbers_of_factors,
    prior_mean,
    prior_of,
)
from autdtorch.methods.problem import Problem, require_pressures, starts_of
from autdtorch.methods.seeds import generators_of, restored, states_of, uniform
from autdtorch.methods.solution import Solution
from autdtorch.objectives.goals import scores_of
from autdtorch.objectives.objective import GoalFunction
from autdtorch.objectives.quiet import SeenPoints
from autdtorch.objectives.readings import Readings
from autdtorch.scene.drive import AMPLITUDE_TOLERANCE
from autdtorch.utils.array_types import REAL
from autdtorch.utils.process import one_library_thread
from autdtorch.utils.text import counted
from autdtorch.utils.validation import device_type, integer_at_least, invalid, number_between, require_one_of

if TYPE_CHECKING:
    from autdtorch.methods.bayes.acquisition import Acquisition
    from autdtorch.methods.bayes.gaussian_process import Hyperparameters, MatrixRows

NOISE = 1e-4
"""Noise variance that the process of the score assumes, relative to its signal variance. A fitted one would
take the kinks of the minimum over the foci for noise, and the search would end lower."""

_SAMPLE_STEPS = 60  # of the climb on a sample of the matrix, from the best drive
_REFIT_GROWTH = 1.2  # growth of the number of observations after which the hyperparameters are fitted again
_PLAYED = 1e-9  # difference of drives from which on a device has played others than were asked for
_PAPERS_FIXED = 6  # Transducer whose phase is fixed in the paper, its 7th


@contextlib.contextmanager
def _defaults_of_processes() -> Iterator[None]:
    """Set PyTorch's global state as GPyTorch needs it, and restore it."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        with contextlib.ExitStack() as changed:
            changed.enter_context(torch.inference_mode(False))
            changed.enter_context(torch.enable_grad())
            if torch.get_default_device().type != "cpu":  # it slows every operation by a microsecond or two
                changed.enter_context(torch.device("cpu"))
            yield
    finally:
        torch.set_default_dtype(before)


def _checked_noise(name: str, value: object) -> object:
    if isinstance(value, str):
        return require_one_of(name, value, ("inferred",))
    return number_between(name, value, 1e-6, 1)


@dataclass(frozen=True)
class BayesOpt(Method):
    """Maximise the score over the phases by Bayesian optimisation (Algorithm 1), all amplitudes being 1.

    The next phases maximise the expected improvement (Eq. 7) by Gaussian processes, BoTorch's `SingleTaskGP`.
    The trials of a block are in the batch shape of one model: another block rounds otherwise, and the search
    amplifies that, so that numbers repeat for equal blocks only. Where the problem has a drive to start from,
    it is the first to be observed.

    Earlier readings of the problem take the place of initial drives, as many as there are, and a search with
    a prior begins with them. Drives told that were not asked for join later. Those with amplitudes below 1 or
    with gaps are not used, which the log says.

    Attributes:
        evaluations: number of evaluations of a trial, > `initial`; >= 2 with a prior.
        initial: number of them, >= 2, that are spread over all phases before the search. With a prior, the
            search begins at the drive whose weakest focus is best in the simulation.
        fixed_transducer: index of the transducer whose phase stays 0, since a common offset of all phases
            changes no magnitude; None for 6, the paper's 7th, or the last one of fewer.
        model: "weakest": one process models the score, as in the paper. "foci": each focus has a process, and
            the improvement of the score is averaged over samples of all. The score must then be
            differentiable by PyTorch. From 3 M - 1 readings on, or with a prior, the processes begin at a
            sample of the transfer matrix that `MatrixPosterior` fits to all readings. With fewer evaluations
            they do so from 2.3 M on, and the search for the matrix takes long if there is noise.
        kernel: of the model "weakest": "phases", as in the paper, measures distances between phases from 0 to
            2 pi; "circle" between their points (cos, sin), which makes the process periodic; both are Matern
            5/2. Of the model "foci": "phasor", the covariance of intensities |g . q|^2; see `PhasorKernel`.
        acquisition: of the model "weakest": "ei", the expected improvement, or "log_ei", its logarithm (Ament
            et al. 2023), which has a slope also where the improvement itself rounds to 0.
        initial_points: a scrambled "sobol" sequence, or independent "random" points.
        noise: variance of the noise, from 1e-6 to 1: of scores in variances of the process, or of a reading
            in mean intensities of its focus (model "foci"). "inferred" fits it, as do readings
            of known deviations. The model "foci" spends the last evaluation at the maximum of the posterior
            mean, and returns the observed drive where the posterior mean is highest.
        prior: simulated transfer matrix, and how far to trust it, for the model "foci".
        device: "cpu", or "cuda" for processes, acquisition and the goal on an NVIDIA GPU. Hyperparameters are
            fitted on the CPU. The rounding of another device leads to other points.

    Raises:
        ValueError: a setting out of range.
    """

    name: ClassVar[str] = "bayes_opt"
    label: ClassVar[str] = "BO"
    block: ClassVar[int] = 25  # a trial takes half the time of one in a block of ten

    evaluations: int = 256
    initial: int = whole(16, least=2)
    fixed_transducer: int | None = whole(None, least=0)
    model: Literal["weakest", "foci"] = choice("weakest", "foci")
    kernel: Literal["phases", "circle", "phasor"] = choice("phases", "circle", "phasor")
    acquisition: Literal["ei", "log_ei"] = choice("ei", "log_ei")
    initial_points: Literal["sobol", "random"] = choice("sobol", "random")
    noise: float | Literal["inferred"] = setting(NOISE, _checked_noise)
    prior: Prior | None = setting(None, prior_of)
    device: Literal["cpu", "cuda"] = choice("cpu", "cuda")

    def __post_init__(self) -> None:
        super().__post_init__()
        device_type("device", self.device)  # refuses a GPU that is not there
        least = self.initial + 1 if self.prior is None else 2
        evaluations = integer_at_least("evaluations", self.evaluations, least)
        object.__setattr__(self, "evaluations", evaluations)
        if (self.kernel == "phasor") != (self.model == "foci"):
            raise invalid("kernel", self.kernel, 'must be "phasor" with the model "foci", and only there')
        if self.prior is not None and self.model != "foci":
            raise invalid("prior", self.prior, 'must be None without the model "foci"')

    def check(self, problem: Problem) -> None:
        """Check the number of transducers, the prior, and earlier readings."""
        require_transducer(self._fixed(problem.transducers), problem.transducers)
        earlier = _usable(problem.readings)
        if self.model == "foci":
            require_pressures(problem, 'the model "foci"')
        if self.model == "foci" and earlier is not None and not (read := earlier.pressure.any(dim=0)).all():
            point = int((~read).nonzero()[0])
            accepted = "must not be 0 throughout: the sensor of this control point has failed"
            raise invalid(f"readings.pressure[:, {point}]", 0.0, accepted, "Pa")
        if self.prior is not None:
            prior_mean(self.prior, problem)

    def numbers_kept(self, problem: Problem) -> float:
        """Return the numbers of the processes: a few matrices of all pairs of evaluations."""
        earlier = 0 if problem.readings is None else len(problem.readings)
        numbers = 4.0 * self._outputs(problem) * (self.evaluations + earlier) ** 2
        return numbers if self.prior is None else numbers + numbers_of_factors(self.prior, problem)

    def begin(self, problem: Problem, seeds: Sequence[int]) -> Step:
        """Observe the initial points that earlier readings do not stand for, or what these show."""
        generators, dimensions = generators_of(seeds), problem.transducers - 1
        points = torch.empty(len(seeds), 0, dimensions, **REAL)
        values = torch.empty(len(seeds), 0, self._outputs(problem), **REAL)
        search = {"points": points, "values": values}
        count = self.initial
        if (earlier := _usable(problem.readings)) is not None:
            search = self._with(search, problem, earlier)
            count = 0 if self.prior is not None else max(0, count - len(earlier))
        if self.prior is not None and earlier is None:
            points = self._points(best_simulated_drives(self.prior, problem, generators))[:, None]
        elif count and self.initial_points == "sobol":
            points = torch.stack([sobol_points(count, dimensions, seed) for seed in seeds])
        elif count:
            points = torch.stack([uniform(draws, count, dimensions) for draws in generators])
        if (starts := starts_of(problem, len(seeds))) is not None:
            points = torch.cat([self._points(starts)[:, None], points[:, 1:]], dim=1)
        search["generators"] = states_of(generators)
        if not points.shape[1]:
            return self._next(problem, search, self.evaluations)
        search["points"] = torch.cat([search["points"], points], dim=1)
        return Step(self._drives(points), search)

    def advance(self, state: State, pressure: torch.Tensor, score: torch.Tensor) -> Step:
        """Observe the points of the largest expected improvement."""
        search, problem = dict(state.search), state.problem
        count, done = search["values"].shape[1], state.best.history.shape[1]
        points, asked = search["points"][:, :count], search["points"][:, count:]
        if (self._drives(asked) - state.drives).abs().max() > _PLAYED:
            asked = self._points(state.drives)
        search["points"] = torch.cat([points, asked], dim=1)
        values = score[..., None] if self.model == "weakest" else pressure
        search["values"] = torch.cat([search["values"], values], dim=1)
        if (further := _usable(state.readings)) is not None:
            earlier = _usable(problem.readings)
            joined = search["values"].shape[1] - done - (0 if earlier is None else len(earlier))
            if joined < len(further):
                search = self._with(search, problem, further[joined:])
        left = self.evaluations - done
        if self.model == "weakest" and left == 0:
            return Step(state.drives[:, :0], search)
        return self._next(problem, search, left)

    @one_library_thread()
    @_defaults_of_processes()
    def _next(self, problem: Problem, search: Mapping[str, torch.Tensor], left: int) -> Step:
        """Observe the points of the largest expected improvement, with so many evaluations left."""
        search = {name: tensor.clone() for name, tensor in search.items()}  # of inference mode: read-only
        generators, points = restored(search["generators"]), search["points"]
        if self.model == "foci":  # processes of the points that were played
            points = self._points(problem.quantise(self._drives(points)))
        fit, rows = self._fitted(problem, search, points, generators, left)
        values = search["values"]
        if rows is not None:  # outliers are as the matrix fits them
            values = torch.where(search["outliers"], search["fitted_values"], values)
        goal = problem.goal
        if isinstance(goal, SeenPoints):  # the foci alone have processes
            foci, goal = sorted({*range(problem.foci)}.difference(goal.points)), goal.goal
            values, fit = values[..., foci], fit.of(foci)
            rows = None if rows is None else rows.of(foci)
        acquisition = self._acquisition(goal, values, points, fit, rows)
        if left == 0:
            return Step(self._drives(points[:, :0]), {**search, "answer": acquisition.best.cpu()})
        point = acquisition.next_points(generators, last=left == 1)[:, None].cpu()
        search |= {"points": torch.cat([search["points"], point], dim=1), "generators": states_of(generators)}
        return Step(self._drives(point), search)

    def best(self, state: State) -> Solution:
        """Return the best drive observed, or the one of the highest posterior mean (model "foci")."""
        solution = super().best(state)
        if not state.done or self.model == "weakest":
            return solution
        chosen = torch.arange(len(solution.score), device="cpu"), state.search["answer"]
        drive = state.problem.quantise(self._drives(state.search["points"][chosen]))
        pressure = state.search["values"][chosen]
        score = scores_of(state.problem.goal, pressure)
        return replace(solution, drive=drive, pressure=pressure, score=score)

    def _doubts(self, state: State) -> Sequence[Iterable[str]]:
        """Describe a lone highest score, and readings that are not used: at the beginning and at the end."""
        doubts = [[*texts] for texts in super()._doubts(state)]
        parts = [readings for readings in (state.problem.readings, state.readings) if readings is not None]
        unused = sum(len(readings) - len(_usable(readings) or ()) for readings in parts)
        if unused and (state.done or not state.evaluations):
            every = sum(map(len, parts))
            text = f"{unused} of {every} readings are not used: they have gaps or amplitudes below 1"
            doubts = [[text, *texts] for texts in doubts or [[]]]
        if state.done and "outliers" in state.search:
            counts = state.search["outliers"].sum(dim=(1, 2)).tolist()
            texts = [f"left out, far from the fit: {counted(count, 'pressure')}" for count in counts]
            doubts = [
                [text, *others] if count else others
                for count, text, others in zip(counts, texts, doubts, strict=True)
            ]
        if state.done and "trend" in state.search:
            told = [list(GainTrend(*trend).doubts()) for trend in state.search["trend"].tolist()]
            doubts = [[*texts, *more] for texts, more in zip(doubts, told, strict=True)]
        return doubts

    def _with(
        self, search: Mapping[str, torch.Tensor], problem: Problem, readings: Readings
    ) -> dict[str, torch.Tensor]:
        """Return the search with usable readings that are no evaluations."""
        values = readings.pressure
        if self.model == "weakest":
            values = scores_of(problem.goal, values)[:, None]
        more = {"points": self._points(readings.drives), "values": values}
        joined = {
            name: torch.cat([search[name], tensor.expand(len(search[name]), *tensor.shape)], dim=1)
            for name, tensor in more.items()
        }
        return {**search, **joined}

    def _outputs(self, problem: Problem) -> int:
        return 1 if self.model == "weakest" else problem.foci

    def _points(self, drives: torch.Tensor) -> torch.Tensor:
        return points_of(drives, self._fixed(drives.shape[-1]))

    def _fixed(self, transducers: int) -> int:
        return min(_PAPERS_FIXED, transducers - 1) if self.fixed_transducer is None else self.fixed_transducer

    def _drives(self, points: torch.Tensor) -> torch.Tensor:
        return drives_at(points, self._fixed(points.shape[-1] + 1))

    def _fitted(
        self,
        problem: Problem,
        search: dict[str, torch.Tensor],
        points: torch.Tensor,
        generators: Sequence[torch.Generator],
        left: int,
    ) -> tuple[Hyperparameters, MatrixRows | None]:
        """Return hyperparameters and rows; `search` gets the tensors that the next fit begins with."""
        from autdtorch.methods.bayes.gaussian_process import Hyperparameters, fitted

        count, needed = search["values"].shape[1], 3 * problem.transducers - 1
        if count + left <= needed:  # the last drive would come too soon: a long search then needs fewer
            needed = least_readings(problem.transducers)
        if self.model == "foci" and (self.prior is not None or count >= needed):
            return self._with_rows(problem, search, generators, left)
        # The hyperparameters are fitted again where the observations grew by a fifth.
        if "fitted" not in search or count >= _REFIT_GROWTH * int(search["fitted"]):
            search |= fitted(self.kernel, points, search["values"], self.noise)._asdict()
            search["fitted"] = torch.tensor(count, dtype=torch.int64, device="cpu")
        return Hyperparameters(search["length_scale"], search["noise"]), None

    def _with_rows(
        self,
        problem: Problem,
        search: dict[str, torch.Tensor],
        generators: Sequence[torch.Generator],
        left: int,
    ) -> tuple[Hyperparameters, MatrixRows]:
        """Return the noise, and rows of the matrix that is fitted to all readings, or of a sample of it."""
        from autdtorch.methods.bayes.gaussian_process import Hyperparameters, MatrixRows, mean_intensity

        observed = search["values"]
        drives = problem.quantise(self._drives(search["points"]))
        power = mean_intensity(_believed(search))
        deviation = None if problem.deviation is None else problem.deviation(observed)
        is_known = deviation is None and not isinstance(self.noise, str)
        variance = 0.5 * float(self.noise) / (1 + float(self.noise)) * power if is_known else None
        prior = None if self.prior is None else matrix_prior(self.prior, problem)
        fits = posteriors(prior, search, drives, observed, generators, variance, deviation)
        search |= tensors_of(fits)
        if left == 0:
            search["trend"] = trends_of(fits, drives)
        mean = torch.stack([fit.posterior.matrix for fit in fits])
        search["fitted_values"] = (drives @ mean.mT).abs()
        each = zip(fits, drives, generators, strict=True)
        sampled = torch.cat(
            [fit.posterior.samples(drives, fit.read, draws, 1) for fit, drives, draws in each]
        )
        spread = (sampled - mean).abs().square().mean(dim=-1)
        # The search explores by samples; the answer, and the last drive, follow the mean.
        rows = mean if left <= 1 else sampled
        share = (2 * search["variance"] / power).clamp_max(0.5)
        fit = Hyperparameters(torch.ones_like(share), share / (1 - share))
        if left == 1:
            fitted = zip(mean, generators, drives, strict=True)
            best = torch.stack([highest_drive(problem.goal, *trial) for trial in fitted])
        else:
            seen = scores_of(problem.goal, (drives @ rows.mT).abs()).argmax(dim=1)
            start = drives[torch.arange(len(seen), device="cpu"), seen]
            best = climbed(problem.goal, rows, start, _SAMPLE_STEPS)
        order = fixed_last(problem.transducers, self._fixed(problem.transducers))
        return fit, MatrixRows(rows[..., order], spread, self._points(best))

    def _acquisition(
        self,
        goal: GoalFunction,
        values: torch.Tensor,
        points: torch.Tensor,
        fit: Hyperparameters,
        rows: MatrixRows | None,
    ) -> Acquisition:
        from autdtorch.methods.bayes.acquisition import FocusAcquisition, ScoreAcquisition
        from autdtorch.methods.bayes.gaussian_process import Processes

        points, values, fit = points.to(self.device), values.to(self.device), fit.to(self.device)
        rows = None if rows is None else rows.to(self.device)
        processes = Processes(self.kernel, points, values, fit, rows)
        if self.model == "weakest":
            return ScoreAcquisition(processes, points, values, self.acquisition == "log_ei")
        return FocusAcquisition(processes, points, goal, None if rows is None else rows.best)


def _usable(readings: Readings | None) -> Readings | None:
    """Return the readings of drives at full amplitude without gaps, if there are any."""
    if readings is None:
        return None
    full = (readings.drives.abs() > 1 - AMPLITUDE_TOLERANCE).all(dim=1)
    usable = full & ~readings.pressure.isnan().any(dim=1)
    return readings[usable] if usable.any() else None


def _believed(search: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Return the values (T, N, P), those that were outliers in the fit before as this fitted them."""
    values = search["values"]
    if "fitted_values" not in search:
        return values
    count = search["outliers"].shape[1]
    known = torch.where(search["outliers"], search["fitted_values"], values[:, :count])
    return torch.cat([known, values[:, count:]], dim=1)
