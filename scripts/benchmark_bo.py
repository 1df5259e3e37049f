"""Bayesian optimisation of all trials at once: against BoTorch, with other options, on large arrays.

    python scripts/benchmark_bo.py sequential --sequential-trials 10     15 minutes on an idle core
    python scripts/benchmark_bo.py options large                         20 minutes

Prints Markdown tables. Times are those of the processor, on one thread unless `--threads` says otherwise, so
that what else the machine does counts little.
"""

from __future__ import annotations

import argparse
import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from generated_block import table
from large_arrays import autd3_array, with_array

import autdtorch as at
from autdtorch.methods.base import trial_seeds
from autdtorch.methods.bayes.bayes import NOISE, drives_at
from autdtorch.objectives.simulated import weakest_focus

SCENES = Path(__file__).parents[1] / "configs" / "scene"
EVALUATIONS, INITIAL, FIXED = 256, 16, 6
REFIT_GROWTH, CANDIDATES, STARTS, CLIMB_STEPS = 1.1, 128, 2, 20
"""Of the sequential loop: the same schedule and as much search as in the batch."""
OPTIONS: dict[str, dict[str, Any]] = {
    "as in the paper": {},
    "log_ei": {"acquisition": "log_ei"},
    "random initial points": {"initial_points": "random"},
    "inferred noise": {"noise": "inferred"},
    "circle": {"embedding": "circle"},
    "circle, log_ei": {"embedding": "circle", "acquisition": "log_ei"},
    "circle, log_ei, inferred noise": {"embedding": "circle", "acquisition": "log_ei", "noise": "inferred"},
}


def main() -> None:
    """Measure what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("what", nargs="+", choices=["sequential", "options", "large"])
    parser.add_argument("--scenes", nargs="+", default=["homogeneous", "three_cubes", "two_cubes"])
    parser.add_argument("--trials", type=int, default=50)
    parser.add_argument("--sequential-trials", type=int, default=5)
    parser.add_argument("--large-trials", type=int, default=4)
    parser.add_argument("--large-evaluations", type=int, default=1000)
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    scenes = {name: at.load_scene(SCENES / f"{name}.yaml") for name in given.scenes}
    warm = at.SimulatedObjective(scenes[given.scenes[0]], at.make_propagator(scenes[given.scenes[0]]))
    at.bayes_opt(warm, evaluations=18)  # compiles
    if "sequential" in given.what:
        show(*sequential_rows(scenes, given.trials, given.sequential_trials))
    if "options" in given.what:
        show(*option_rows(scenes, OPTIONS, given.trials))
    if "large" in given.what:
        show(*large_rows(given.large_trials, given.large_evaluations))


def show(header: list[str], rows: Iterator[list[str]]) -> None:
    """Print the rows as they come, and then the table."""
    done = []
    for row in rows:
        print(*row, sep="  ", flush=True)
        done.append(row)
    print("", table(header, done), "", sep="\n", flush=True)


def sequential_rows(
    scenes: Mapping[str, at.Scene], trials: int, sequential_trials: int
) -> tuple[list[str], Iterator[list[str]]]:
    """The batch against one trial after the other."""

    def rows() -> Iterator[list[str]]:
        for name, scene in scenes.items():
            objective = at.SimulatedObjective(scene, at.make_propagator(scene))
            batch, seconds = timed(lambda o=objective: at.bayes_opt(o, trials=trials).score)
            alone, alone_seconds = timed(
                lambda o=objective: torch.cat([botorch_trial(o, t) for t in range(sequential_trials)])
            )
            each, alone_each = seconds / trials, alone_seconds / sequential_trials
            yield [
                name,
                f"{seconds:.1f} s",
                f"{each:.2f} s",
                f"{alone_each:.1f} s",
                f"{alone_each / each:.0f}",
                quartiles(batch),
                quartiles(batch[:sequential_trials]),
                quartiles(alone),
            ]

    times = [f"{trials} trials at once", "a trial", "a BoTorch trial", "ratio"]
    scores = [f"score [Pa] of {trials}", f"of the first {sequential_trials}", "of BoTorch's"]
    return ["scene", *times, *scores], rows()


def option_rows(
    scenes: Mapping[str, at.Scene], options: Mapping[str, Mapping[str, Any]], trials: int
) -> tuple[list[str], Iterator[list[str]]]:
    """Scores with other options."""

    def rows() -> Iterator[list[str]]:
        objectives = [at.SimulatedObjective(scene, at.make_propagator(scene)) for scene in scenes.values()]
        for name, given in options.items():
            solutions, seconds = timed(
                lambda given=given: [at.bayes_opt(o, trials=trials, **given) for o in objectives]
            )
            yield [name, *(quartiles(solution.score) for solution in solutions), f"{seconds:.0f} s"]

    return ["options", *scenes, "time"], rows()


def large_rows(trials: int, evaluations: int) -> tuple[list[str], Iterator[list[str]]]:
    """Scores with large arrays after a quarter, half and all of the evaluations."""
    grid = at.TransducerArray.grid((16, 16), 10e-3, (1e-3, 50e-3, 50e-3))
    methods: dict[str, Callable[[at.SimulatedObjective], at.Solution]] = {
        "GABS": lambda o: at.gabs(o, trials=trials),
        "as in the paper": lambda o: at.bayes_opt(o, evaluations, trials=trials),
        "circle": lambda o: at.bayes_opt(o, evaluations, trials=trials, embedding="circle"),
    }

    def rows() -> Iterator[list[str]]:
        for array_name, array in (("16 x 16", grid), ("AUTD3", autd3_array())):
            for scene_name in ("homogeneous", "two_cubes"):
                scene = with_array(at.load_scene(SCENES / f"{scene_name}.yaml"), array)
                objective = at.SimulatedObjective(scene, at.make_propagator(scene))
                for name, method in methods.items():
                    solution, seconds = timed(lambda m=method, o=objective: m(o))
                    after = (evaluations // 4, evaluations // 2, evaluations)
                    scores = [f"{solution.history[:, count - 1].median():.1f}" for count in after]
                    yield [f"{array_name}, {scene_name}", name, *scores, f"{seconds / trials:.0f} s"]

    return ["scene", "method", *(f"{evaluations * k // 4}" for k in (1, 2, 4)), "a trial"], rows()


def timed(run: Callable[[], Any]) -> tuple[Any, float]:
    """What it returns, and the seconds of the processor it took."""
    begin = time.process_time()
    result = run()
    return result, time.process_time() - begin


def quartiles(score: torch.Tensor) -> str:
    """Median and quartiles [Pa]."""
    low, middle, high = score.quantile(torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64)).tolist()
    return f"{middle:.2f} ({low:.2f} to {high:.2f})"


def botorch_trial(objective: at.SimulatedObjective, trial: int) -> torch.Tensor:
    """Score (1,) of one trial, as one would write it with BoTorch."""
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
    """Lower and upper corner (2, D)."""
    return torch.tensor([[0.0], [1.0]], dtype=torch.float64).expand(2, dimensions)


def next_point(
    points: torch.Tensor, scores: torch.Tensor, length_scale: float | None, generator: torch.Generator
) -> tuple[torch.Tensor, float]:
    """The point (1, D) of the largest expected improvement, and the length scale, fitted unless given."""
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
        warnings.simplefilter("ignore")  # BoTorch advises the logarithm
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
    """Points to compare, half of them anywhere, half around the best; those of the batch."""
    anywhere, near = torch.rand(2, CANDIDATES // 2, len(best), dtype=torch.float64, generator=generator)
    scale = 10 ** (-3 + 2.5 * torch.rand(len(near), 1, dtype=torch.float64, generator=generator))
    steps = scale * torch.randn(near.shape, dtype=torch.float64, generator=generator)
    return torch.cat([anywhere, (best + steps).clamp(0, 1)])


if __name__ == "__main__":
    main()
