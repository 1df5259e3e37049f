"""The circular cylinder."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from autdtorch.scene.obstacles.base import Obstacle, distance_from_excess
from autdtorch.scene.obstacles.triangles import revolved
from autdtorch.utils.validation import Vector, finite_vector, positive, unit_vector


@dataclass(frozen=True)
class Cylinder(Obstacle):
    """A circular cylinder with flat ends.

    Attributes:
        center: centre (3,) [m], halfway between the ends.
        radius: [m], > 0.
        height: between the ends [m], > 0.
        axis: direction (3,) from one end to the other, stored with length 1.

    Raises:
        ValueError: an attribute is not finite, has the wrong shape or is out of range; see also `Obstacle`.
    """

    center: Vector
    radius: float
    height: float
    axis: Vector = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Check the attributes and bring them into canonical form."""
        super().__post_init__()
        object.__setattr__(self, "center", finite_vector("Cylinder.center", self.center))
        object.__setattr__(self, "radius", positive("Cylinder.radius", self.radius, "m"))
        object.__setattr__(self, "height", positive("Cylinder.height", self.height, "m"))
        object.__setattr__(self, "axis", unit_vector("Cylinder.axis", self.axis))

    @property
    def lower(self) -> Vector:
        """Corner of the bounding box with the smallest coordinates (3,) [m]."""
        return self._corner(-1.0)

    @property
    def upper(self) -> Vector:
        """Corner of the bounding box with the largest coordinates (3,) [m]."""
        return self._corner(1.0)

    def surface(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return a prism with its edges on the cylinder; see `Obstacle.surface`."""
        radius, half = self.radius, self.height / 2
        profile = [(0, -half), (radius, -half), (radius, half), (0, half)]
        return revolved(torch.tensor(profile, dtype=torch.float64, device="cpu"), self.center, self.axis)

    def _corner(self, sign: float) -> Vector:
        x, y, z = (
            # The extent of an end disc along a coordinate is the radius times the sine to the axis.
            middle + sign * (abs(along) * self.height / 2 + math.sqrt(max(0.0, 1 - along**2)) * self.radius)
            for middle, along in zip(self.center, self.axis, strict=True)
        )
        return x, y, z

    def _distance(self, points: torch.Tensor) -> torch.Tensor:
        inner, axis = points - points.new_tensor(self.center), points.new_tensor(self.axis)
        along = inner @ axis
        across = torch.linalg.vector_norm(inner - along[:, None] * axis, dim=-1)
        excess = torch.stack([across - self.radius, along.abs() - self.height / 2], dim=-1)
        return distance_from_excess(excess)
