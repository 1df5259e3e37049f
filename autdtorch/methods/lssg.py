"""LSS, the linear synthesis scheme, and LSSG, its offsets searched greedily: the paper's baseline."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch

from autdtorch.methods.base import Ledger, Solution
from autdtorch.methods.coordinates import indices_of, repeat_passes
from autdtorch.objectives.simulated import Objective, Score, weakest_focus
from autdtorch.scene.drive import drive_from_phases, focus_phases, normalise
from autdtorch.scene.scene import Scene
from autdtorch.utils.validation import integer_at_least


def lss(objective: Objective, score: Score = weakest_focus) -> Solution:
    """Superpose the free-space drives of the single foci (Eq. 4, 5 and 6, all offsets 0): one evaluation.

    The amplitudes are in [0, 1], not all 1.

    Args:
        objective: what is evaluated.
        score: what is reported; nothing is searched.

    Returns:
        One trial, since the method has no randomness.

    Raises:
        ValueError: the objective's pressure or score is not finite.
    """
    ledger = Ledger(objective, trials=1, score=score)
    ledger.evaluate(normalise(_focus_drives(objective.scene).sum(dim=0))[None, None])
    return ledger.solution()


def lssg(
    objective: Objective,
    levels: int = 16,
    order: Literal["given"] | Sequence[int] = "given",
    passes: int = 1,
    score: Score = weakest_focus,
) -> Solution:
    """Superpose the free-space drives of the single foci, with the best offset for each (Eq. 4, 5 and 6).

    The search starts from the linear synthesis scheme, all offsets 0, and goes through the foci once, in
    their order: each tries `levels` offsets while the others stay, and keeps the best. Since 0 is among them,
    LSSG is never worse than its start. The paper leaves the search open but for its number of evaluations,
    which is this one's: P * levels, 64 with 4 foci. Adding one focus after the other, as GABS does with
    transducers, would take `levels` fewer, but would score foci at which nothing aims yet.

    Further passes go through the foci again, for P * levels evaluations each; the search ends early with a
    pass that changes nothing.

    Obstacles enter through the observed scores alone, not through the phases of the foci. The amplitudes are
    in [0, 1], not all 1.

    Args:
        objective: what is evaluated.
        levels: number of offsets in [0, 2 pi), >= 2.
        order: of the foci: "given", that of the control points, or all their indices.
        passes: >= 1.
        score: what is maximised.

    Returns:
        One trial, since the method has no randomness.

    Raises:
        ValueError: an argument out of range, or the objective's pressures or scores are not finite.
    """
    levels = integer_at_least("levels", levels, 2)
    passes = integer_at_least("passes", passes, 1)
    ledger = Ledger(objective, trials=1, score=score)
    foci = _focus_drives(objective.scene)
    evaluations = float(len(foci)) * passes * levels
    ledger.require_memory(evaluations, levels, levels=levels, passes=passes)
    places = indices_of(order, len(foci))
    start = torch.ones(1, len(foci), dtype=torch.complex128, device="cpu")
    repeat_passes(ledger, start, places[None], levels, passes, lambda weights: normalise(weights @ foci))
    return ledger.solution(most=passes * len(foci) * levels)


def _focus_drives(scene: Scene) -> torch.Tensor:
    """Drives that aim at each focus in free space (P, M)."""
    return drive_from_phases(focus_phases(scene.array.positions, scene.control_points, scene.wavenumber))
