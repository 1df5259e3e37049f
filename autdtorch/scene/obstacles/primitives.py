"""The cuboid, the sphere and the circular cylinder."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import InitVar, dataclass, field
from typing import ClassVar

import torch

from autdtorch.scene.geometry import circle_points, rotation_matrix
from autdtorch.scene.obstacles.base import Obstacle
from autdtorch.utils.array_types import REAL
from autdtorch.utils.units import angles
from autdtorch.utils.validation import Vector, finite_vector, positive, positive_entries, unit_vector

SEGMENTS = 48
"""Sides of the polygon drawn for a circle: corners on the circle, sides up to 0.2 % of the radius inside."""

_BOX = "013 032 467 475 045 051 237 276 026 064 157 173"
BOX_TRIANGLES = torch.tensor([[*map(int, face)] for face in _BOX.split()], dtype=torch.int64, device="cpu")
"""Triangles of a box with corners in the order of `torch.cartesian_prod`, two for each face
from -x, +x, -y to +z."""


@dataclass(frozen=True)
class _Centred(Obstacle):
    """A body that is symmetric about its centre (3,) [m]."""

    position_field: ClassVar[str] = "center"

    center: Vector

    def __post_init__(self) -> None:
        super().__post_init__()
        center = finite_vector(f"{type(self).__name__}.center", self.center)
        object.__setattr__(self, "center", center)

    @property
    def lower(self) -> Vector:
        (x, y, z), (a, b, c) = self.center, self._half_extents
        return x - a, y - b, z - c

    @property
    def upper(self) -> Vector:
        (x, y, z), (a, b, c) = self.center, self._half_extents
        return x + a, y + b, z + c

    @property
    @abstractmethod
    def _half_extents(self) -> Vector:
        """Half the edges of the bounding box (3,) [m]."""

    def _from_center(self, points: torch.Tensor) -> torch.Tensor:
        return points - points.new_tensor(self.center)


@dataclass(frozen=True)
class Box(_Centred):
    """A cuboid.

    Attributes:
        center: centre (3,) [m].
        size: edge lengths (3,) [m], > 0, before rotation.
        rotation: angles (3,) [rad] about the centre; see `autdtorch.scene.geometry.rotation_matrix`.
        rotation_degrees: these angles (3,) in degrees, in place of `rotation`; it is no attribute afterwards.

    Raises:
        ValueError: an attribute is not finite, has the wrong shape or is out of range; see also `Obstacle`.
    """

    orientation_field: ClassVar[str | None] = "rotation"

    size: Vector
    rotation: Vector = (0.0, 0.0, 0.0)
    rotation_degrees: InitVar[Vector | None] = field(default=None, kw_only=True)

    def __post_init__(self, rotation_degrees: Vector | None) -> None:
        super().__post_init__()
        object.__setattr__(self, "size", positive_entries("Box.size", self.size, 3))
        object.__setattr__(self, "rotation", angles("Box.rotation", self.rotation, rotation_degrees))

    @property
    def fills_bounds(self) -> bool:
        """True if the edges are along the axes; see `Obstacle.fills_bounds`."""
        return self.rotation == (0.0, 0.0, 0.0)

    def surface(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return two triangles for each face; see `Obstacle.surface`."""
        signs = torch.tensor([-0.5, 0.5], **REAL)
        corners = torch.cartesian_prod(signs, signs, signs) * signs.new_tensor(self.size)
        vertices = signs.new_tensor(self.center) + corners @ rotation_matrix(self.rotation).T
        return vertices, BOX_TRIANGLES.clone()

    @property
    def _half_extents(self) -> Vector:
        turn = rotation_matrix(self.rotation).abs()
        a, b, c = (0.5 * (turn @ turn.new_tensor(self.size))).tolist()
        return a, b, c

    def _inside(self, points: torch.Tensor, margin: float) -> torch.Tensor:
        """Count lower faces as inside and upper faces as outside: touching boxes share no point."""
        inner, half = self._inner(points), points.new_tensor(self.size) / 2 + margin
        return ((inner >= -half) & (inner < half)).all(dim=-1)

    def _distance(self, points: torch.Tensor) -> torch.Tensor:
        return _distance_from_excess(self._inner(points).abs() - points.new_tensor(self.size) / 2)

    def _inner(self, points: torch.Tensor) -> torch.Tensor:
        """Return coordinates (N, 3) [m] from the centre along the edges."""
        return self._from_center(points) @ rotation_matrix(self.rotation).to(points)


@dataclass(frozen=True)
class Sphere(_Centred):
    """A sphere.

    Attributes:
        center: centre (3,) [m].
        radius: [m], > 0.

    Raises:
        ValueError: an attribute is not finite, has the wrong shape or is out of range; see also `Obstacle`.
    """

    orientation_field: ClassVar[str | None] = ""

    radius: float

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "radius", positive("Sphere.radius", self.radius, "m"))

    def surface(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return a polyhedron with its vertices on the sphere; see `Obstacle.surface`."""
        angles = torch.linspace(0, math.pi, SEGMENTS // 2 + 1, **REAL)
        profile = self.radius * torch.stack([angles.sin(), -angles.cos()], dim=-1)
        return revolved(profile, self.center, (0.0, 0.0, 1.0))

    def farthest(self, center: torch.Tensor) -> float:
        """Return the distance [m] of the farthest point; see `Obstacle.farthest`."""
        return float((center - center.new_tensor(self.center)).norm()) + self.radius

    @property
    def _half_extents(self) -> Vector:
        return self.radius, self.radius, self.radius

    def _distance(self, points: torch.Tensor) -> torch.Tensor:
        from_center: torch.Tensor = torch.linalg.vector_norm(self._from_center(points), dim=-1)
        return from_center - self.radius


@dataclass(frozen=True)
class Cylinder(_Centred):
    """A circular cylinder with flat ends.

    Attributes:
        center: centre (3,) [m], halfway between the ends.
        radius: [m], > 0.
        height: between the ends [m], > 0.
        axis: direction (3,) from one end to the other, stored with length 1.

    Raises:
        ValueError: an attribute is not finite, has the wrong shape or is out of range; see also `Obstacle`.
    """

    orientation_field: ClassVar[str | None] = "axis"

    radius: float
    height: float
    axis: Vector = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "radius", positive("Cylinder.radius", self.radius, "m"))
        object.__setattr__(self, "height", positive("Cylinder.height", self.height, "m"))
        object.__setattr__(self, "axis", unit_vector("Cylinder.axis", self.axis))

    def surface(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return a prism with its edges on the cylinder; see `Obstacle.surface`."""
        radius, half = self.radius, self.height / 2
        profile = [(0, -half), (radius, -half), (radius, half), (0, half)]
        return revolved(torch.tensor(profile, **REAL), self.center, self.axis)

    @property
    def _half_extents(self) -> Vector:
        a, b, c = (
            # The extent of an end disc along a coordinate is the radius times the sine to the axis.
            abs(along) * self.height / 2 + math.sqrt(max(0.0, 1 - along**2)) * self.radius
            for along in self.axis
        )
        return a, b, c

    def _distance(self, points: torch.Tensor) -> torch.Tensor:
        inner, axis = self._from_center(points), points.new_tensor(self.axis)
        along = inner @ axis
        across = torch.linalg.vector_norm(inner - along[:, None] * axis, dim=-1)
        return _distance_from_excess(
            torch.stack([across - self.radius, along.abs() - self.height / 2], dim=-1)
        )


def _distance_from_excess(excess: torch.Tensor) -> torch.Tensor:
    """Return signed distances (N,) from the distances (N, K) of points beyond K perpendicular faces."""
    outside: torch.Tensor = torch.linalg.vector_norm(excess.clamp(min=0), dim=-1)
    return outside + excess.amax(dim=-1).clamp(max=0)


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
