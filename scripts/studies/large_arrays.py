"""Methods on arrays of 249 and 256 transducers, at equal numbers of evaluations.

Fills in a block of methods.md.

    python scripts/study.py large_arrays            a quarter of an hour
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from functools import partial

import torch
from shared.document import fill_in, measured, table
from shared.scenes import MIDDLE, autd3_array, paper_scene, with_array

import autdtorch as at
from autdtorch.utils.display import in_digits

DOCUMENT = "methods.md"

SCENE = "two_cubes"
ARRAYS: dict[str, Callable[[], at.TransducerArray]] = {
    "AUTD3": autd3_array,
    "16 x 16": partial(at.TransducerArray.grid, (16, 16), 10e-3, MIDDLE),
}

Method = Callable[..., at.Solution]

METHODS: tuple[tuple[str, Method], ...] = (
    ("random search", partial(at.random_search, evaluations=1000)),
    ("LSSG, 5 passes", partial(at.lssg, passes=5)),
    ("GABS, 4 levels", partial(at.gabs, levels=4)),
    ("GABS, 16 levels", at.gabs),
    ("BO", at.bayes_opt),
    (
        "BO per focus",
        partial(at.bayes_opt, evaluations=600, initial=4, model="foci", kernel="phasor", noise="inferred"),
    ),
    ("identify", partial(at.identify, evaluations=600)),
    ("gradient ascent", at.gradient_ascent),
)


def run(method: Method, objective: at.Objective, trials: int) -> tuple[at.Solution, float]:
    """Return the solution and the seconds per trial."""
    begin = time.perf_counter()
    function = method.func if isinstance(method, partial) else method
    solution = method(objective) if function is at.lssg else method(objective, trials=trials)
    return solution, (time.perf_counter() - begin) / len(solution.score)


def measure(objectives: Mapping[str, at.SimulatedObjective], trials: int) -> list[list[str]]:
    """Return a row for each method, with its scores as shares of the bound."""
    bounds = {name: at.focus_bound(objective.transfer_matrix) for name, objective in objectives.items()}
    rows = []
    for name, method in METHODS:
        shares, evaluations, seconds = [], [], []
        for where, objective in objectives.items():
            solution, duration = run(method, objective, trials)
            shares.append(spread(100 * solution.score / bounds[where]))
            evaluations.append(solution.evaluations.double().mean())
            seconds.append(duration)
            print(where, name, shares[-1], f"{duration:.2g} s a trial", flush=True)
        mean = torch.stack(evaluations).mean()
        rows.append([name, f"{mean:.0f}", *shares, in_digits(sum(seconds) / len(seconds), 2)])
    return rows


def spread(shares: torch.Tensor) -> str:
    """Format the median and the range of the trials."""
    if len(shares) == 1:
        return f"{shares.item():.1f}"
    return f"{shares.median():.1f} ({shares.min():.1f} to {shares.max():.1f})"


OPTIONS = {"--trials": {"type": int, "default": 3, "help": "trials of each method"}}


def main(given: argparse.Namespace) -> None:
    """Measure, and write the block."""
    scenes = {name: with_array(paper_scene(SCENE), array()) for name, array in ARRAYS.items()}
    objectives = {name: at.SimulatedObjective(one, at.make_propagator(one)) for name, one in scenes.items()}
    parts = (
        measured(),
        f"Weakest focus in % of the bound: median (minimum to maximum) of {given.trials} trials.",
        table(["method", "evaluations", *objectives, "s a trial"], measure(objectives, given.trials)),
    )
    fill_in(DOCUMENT, "study.py large_arrays", parts, given.output)
