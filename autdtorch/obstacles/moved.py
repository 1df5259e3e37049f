"""An obstacle somewhere else."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from autdtorch.obstacles.base import Obstacle
from autdtorch.validation import Vector


@dataclass(frozen=True, kw_only=True)
class Moved(Obstacle):
    """The shape of an obstacle, moved, in a material of its own.

    Attributes:
        shape: the obstacle whose shape it has.
        offset: by which it is moved (3,) [m].
    """

    shape: Obstacle = field(repr=False)
    offset: Vector

    @property
    def lower(self) -> Vector:
        """Corner of the bounding box with the smallest coordinates (3,) [m]."""
        return self._moved(self.shape.lower)

    @property
    def upper(self) -> Vector:
        """Corner of the bounding box with the largest coordinates (3,) [m]."""
        return self._moved(self.shape.upper)

    def surface(self) -> tuple[torch.Tensor, torch.Tensor]:
        """That of the shape, moved; see `Obstacle.surface`."""
        vertices, faces = self.shape.surface()
        return vertices + vertices.new_tensor(self.offset), faces

    def _moved(self, corner: Vector) -> Vector:
        x, y, z = (start + shift for start, shift in zip(corner, self.offset, strict=True))
        return x, y, z

    def _inside(self, points: torch.Tensor, margin: float) -> torch.Tensor:
        return self.shape.contains(points - points.new_tensor(self.offset), margin)

    def _distance(self, points: torch.Tensor) -> torch.Tensor:
        return self.shape.signed_distance(points - points.new_tensor(self.offset))
