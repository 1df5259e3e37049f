"""Triangulated surfaces of bodies, counter-clockwise as seen from outside."""

from __future__ import annotations

import math

import torch

from autdtorch.scene.geometry import plane_basis
from autdtorch.utils.validation import Vector

#: Sides of the polygon that stands for a circle: its corners are on the circle, its sides 0.2 % inside.
SEGMENTS = 48

#: Of a box with its corners in the order of `torch.cartesian_prod`, two for each of -x, +x, -y, +y, -z, +z.
BOX_TRIANGLES = torch.tensor(
    [
        *((0, 1, 3), (0, 3, 2)),
        *((4, 6, 7), (4, 7, 5)),
        *((0, 4, 5), (0, 5, 1)),
        *((2, 3, 7), (2, 7, 6)),
        *((0, 2, 6), (0, 6, 4)),
        *((1, 5, 7), (1, 7, 3)),
    ],
    dtype=torch.int64,
    device="cpu",
)


def revolved(profile: torch.Tensor, center: Vector, axis: Vector) -> tuple[torch.Tensor, torch.Tensor]:
    """The body that a profile sweeps out around an axis.

    Args:
        profile: (K, 2) [m], distance from the axis and position along it, upwards; its ends on the axis.
        center: what the positions are counted from (3,) [m].
        axis: unit vector (3,).

    Returns:
        Vertices (V, 3) [m] and triangles (F, 3): `SEGMENTS` of them between neighbouring rings or poles.
    """
    rings, count = len(profile) - 2, SEGMENTS
    u, v = plane_basis(axis)
    angles = 2 * math.pi * torch.arange(count, dtype=torch.float64, device="cpu") / count
    circle = angles.cos()[:, None] * u + angles.sin()[:, None] * v
    upwards = torch.tensor(axis, dtype=torch.float64, device="cpu")
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
    return torch.tensor(center, dtype=torch.float64, device="cpu") + vertices, torch.cat(triangles)
