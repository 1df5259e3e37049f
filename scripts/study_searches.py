"""What order, levels and further passes do to LSSG and GABS; writes docs/methods.md.

python scripts/study_searches.py            half a minute
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial

import torch
from generated_block import fill_in, measured, table
from paper_objectives import DOCS, SCENES, paper_objectives

import autdtorch as at
from autdtorch.scene.drive import normalise

COMMAND = "python scripts/study_searches.py"

TRIALS = 50

gabs = partial(at.gabs, trials=TRIALS)
random_search = partial(at.random_search, trials=TRIALS)

SEARCHES = {
    "random search": random_search,
    "random search, 4 times as long": partial(random_search, evaluations=1024),
    "LSS": at.lss,
    "LSSG": at.lssg,
    "LSSG, other order": partial(at.lssg, order=[0, 2, 1, 3]),
    "LSSG, 2 passes": partial(at.lssg, passes=2),
    "LSSG, 5 passes": partial(at.lssg, passes=5),
    "LSSG, 32 levels, 5 passes": partial(at.lssg, levels=32, passes=5),
    "GABS": gabs,
    "GABS, 2 passes": partial(gabs, passes=2),
    "GABS, 3 passes": partial(gabs, passes=3),
    "GABS, 20 passes": partial(gabs, passes=20),
    "GABS, order given": partial(at.gabs, order="given"),
    "GABS, by strength": partial(at.gabs, order="strength"),
    "GABS, by strength, 3 passes": partial(at.gabs, order="strength", passes=3),
    "GABS, 4 levels": partial(gabs, levels=4),
    "GABS, 8 levels": partial(gabs, levels=8),
    "GABS, 32 levels": partial(gabs, levels=32),
    "GABS, 4 levels, 4 passes": partial(gabs, levels=4, passes=4),
    "GABS, 8 levels, 2 passes": partial(gabs, levels=8, passes=2),
    "GABS, 8 levels, 4 passes": partial(gabs, levels=8, passes=4),
    "GABS, 32 levels, 20 passes": partial(gabs, levels=32, passes=20),
}

Figures = tuple[torch.Tensor, torch.Tensor]
"""Scores (T,) and evaluations (T,)."""


def best_offsets(objective: at.Objective, fully_on: bool) -> Figures:
    """LSS with the best of all combinations of 16 offsets; amplitudes as superposed, or 1."""
    scene = objective.scene
    foci = at.drive_from_phases(
        at.focus_phases(scene.array.positions, scene.control_points, scene.wavenumber)
    )
    levels = 2 * math.pi * torch.arange(16, dtype=torch.float64) / 16
    offsets = torch.cartesian_prod(levels.new_zeros(1), *[levels] * (len(foci) - 1))
    drive = at.drive_from_phases(offsets) @ foci
    drive = at.drive_from_phases(at.phases_of(drive)) if fully_on else normalise(drive)
    return at.weakest_focus(objective(drive)).max()[None], torch.tensor([len(drive)])


def best_of(figures: Figures, group: int) -> Figures:
    """As if a trial were `group` of the trials, and the best of them counted."""
    scores, evaluations = figures
    return scores.reshape(-1, group).amax(dim=1), evaluations.reshape(-1, group).sum(dim=1)


def measure(objective: at.Objective) -> dict[str, Figures]:
    """Scores and evaluations of every search."""
    figures = {}
    for name, search in SEARCHES.items():
        solution = search(objective)
        figures[name] = solution.score, solution.evaluations
    figures["LSS, best of all offsets"] = best_offsets(objective, fully_on=False)
    figures["LSS, best of all offsets, amplitudes 1"] = best_offsets(objective, fully_on=True)
    solution = at.gabs(objective, trials=4 * TRIALS)
    for group in (2, 4):
        figures[f"GABS, best of {group} orders"] = best_of((solution.score, solution.evaluations), group)
    return figures


def summary(figures: Mapping[str, Mapping[str, Figures]]) -> str:
    """A Markdown table, a row a search."""
    rows = []
    for name in figures[SCENES[0]]:
        evaluations = torch.cat([figures[scene][name][1] for scene in SCENES]).double().mean()
        cells = [spread(figures[scene][name][0]) for scene in SCENES]
        rows.append([name, f"{evaluations:.0f}", *cells])
    return table(["search", "evaluations", *(scene.replace("_", " ") for scene in SCENES)], rows)


def spread(scores: torch.Tensor) -> str:
    """Mean, and the range of all trials."""
    if len(scores) == 1:
        return f"{scores.item():.2f}"
    return f"{scores.mean():.2f} ({scores.min():.2f} to {scores.max():.2f})"


def main() -> None:
    """Measure, and write the block."""
    figures = {scene: measure(objective) for scene, objective in paper_objectives().items()}
    parts = (
        measured(COMMAND),
        "Weakest focus [Pa] in the paper's scenes: mean (least to greatest) of the trials, where they\n"
        f"differ, and mean evaluations of a trial. {TRIALS} trials, 16 levels and one pass unless said.",
        summary(figures),
    )
    fill_in(DOCS / "methods.md", "study_searches", parts, DOCS)


if __name__ == "__main__":
    main()
