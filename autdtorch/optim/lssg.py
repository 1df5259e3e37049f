"""LSSG: the linear synthesis scheme with greedily searched offsets, the paper's baseline."""

from __future__ import annotations

import math

import torch

from autdtorch.drive import drive_from_phases, focus_phases, normalise
from autdtorch.objective import Objective, Score, weakest_focus
from autdtorch.optim.base import Ledger, Solution
from autdtorch.validation import integer_at_least


def lssg(objective: Objective, levels: int = 16, score: Score = weakest_focus) -> Solution:
    """Superpose the free-space drives of the single foci, with the best offset for each (Eq. 4, 5 and 6).

    The search starts from the linear synthesis scheme, all offsets 0, and goes through the foci once, in
    their order: each tries `levels` offsets while the others stay, and keeps the best. Since 0 is among them,
    LSSG is never worse than its start. The paper leaves the search open but for its number of evaluations,
    which is this one's: P * levels, 64 with 4 foci. Adding one focus after the other, as GABS does with
    transducers, would take `levels` fewer, but would score foci at which nothing aims yet.

    Obstacles enter through the observed scores alone, not through the phases of the foci. The amplitudes are
    in [0, 1], not all 1.

    Args:
        objective: what is evaluated.
        levels: number of offsets in [0, 2 pi), >= 2.
        score: what is maximised.

    Returns:
        One trial: the method has no randomness.

    Raises:
        ValueError: `levels` is not an integer >= 2, or the objective's pressures or scores are not finite.
    """
    levels = integer_at_least("levels", levels, 2)
    scene = objective.scene
    foci = drive_from_phases(focus_phases(scene.array.positions, scene.control_points, scene.wavenumber))
    offsets = drive_from_phases(2 * math.pi * torch.arange(levels, dtype=torch.float64) / levels)
    ledger = Ledger(objective, trials=1, score=score)
    weights = torch.ones(len(foci), dtype=torch.complex128)
    for focus in range(len(foci)):
        candidates = weights.repeat(levels, 1)
        candidates[:, focus] = offsets
        scores = ledger.evaluate(normalise(candidates @ foci)[None])
        weights = candidates[scores[0].argmax()]
    return ledger.solution()
