"""The cuboid."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.obstacles.base import Obstacle, distance_from_excess
from autdtorch.scene.obstacles.triangles import BOX_TRIANGLES
from autdtorch.utils.validation import Vector, finite_vector, positive_entries


@dataclass(frozen=True)
class Box(Obstacle):
    """A cuboid.

    Attributes:
        center: centre (3,) [m].
        size: edge lengths (3,) [m], > 0, before rotation.
        rotation: angles (3,) [rad] about the centre; see `autdtorch.scene.geometry.rotation_matrix`.

    Raises:
        ValueError: an attribute is not finite, has the wrong shape or is out of range; see also `Obstacle`.
    """

    center: Vector
    size: Vector
    rotation: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        """Check the attributes and bring them into canonical form."""
        super().__post_init__()
        object.__setattr__(self, "center", finite_vector("Box.center", self.center))
        object.__setattr__(self, "size", positive_entries("Box.size", self.size, 3))
        object.__setattr__(self, "rotation", finite_vector("Box.rotation", self.rotation, "rad"))

    @property
    def lower(self) -> Vector:
        """Corner of the bounding box with the smallest coordinates (3,) [m]."""
        return self._corner(-0.5)

    @property
    def upper(self) -> Vector:
        """Corner of the bounding box with the largest coordinates (3,) [m]."""
        return self._corner(0.5)

    def surface(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return two triangles for each face; see `Obstacle.surface`."""
        signs = torch.tensor([-0.5, 0.5], dtype=torch.float64, device="cpu")
        corners = torch.cartesian_prod(signs, signs, signs) * signs.new_tensor(self.size)
        vertices = signs.new_tensor(self.center) + corners @ rotation_matrix(self.rotation).T
        return vertices, BOX_TRIANGLES.clone()

    def _corner(self, share: float) -> Vector:
        turn = rotation_matrix(self.rotation).abs()
        extent = (turn @ turn.new_tensor(self.size)).tolist()
        x, y, z = (middle + share * length for middle, length in zip(self.center, extent, strict=True))
        return x, y, z

    def _inside(self, points: torch.Tensor, margin: float) -> torch.Tensor:
        """Count lower faces as inside and upper faces as outside: touching boxes share no point."""
        inner, half = self._inner(points), points.new_tensor(self.size) / 2 + margin
        return ((inner >= -half) & (inner < half)).all(dim=-1)

    def _distance(self, points: torch.Tensor) -> torch.Tensor:
        excess = self._inner(points).abs() - points.new_tensor(self.size) / 2
        return distance_from_excess(excess)

    def _inner(self, points: torch.Tensor) -> torch.Tensor:
        """Return coordinates (N, 3) [m] from the centre along the edges."""
        return (points - points.new_tensor(self.center)) @ rotation_matrix(self.rotation).to(points)
