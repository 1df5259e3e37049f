"""Coordinate ascent: one weight after the other takes the best of several phases, the others held."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from autdtorch.methods.base import first_of_best, setting
from autdtorch.scene.drive import drive_from_phases, phases_of
from autdtorch.utils.array_types import REAL
from autdtorch.utils.validation import integers, invalid

Search = Mapping[str, torch.Tensor]
"""The state of the ascent of L trials over N weights:

- ``weights`` (L, N), complex128: e^{-i phi}, or 0 for what is off; ``before``: as they were before this pass.
- ``order`` (L, K): indices of the weights to go through in a pass.
"""


def order(*names: str) -> Any:
    """Return the field of a setting that is one of these names, the first by default, or indices."""
    return setting(names[0], functools.partial(_checked_order, names=names))


def _checked_order(name: str, order: str | Sequence[int], names: Sequence[str]) -> str | tuple[int, ...]:
    if isinstance(order, str) and order in names:
        return order
    quoted = ", ".join(f'"{name}"' for name in names)
    accepted = f"must be {quoted} or the indices of all, each once"
    chosen = tuple(integers(name, order, 0, accepted))
    if sorted(chosen) != list(range(len(chosen))):
        raise invalid(name, order, accepted)
    return chosen


def require_all(order: str | Sequence[int], count: int) -> None:
    """Check that an order by indices has `count` of them."""
    if not isinstance(order, str) and len(order) != count:
        raise invalid("order", order, f"must be the indices 0 to {count - 1}, each once")


def indices_of(order: str | Sequence[int], count: int) -> torch.Tensor:
    """Return the indices (count,) of an order; ascending where the order is a name."""
    return torch.tensor(range(count) if isinstance(order, str) else order, dtype=torch.int64, device="cpu")


def at_levels(drive: torch.Tensor, levels: int) -> torch.Tensor:
    """Return drives (L, N) with the nearest of the phases, and amplitudes 1 where they are on."""
    nearest = (phases_of(drive) * levels / (2 * math.pi)).round().to(torch.int64) % levels
    return torch.where(drive == 0, 0, _phases(levels)[nearest])


def begin_ascent(weights: torch.Tensor, order: torch.Tensor) -> Search:
    """Return the state of an ascent from weights (L, N)."""
    return {"weights": weights, "before": weights, "order": order}


def candidates(search: Search, levels: int, step: int) -> torch.Tensor:
    """Return the weights (L, levels, N) to compare in a step: all phases of its weight.

    The present phase is among them, so that a choice is made among observations of one time: a lucky reading,
    or the drift since, does not hold a phase for ever.
    """
    weights, order = search["weights"][:, None], search["order"]
    index = order[:, step % order.shape[1], None, None].expand(-1, levels, 1)
    phases = _phases(levels)[:, None].expand(len(order), -1, 1)
    return weights.expand(-1, levels, -1).scatter(2, index, phases)


def ascend(search: Search, step: int, score: torch.Tensor) -> tuple[Search, torch.Tensor | None]:
    """Take the best of the `candidates` of a step by their scores (L, levels); of near ties the first.

    Returns:
        The state, and which of the L trials go on (L,), None for all. A trial ends after a pass that changed
        none of its weights.
    """
    order = search["order"]
    index = order[:, step % order.shape[1], None]
    phases = _phases(score.shape[1])[first_of_best(score)]
    weights = search["weights"].scatter(1, index, phases[:, None])
    if (step + 1) % order.shape[1]:
        return {**search, "weights": weights}, None
    goes_on = (weights != search["before"]).any(dim=1)
    return {**search, **begin_ascent(weights[goes_on], order[goes_on])}, goes_on


@functools.lru_cache(maxsize=8)
def _phases(levels: int) -> torch.Tensor:
    """Return e^{-i phi} (levels,) of the phases to compare."""
    turns = torch.arange(levels, **REAL)
    return drive_from_phases(2 * math.pi * turns / levels)
