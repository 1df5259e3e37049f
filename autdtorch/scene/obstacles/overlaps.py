"""Overlaps and gaps of obstacles, and points in any of them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import combinations

import numpy as np
import torch

from autdtorch.scene.obstacles.base import Obstacle
from autdtorch.utils.array_types import REAL, Array
from autdtorch.utils.validation import LENGTH_TOLERANCE, Vector

_SAMPLES = 16  # along each axis of the intersection of two bounding boxes


def inside_any(points: torch.Tensor, obstacles: Iterable[Obstacle]) -> torch.Tensor:
    """Return whether each of the points (..., 3) [m] is inside an obstacle, bool (...)."""
    inside = torch.zeros(points.shape[:-1], dtype=torch.bool, device=points.device)
    for obstacle in obstacles:
        inside[~inside] = obstacle.contains(points[~inside])
    return inside


def overlap(obstacle: Obstacle, other: Obstacle) -> bool:
    """Return whether two obstacles share one of 16^3 points of their bounding boxes' intersection."""
    shared = shared_box((obstacle.lower, obstacle.upper), (other.lower, other.upper))
    if shared is None:
        return False
    lower, upper = shared
    share = (torch.arange(_SAMPLES, **REAL) + 0.5) / _SAMPLES
    points = lower + (upper - lower) * torch.cartesian_prod(share, share, share)
    return bool((obstacle.contains(points) & other.contains(points)).any())


def shared_box(
    box: tuple[Vector, Vector], other: tuple[Vector, Vector]
) -> tuple[torch.Tensor, torch.Tensor] | None:
    """Return the corners of the intersection of two boxes (lower, upper); None if they at most touch."""
    corners = torch.tensor([box, other], **REAL)
    lower, upper = corners[:, 0].amax(dim=0), corners[:, 1].amin(dim=0)
    return (lower, upper) if (upper - lower).min() > LENGTH_TOLERANCE else None


def gaps(axes: Array, middles: Array, halves: Array) -> Array:
    """Return the gaps (B, B) [m] between tilted boxes, negative where they overlap, infinite on the diagonal.

    The gap of two boxes is the largest of those along their axes, a lower bound of their distance.

    Args:
        axes: of each box, one a row (B, 3, 3).
        middles: centres (B, 3) [m].
        halves: half of the edges along the axes (B, 3) [m].
    """
    gaps = np.full((len(axes), len(axes)), math.inf)
    for i, j in combinations(range(len(axes)), 2):
        along = np.concatenate((axes[i], axes[j]))
        reach = sum(np.abs(along @ axes[box].T) @ halves[box] for box in (i, j))
        gaps[i, j] = gaps[j, i] = (np.abs(along @ (middles[i] - middles[j])) - reach).max()
    return gaps
