"""Bayesian optimisation with a process for each focus, without noise and beside `identify` under noise.

Prints Markdown tables. Times are processor times on one thread, so that other processes matter little.
`foci` takes 3 minutes, `noise` 15.
"""

import time
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from shared.document import printed, quartiles, table
from shared.scenes import PAPER, objective_of, paper_scene
from shared.timing import timed

import autdtorch as at

BUDGETS = (32, 48, 64, 96)
NOISY_BUDGETS = (64, 128, 256)
FOCI: dict[str, Any] = {"model": "foci", "kernel": "phasor", "noise": "inferred"}

OPTIONS = {
    "what": {"nargs": "+", "choices": ["foci", "noise"], "help": "tables to print"},
    "--scenes": {"nargs": "+", "default": PAPER, "help": "names of scenes"},
    "--trials": {"type": int, "default": 50, "help": "trials at once"},
    "--threads": {"type": int, "default": 1, "help": "threads of PyTorch"},
}


def main(what: list[str], scenes: list[str], trials: int, threads: int) -> None:
    """Print the tables."""
    torch.set_num_threads(threads)
    objectives = {name: objective_of(paper_scene(name)) for name in scenes}
    if "foci" in what:
        rows = printed(foci_rows(objectives, trials))
        print("", table(["scene", *map(str, BUDGETS), "time of a trial"], rows), sep="\n")
    if "noise" in what:
        columns = [f"{name}, {count}" for count in NOISY_BUDGETS for name in ("bo_foci", "identify")]
        print("", table(["scene, 20 dB", *columns], printed(noise_rows(objectives, trials))), sep="\n")


def foci_rows(objectives: Mapping[str, at.SimulatedObjective], trials: int) -> Iterator[list[str]]:
    """Compare a process for each focus with gradient ascent after numbers of evaluations."""
    for name, objective in objectives.items():
        best = at.gradient_ascent(objective).score
        solution, seconds = timed(
            lambda o=objective: at.bayes_opt(o, max(BUDGETS), 4, trials=trials, **FOCI), time.process_time
        )
        shares = [quartiles(solution.history[:, count - 1] / best) for count in BUDGETS]
        yield [name, *shares, f"{seconds / trials:.2f} s"]


def noise_rows(objectives: Mapping[str, at.SimulatedObjective], trials: int) -> Iterator[list[str]]:
    """Compare true pressures of the answers with those of `identify`, as shares of gradient ascent."""
    for name, objective in objectives.items():
        best = at.gradient_ascent(objective).score
        row = [name]
        for count in NOISY_BUDGETS:
            for method in (at.BayesOpt(count, 4, **FOCI), at.Identify(count)):
                drive = at.run(method, at.Noise(objective, 20.0), trials).drive
                row.append(quartiles(at.true_pressure(objective, drive).amin(dim=1) / best))
        yield row
