"""Points that no sound reaches: in rigid bodies, or in cavities that these close off."""

from __future__ import annotations

from typing import cast

import torch

from autdtorch.fdtd.region import Region
from autdtorch.scene.obstacles import Obstacle
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import REAL
from autdtorch.utils.validation import LENGTH_TOLERANCE

_SIDES = torch.tensor([-1.0, 1.0], **REAL)


def in_rigid(region: Region, points: torch.Tensor) -> torch.Tensor:
    """Return which points (N, 3) [m] are in rigid bodies, bool (N,); of overlapping bodies the later counts.

    A point on a surface is in the air, if there is air next to it: where rigid bodies touch there is none.
    """
    rigid = _in_rigid(region, points, LENGTH_TOLERANCE)
    place = rigid.nonzero()[:, 0]
    on_surfaces = torch.zeros(len(place), dtype=torch.bool, device="cpu")
    for shape in region.shapes:
        on_surfaces |= _on_surface(cast(Obstacle, shape), points[place])
    place = place[on_surfaces]
    around = points[place, None] + 2 * LENGTH_TOLERANCE * torch.cartesian_prod(*[_SIDES] * 3)
    for mirror in region.mirrors:  # behind it is the image of what is in front
        behind = mirror.height(around).clamp(max=0.0)
        around = around - 2 * behind[..., None] * around.new_tensor(mirror.normal)
    rigid[place] = _in_rigid(region, around.reshape(-1, 3)).reshape(around.shape[:2]).all(dim=1)
    return rigid


def in_filled_cavities(scene: Scene, region: Region, points: torch.Tensor) -> torch.Tensor:
    """Return which points (..., 3) [m] are in cavities of obstacles that the region's bodies do not have."""
    enclosed = torch.zeros(points.shape[:-1], dtype=torch.bool, device="cpu")
    for obstacle, body in zip(scene.obstacles, region.bodies, strict=True):
        if body.shape is not obstacle:
            filled = cast(Obstacle, body.shape)
            inside = filled.contains(points) & ~obstacle.contains(points)
            inside[inside.clone()] = ~_on_surface(filled, points[inside])  # where rounding would decide
            enclosed |= inside
    return enclosed


def _in_rigid(region: Region, points: torch.Tensor, margin: float = 0.0) -> torch.Tensor:
    """Return which points (N, 3) [m] are in rigid bodies that are enlarged by a margin [m]."""
    rigid = torch.zeros(len(points), dtype=torch.bool, device="cpu")
    for body in region.bodies:
        inside = cast(Obstacle, body.shape).contains(points, margin)
        rigid = torch.where(inside, body.fluid is None, rigid)
    return rigid


def _on_surface(obstacle: Obstacle, points: torch.Tensor) -> torch.Tensor:
    """Return which points (..., 3) [m] are on the surface of an obstacle, bool (...)."""
    on = obstacle.near(points)
    on[on.clone()] = obstacle.signed_distance(points[on]).abs() <= LENGTH_TOLERANCE
    return on
