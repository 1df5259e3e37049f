"""The base class of obstacles: a material, a bounding box and a signed distance."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Self

import torch

from autdtorch.utils.validation import (
    LENGTH_TOLERANCE,
    ArrayLike,
    Vector,
    boolean,
    fluid,
    invalid,
    not_negative,
    real_tensor,
)


@dataclass(frozen=True, kw_only=True)
class Obstacle(ABC):
    """A body of a fluid material, or a rigid body. Several obstacles in a list make a union.

    Obstacles are constant. `dataclasses.replace` returns one that is moved, rescaled or of another material.

    Attributes:
        density: of the material [kg/m^3], 1e-9 to 1e9; None if rigid.
        sound_speed: of the material [m/s], 1e-3 to 1e6; None if rigid.
        rigid: True for walls that do not move.

    Raises:
        ValueError: a density or sound speed out of range; both a material and rigid, or neither.
    """

    density: float | None = None
    sound_speed: float | None = None
    rigid: bool = False

    def __post_init__(self) -> None:
        """Check the material."""
        kind = type(self).__name__
        object.__setattr__(self, "rigid", boolean(f"{kind}.rigid", self.rigid))
        if self.rigid:
            if (material := (self.density, self.sound_speed)) != (None, None):
                accepted = "must have either a material or rigid=True, not both"
                raise invalid(f"{kind}.rigid", material, accepted)
            return
        if self.density is None or self.sound_speed is None:
            missing = "density" if self.density is None else "sound_speed"
            raise invalid(f"{kind}.{missing}", None, "must have both density and sound_speed, or rigid=True")
        density, sound_speed = fluid(kind, self.density, self.sound_speed)
        object.__setattr__(self, "density", density)
        object.__setattr__(self, "sound_speed", sound_speed)

    @property
    def uncertainty(self) -> float:
        """Distance [m] by which its surface may be off (rms); 0 where it is exact."""
        return 0.0

    def filled(self) -> Self:
        """Return the obstacle without its cavities, which no sound enters if it is rigid."""
        return self

    @property
    @abstractmethod
    def lower(self) -> Vector:
        """Corner of the bounding box with the smallest coordinates (3,) [m]."""

    @property
    @abstractmethod
    def upper(self) -> Vector:
        """Corner of the bounding box with the largest coordinates (3,) [m]."""

    def contains(self, points: ArrayLike, margin: float = 0.0) -> torch.Tensor:
        """Return whether each point lies inside, bool (...).

        Args:
            points: (..., 3) [m].
            margin: distance by which the obstacle is enlarged on every side [m], >= 0.

        Raises:
            ValueError: `points` are not finite real numbers or have another last axis, or `margin` is < 0.
        """
        points = _points(points)
        margin = not_negative("margin", margin, "m")
        flat = points.reshape(-1, 3)
        near = self.near(flat, margin)  # distances to meshes are slow
        inside = torch.zeros(len(flat), dtype=torch.bool, device=flat.device)
        inside[near] = self._inside(flat[near], margin)
        return inside.reshape(points.shape[:-1])

    def near(self, points: torch.Tensor, margin: float = 0.0) -> torch.Tensor:
        """Return whether each of the points (..., 3) [m] is at most `margin` [m] from the bounding box."""
        lower, upper = points.new_tensor([self.lower, self.upper])
        beside = margin + LENGTH_TOLERANCE
        near: torch.Tensor = ((points >= lower - beside) & (points <= upper + beside)).all(dim=-1)
        return near

    def signed_distance(self, points: ArrayLike) -> torch.Tensor:
        """Return the distance of each point to the surface, float64 (...) [m], negative inside.

        Args:
            points: (..., 3) [m].

        Raises:
            ValueError: `points` are not finite real numbers or have another last axis.
        """
        points = _points(points)
        return self._distance(points.reshape(-1, 3)).reshape(points.shape[:-1])

    @abstractmethod
    def surface(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return vertices (V, 3) [m], float64, and triangles of their indices (F, 3), int64.

        Triangles are counter-clockwise as seen from outside.
        """

    def _inside(self, points: torch.Tensor, margin: float) -> torch.Tensor:
        return self._distance(points) < margin

    @abstractmethod
    def _distance(self, points: torch.Tensor) -> torch.Tensor:
        """Return the signed distances (N,) [m] of checked `points` (N, 3) [m]."""


def _points(given: ArrayLike) -> torch.Tensor:
    points = real_tensor("points", given, "m")
    if points.ndim == 0 or points.shape[-1] != 3:
        raise ValueError(f"points: shape {tuple(points.shape)}; must be (..., 3)")
    return points
