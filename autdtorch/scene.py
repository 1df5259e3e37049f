"""The scene: medium, obstacles, control points and the array, checked once and then constant."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch

from autdtorch import air
from autdtorch.array import TransducerArray
from autdtorch.geometry import Plane
from autdtorch.validation import (
    LENGTH_TOLERANCE,
    ArrayLike,
    Vector,
    distances,
    finite_vector,
    invalid,
    not_negative,
    points_tensor,
    positive,
    positive_entries,
    real_tensor,
    require_distinct,
)

_DEFAULT_MARGIN = 2.0  # wavelengths of air on each side of everything, where no domain is given

_DECIBELS = 20 / math.log(10)  # of a neper

_MOST_ABSORPTION = 3.0  # dB per wavelength: absorption is to be a small part of the wavenumber


@dataclass(frozen=True)
class Medium:
    """A uniform fluid.

    Attributes:
        density: [kg/m^3], > 0.
        sound_speed: [m/s], > 0.
        absorption: of a plane wave at the frequency of the drive [dB/m], >= 0.

    Raises:
        ValueError: an attribute is not finite or out of range.
    """

    density: float
    sound_speed: float
    absorption: float = 0.0

    def __post_init__(self) -> None:
        """Check the attributes."""
        object.__setattr__(self, "density", positive("Medium.density", self.density, "kg/m^3"))
        object.__setattr__(self, "sound_speed", positive("Medium.sound_speed", self.sound_speed, "m/s"))
        object.__setattr__(self, "absorption", not_negative("Medium.absorption", self.absorption, "dB/m"))

    @classmethod
    def air(
        cls,
        temperature: float = 20.0,
        relative_humidity: float = 50.0,
        pressure: float = 101325.0,
        frequency: float = 40e3,
    ) -> Medium:
        """Humid air: an ideal gas that absorbs by ISO 9613-1:1993; `autdtorch.air` says how accurate that is.

        Args:
            temperature: [deg C], -20 to 50.
            relative_humidity: [%], 0 to 100.
            pressure: ambient [Pa], 50e3 to 200e3.
            frequency: of the drive, for the absorption [Hz]; 4e-4 to 10 times the pressure in Pa.

        Raises:
            ValueError: an argument is not a number in its range.
        """
        density, sound_speed = air.density_and_sound_speed(temperature, relative_humidity, pressure)
        absorption = air.absorption(temperature, relative_humidity, pressure, frequency)
        return cls(density, sound_speed, absorption)


@dataclass(frozen=True)
class Box:
    """A cuboid obstacle with edges along the axes: either of a fluid material, or rigid.

    Attributes:
        center: centre (3,) [m].
        size: edge lengths (3,) [m], > 0.
        density: of the material [kg/m^3], > 0; None if rigid.
        sound_speed: of the material [m/s], > 0; None if rigid.
        rigid: True for walls that do not move.

    Raises:
        ValueError: an attribute is not finite, has the wrong shape or is out of range; or both a material and
            rigid, or neither.
    """

    center: Vector
    size: Vector
    density: float | None = None
    sound_speed: float | None = None
    rigid: bool = False

    def __post_init__(self) -> None:
        """Check the attributes and bring them into canonical form."""
        object.__setattr__(self, "center", finite_vector("Box.center", self.center))
        object.__setattr__(self, "size", positive_entries("Box.size", self.size, 3))
        if not isinstance(self.rigid, bool):
            raise invalid("Box.rigid", self.rigid, "must be true or false")
        if self.rigid:
            if self.density is not None or self.sound_speed is not None:
                material = (self.density, self.sound_speed)
                raise invalid("Box.rigid", material, "must have either a material or rigid=True, not both")
            return
        if self.density is None or self.sound_speed is None:
            missing = "density" if self.density is None else "sound_speed"
            raise invalid(f"Box.{missing}", None, "must have both density and sound_speed, or rigid=True")
        object.__setattr__(self, "density", positive("Box.density", self.density, "kg/m^3"))
        object.__setattr__(self, "sound_speed", positive("Box.sound_speed", self.sound_speed, "m/s"))

    @property
    def lower(self) -> Vector:
        """Corner with the smallest coordinates (3,) [m]."""
        return _shifted(self.center, self.size, -0.5)

    @property
    def upper(self) -> Vector:
        """Corner with the largest coordinates (3,) [m]."""
        return _shifted(self.center, self.size, 0.5)

    def contains(self, points: ArrayLike, margin: float = 0.0) -> torch.Tensor:
        """Which points lie in lower - margin <= r < upper + margin: boxes face to face share no point.

        Args:
            points: (..., 3) [m].
            margin: by how much the box is grown on every side [m].

        Returns:
            bool (...).

        Raises:
            ValueError: `points` are not finite real numbers or have another last axis.
        """
        points = real_tensor("points", points, "m")
        if points.ndim == 0 or points.shape[-1] != 3:
            raise ValueError(f"points: shape {tuple(points.shape)}; must be (..., 3)")
        lower, upper = points.new_tensor(self.lower), points.new_tensor(self.upper)
        return ((points >= lower - margin) & (points < upper + margin)).all(dim=-1)


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Scene:
    """All that determines a field. The tensors are the scene's own copies, on the CPU.

    Attributes:
        array: the transducers.
        medium: what surrounds the obstacles.
        frequency: [Hz], > 0.
        control_points: (P, 3) [m], float64, where pressure is observed; all different.
        obstacles: may touch, may not overlap.
        observation_plane: where pictures and areas are taken, or None.
        domain: corners (lower, upper) [m] of the space that holds everything.
        name: for titles and file names.
    """

    array: TransducerArray
    medium: Medium
    frequency: float
    control_points: torch.Tensor
    obstacles: tuple[Box, ...]
    observation_plane: Plane | None
    domain: tuple[Vector, Vector]
    name: str

    def __init__(
        self,
        array: TransducerArray,
        medium: Medium,
        frequency: float,
        control_points: ArrayLike,
        obstacles: Iterable[Box] = (),
        observation_plane: Plane | None = None,
        domain: ArrayLike | None = None,
        name: str = "scene",
    ) -> None:
        """Check and copy the input.

        Args:
            array: the transducers, outside the obstacles.
            medium: what surrounds the obstacles.
            frequency: [Hz], > 0.
            control_points: (P, 3) [m], P >= 1, outside the obstacles.
            obstacles: may touch, may not overlap.
            observation_plane: where pictures and areas are taken.
            domain: corners (lower, upper) [m] around array, control points, obstacles and observation plane.
                By default their bounding box and two wavelengths more on each side.
            name: for titles and file names.

        Raises:
            ValueError: a field of the wrong type or out of range, a transducer or control point in or on an
                obstacle, two points in one place, overlapping obstacles, something outside the domain, or a
                medium that absorbs more than 3 dB per wavelength.
        """
        _require_type("Scene.array", array, TransducerArray)
        _require_type("Scene.medium", medium, Medium)
        if observation_plane is not None:
            _require_type("Scene.observation_plane", observation_plane, Plane)
        if not isinstance(name, str) or not name:
            raise invalid("Scene.name", name, "must be text of at least one character")
        object.__setattr__(self, "array", array)
        object.__setattr__(self, "medium", medium)
        object.__setattr__(self, "frequency", positive("Scene.frequency", frequency, "Hz"))
        points = points_tensor("Scene.control_points", control_points).cpu()
        object.__setattr__(self, "control_points", points)
        object.__setattr__(self, "obstacles", _obstacles(obstacles))
        object.__setattr__(self, "observation_plane", observation_plane)
        object.__setattr__(self, "name", name)
        object.__setattr__(self, "domain", self._bounds() if domain is None else _corners(domain))
        _require_propagating(self)
        _require_separate_points(self)
        _require_separate_obstacles(self.obstacles)
        _require_in_domain(self)

    @property
    def angular_frequency(self) -> float:
        """Of the drive, 2 pi f [rad/s]."""
        return 2 * math.pi * self.frequency

    @property
    def wavenumber(self) -> float:
        """In the medium, k = 2 pi f / c [rad/m]."""
        return self.angular_frequency / self.medium.sound_speed

    @property
    def attenuation(self) -> float:
        """In the medium, alpha [Np/m]: a plane wave falls as e^{-alpha x}."""
        return self.medium.absorption / _DECIBELS

    @property
    def complex_wavenumber(self) -> complex:
        """In the medium, k + i alpha [rad/m]: a plane wave is e^{i (k + i alpha) x}."""
        return complex(self.wavenumber, self.attenuation)

    @property
    def wavelength(self) -> float:
        """In the medium, c / f [m]."""
        return self.medium.sound_speed / self.frequency

    def __repr__(self) -> str:
        """Name, frequency, counts and extent, with units."""
        lower, upper = self.domain
        extent = " x ".join(f"{1e3 * (high - low):.4g}" for low, high in zip(lower, upper, strict=True))
        return (
            f"Scene({self.name!r}, {self.frequency / 1e3:.4g} kHz, "
            f"wavelength {1e3 * self.wavelength:.4g} mm, {len(self.array)} transducers, "
            f"{len(self.control_points)} control points, {len(self.obstacles)} obstacles, domain {extent} mm)"
        )

    def _bounds(self) -> tuple[Vector, Vector]:
        points = torch.cat([points for _, points in _contents(self)])
        margin = _DEFAULT_MARGIN * self.wavelength
        return _corners(torch.stack([points.amin(dim=0) - margin, points.amax(dim=0) + margin]))


def _shifted(center: Vector, size: Vector, share: float) -> Vector:
    x, y, z = (middle + share * length for middle, length in zip(center, size, strict=True))
    return x, y, z


def _require_type(name: str, value: object, kind: type) -> None:
    if not isinstance(value, kind):
        raise invalid(name, value, f"must be a {kind.__name__}")


def _obstacles(given: Iterable[Box]) -> tuple[Box, ...]:
    if not isinstance(given, Iterable):
        raise invalid("Scene.obstacles", given, "must be a sequence of obstacles")
    obstacles = tuple(given)
    for index, obstacle in enumerate(obstacles):
        _require_type(f"Scene.obstacles[{index}]", obstacle, Box)
    return obstacles


def _corners(domain: ArrayLike) -> tuple[Vector, Vector]:
    corners = real_tensor("Scene.domain", domain, "m")
    if corners.shape != (2, 3):
        raise invalid("Scene.domain", domain, "must be two corners (lower, upper) of three numbers each [m]")
    lower, upper = (finite_vector("Scene.domain", corner) for corner in corners)
    if not all(low < high for low, high in zip(lower, upper, strict=True)):
        raise invalid("Scene.domain", (lower, upper), "lower must be below upper on every axis", "m")
    return lower, upper


def _points(scene: Scene) -> dict[str, torch.Tensor]:
    return {"Scene.array.positions": scene.array.positions, "Scene.control_points": scene.control_points}


def _require_propagating(scene: Scene) -> None:
    most = _MOST_ABSORPTION / scene.wavelength
    if scene.medium.absorption > most:
        accepted = f"must be at most {most:.4g} dB/m, {_MOST_ABSORPTION:g} dB per wavelength"
        raise invalid("Scene.medium.absorption", scene.medium.absorption, accepted, "dB/m")


def _contents(scene: Scene) -> list[tuple[str, torch.Tensor]]:
    """Everything the domain must hold: names, and points (N, 3) [m] that span it."""
    contents = list(_points(scene).items())
    positions, reach = scene.array.positions, scene.array.half_extents
    contents += [("Scene.array disc's lower edge", positions - reach)]
    contents += [("Scene.array disc's upper edge", positions + reach)]
    for index, box in enumerate(scene.obstacles):
        corners = torch.tensor([box.lower, box.upper], dtype=torch.float64)
        contents.append((f"Scene.obstacles[{index}] corner", corners))
    if scene.observation_plane is not None:
        contents.append(("Scene.observation_plane corner", scene.observation_plane.corners))
    return contents


def _require_separate_points(scene: Scene) -> None:
    """No two points in one place, none in an obstacle or on it, where rounding would choose the side."""
    require_distinct("Scene.control_points", scene.control_points)
    nodes = scene.array.nodes.positions
    gap = distances(scene.control_points, nodes.reshape(-1, 3)).reshape(-1, *nodes.shape[:2]).amin(dim=2)
    if gap.min() < LENGTH_TOLERANCE:
        point, transducer = divmod(int(gap.argmin()), len(scene.array))
        raise invalid(
            f"Scene.control_points[{point}]",
            scene.control_points[point],
            f"lies on transducer {transducer}, must be at least {LENGTH_TOLERANCE:g} m away",
            "m",
        )
    for name, group in (_points(scene) | {"Scene.array.nodes": nodes}).items():
        for index, box in enumerate(scene.obstacles):
            inside = box.contains(group, margin=LENGTH_TOLERANCE)
            if inside.any():
                first = tuple(inside.nonzero()[0].tolist())
                accepted = f"lies in or on obstacle {index}, {box.lower} to {box.upper} m, must be outside it"
                raise invalid(f"{name}{list(first)}", group[first], accepted, "m")


def _require_separate_obstacles(obstacles: tuple[Box, ...]) -> None:
    for index, box in enumerate(obstacles):
        for other_index, other in enumerate(obstacles[:index]):
            depth = min(
                min(box.upper[axis], other.upper[axis]) - max(box.lower[axis], other.lower[axis])
                for axis in range(3)
            )
            if depth > LENGTH_TOLERANCE:
                accepted = f"overlaps obstacle {other_index} by {depth:g} m, may touch it but not overlap"
                raise invalid(f"Scene.obstacles[{index}]", box, accepted)


def require_inside(domain: tuple[Vector, Vector], name: str, points: torch.Tensor) -> None:
    """Refuse points (N, 3) [m] outside the corners (lower, upper) of a domain.

    Raises:
        ValueError: names the first point outside, as an entry of `name`.
    """
    lower, upper = (torch.tensor(corner, dtype=torch.float64) for corner in domain)
    outside = ((points < lower - LENGTH_TOLERANCE) | (points > upper + LENGTH_TOLERANCE)).any(dim=-1)
    if outside.any():
        first = int(outside.nonzero()[0, 0])
        accepted = f"must be inside the domain, {domain[0]} to {domain[1]} m"
        raise invalid(f"{name}[{first}]", points[first], accepted, "m")


def _require_in_domain(scene: Scene) -> None:
    for name, points in _contents(scene):
        require_inside(scene.domain, name, points)
