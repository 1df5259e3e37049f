"""Effect of order, levels and passes on LSSG and GABS.

Takes half a minute.
"""

import math
from collections.abc import Mapping
from functools import partial

import torch
from shared.document import Page, spread, table
from shared.scenes import PAPER, paper_objectives

import autdtorch as at

DOCUMENT = "methods.md"
OPTIONS = {"--trials": {"type": int, "default": 50, "help": "trials of each random search"}}

Figures = tuple[torch.Tensor, torch.Tensor]
"""Scores (T,) [Pa] and evaluations (T,)."""


def main(page: Page, trials: int) -> None:
    figures = {scene: measure(objective, trials) for scene, objective in paper_objectives().items()}
    page.write(
        f"Weakest focus [Pa] in the paper's scenes: mean (minimum to maximum) of {trials} trials, and\n"
        "mean evaluations of a trial. 16 levels and one pass unless stated.",
        summary(figures),
    )


def best_offsets(objective: at.Objective) -> Figures:
    """Return the best of all combinations of 16 offsets per focus, with all amplitudes 1."""
    scene = objective.scene
    foci = at.drive_from_phases(
        at.focus_phases(scene.array.positions, scene.control_points, scene.wavenumber)
    )
    levels = 2 * math.pi * torch.arange(16, dtype=torch.float64) / 16
    offsets = torch.cartesian_prod(levels.new_zeros(1), *[levels] * (len(foci) - 1))
    drive = at.drive_from_phases(at.phases_of(at.drive_from_phases(offsets) @ foci))
    return at.weakest_focus(objective(drive)).max()[None], torch.tensor([len(drive)])


def measure(objective: at.Objective, trials: int) -> dict[str, Figures]:
    gabs = partial(at.gabs, trials=trials)
    searches = {
        "random search": partial(at.random_search, trials=trials),
        "LSSG": at.lssg,
        "GABS": gabs,
        "GABS, 2 passes": partial(gabs, passes=2),
        "GABS, 4 levels": partial(gabs, levels=4),
    }
    solutions = {name: search(objective) for name, search in searches.items()}
    figures = {name: (solution.score, solution.evaluations) for name, solution in solutions.items()}
    figures["LSS, best of all offsets, amplitudes 1"] = best_offsets(objective)
    return figures


def summary(figures: Mapping[str, Mapping[str, Figures]]) -> str:
    rows = []
    for name in figures[PAPER[0]]:
        evaluations = torch.cat([figures[scene][name][1] for scene in PAPER]).double().mean()
        cells = [spread(figures[scene][name][0]) for scene in PAPER]
        rows.append([name, f"{evaluations:.0f}", *cells])
    return table(["search", "evaluations", *(scene.replace("_", " ") for scene in PAPER)], rows)
