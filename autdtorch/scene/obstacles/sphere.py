"""The sphere."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from autdtorch.scene.obstacles.base import Obstacle
from autdtorch.scene.obstacles.triangles import SEGMENTS, revolved
from autdtorch.utils.validation import Vector, finite_vector, positive


@dataclass(frozen=True)
class Sphere(Obstacle):
    """A sphere.

    Attributes:
        center: centre (3,) [m].
        radius: [m], > 0.

    Raises:
        ValueError: an attribute is not finite, has the wrong shape or is out of range; see also `Obstacle`.
    """

    center: Vector
    radius: float

    def __post_init__(self) -> None:
        """Check the attributes and bring them into canonical form."""
        super().__post_init__()
        object.__setattr__(self, "center", finite_vector("Sphere.center", self.center))
        object.__setattr__(self, "radius", positive("Sphere.radius", self.radius, "m"))

    @property
    def lower(self) -> Vector:
        """Corner of the bounding box with the smallest coordinates (3,) [m]."""
        x, y, z = self.center
        return x - self.radius, y - self.radius, z - self.radius

    @property
    def upper(self) -> Vector:
        """Corner of the bounding box with the largest coordinates (3,) [m]."""
        x, y, z = self.center
        return x + self.radius, y + self.radius, z + self.radius

    def surface(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return a polyhedron with its vertices on the sphere; see `Obstacle.surface`."""
        angles = torch.linspace(0, math.pi, SEGMENTS // 2 + 1, dtype=torch.float64, device="cpu")
        profile = self.radius * torch.stack([angles.sin(), -angles.cos()], dim=-1)
        return revolved(profile, self.center, (0.0, 0.0, 1.0))

    def _distance(self, points: torch.Tensor) -> torch.Tensor:
        from_center: torch.Tensor = torch.linalg.vector_norm(points - points.new_tensor(self.center), dim=-1)
        return from_center - self.radius
