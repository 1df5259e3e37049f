"""Bayesian optimisation: against one trial after the other, by options, and with a process for each focus.

Prints Markdown tables. Times are processor times on one thread, so that other processes matter little.

    python scripts/benchmark.py bo sequential --scenes homogeneous       20 minutes on an idle core
    python scripts/benchmark.py bo options                               30 minutes
    python scripts/benchmark.py bo foci                                  3 minutes
    python scripts/benchmark.py bo noise                                 15 minutes
"""

from __future__ import annotations

import argparse
import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import torch
from shared.document import table
from shared.scenes import PAPER, paper_scene

import autdtorch as at
from autdtorch.methods.bayes_opt import NOISE, drives_at
from autdtorch.methods.seeds import trial_seeds
from autdtorch.objectives.objective import weakest_focus

EVALUATIONS, INITIAL, FIXED = 256, 16, 6
REFIT_GROWTH, CANDIDATES, STARTS, CLIMB_STEPS = 1.2, 128, 2, 20
"""Schedule and search effort of the sequential loop: those of `bayes_opt`."""
VARIANTS: dict[str, dict[str, Any]] = {
    "as in the paper": {},
    "log_ei": {"acquisition": "log_ei"},
    "random initial points": {"initial_points": "random"},
    "inferred noise": {"noise": "inferred"},
    "circle": {"kernel": "circle"},
    "circle, log_ei": {"kernel": "circle", "acquisition": "log_ei"},
    "circle, log_ei, inferred noise": {"kernel": "circle", "acquisition": "log_ei", "noise": "inferred"},
}

BUDGETS = (32, 48, 64, 96)
NOISY_BUDGETS = (64, 128, 256)
FOCI: dict[str, Any] = {"model": "foci", "kernel": "phasor", "noise": "inferred"}

Objectives = Mapping[str, at.SimulatedObjective]

OPTIONS = {
    "what": {"nargs": "+", "choices": ["sequential", "options", "foci", "noise"], "help": "tables to print"},
    "--scenes": {"nargs": "+", "default": PAPER, "help": "names of scenes"},
    "--trials": {"type": int, "default": 50, "help": "trials at once"},
    "--sequential-trials": {"type": int, "default": 50, "help": "trials with BoTorch"},
    "--threads": {"type": int, "default": 1, "help": "threads of PyTorch"},
}


def main(given: argparse.Namespace) -> None:
    """Print the tables."""
    torch.set_num_threads(given.threads)
    scenes = {name: paper_scene(name) for name in given.scenes}
    objectives = {
        name: at.SimulatedObjective(scene, at.make_propagator(scene)) for name, scene in scenes.items()
    }
    if "sequential" in given.what:
        times = [f"{given.trials} trials at once", "a trial", "a BoTorch trial", "ratio"]
        first = given.sequential_trials
        scores = [f"score [Pa] of {given.trials}", f"of {first} by BoTorch", "difference of means"]
        show(["scene", *times, *scores], sequential_rows(objectives, given.trials, first))
    if "options" in given.what:
        show(["options", *objectives, "time"], option_rows(objectives, given.trials))
    if "foci" in given.what:
        show(["scene", *map(str, BUDGETS), "time of a trial"], foci_rows(objectives, given.trials))
    if "noise" in given.what:
        columns = [f"{name}, {count}" for count in NOISY_BUDGETS for name in ("bo_foci", "identify")]
        show(["scene, 20 dB", *columns], noise_rows(objectives, given.trials))


def show(header: list[str], rows: Iterator[list[str]]) -> None:
    """Print each row when it is done, then the table."""
    done = []
    for row in rows:
        print(*row, sep="  ", flush=True)
        done.append(row)
    print("", table(header, done), "", sep="\n", flush=True)


def sequential_rows(objectives: Objectives, trials: int, sequential_trials: int) -> Iterator[list[str]]:
    """Compare all trials at once with one trial after the other."""
    for name, objective in objectives.items():
        batch, seconds = timed(lambda o=objective: at.bayes_opt(o, trials=trials).score)
        alone, alone_seconds = timed(
            lambda o=objective: torch.cat([botorch_trial(o, t) for t in range(sequential_trials)])
        )
        each, alone_each = seconds / trials, alone_seconds / sequential_trials
        times = [f"{seconds:.1f} s", f"{each:.2f} s", f"{alone_each:.1f} s", f"{alone_each / each:.0f}"]
        # 95 % of the differences that chance makes, by Welch's standard error
        chance = 1.96 * math.sqrt(batch.var() / trials + alone.var() / sequential_trials)
        difference = f"{batch.mean() - alone.mean():+.2f} (chance: {chance:.2f})"
        yield [name, *times, quartiles(batch), quartiles(alone), difference]


def option_rows(objectives: Objectives, trials: int) -> Iterator[list[str]]:
    """Compare options."""
    for name, given in VARIANTS.items():
        solutions, seconds = timed(
            lambda given=given: [at.bayes_opt(o, trials=trials, **given) for o in objectives.values()]
        )
        yield [name, *(quartiles(solution.score) for solution in solutions), f"{seconds:.0f} s"]


def foci_rows(objectives: Objectives, trials: int) -> Iterator[list[str]]:
    """Compare a process for each focus with gradient ascent after numbers of evaluations."""
    for name, objective in objectives.items():
        best = at.gradient_ascent(objective).score
        solution, seconds = timed(lambda o=objective: at.bayes_opt(o, max(BUDGETS), 4, trials=trials, **FOCI))
        shares = [quartiles(solution.history[:, count - 1] / best) for count in BUDGETS]
        yield [name, *shares, f"{seconds / trials:.2f} s"]


def noise_rows(objectives: Objectives, trials: int) -> Iterator[list[str]]:
    """Compare true pressures of the answers with those of `identify`, as shares of gradient ascent."""
    for name, objective in objectives.items():
        best = at.gradient_ascent(objective).score
        row = [name]
        for count in NOISY_BUDGETS:
            for method in (at.BayesOpt(count, 4, **FOCI), at.Identify(count)):
                drive = at.run(method, at.Noise(objective, 20.0), trials).drive
                row.append(quartiles(at.true_pressure(objective, drive).amin(dim=1) / best))
        yield row


def timed(run: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result and the processor time [s]."""
    begin = time.process_time()
    result = run()
    return result, time.process_time() - begin


def quartiles(score: torch.Tensor) -> str:
    """Format median and quartiles."""
    low, middle, high = score.quantile(torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64)).tolist()
    digits = 3 if high < 1.5 else 2  # shares, or pressures
    return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def botorch_trial(objective: at.SimulatedObjective, trial: int) -> torch.Tensor:
    """Return the score (1,) of one trial, written as BoTorch users do."""
    from botorch.utils.sampling import draw_sobol_samples

    (seed,) = trial_seeds(0, [trial])
    generator = torch.Generator().manual_seed(seed)
    dimensions = len(objective.scene.array) - 1
    points = draw_sobol_samples(unit_cube(dimensions), n=INITIAL, q=1, seed=seed)[:, 0]
    scores = weakest_focus(objective(drives_at(points, FIXED)))
    length_scale = None
    next_fit = INITIAL
    for count in range(INITIAL, EVALUATIONS):
        if count >= next_fit:
            length_scale, next_fit = None, math.ceil(REFIT_GROWTH * count)
        point, length_scale = next_point(points, scores, length_scale, generator)
        points = torch.cat([points, point])
        scores = torch.cat([scores, weakest_focus(objective(drives_at(point, FIXED)))])
    return scores.amax(dim=0, keepdim=True)


def unit_cube(dimensions: int) -> torch.Tensor:
    """Return the lower and upper corner (2, D)."""
    return torch.tensor([[0.0], [1.0]], dtype=torch.float64).expand(2, dimensions)


def next_point(
    points: torch.Tensor, scores: torch.Tensor, length_scale: float | None, generator: torch.Generator
) -> tuple[torch.Tensor, float]:
    """Return the point (1, D) of largest expected improvement and the length scale, fitted unless given."""
    from botorch import fit_gpytorch_mll
    from botorch.acquisition.analytic import ExpectedImprovement
    from botorch.models import SingleTaskGP
    from botorch.optim.optimize import optimize_acqf
    from gpytorch.kernels import MaternKernel
    from gpytorch.means import ZeroMean
    from gpytorch.mlls import ExactMarginalLogLikelihood

    standard = ((scores - scores.mean()) / scores.std())[:, None]
    kernel = MaternKernel(nu=2.5)
    if length_scale is not None:
        kernel.lengthscale = length_scale
    noise = torch.full_like(standard, NOISE)
    process = SingleTaskGP(
        points, standard, noise, covar_module=kernel, mean_module=ZeroMean(), outcome_transform=None
    )
    if length_scale is None:
        fit_gpytorch_mll(ExactMarginalLogLikelihood(process.likelihood, process))
    process.eval().requires_grad_(False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # BoTorch recommends LogEI
        acquisition = ExpectedImprovement(process, best_f=standard.max())
    candidates = near_and_far(points[scores.argmax()], generator)[:, None]
    with torch.no_grad():
        starts = candidates[acquisition(candidates).topk(STARTS).indices]
    point, _ = optimize_acqf(
        acquisition,
        bounds=unit_cube(points.shape[1]),
        q=1,
        num_restarts=STARTS,
        batch_initial_conditions=starts,
        options={"maxiter": CLIMB_STEPS},
    )
    return point, process.covar_module.lengthscale.item()


def near_and_far(best: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Return candidates as `bayes_opt` does: half of them anywhere, half near the best point."""
    anywhere, near = torch.rand(2, CANDIDATES // 2, len(best), dtype=torch.float64, generator=generator)
    scale = 10 ** (-3 + 2.5 * torch.rand(len(near), 1, dtype=torch.float64, generator=generator))
    steps = scale * torch.randn(near.shape, dtype=torch.float64, generator=generator)
    return torch.cat([anywhere, (best + steps).clamp(0, 1)])
