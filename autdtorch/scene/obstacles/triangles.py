"""Triangulated surfaces of bodies, counter-clockwise as seen from outside."""

from __future__ import annotations

import torch

from autdtorch.scene.geometry import circle_points
from autdtorch.utils.array_types import REAL
from autdtorch.utils.validation import Vector

SEGMENTS = 48
"""Sides of the polygon drawn for a circle: corners on the circle, sides up to 0.2 % of the radius inside."""

_BOX = "013 032 467 475 045 051 237 276 026 064 157 173"
BOX_TRIANGLES = torch.tensor([[*map(int, face)] for face in _BOX.split()], dtype=torch.int64, device="cpu")
"""Triangles of a box with corners in the order of `torch.cartesian_prod`, two for each face
from -x, +x, -y to +z."""


def revolved(profile: torch.Tensor, center: Vector, axis: Vector) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the surface, vertices (V, 3) [m] and triangles (F, 3), of a body of revolution.

    Args:
        profile: (K, 2) [m], distance from the axis and position along it, upwards; both ends on the axis.
        center: origin of the positions along the axis (3,) [m].
        axis: unit vector (3,).
    """
    rings, count = len(profile) - 2, SEGMENTS
    circle = circle_points((0.0, 0.0, 0.0), 1.0, count, axis)
    upwards = torch.tensor(axis, **REAL)
    bottom, top = (profile[end, 1] * upwards for end in (0, -1))
    sides = profile[1:-1, :1, None] * circle + profile[1:-1, 1:, None] * upwards
    vertices = torch.cat([bottom[None], sides.reshape(-1, 3), top[None]])
    ring = 1 + torch.arange(rings * count, device="cpu").reshape(rings, count)
    turned = ring.roll(-1, dims=1)
    triangles = [
        torch.stack([torch.zeros_like(ring[0]), turned[0], ring[0]], dim=-1),
        torch.stack([ring[:-1], turned[:-1], turned[1:]], dim=-1).reshape(-1, 3),
        torch.stack([ring[:-1], turned[1:], ring[1:]], dim=-1).reshape(-1, 3),
        torch.stack([torch.full_like(ring[0], rings * count + 1), ring[-1], turned[-1]], dim=-1),
    ]
    return torch.tensor(center, **REAL) + vertices, torch.cat(triangles)
