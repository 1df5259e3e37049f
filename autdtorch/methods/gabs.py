"""GABS: the greedy algorithm with brute-force search (Algorithm 2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch

from autdtorch.methods.base import Ledger, Solution, Trials, best_first, trial_seeds
from autdtorch.methods.coordinates import indices_of, repeat_passes, take_best_levels
from autdtorch.objectives.simulated import Objective, Score, weakest_focus
from autdtorch.utils.validation import integer_at_least, invalid


def gabs(
    objective: Objective,
    levels: int = 16,
    order: Literal["random", "given", "strength"] | Sequence[int] = "random",
    first: int | None = None,
    passes: int = 1,
    trials: Trials = 1,
    seed: int = 0,
    score: Score = weakest_focus,
) -> Solution:
    """Switch on one transducer after the other, each with the best of `levels` phases (Algorithm 2).

    All trials take a step together, in one call of the objective of trials * levels rows. Further passes go
    through all M transducers again in the same order (coordinate ascent), while the others stay; a trial ends
    early with a pass that changes nothing.

    A trial takes 1 + (M - 1) * levels evaluations: the first transducer alone, whose phase changes no
    magnitude, then `levels` for every further one. That is 241 for the paper's M = levels = 16; the paper
    says M * levels, 256. The order "strength" takes M - 1 more, a further pass at most M * levels.

    Args:
        objective: what is evaluated.
        levels: number of phases in [0, 2 pi), >= 2.
        order: of the transducers. "random" is another one in every trial; "given" that of the array, as
            Algorithm 2 is written; "strength" by falling score of each transducer alone; or all their
            indices. Trials differ in a random order only.
        first: index of the transducer that comes first, the others after it in their order; None for the
            first of the order.
        passes: >= 1.
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
    passes = integer_at_least("passes", passes, 1)
    seeds = trial_seeds(seed, trials)
    ledger = Ledger(objective, len(seeds), score)
    transducers = ledger.transducers
    evaluations, at_once = transducers * (1.0 + passes * levels), max(levels, transducers)
    ledger.require_memory(evaluations, at_once, levels=levels, passes=passes)
    orders = _known_orders(order, transducers, seeds)
    if first is not None and integer_at_least("first", first, 0) >= transducers:
        raise invalid("first", first, f"must be an integer from 0 to {transducers - 1}")

    alone = torch.eye(transducers, dtype=torch.complex128, device="cpu")
    if orders is None:
        scores = ledger.evaluate(alone.expand(len(seeds), -1, -1))
        orders = _with_first(best_first(scores), first)
    else:
        orders = _with_first(orders, first)
        ledger.evaluate(alone[orders[:, :1]])
    drive = take_best_levels(ledger, alone[orders[:, 0]], orders[:, 1:], levels, _itself)
    so_far = ledger.evaluations
    repeat_passes(ledger, drive, orders, levels, passes - 1, _itself)
    return ledger.solution(most=so_far + (passes - 1) * transducers * levels)


def _known_orders(order: str | Sequence[int], transducers: int, seeds: Sequence[int]) -> torch.Tensor | None:
    """The order of each trial (T, M), or None for what only evaluations can tell."""
    if isinstance(order, str) and order == "strength":
        return None
    if isinstance(order, str) and order == "random":
        generators = [torch.Generator("cpu").manual_seed(seed) for seed in seeds]
        return torch.stack([torch.randperm(transducers, generator=own, device="cpu") for own in generators])
    return indices_of(order, transducers, ("random", "given", "strength")).expand(len(seeds), -1)


def _with_first(orders: torch.Tensor, first: int | None) -> torch.Tensor:
    """`orders` (T, M) with the transducer `first` moved to the front."""
    if first is None:
        return orders
    others = orders[orders != first].reshape(len(orders), -1)
    return torch.cat([orders.new_full((len(orders), 1), first), others], dim=1)


def _itself(drive: torch.Tensor) -> torch.Tensor:
    return drive
