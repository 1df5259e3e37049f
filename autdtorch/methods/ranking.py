"""Ranking of scores in which near ties count as equal."""

from __future__ import annotations

import torch

NEAR_TIE = 1e-5
"""Relative difference below which scores count as equal. Symmetric scenes have many equal scores, and the
rounding of the simulation, which differs between machines, must not decide between them."""


def first_of_best(score: torch.Tensor) -> torch.Tensor:
    """Return the index (T,) of the first of scores (T, B) within `NEAR_TIE` of the best."""
    best = score.amax(dim=1, keepdim=True)
    return (score >= best - NEAR_TIE * best.abs()).byte().argmax(dim=1)


def best_first(score: torch.Tensor) -> torch.Tensor:
    """Return the indices (T, B) of scores (T, B) in descending order, near ties in ascending order."""
    order = score.argsort(dim=1, descending=True, stable=True)
    ranked = score.gather(1, order)
    apart = ranked[:, :-1] - ranked[:, 1:] > NEAR_TIE * ranked[:, :-1].abs()
    group = torch.nn.functional.pad(apart.cumsum(dim=1), (1, 0))
    return order.gather(1, (group * score.shape[1] + order).argsort(dim=1))
