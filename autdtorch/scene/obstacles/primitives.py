"""The cuboid, the sphere and the circular cylinder."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import InitVar, dataclass, field

import torch

from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.obstacles.base import Obstacle
from autdtorch.scene.obstacles.triangles import BOX_TRIANGLES, SEGMENTS, revolved
from autdtorch.utils.array_types import REAL
from autdtorch.utils.units import angles
from autdtorch.utils.validation import Vector, finite_vector, positive, positive_entries, unit_vector


@dataclass(frozen=True)
class _Centred(Obstacle):
    """A body that is symmetric about its centre (3,) [m]."""

    center: Vector

    def __post_init__(self) -> None:
        """Check the material and the centre."""
        super().__post_init__()
        center = finite_vector(f"{type(self).__name__}.center", self.center)
        object.__setattr__(self, "center", center)

    @property
    def lower(self) -> Vector:
        """Corner of the bounding box with the smallest coordinates (3,) [m]."""
        (x, y, z), (a, b, c) = self.center, self._half_extents
        return x - a, y - b, z - c

    @property
    def upper(self) -> Vector:
        """Corner of the bounding box with the largest coordinates (3,) [m]."""
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

    size: Vector
    rotation: Vector = (0.0, 0.0, 0.0)
    rotation_degrees: InitVar[Vector | None] = field(default=None, kw_only=True)

    def __post_init__(self, rotation_degrees: Vector | None) -> None:
        """Check the attributes and bring them into canonical form."""
        super().__post_init__()
        object.__setattr__(self, "size", positive_entries("Box.size", self.size, 3))
        object.__setattr__(self, "rotation", angles("Box.rotation", self.rotation, rotation_degrees))

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

    radius: float

    def __post_init__(self) -> None:
        """Check the attributes and bring them into canonical form."""
        super().__post_init__()
        object.__setattr__(self, "radius", positive("Sphere.radius", self.radius, "m"))

    def surface(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return a polyhedron with its vertices on the sphere; see `Obstacle.surface`."""
        angles = torch.linspace(0, math.pi, SEGMENTS // 2 + 1, **REAL)
        profile = self.radius * torch.stack([angles.sin(), -angles.cos()], dim=-1)
        return revolved(profile, self.center, (0.0, 0.0, 1.0))

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

    radius: float
    height: float
    axis: Vector = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """Check the attributes and bring them into canonical form."""
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
