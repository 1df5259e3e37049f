"""Overlaps of obstacles, and points in any of them."""

from __future__ import annotations

from collections.abc import Iterable

import torch

from autdtorch.scene.obstacles.base import Obstacle
from autdtorch.utils.array_types import REAL
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
