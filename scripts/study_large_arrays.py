"""All methods on arrays of 249 and 256 transducers, at equal budgets; writes docs/methods.md.

python scripts/study_large_arrays.py            a quarter of an hour
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import torch
from generated_block import fill_in, measured, table
from large_arrays import MIDDLE, autd3_array, with_array
from paper_objectives import DOCS, ROOT

import autdtorch as at

COMMAND = "python scripts/study_large_arrays.py"
SCENE = "two_cubes"
ARRAYS: dict[str, Callable[[], at.TransducerArray]] = {
    "AUTD3": autd3_array,
    "16 x 16": partial(at.TransducerArray.grid, (16, 16), 10e-3, MIDDLE),
}

Method = Callable[..., at.Solution]

#: By the budget [evaluations] that they are compared at: all but LSSG take about as many.
METHODS: dict[str, dict[str, Method]] = {
    "about 1000": {
        "random search": partial(at.random_search, evaluations=1000),
        "LSSG, 5 passes": partial(at.lssg, passes=5),
        "GABS, 4 levels": partial(at.gabs, levels=4),
        "BO": partial(at.bayes_opt, evaluations=1000),
        "BO on the circle": partial(at.bayes_opt, evaluations=1000, embedding="circle"),
        "identify": partial(at.identify, evaluations=1000),
    },
    "about 4000": {
        "random search": partial(at.random_search, evaluations=4000),
        "GABS, 16 levels": at.gabs,
        "GABS, 4 levels, 4 passes": partial(at.gabs, levels=4, passes=4),
    },
    "-": {"gradient ascent": at.gradient_ascent},
}


def run(method: Method, objective: at.Objective, trials: int) -> tuple[at.Solution, float]:
    """What the trials found, and seconds a trial."""
    begin = time.perf_counter()
    random = method.func if isinstance(method, partial) else method
    solution = method(objective) if random is at.lssg else method(objective, trials=trials)
    return solution, (time.perf_counter() - begin) / len(solution.score)


def measure(objectives: Mapping[str, at.SimulatedObjective], trials: int) -> list[list[str]]:
    """A row a method, with its scores as shares of the bound by objective."""
    bounds = {name: at.focus_bound(objective.transfer_matrix) for name, objective in objectives.items()}
    rows = []
    for budget, methods in METHODS.items():
        for name, method in methods.items():
            shares, evaluations, seconds = [], [], []
            for where, objective in objectives.items():
                solution, duration = run(method, objective, trials)
                shares.append(spread(100 * solution.score / bounds[where]))
                evaluations.append(solution.evaluations.double().mean())
                seconds.append(duration)
                print(where, name, shares[-1], f"{duration:.2g} s a trial", flush=True)
            mean = torch.stack(evaluations).mean()
            rows.append([budget, name, f"{mean:.0f}", *shares, f"{sum(seconds) / len(seconds):.2g}"])
    return rows


def spread(shares: torch.Tensor) -> str:
    """Median, and the range of the trials."""
    if len(shares) == 1:
        return f"{shares.item():.1f}"
    return f"{shares.median():.1f} ({shares.min():.1f} to {shares.max():.1f})"


def large_objectives() -> dict[str, at.SimulatedObjective]:
    """The paper's two cubes in front of the large arrays."""
    scene = at.load_scene(ROOT / "configs" / "scene" / f"{SCENE}.yaml")
    objectives = {}
    for name, array in ARRAYS.items():
        large = with_array(scene, array())
        objectives[name] = at.SimulatedObjective(large, at.make_propagator(large))
    return objectives


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and write the block."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--trials", type=int, default=3)
    trials = parser.parse_args(arguments).trials
    objectives = large_objectives()
    rows = measure(objectives, trials)
    parts = (
        measured(COMMAND),
        f"Weakest focus in % of the certified bound: median (least to greatest) of {trials} trials.",
        table(["budget", "method", "evaluations", *objectives, "s a trial"], rows),
    )
    fill_in(DOCS / "methods.md", "study_large_arrays", parts, DOCS)


if __name__ == "__main__":
    main()
