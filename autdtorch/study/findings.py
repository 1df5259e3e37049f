"""What a study finds beyond the paper: how near a method comes to the certified bound, and at what cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from autdtorch.methods.base import Solution
from autdtorch.study.intervals import Interval, bootstrap
from autdtorch.study.results import MethodResult

NEAR_BOUND = 0.9
"""A score is near the bound from this share of it."""


@dataclass(frozen=True, eq=False)
class Finding:
    """How good a method's drives are, and what they cost.

    Attributes:
        score: median over the trials [Pa].
        gap: what the median lacks to the bound, as a share of it.
        evaluations_near: evaluations until each trial was near the bound (T,), float64, inf where it never
            was.
    """

    score: Interval
    gap: Interval
    evaluations_near: torch.Tensor


def find(method: MethodResult, bound: float) -> Finding:
    """What one method found in a scene.

    Args:
        method: its trials. A single one has no interval.
        bound: upper bound on the score [Pa], >= 0.
    """
    score = bootstrap(method.solution.score, average=np.median)
    gap = score.mapped(lambda value: 1 - value / bound if bound > 0 else 0.0)
    return Finding(score, gap, evaluations_to(method.solution, NEAR_BOUND * bound))


def evaluations_to(solution: Solution, level: float) -> torch.Tensor:
    """Evaluations until the best score was at `level` (T,), float64; inf for a trial that ended below it.

    To take such a trial as inf keeps a median over the trials right, whatever it would have done with more
    evaluations, as long as more than half of the trials got there.
    """
    reached = solution.history >= level
    first = reached.int().argmax(dim=1).double() + 1
    return torch.where(reached.any(dim=1), first, torch.inf)
