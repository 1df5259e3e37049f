"""The scene: array, medium, obstacles and control points, checked once and then constant."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace

import torch

from autdtorch.scene.arrays import TransducerArray, phase_offsets_of, radii_of, strengths_of, strengths_text
from autdtorch.scene.checks import OverlapWarning as OverlapWarning
from autdtorch.scene.checks import (
    everything_of,
    require_places,
    require_waves,
    require_within,
    warn_of_doubts,
)
from autdtorch.scene.contents import SceneContents
from autdtorch.scene.geometry import Coordinates, Plane
from autdtorch.scene.medium import Medium as Medium
from autdtorch.scene.obstacles import Obstacle
from autdtorch.scene.obstacles.moving import moved
from autdtorch.scene.reflectors import Reflector, kinds_of, require_arrangement
from autdtorch.utils.array_types import REAL
from autdtorch.utils.hints import suggesting
from autdtorch.utils.mirror_images import Image, images_of
from autdtorch.utils.process import cached_property
from autdtorch.utils.text import counted, html_facts
from autdtorch.utils.units import ScaleWarning as ScaleWarning
from autdtorch.utils.units import angles
from autdtorch.utils.validation import (
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
_FREQUENCIES = 1e-3, 1e12  # [Hz]


@dataclass(frozen=True, eq=False, init=False, repr=False)
class Scene(SceneContents):
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
            ValueError: a field of the wrong type or out of range, or a coordinate beyond 1e6 m; a point in or
                on an obstacle, coincident with another or outside the domain; a medium that absorbs more than
                3 dB per wavelength, or an obstacle more than 27; something behind a reflector; or reflectors
                that are neither at right angles nor facing each other, a wavelength apart.

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
        for field, places in everything_of(self):
            require_within(field, places)
        object.__setattr__(self, "domain", self._bounds() if domain is None else _corners(domain))
        require_waves(self)
        object.__setattr__(self, "reflectors", members("Scene.reflectors", reflectors, Reflector))
        require_arrangement(self.reflectors, self.complex_wavenumber)
        require_places(self)
        warn_of_doubts(self)

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

    @cached_property
    def images(self) -> tuple[Image, ...]:
        """The images of the space in the reflectors, the space itself first."""
        size = float((torch.tensor(self.domain[1], **REAL) - torch.tensor(self.domain[0], **REAL)).norm())
        return images_of([reflector.mirror for reflector in self.reflectors], self.complex_wavenumber, size)

    def __repr__(self) -> str:
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
        points = torch.cat([points for _, points in everything_of(self)])
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
    require_within("Scene.domain", corners)
    return lower, upper
