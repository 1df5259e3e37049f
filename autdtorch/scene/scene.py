"""The scene: array, medium, obstacles and control points, checked once and then constant."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

import torch

from autdtorch.scene.arrays import TransducerArray, phase_offsets_of, radii_of, strengths_of, strengths_text
from autdtorch.scene.geometry import Coordinates, Plane
from autdtorch.scene.medium import Medium as Medium
from autdtorch.scene.obstacles import Obstacle
from autdtorch.scene.obstacles.base import overlap, shared_box
from autdtorch.scene.obstacles.moving import moved
from autdtorch.scene.plausibility import extent_of, unit_hint, warn_of_implausible
from autdtorch.scene.reflectors import Reflector, kinds_of, require_arrangement
from autdtorch.utils.array_types import REAL
from autdtorch.utils.hints import suggesting
from autdtorch.utils.images import Image, images_of
from autdtorch.utils.process import cached_property
from autdtorch.utils.spatial import require_distinct
from autdtorch.utils.text import counted, html_facts
from autdtorch.utils.units import DECIBELS, angles, warn_user
from autdtorch.utils.units import ScaleWarning as ScaleWarning
from autdtorch.utils.validation import (
    LENGTH_TOLERANCE,
    ArrayLike,
    Vector,
    finite_vector,
    invalid,
    members,
    number_between,
    points_tensor,
    positive,
    real_tensor,
    require_kind,
)

_DEFAULT_MARGIN = 2.0  # [wavelengths] of air on each side, by default
_FARTHEST = 1e6  # [m] along an axis; far beyond any simulation, and volumes do not overflow
_FREQUENCIES = 1e-3, 1e12  # [Hz]
_LOWEST = 1000.0  # [Hz], below which a frequency may be in kHz
_MOST_ABSORPTION = 3.0  # [dB per wavelength]: the model assumes a small imaginary part of the wavenumber
_MOST_OF_OBSTACLE = 27.0  # [dB per wavelength], an imaginary part of half the wavenumber
_AT_ONCE = 1_000_000  # pairs of a point and a transducer whose distances are in memory at once


class OverlapWarning(UserWarning):
    """Two obstacles of different materials overlap."""


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Scene:
    """The description of a field: array, medium, frequency, obstacles and points of observation.

    The tensors are copies on the CPU. No coordinate may exceed 1e6 m.

    Attributes:
        array: the transducers.
        medium: the fluid around the obstacles.
        frequency: [Hz], 1e-3 to 1e12.
        control_points: (P, 3) [m], float64, P >= 1, where the pressure is observed; all different.
        obstacles: may touch and overlap; in an overlap the later one counts.
        observation_plane: plane of pictures and focal areas, or None.
        domain: corners (lower, upper) [m] of the simulated space; obstacles may extend beyond it.
        name: for titles and file names.
        reflectors: planes that reflect everything in front of them.
    """

    array: TransducerArray
    medium: Medium
    frequency: float
    control_points: torch.Tensor
    obstacles: tuple[Obstacle, ...]
    observation_plane: Plane | None
    domain: tuple[Vector, Vector]
    name: str
    reflectors: tuple[Reflector, ...]

    def __init__(
        self,
        array: TransducerArray,
        medium: Medium,
        frequency: float,
        control_points: ArrayLike,
        obstacles: Iterable[Obstacle] = (),
        observation_plane: Plane | None = None,
        domain: ArrayLike | None = None,
        name: str = "scene",
        reflectors: Iterable[Reflector] = (),
    ) -> None:
        """Check and copy the input; the arguments are the attributes, see `Scene`.

        Array and control points lie outside the obstacles. The domain, two corners (2, 3) [m], holds array,
        control points and observation plane. Walls and slabs across it extend to infinity; for other
        obstacles that leave it, see the methods of `make_propagator`. By default it is the bounding box of
        everything, with a margin of two wavelengths on each side.

        Array, control points and observation plane lie in front of all reflectors, or in them; obstacles are
        cut at them.

        Raises:
            ValueError: a field of the wrong type or out of range, or a coordinate beyond 1e6 m. Also a point
                in or on an obstacle, coincident with another or outside the domain, or a medium that absorbs
                more than 3 dB per wavelength, or an obstacle more than 27; or
                something behind a reflector, or reflectors that are neither at right angles nor facing each
                other, a wavelength apart.

        Warns:
            OverlapWarning: two obstacles of different materials overlap.
            ScaleWarning: lengths, or the file of a mesh, seem to be in mm, or the frequency in kHz; all
                control points and obstacles lie behind the array; or `Medium.air` was made for another
                frequency.
        """
        require_kind("Scene.array", array, TransducerArray)
        require_kind("Scene.medium", medium, Medium)
        if observation_plane is not None:
            require_kind("Scene.observation_plane", observation_plane, Plane)
        if not isinstance(name, str) or not name:
            raise invalid("Scene.name", name, "must be text of at least one character")
        object.__setattr__(self, "array", array)
        object.__setattr__(self, "medium", medium)
        positive("Scene.frequency", frequency, "Hz")
        frequency = number_between("Scene.frequency", frequency, *_FREQUENCIES, "Hz")
        object.__setattr__(self, "frequency", frequency)
        points = points_tensor("Scene.control_points", control_points).cpu()
        object.__setattr__(self, "control_points", points.as_subclass(Coordinates))
        object.__setattr__(self, "obstacles", members("Scene.obstacles", obstacles, Obstacle))
        object.__setattr__(self, "observation_plane", observation_plane)
        object.__setattr__(self, "name", name)
        for field, places in _everything(self):
            _require_within(field, places)
        object.__setattr__(self, "domain", self._bounds() if domain is None else _corners(domain))
        most = _MOST_ABSORPTION / self.wavelength
        if medium.absorption > most:
            accepted = f"must be at most {most:.4g} dB/m, {_MOST_ABSORPTION:g} dB per wavelength"
            if self.frequency < _LOWEST:
                accepted += f"; is the frequency, {self.frequency:g}, in Hz, 40 kHz as 40e3?"
            raise invalid("Scene.medium.absorption", medium.absorption, accepted, "dB/m")
        _require_waves_inside(self)
        object.__setattr__(self, "reflectors", members("Scene.reflectors", reflectors, Reflector))
        require_arrangement(self.reflectors, self.complex_wavenumber)
        _require_in_front(self)
        _require_separate_points(self)
        _require_in_domain(self)
        _warn_of_overlaps(self.obstacles)
        warn_of_implausible(self)

    @suggesting
    def moved(
        self,
        offset: ArrayLike = (0.0, 0.0, 0.0),
        rotation: ArrayLike = (0.0, 0.0, 0.0),
        *,
        rotation_degrees: ArrayLike | None = None,
    ) -> Scene:
        """Return the scene with all obstacles shifted, and turned as one body.

        They turn about the centre of the sphere around them, as those of a `TMatrix`.

        Args:
            offset: (3,) [m].
            rotation: angles (3,) [rad] about the fixed axes x, y, z, in this order.
            rotation_degrees: these angles (3,) in degrees, in place of `rotation`.

        Raises:
            ValueError: an obstacle then holds a transducer or control point, or is of a kind that cannot be
                moved; a `VoxelMask` cannot be turned.
        """
        shift = torch.tensor(finite_vector("offset", offset), **REAL)
        turn = angles("rotation", rotation, rotation_degrees)
        return replace(self, obstacles=moved(self.obstacles, shift, turn))

    def equals(self, other: Scene) -> bool:
        """Return whether another scene describes the same field at the same points, whatever its name."""
        require_kind("other", other, Scene)
        if self is other:
            return True
        alike = ("medium", "frequency", "obstacles", "observation_plane", "domain", "reflectors")
        array, theirs = self.array, other.array
        return (
            all(getattr(self, name) == getattr(other, name) for name in alike)
            and torch.equal(self.control_points, other.control_points)
            and torch.equal(array.positions, theirs.positions)
            and torch.equal(array.normals, theirs.normals)
            and torch.equal(strengths_of(array), strengths_of(theirs))
            and torch.equal(radii_of(array), radii_of(theirs))
            and torch.equal(phase_offsets_of(array), phase_offsets_of(theirs))
        )

    @property
    def angular_frequency(self) -> float:
        """Angular frequency of the drive, 2 pi f [rad/s]."""
        return 2 * math.pi * self.frequency

    @property
    def wavenumber(self) -> float:
        """Wavenumber in the medium, k = 2 pi f / c [rad/m]."""
        return self.angular_frequency / self.medium.sound_speed

    @property
    def attenuation(self) -> float:
        """Attenuation in the medium, alpha [Np/m]: a plane wave decays as e^{-alpha x}."""
        return self.medium.absorption / DECIBELS

    @property
    def complex_wavenumber(self) -> complex:
        """Complex wavenumber in the medium, k + i alpha [rad/m]: a plane wave is e^{i (k + i alpha) x}."""
        return complex(self.wavenumber, self.attenuation)

    @property
    def wavelength(self) -> float:
        """Wavelength in the medium, c / f [m]."""
        return self.medium.sound_speed / self.frequency

    @cached_property
    def images(self) -> tuple[Image, ...]:
        """The images of the space in the reflectors, the space itself first."""
        size = float((torch.tensor(self.domain[1], **REAL) - torch.tensor(self.domain[0], **REAL)).norm())
        return images_of([one.mirror for one in self.reflectors], self.complex_wavenumber, size)

    def __repr__(self) -> str:
        """Return name, frequency, counts and extent, with units."""
        wave = f"{self.frequency / 1e3:.4g} kHz, wavelength {1e3 * self.wavelength:.4g} mm"
        points = counted(len(self.control_points), "control point")
        counts = f"{counted(len(self.array), 'transducer')}, {points}"
        space = f"{counted(len(self.obstacles), 'obstacle')}, domain {self._size()} mm"
        if self.reflectors:
            space = f"{counted(len(self.reflectors), 'reflector')}, {space}"
        return f"Scene({self.name!r}, {wave}, {counts}, {space})"

    def _repr_html_(self) -> str:
        """Return a table of the scene's contents, for Jupyter."""
        medium = self.medium
        fluid = f"{medium.density:.4g} kg/m³, {medium.sound_speed:.4g} m/s"
        facts = [
            ("frequency", f"{self.frequency / 1e3:.4g} kHz, wavelength {1e3 * self.wavelength:.4g} mm"),
            ("medium", f"{fluid}, {medium.absorption:.3g} dB/m"),
            ("transducers", f"{len(self.array)}, of source strength {strengths_text(self.array)}"),
            ("control points", str(len(self.control_points))),
            ("obstacles", ", ".join(obstacle_kinds(self.obstacles)) or "none"),
            ("reflectors", ", ".join(kinds_of(self.reflectors)) or "none"),
            ("domain", f"{self._size()} mm, {self._size(self.wavelength, 3)} wavelengths"),
        ]
        return html_facts(f"Scene {self.name!r}", facts)

    def _size(self, unit: float = 1e-3, digits: int = 4) -> str:
        """Return the edges of the domain as text, in multiples of `unit` [m]."""
        lower, upper = self.domain
        return " x ".join(f"{(high - low) / unit:.{digits}g}" for low, high in zip(lower, upper, strict=True))

    def _bounds(self) -> tuple[Vector, Vector]:
        points = torch.cat([points for _, points in _everything(self)])
        margin = _DEFAULT_MARGIN * self.wavelength
        return _corners(torch.stack([points.amin(dim=0) - margin, points.amax(dim=0) + margin]))


def obstacle_kinds(obstacles: tuple[Obstacle, ...]) -> list[str]:
    """Return the number of obstacles of each kind and material as texts."""
    counts = Counter(f"{type(obstacle).__name__} ({_material(obstacle)})" for obstacle in obstacles)
    return [f"{count} x {kind}" for kind, count in counts.items()]


def _material(obstacle: Obstacle) -> str:
    if obstacle.impedance is not None:
        return f"impedance {obstacle.impedance:.4g}"
    if obstacle.rigid:
        return "rigid"
    absorption = f", {obstacle.absorption:.3g} dB/m" if obstacle.absorption else ""
    return f"{obstacle.density:.4g} kg/m³, {obstacle.sound_speed:.4g} m/s{absorption}"


def _corners(domain: ArrayLike) -> tuple[Vector, Vector]:
    corners = real_tensor("Scene.domain", domain, "m")
    if corners.shape != (2, 3):
        raise invalid("Scene.domain", domain, "must be two corners (lower, upper) of three numbers each [m]")
    lower, upper = (finite_vector("Scene.domain", corner) for corner in corners)
    if not all(low < high for low, high in zip(lower, upper, strict=True)):
        raise invalid("Scene.domain", (lower, upper), "lower must be below upper on every axis", "m")
    _require_within("Scene.domain", corners)
    return lower, upper


def _contents(scene: Scene) -> list[tuple[str, torch.Tensor]]:
    """Return names and points (N, 3) [m] of everything that must be inside the domain."""
    positions, reach = scene.array.positions, scene.array.half_extents
    contents = [
        ("Scene.array.positions", positions),
        ("Scene.control_points", scene.control_points),
        ("Scene.array disc's lower edge", positions - reach),
        ("Scene.array disc's upper edge", positions + reach),
    ]
    if scene.observation_plane is not None:
        contents.append(("Scene.observation_plane corner", scene.observation_plane.corners))
    return contents


def _everything(scene: Scene) -> list[tuple[str, torch.Tensor]]:
    """Return names and points (N, 3) [m] of the contents and of the obstacles' bounding boxes."""
    bounds = [
        (f"Scene.obstacles[{index}] corner", scene.control_points.new_tensor([body.lower, body.upper]))
        for index, body in enumerate(scene.obstacles)
    ]
    return _contents(scene) + bounds


def _require_within(name: str, points: torch.Tensor) -> None:
    far = ~(points.abs() <= _FARTHEST).all(dim=-1)
    if far.any():
        first = points[far][0].detach()
        raise invalid(name, first, f"every coordinate must be in {-_FARTHEST:g} to {_FARTHEST:g}", "m")


def _require_waves_inside(scene: Scene) -> None:
    """Refuse absorptions that leave no wave in an obstacle, which an impedance describes better."""
    for index, obstacle in enumerate(scene.obstacles):
        if obstacle.absorption and obstacle.sound_speed is not None:
            most = _MOST_OF_OBSTACLE * scene.frequency / obstacle.sound_speed.real
            if obstacle.absorption > most:
                accepted = f"must be at most {most:.4g} dB/m, {_MOST_OF_OBSTACLE:g} dB per wavelength inside"
                accepted += "; porous() and impedance= describe what absorbs more"
                raise invalid(f"Scene.obstacles[{index}].absorption", obstacle.absorption, accepted, "dB/m")


def _require_in_front(scene: Scene) -> None:
    """Refuse what lies behind a reflector; obstacles that cross one are cut."""
    if not scene.reflectors:
        return
    contents = [*_contents(scene)[:2], ("Scene.array.nodes", scene.array.nodes.positions.reshape(-1, 3))]
    if scene.observation_plane is not None:
        contents.append(("Scene.observation_plane corner", scene.observation_plane.corners))
    for number, reflector in enumerate(scene.reflectors):
        for name, places in contents:
            require_in_front([reflector], name, places, number)
        for index, obstacle in enumerate(scene.obstacles):
            highest = float(reflector.mirror.height(obstacle.surface()[0]).max())
            if highest <= LENGTH_TOLERANCE:
                accepted = f"is wholly behind reflector {number}, must be in front of it, at least in part"
                raise ValueError(f"Scene.obstacles[{index}]: {extent_of(obstacle)}; {accepted}")


def require_in_front(
    reflectors: Sequence[Reflector], name: str, points: torch.Tensor, first_number: int = 0
) -> None:
    """Refuse points (N, 3) [m] behind a reflector."""
    for number, reflector in enumerate(reflectors, first_number):
        height = reflector.mirror.height(points)
        if (height < -LENGTH_TOLERANCE).any():
            lowest = int(height.argmin())
            accepted = f"is {-1e3 * float(height[lowest]):.4g} mm behind reflector {number}"
            accepted += ", must be in front of it"
            if (height < 0).all():
                accepted += "; its normal points into the space that is simulated"
            raise invalid(f"{name}[{lowest}]", points[lowest], accepted, "m")


def _require_separate_points(scene: Scene) -> None:
    """Refuse coincident points and points in or on an obstacle; on it, rounding would choose the side."""
    require_distinct("Scene.control_points", scene.control_points)
    array, points = scene.array, scene.control_points
    require_clear(array, "Scene.control_points", points)
    groups = {"array.positions": array.positions, "control_points": points}
    radius = float(radii_of(array).max())
    if any(obstacle.near(array.positions, radius).any() for obstacle in scene.obstacles):
        groups["array.nodes"] = array.nodes[0]
    for name, group in groups.items():
        for index, obstacle in enumerate(scene.obstacles):
            if _is_of_medium(scene, obstacle):
                continue
            inside = obstacle.contains(group, margin=LENGTH_TOLERANCE)
            if inside.any():
                inside &= ~_in_later_medium(scene, index, group)
            if inside.any():
                first = tuple(inside.nonzero()[0].tolist())
                accepted = f"lies in or on obstacle {index}, {extent_of(obstacle)}, must be outside it"
                accepted += unit_hint(scene, obstacle)
                raise invalid(f"Scene.{name}{list(first)}", group[first], accepted, "m")


def _is_of_medium(scene: Scene, obstacle: Obstacle) -> bool:
    """Return whether an obstacle is of the medium's material: it cuts earlier ones, and hides no point."""
    material = obstacle.density, obstacle.sound_speed, obstacle.absorption
    return material == (scene.medium.density, scene.medium.sound_speed, 0.0)


def _in_later_medium(scene: Scene, index: int, points: torch.Tensor) -> torch.Tensor:
    """Return whether points (..., 3) are within an obstacle of the medium's material that follows `index`."""
    cleared = torch.zeros(points.shape[:-1], dtype=torch.bool, device="cpu")
    for later in scene.obstacles[index + 1 :]:
        if _is_of_medium(scene, later):
            cleared |= later.signed_distance(points) < -LENGTH_TOLERANCE
    return cleared


def _warn_of_overlaps(obstacles: tuple[Obstacle, ...]) -> None:
    """Warn of overlapping pairs of different material, where the order of the list matters."""
    material = attrgetter("density", "sound_speed", "rigid", "absorption", "impedance")
    pairs = [
        f"{index} overlaps {earlier}"
        for index, obstacle in enumerate(obstacles)
        for earlier, other in enumerate(obstacles[:index])
        if material(obstacle) != material(other) and overlap(obstacle, other)
    ]
    if pairs:
        text = f"{', '.join(pairs)}, of another material; where both are, the later counts"
        warn_user(f"Scene.obstacles: {text}", OverlapWarning)


def require_clear(array: TransducerArray, name: str, points: torch.Tensor) -> None:
    """Refuse points (N, 3) [m] on a transducer."""
    reach = radii_of(array)[:, None]
    axes = torch.cat([torch.eye(3, **REAL), array.normals[:1]])  # flat arrays are thin along their normal
    half = reach * (1 - (array.normals @ axes.mT) ** 2).clamp(min=0).sqrt() + LENGTH_TOLERANCE
    centers, along = array.positions @ axes.mT, points.cpu() @ axes.mT
    near = (along >= (centers - half).amin(dim=0)) & (along <= (centers + half).amax(dim=0))
    for some in torch.split(near.all(dim=1).nonzero()[:, 0], 1 + _AT_ONCE // len(array)):
        between = points[some].cpu()[:, None] - array.positions
        height = (between * array.normals).sum(dim=-1).abs()
        on = (height < LENGTH_TOLERANCE) & (between.norm(dim=-1) < reach[:, 0] + LENGTH_TOLERANCE)
        if on.any():
            row, transducer = on.nonzero()[0].tolist()
            accepted = f"lies on transducer {transducer}, must be at least {LENGTH_TOLERANCE:g} m away"
            raise invalid(f"{name}[{int(some[row])}]", points[some[row]], accepted, "m")


def require_inside(domain: tuple[Vector, Vector], name: str, points: torch.Tensor, fix: str = "") -> None:
    """Refuse points (N, 3) [m] outside the corners (lower, upper) of a domain; `fix` says what would help."""
    lower, upper = (torch.tensor(corner, **REAL) for corner in domain)
    outside = ((points < lower - LENGTH_TOLERANCE) | (points > upper + LENGTH_TOLERANCE)).any(dim=-1)
    if outside.any():
        first = int(outside.nonzero()[0, 0])
        accepted = f"must be inside the domain, {domain[0]} to {domain[1]} m{fix}"
        raise invalid(f"{name}[{first}]", points[first], accepted, "m")


def _require_in_domain(scene: Scene) -> None:
    for name, points in _contents(scene):
        require_inside(scene.domain, name, points, "; domain=None fits it to the scene")
    for index, obstacle in enumerate(scene.obstacles):
        if shared_box((obstacle.lower, obstacle.upper), scene.domain) is None:
            accepted = f"must be at least partly inside the domain, {scene.domain[0]} to {scene.domain[1]} m"
            accepted += unit_hint(scene, obstacle)
            raise ValueError(f"Scene.obstacles[{index}]: {extent_of(obstacle)}; {accepted}")
