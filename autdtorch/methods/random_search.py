"""Random search: the baseline that any search must beat."""

from __future__ import annotations

import math

import torch

from autdtorch.methods.base import Ledger, Solution, Trials, trial_seeds
from autdtorch.objectives.simulated import Objective, Score, weakest_focus
from autdtorch.scene.drive import drive_from_phases
from autdtorch.utils.validation import integer_at_least

_AT_ONCE = 64  # evaluations of a trial in one call of the objective, which bounds its memory


def random_search(
    objective: Objective,
    evaluations: int = 256,
    levels: int | None = None,
    trials: Trials = 1,
    seed: int = 0,
    score: Score = weakest_focus,
) -> Solution:
    """Try random phases, all amplitudes being 1, and keep the best.

    Args:
        objective: what is evaluated.
        evaluations: number of evaluations a trial, >= 1.
        levels: number of phases in [0, 2 pi) to draw from, >= 2; None for any phase.
        trials: number of trials T, >= 1, or their numbers.
        seed: >= 0; trial t is the same for every number of trials.
        score: what is maximised.

    Returns:
        The best drive observed in each trial.

    Raises:
        ValueError: an argument out of range, or the objective's pressures or scores are not finite.
    """
    evaluations = integer_at_least("evaluations", evaluations, 1)
    levels = None if levels is None else integer_at_least("levels", levels, 2)
    generators = [torch.Generator("cpu").manual_seed(own) for own in trial_seeds(seed, trials)]
    ledger = Ledger(objective, len(generators), score)
    ledger.require_memory(evaluations, min(evaluations, _AT_ONCE), evaluations=evaluations)
    for begin in range(0, evaluations, _AT_ONCE):
        count = min(_AT_ONCE, evaluations - begin)
        turns = torch.stack(
            [
                torch.rand(count, ledger.transducers, dtype=torch.float64, generator=own, device="cpu")
                for own in generators
            ]
        )
        if levels is not None:
            turns = (levels * turns).floor() / levels
        ledger.evaluate(drive_from_phases(2 * math.pi * turns))
    return ledger.solution()
