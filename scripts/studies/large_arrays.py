"""Methods on the 249 transducers of an AUTD3, at equal numbers of evaluations.

Takes ten minutes.
"""

from collections.abc import Callable, Iterator
from functools import partial

import torch
from shared.document import Page, printed, spread, table
from shared.scenes import autd3_array, objective_of, paper_scene, with_array
from shared.timing import timed

import autdtorch as at
from autdtorch.utils.text import in_digits

DOCUMENT = "methods.md"

SCENE = "two_cubes"

METHODS: dict[str, Callable[..., at.Solution]] = {
    "LSSG, 5 passes": lambda objective, trials: at.lssg(objective, passes=5),
    "GABS, 16 levels": at.gabs,
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
        table(["method", "evaluations", "share", "s a trial"], printed(rows(trials))),
    )


def rows(trials: int) -> Iterator[list[str]]:
    """Yield a row for each method, with its scores as shares of the bound."""
    objective = objective_of(with_array(paper_scene(SCENE), autd3_array()))
    bound = at.focus_bound(objective.transfer_matrix)
    for name, method in METHODS.items():
        solution, seconds = timed(lambda m=method: m(objective, trials=trials))
        share = spread(100 * solution.score / bound, 1, torch.median)
        evaluations = f"{solution.evaluations.double().mean():.0f}"
        yield [name, evaluations, share, in_digits(seconds / len(solution.score), 2)]
