"""GABS: the greedy algorithm with brute-force search (Algorithm 2)."""

from __future__ import annotations

import math

import torch

from autdtorch.drive import drive_from_phases
from autdtorch.objective import Objective, Score, weakest_focus
from autdtorch.optim.base import Ledger, Solution, Trials, trial_seeds
from autdtorch.validation import integer_at_least


def gabs(
    objective: Objective, levels: int = 16, trials: Trials = 1, seed: int = 0, score: Score = weakest_focus
) -> Solution:
    """Switch on one transducer after the other, each with the best of `levels` phases (Algorithm 2).

    Trials differ in the order of the transducers, which is random. All trials take a step together, in one
    call of the objective of trials * levels rows.

    A trial takes 1 + (M - 1) * levels evaluations: the first transducer alone, whose phase changes no
    magnitude, then `levels` for every further one. That is 241 for the paper's M = levels = 16; the paper
    says M * levels, 256.

    Args:
        objective: what is evaluated.
        levels: number of phases in [0, 2 pi), >= 2.
        trials: number of trials T, >= 1, or their numbers.
        seed: >= 0; trial t is the same for every number of trials.
        score: what is maximised.

    Returns:
        The best drive observed in each trial. Where switching on the last transducers only did harm, they are
        off.

    Raises:
        ValueError: an argument out of range, or the objective's pressures or scores are not finite.
    """
    levels = integer_at_least("levels", levels, 2)
    seeds = trial_seeds(seed, trials)
    transducers = len(objective.scene.array)
    order = torch.stack([_random_order(transducers, own) for own in seeds])
    choices = drive_from_phases(2 * math.pi * torch.arange(levels, dtype=torch.float64) / levels)
    rows = torch.arange(len(seeds))

    ledger = Ledger(objective, len(seeds), score)
    drive = torch.zeros(len(seeds), transducers, dtype=torch.complex128)
    drive[rows, order[:, 0]] = 1
    ledger.evaluate(drive[:, None])
    for transducer in order.T[1:]:
        candidates = drive[:, None].repeat(1, levels, 1)
        candidates[rows, :, transducer] = choices
        best = ledger.evaluate(candidates).argmax(dim=1)
        drive = candidates[rows, best]
    return ledger.solution()


def _random_order(transducers: int, seed: int) -> torch.Tensor:
    return torch.randperm(transducers, generator=torch.Generator().manual_seed(seed))
