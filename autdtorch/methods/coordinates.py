"""Coordinate search: one phase after the other, each the best of several levels, the others held."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch

from autdtorch.methods.base import Ledger, first_of_best
from autdtorch.scene.drive import drive_from_phases
from autdtorch.utils.validation import integers, invalid


def indices_of(order: str | Sequence[int], count: int, names: Sequence[str] = ("given",)) -> torch.Tensor:
    """Indices (count,) of an `order`, which is "given", from 0 on, or all indices themselves.

    Args:
        order: as the user gave it.
        count: number of what is ordered.
        names: what the order may be called, for the message.

    Raises:
        ValueError: anything else.
    """
    if isinstance(order, str) and order == "given":
        return torch.arange(count, device="cpu")
    named = ", ".join(f'"{name}"' for name in names)
    accepted = f"must be {named} or the indices 0 to {count - 1}, each once"
    indices = integers("order", order, 0, accepted)
    if sorted(indices) != list(range(count)):
        raise invalid("order", indices, accepted)
    return torch.tensor(indices, dtype=torch.int64, device="cpu")


def take_best_levels(
    ledger: Ledger,
    weights: torch.Tensor,
    order: torch.Tensor,
    levels: int,
    drive: Callable[[torch.Tensor], torch.Tensor],
    trials: torch.Tensor | None = None,
) -> torch.Tensor:
    """Go through the weights of every trial in its `order`; each takes the best of `levels` phases.

    A step takes `levels` evaluations a trial, in one call of the objective for all trials. Of near ties the
    first level is taken (`first_of_best`).

    Args:
        ledger: counts the evaluations.
        weights: e^{-i phi}, or 0 for what is off (T, N), complex128.
        order: indices of the weights to go through (T, K).
        levels: number of phases in [0, 2 pi).
        drive: makes drives (..., M) of weights (..., N).
        trials: places of the T trials in the ledger; all by default.

    Returns:
        The weights (T, N) after the last step.
    """
    choices = drive_from_phases(
        2 * math.pi * torch.arange(levels, dtype=torch.float64, device="cpu") / levels
    )
    rows = torch.arange(len(weights), device="cpu")
    for index in order.T:
        candidates = weights[:, None].repeat(1, levels, 1)
        candidates[rows, :, index] = choices
        best = first_of_best(ledger.evaluate(drive(candidates), trials))
        weights = candidates[rows, best]
    return weights


def repeat_passes(
    ledger: Ledger,
    weights: torch.Tensor,
    order: torch.Tensor,
    levels: int,
    passes: int,
    drive: Callable[[torch.Tensor], torch.Tensor],
) -> None:
    """Coordinate ascent: go through `order` up to `passes` times.

    A trial ends with the first pass that changes none of its weights. The present level is evaluated again
    with the others, so that a choice is among observations made together: one lucky reading, or the drift
    since, does not hold a level for ever.

    Args:
        ledger: counts the evaluations.
        weights: as for `take_best_levels`, of all trials.
        order: indices of the weights to go through (T, K).
        levels: number of phases in [0, 2 pi).
        passes: most passes, >= 0.
        drive: makes drives (..., M) of weights (..., N).
    """
    trials = torch.arange(len(weights), device="cpu")
    for _ in range(passes):
        passed = take_best_levels(ledger, weights, order[trials], levels, drive, trials)
        changed = (passed != weights).any(dim=1)
        trials, weights = trials[changed], passed[changed]
        if len(trials) == 0:
            return
