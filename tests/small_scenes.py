"""Small scenes that several tests share: a 2 x 2 array in front of an obstacle, 24 mm across."""

from __future__ import annotations

import torch

from autdtorch.array import TransducerArray
from autdtorch.scene import Box, Medium, Scene

AIR = Medium(density=1.293, sound_speed=340.0)
CUBE = Box(center=(12e-3, 12e-3, 12e-3), size=(6e-3, 8e-3, 4e-3), density=100.0, sound_speed=340.0)


def small_scene(
    obstacles: tuple[Box, ...] = (), extent: float = 24e-3, absorption: float = 0.0, radius: float = 0.0
) -> Scene:
    """A 2 x 2 array at one face of a cube of air, three control points near the other, none on a cell."""
    array = TransducerArray.grid((2, 2), pitch=8e-3, center=(1.2e-3, extent / 2, extent / 2), radius=radius)
    air = Medium(AIR.density, AIR.sound_speed, absorption)
    points = [
        [extent - 1.7e-3, 0.31 * extent, 0.6 * extent],
        [extent - 4.1e-3, 0.7 * extent, 0.52 * extent],
        [extent - 2.6e-3, 0.44 * extent, 0.23 * extent],
    ]
    return Scene(array, air, 40e3, points, obstacles, domain=((0, 0, 0), (extent,) * 3))


def relative_error(value: torch.Tensor, reference: torch.Tensor) -> float:
    """Complex relative L2 error."""
    return float((value - reference).norm() / reference.norm())
