"""Known algorithms beside our methods: shares of the certified bound, by evaluations and CPU time.

Needs `pip install 'autdtorch[optimisers]'`. Every drive has 32 phase levels. The base case is the weakest of
four foci without noise, for 16 transducers (the paper's two cubes), for 12 x 12 with a reflecting side, and
for an AUTD3, after 2, 4 and 16 evaluations for each transducer and four more. One factor varies around it:
noise of 20 dB, and at 4 evaluations for each transducer targets (1 : 2 : 3 : 4, at 80 % of their bound), or
two foci beside two quiet points (-20 dB). Algorithms know their budget. Those that take hours are left out;
see `MOST`.

A share is that of the true score of the drive that an algorithm returns: of others without noise, the best
one that it observed; under noise, the one that it recommends. Of targets, it is 1 - rms deviation. Results
are in a folder, from which an interrupted run goes on; a changed method needs an empty one. The whole table
takes half an hour on 2 idle cores.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import multiprocessing
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import threadpoolctl
import torch
from benchmarks.known_algorithms import ALGORITHMS, Algorithm, Losses
from shared.document import Page, quartiles, table
from shared.scenes import MIDDLE, autd3_array, objective_of, paper_scene, with_array

import autdtorch as at
from autdtorch.utils.files import replace_file

DOCUMENT = "which_method.md"

LEVELS, SNR = 32, 20.0
WANTED, REACHED = (1.0, 2.0, 3.0, 4.0), 0.8
QUIET = at.QuietPoints(at.WeakestFocus(), (2, 3), 0.1)
TRANSDUCERS = (16, 144, 249)
BUDGETS = {"weakest focus": (2, 4, 16), "20 dB": (2, 4, 16), "targets": (4,), "quiet points": (4,)}
"""Evaluations for each transducer, by case."""
SHOWN = 4
"""Those of the table in the documentation."""

MOST = {"BO": 300, "BO per focus": 300, "TuRBO": 300, "TPE": 300, "identify": 1000}
"""Most evaluations of algorithms that take long."""

Made = Callable[[int, int], at.Method | Algorithm]
"""From numbers of transducers and evaluations to a method or an algorithm."""

OURS: dict[str, Made] = {
    "random search": lambda transducers, evaluations: at.RandomSearch(evaluations),
    "LSSG": lambda transducers, evaluations: at.LSSG(
        levels=min(16, evaluations // 4), passes=max(1, evaluations // 64)
    ),
    "GABS": lambda transducers, evaluations: at.GABS(levels=evaluations // transducers),
    "BO": lambda transducers, evaluations: at.BayesOpt(evaluations),
    "BO per focus": lambda transducers, evaluations: at.BayesOpt(
        evaluations, 4, model="foci", kernel="phasor", noise="inferred"
    ),
    "phase stepping": lambda transducers, evaluations: at.PhaseStepping(
        (evaluations - 1) // (2 * transducers + 1)
    ),
    "identify": lambda transducers, evaluations: at.Identify(evaluations),
    "gradient ascent": lambda transducers, evaluations: at.GradientAscent(),
}
THEIRS: dict[str, Made] = {
    name: lambda transducers, evaluations, algorithm=algorithm: algorithm
    for name, algorithm in ALGORITHMS.items()
}
ENTRIES = {**OURS, **THEIRS}

OPTIONS = {
    "--trials": {"type": int, "default": 20, "help": "trials, each with a seed"},
    "--most": {"type": int, "default": 16, "help": "evaluations for each transducer, at most"},
    "--transducers": {"type": int, "nargs": "+", "choices": TRANSDUCERS, "default": list(TRANSDUCERS)},
    "--processes": {"type": int, "default": 2, "help": "runs at once"},
    "--results": {"type": Path, "default": Path("outputs/algorithms"), "help": "folder of the results"},
}


class Run(NamedTuple):
    """The trials of an algorithm on a problem, and the file of their results."""

    transducers: int
    case: str
    evaluations: int
    algorithm: str
    trials: int
    folder: Path

    @property
    def path(self) -> Path:
        """The file: shares (T,) and CPU seconds of a trial."""
        name = f"{self.transducers}-{self.case}-{self.evaluations}-{self.algorithm}-{self.trials}.json"
        return self.folder / name.replace(" ", "_")


def main(page: Page, trials: int, most: int, transducers: list[int], processes: int, results: Path) -> None:
    """Measure, print the whole table, and write rows and summary."""
    results.mkdir(parents=True, exist_ok=True)
    runs = [
        Run(count, case, evaluations_of(budget, count), algorithm, trials, results)
        for count in sorted(transducers, reverse=True)  # the longest first
        for case, budgets in BUDGETS.items()
        for budget in budgets
        for algorithm in ENTRIES
        if budget <= most and possible(algorithm, count, evaluations_of(budget, count))
    ]
    missing = [run for run in runs if not run.path.exists()]
    with multiprocessing.get_context("spawn").Pool(processes, _alone) as pool:
        for number, run in enumerate(pool.imap_unordered(measured, missing), 1):
            print(f"{number} of {len(missing)}: {run.path.stem}", flush=True)
    answers = {run[:4]: json.loads(run.path.read_text(encoding="utf-8")) for run in runs}
    header = ["transducers", "case", "evaluations", "algorithm", "share [%]", "CPU s"]
    print(table(header, rows(answers)))
    print("", *wins(answers), sep="\n")
    page.write_rows("algorithms.json", data(answers))
    page.write(
        f"Share of the certified bound [%], median of {trials} seeds, after {SHOWN} evaluations for each\n"
        "transducer; CPU time of a trial with the most transducers.",
        summary(answers, sorted(transducers)),
    )


def evaluations_of(budget: int, transducers: int) -> int:
    """Return the evaluations of a budget: four more are for the references and last drives of two rounds."""
    return budget * transducers + 4


def possible(algorithm: str, transducers: int, evaluations: int) -> bool:
    if algorithm == "identify" and evaluations < 3 * transducers:
        return False
    if algorithm == "TPE" and transducers > 16:
        return False
    return evaluations <= MOST.get(algorithm, evaluations)


def _alone() -> None:
    """Prepare a process: one thread, and no warnings of trials."""
    torch.set_num_threads(1)
    threadpoolctl.threadpool_limits(1)
    logging.getLogger("autdtorch").setLevel(logging.ERROR)


@cache
def objective(transducers: int) -> at.SimulatedObjective:
    """Return the undisturbed objective of an array before the paper's two cubes."""
    scene = paper_scene("two_cubes")
    if transducers == 249:
        scene = with_array(scene, autd3_array())
    elif transducers == 144:
        array = at.TransducerArray.grid((12, 12), 10e-3, MIDDLE, source_strength=at.PAPER_SOURCE_STRENGTH)
        side = at.Reflector((0.0, -20e-3, 0.0), (0.0, 1.0, 0.0))
        scene = dataclasses.replace(with_array(scene, array), reflectors=(side,))
    return objective_of(scene)


@cache
def goal_and_bound(transducers: int, case: str) -> tuple[at.Goal, float]:
    matrix, goal = objective(transducers).transfer_matrix, at.WeakestFocus()
    if case == "targets":
        level = REACHED * at.WeakestFocus(WANTED).bound(matrix)
        goal = at.TargetPressures([level * wanted for wanted in WANTED])
    elif case == "quiet points":
        goal = QUIET
    return goal, goal.bound(matrix)


def measured(run: Run) -> Run:
    truth = objective(run.transducers)
    goal, bound = goal_and_bound(run.transducers, run.case)
    entry, noisy = ENTRIES[run.algorithm](run.transducers, run.evaluations), run.case == "20 dB"

    def observed(seed: int) -> at.Objective:
        return at.Quantised(at.Noise(truth, SNR, seed=seed) if noisy else truth, LEVELS)

    begin = time.process_time()
    if isinstance(entry, at.Method):
        trials = run.trials if entry.random else 1
        drives = at.run(entry, observed(0), trials, goal=goal).drive
    else:
        assert entry is not None
        losses = [Losses(observed(seed), goal, run.evaluations) for seed in range(run.trials)]
        drives = torch.stack([answer(entry, each, seed, noisy) for seed, each in enumerate(losses)])
    seconds = (time.process_time() - begin) / len(drives)
    scores = goal(truth(at.Quantised(truth, LEVELS).quantised(drives)))
    shares = (1 + scores) / (1 + bound) if run.case == "targets" else scores / bound
    replace_file(run.path, json.dumps({"shares": shares.tolist(), "seconds": seconds}).encode())
    return run


def answer(algorithm: Algorithm, losses: Losses, seed: int, noisy: bool) -> torch.Tensor:
    """Return the drive (M,) of a trial; the last evaluation is that of the recommended one."""
    losses.left -= 1
    recommended = algorithm(losses, seed)
    losses.left = 1
    losses(recommended[None])
    return at.drive_from_phases(torch.from_numpy(recommended if noisy else losses.best))


Answers = dict[tuple[int, str, int, str], dict[str, Any]]
"""Shares (T,) and CPU seconds of a trial, by transducers, case, evaluations and algorithm."""


def rows(answers: Answers) -> Iterator[list[str]]:
    for key, answer in answers.items():
        shares = 100 * torch.tensor(answer["shares"])
        share = quartiles(shares, ".1f") if len(shares) > 1 else f"{shares.item():.1f}"
        yield [*map(str, key), share, f"{answer['seconds']:.2g}"]


def summary(answers: Answers, transducers: Sequence[int]) -> str:
    """Return the table of medians, with and without noise."""
    noises = {"weakest focus": "", "20 dB": ", 20 dB"}
    header = [f"{count}{noise}" for count in transducers for noise in noises.values()]
    lines = []
    for algorithm in ENTRIES:
        keys = [
            (count, case, evaluations_of(SHOWN, count), algorithm) for count in transducers for case in noises
        ]
        shown = [answers.get(key) for key in keys]
        cells = [f"{100 * statistics.median(each['shares']):.1f}" if each else "" for each in shown]
        seconds = [f"{each['seconds']:.2g}" for each in shown if each]
        lines.append([algorithm, *cells, *seconds[-1:]])
    return table(["algorithm", *header, "CPU s"], (line for line in lines if any(line[1:])))


def wins(answers: Answers) -> Iterator[str]:
    """Yield the cases in which an algorithm of others beats ours by more than the quartiles.

    Gradient ascent does not count, as it reads the matrix. Ours with fewer evaluations do.
    """
    for (count, case, evaluations, algorithm), answer in answers.items():
        ours = [
            _quartile(other["shares"], 2)
            for key, other in answers.items()
            if key[:2] == (count, case) and key[2] <= evaluations
            if key[3] in OURS and key[3] != "gradient ascent"
        ]
        if algorithm in THEIRS and _quartile(answer["shares"], 0) > max(ours):
            yield f"{algorithm} wins: {count} transducers, {case}, {evaluations} evaluations"


def _quartile(shares: Sequence[float], number: int) -> float:
    if len(shares) == 1:
        return shares[0]
    return statistics.quantiles(shares, n=4, method="inclusive")[number]


def data(answers: Answers) -> Iterator[dict[str, object]]:
    for key, answer in answers.items():
        lower, middle, upper = (_quartile(answer["shares"], number) for number in range(3))
        yield {
            **dict(zip(("transducers", "case", "evaluations", "algorithm"), key, strict=True)),
            **{"median": middle, "lower": lower, "upper": upper, "CPU s": answer["seconds"]},
        }
