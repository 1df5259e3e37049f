"""Methods on arrays of 249 and 256 transducers, at equal numbers of evaluations.

Takes a quarter of an hour.
"""

from collections.abc import Callable, Iterator
from functools import partial

import torch
from shared.document import Page, printed, spread, table
from shared.scenes import MIDDLE, autd3_array, objective_of, paper_scene, with_array
from shared.timing import timed

import autdtorch as at
from autdtorch.utils.text import in_digits

DOCUMENT = "methods.md"

SCENE = "two_cubes"
ARRAYS: dict[str, Callable[[], at.TransducerArray]] = {
    "AUTD3": autd3_array,
    "16 x 16": partial(at.TransducerArray.grid, (16, 16), 10e-3, MIDDLE),
}

METHODS: dict[str, Callable[..., at.Solution]] = {
    "random search": partial(at.random_search, evaluations=1000),
    "LSSG, 5 passes": lambda objective, trials: at.lssg(objective, passes=5),
    "GABS, 4 levels": partial(at.gabs, levels=4),
    "GABS, 16 levels": at.gabs,
    "BO": at.bayes_opt,
    "BO per focus": partial(
        at.bayes_opt, evaluations=600, initial=4, model="foci", kernel="phasor", noise="inferred"
    ),
    "identify": partial(at.identify, evaluations=600),
    "gradient ascent": at.gradient_ascent,
}
OPTIONS = {"--trials": {"type": int, "default": 3, "help": "trials of each method"}}


def main(page: Page, trials: int) -> None:
    """Measure, and write the block."""
    page.write(
        f"Weakest focus in % of the bound: median (minimum to maximum) of {trials} trials.",
        table(["method", "evaluations", *ARRAYS, "s a trial"], printed(rows(trials))),
    )


def rows(trials: int) -> Iterator[list[str]]:
    """Yield a row for each method, with its scores as shares of the bound."""
    scene = paper_scene(SCENE)
    objectives = [objective_of(with_array(scene, array())) for array in ARRAYS.values()]
    bounds = [at.focus_bound(objective.transfer_matrix) for objective in objectives]
    for name, method in METHODS.items():
        runs = [timed(lambda o=objective, m=method: m(o, trials=trials)) for objective in objectives]
        pairs = zip((solution for solution, _ in runs), bounds, strict=True)
        shares = [spread(100 * solution.score / bound, 1, torch.median) for solution, bound in pairs]
        evaluations = torch.stack([solution.evaluations.double().mean() for solution, _ in runs]).mean()
        seconds = [spent / len(solution.score) for solution, spent in runs]
        yield [name, f"{evaluations:.0f}", *shares, in_digits(sum(seconds) / len(seconds), 2)]
