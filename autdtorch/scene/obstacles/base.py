"""The base class of obstacles, points in any of them, and their overlaps."""

from __future__ import annotations

import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import torch

from autdtorch.utils.array_types import REAL
from autdtorch.utils.fluids import equivalent_fluid, passive_impedance
from autdtorch.utils.units import DECIBELS
from autdtorch.utils.validation import (
    LENGTH_TOLERANCE,
    ArrayLike,
    Vector,
    boolean,
    invalid,
    not_negative,
    positive,
    real_tensor,
)

_IMPEDANCES = 1e-2, 1e6  # ratios to the medium; beyond are pressure-release and rigid surfaces
_SAMPLES = 16  # along each axis of the intersection of two bounding boxes


@dataclass(frozen=True, kw_only=True)
class Obstacle(ABC):
    """A body of a fluid material, a rigid body, or one whose surface has an impedance.

    Several obstacles in a list make a union. Obstacles are constant. `dataclasses.replace` returns one that
    is moved, rescaled or of another material.

    Attributes:
        density: of the material [kg/m^3], 1e-9 to 1e9; None if rigid or with an impedance. Complex, with an
            imaginary part >= 0, in a porous material: `porous` computes it, and the sound speed.
        sound_speed: of the material [m/s], 1e-3 to 1e6; None if rigid or with an impedance. Complex, with an
            imaginary part <= 0, in a material that absorbs.
        rigid: True for walls that do not move.
        absorption: of a plane wave in the material at the drive frequency [dB/m], >= 0, instead of complex
            numbers.
        impedance: of the surface, pressure over the velocity into it, as a ratio to density times sound
            speed of the medium, with a real part >= 0; complex where it stores energy too. It is locally
            reacting: no sound travels inside. Its size is 0.01 to 1e6; about 3700 is skin in air.

    Raises:
        ValueError: a value out of range, or one that adds energy; more than one of a material, rigid and an
            impedance, or none of them; an absorption of what is rigid or complex.
    """

    position_field: ClassVar[str] = ""
    """Name of the field (3,) [m] that moves along with the body; empty for a class that is not moved."""

    orientation_field: ClassVar[str | None] = None
    """Name of the field that turns along with the body: "rotation", angles (3,) as of `rotation_matrix`, or
    "axis", a direction (3,). Empty where the shape has no direction; None for a class that is not turned."""

    unit_question: ClassVar[str] = "are its lengths in m, 16 mm as 16e-3?"
    """Question to the user about an obstacle that is far too large."""

    density: complex | None = None
    sound_speed: complex | None = None
    rigid: bool = False
    absorption: float = 0.0
    impedance: complex | None = None

    def __post_init__(self) -> None:
        kind = type(self).__name__
        object.__setattr__(self, "rigid", boolean(f"{kind}.rigid", self.rigid))
        object.__setattr__(self, "absorption", not_negative(f"{kind}.absorption", self.absorption, "dB/m"))
        material = self.density, self.sound_speed
        absent = [entry is None for entry in material]
        if self.impedance is not None:
            if self.rigid or not all(absent):
                accepted = "must have either an impedance, a material or rigid=True, no two of them"
                raise invalid(f"{kind}.impedance", self.impedance, accepted)
            object.__setattr__(self, "impedance", _impedance(f"{kind}.impedance", self.impedance))
        elif self.rigid:
            if not all(absent):
                accepted = "must have either a material or rigid=True, not both"
                raise invalid(f"{kind}.rigid", material, accepted)
        else:
            if any(absent):
                missing = "density" if absent[0] else "sound_speed"
                accepted = "must have both density and sound_speed, or else rigid=True or an impedance"
                raise invalid(f"{kind}.{missing}", None, accepted)
            material = equivalent_fluid(kind, *material)
            object.__setattr__(self, "density", material[0])
            object.__setattr__(self, "sound_speed", material[1])
        if self.absorption and not all(isinstance(entry, float) for entry in material):
            accepted = "must be 0 beside an impedance or complex numbers, which describe all losses"
            if self.rigid:
                accepted = "must be 0: a rigid body absorbs nothing; impedance= describes a surface that does"
            raise invalid(f"{kind}.absorption", self.absorption, accepted, "dB/m")

    @property
    def is_lossy(self) -> bool:
        """True if the obstacle absorbs sound."""
        numbers = (self.density or 0.0, self.sound_speed or 0.0)
        soft = self.impedance is not None and self.impedance.real > 0
        return soft or self.absorption > 0 or any(isinstance(number, complex) for number in numbers)

    def fluid_at(self, frequency: float) -> tuple[complex, complex] | None:
        """Return density [kg/m^3] and sound speed [m/s] at a frequency [Hz], complex where it absorbs.

        None for a rigid body and one with an impedance.
        """
        angular = 2 * math.pi * positive("frequency", frequency, "Hz")
        if self.density is None or self.sound_speed is None:
            return None
        if self.absorption == 0:
            return self.density, self.sound_speed
        return self.density, angular / complex(angular / self.sound_speed.real, self.absorption / DECIBELS)

    @property
    @abstractmethod
    def lower(self) -> Vector:
        """Corner of the bounding box with the smallest coordinates (3,) [m]."""

    @property
    @abstractmethod
    def upper(self) -> Vector:
        """Corner of the bounding box with the largest coordinates (3,) [m]."""

    @property
    def fills_bounds(self) -> bool:
        """True if the obstacle is all of its bounding box, such as a wall along the axes."""
        return False

    @property
    def has_unsure_units(self) -> bool:
        """True if the numbers are those of a file or a surface, which may not be in m."""
        return False

    @property
    def uncertainty(self) -> float:
        """Distance [m] by which the surface may be off (rms); 0 where it is exact."""
        return 0.0

    @abstractmethod
    def surface(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return vertices (V, 3) [m], float64, and triangles of their indices (F, 3), int64.

        Triangles are counter-clockwise as seen from outside.
        """

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
        near = self.near(points, margin)  # distances to meshes are slow
        inside = torch.zeros_like(near)
        inside[near] = self._inside(points[near], margin)
        return inside

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

    def farthest(self, center: torch.Tensor) -> float:
        """Return the distance [m] of the farthest point of the surface from a point (3,) [m]."""
        return float((self.surface()[0] - center).norm(dim=1).max())

    def at(self, position: Vector) -> Self:
        """Return the obstacle with another value (3,) [m] of its `position_field`."""
        field: dict[str, Any] = {self.position_field: position}
        return replace(self, **field)

    def filled(self) -> Self:
        """Return the obstacle without its cavities, which no sound enters if it is rigid."""
        return self

    @classmethod
    def maker(cls) -> Callable[..., Obstacle]:
        """Return the function whose arguments are the keys of an obstacle's section in a scene file."""
        return cls

    def section(self, name: str) -> dict[str, Any]:
        """Return the section of the obstacle in a scene file, without defaults; `name` is of `write_file`."""
        defaults = {key: entry.default for key, entry in inspect.signature(self.maker()).parameters.items()}
        values = {key: getattr(self, key, default) for key, default in defaults.items()}
        return {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in values.items()
            if value != defaults[key]
        }

    def write_file(self, path: Path) -> None:  # noqa: B027 (most obstacles need no file)
        """Write what is too large for a section to a file of this path, to which a suffix is added."""

    def _inside(self, points: torch.Tensor, margin: float) -> torch.Tensor:
        return self._distance(points) < margin

    @abstractmethod
    def _distance(self, points: torch.Tensor) -> torch.Tensor:
        """Return the signed distances (N,) [m] of checked `points` (N, 3) [m]."""


def inside_any(points: torch.Tensor, obstacles: Iterable[Obstacle]) -> torch.Tensor:
    """Return whether each of the points (..., 3) [m] is inside an obstacle, bool (...)."""
    inside = torch.zeros(points.shape[:-1], dtype=torch.bool, device=points.device)
    for obstacle in obstacles:
        inside |= obstacle.contains(points)
    return inside


def overlap(obstacle: Obstacle, other: Obstacle) -> bool:
    """Return whether one of 16^3 points of their bounding boxes' intersection is inside two obstacles."""
    shared = shared_box((obstacle.lower, obstacle.upper), (other.lower, other.upper))
    if shared is None:
        return False
    lower, upper = shared
    share = (torch.arange(_SAMPLES, **REAL) + 0.5) / _SAMPLES
    points = lower + (upper - lower) * torch.cartesian_prod(share, share, share)
    inside = [body.signed_distance(points) < -LENGTH_TOLERANCE for body in (obstacle, other)]
    return bool((inside[0] & inside[1]).any())


def shared_box(
    box: tuple[Vector, Vector], other: tuple[Vector, Vector]
) -> tuple[torch.Tensor, torch.Tensor] | None:
    """Return the corners of the intersection of two boxes (lower, upper); None if they at most touch."""
    corners = torch.tensor([box, other], **REAL)
    lower, upper = corners[:, 0].amax(dim=0), corners[:, 1].amin(dim=0)
    return (lower, upper) if (upper - lower).min() > LENGTH_TOLERANCE else None


def _impedance(name: str, value: object) -> complex:
    impedance = passive_impedance(name, value)
    least, most = _IMPEDANCES
    if not least <= abs(impedance) <= most:
        ratio = "density times sound speed of the medium, some 413 Pa s/m in air"
        raise invalid(name, value, f"must have a size of {least:g} to {most:g}, as a ratio to {ratio}")
    return impedance


def _points(values: ArrayLike) -> torch.Tensor:
    points = real_tensor("points", values, "m")
    if points.ndim == 0 or points.shape[-1] != 3:
        raise ValueError(f"points: shape {tuple(points.shape)}; must be (..., 3)")
    return points
