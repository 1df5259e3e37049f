"""The region that is simulated: a fluid, bodies in it, and the frequency of the drive."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, Self

import numpy as np
from torch import Tensor

from autdtorch.utils.array_types import Array
from autdtorch.utils.images import Mirror
from autdtorch.utils.validation import Vector


class Fluid(NamedTuple):
    """Density [kg/m^3] and sound speed [m/s] of a fluid, complex where it absorbs.

    Time factor e^{-i w t}: Im(density) >= 0 and Im(1 / bulk modulus) >= 0 are passive.
    """

    density: complex
    sound_speed: complex

    @property
    def is_lossy(self) -> bool:
        """True if it absorbs."""
        return self.density.imag != 0 or self.sound_speed.imag != 0

    @property
    def inertia(self) -> float:
        """Ratio of a pressure gradient to the acceleration in phase with it [kg/m^3]."""
        return self.density.real if self.density.imag == 0 else 1 / (1 / self.density).real

    @property
    def phase_speed(self) -> float:
        """Speed of wave fronts [m/s]."""
        return self.sound_speed.real if self.sound_speed.imag == 0 else 1 / (1 / self.sound_speed).real


class Shape(Protocol):
    """A shape that a grid can represent."""

    @property
    def lower(self) -> Vector:
        """Corner of the bounding box with the smallest coordinates (3,) [m]."""

    @property
    def upper(self) -> Vector:
        """Corner of the bounding box with the largest coordinates (3,) [m]."""

    def signed_distance(self, points: Tensor, /) -> Tensor:
        """Return the distance (...) [m] of points (..., 3) to the surface, negative inside."""

    def surface(self) -> tuple[Tensor, Tensor]:
        """Return vertices (V, 3) [m] and triangles (F, 3), counter-clockwise as seen from outside."""


def bounds(shapes: Sequence[Shape]) -> tuple[Array, Array]:
    """Return the lower and upper corner (3,) [m] of the bounding box of shapes."""
    lower = np.array([shape.lower for shape in shapes], np.float64).min(axis=0)
    return lower, np.array([shape.upper for shape in shapes], np.float64).max(axis=0)


@dataclass(frozen=True)
class Body:
    """A shape of one material."""

    shape: Shape
    fluid: Fluid | None  # its material, None if it is rigid or has an impedance
    continued: bool = False  # whether it continues through the boundary layers instead of ending before them
    uncertainty: float = 0.0  # distance [m] by which its surface may be off (rms)
    rigid_error: float = 0.0  # relative difference of the field in front of it, of a body taken as rigid
    # impedance of its surface, locally reacting, as a ratio to air (density times sound speed); None if rigid
    impedance: complex | None = None


@dataclass(frozen=True, eq=False)
class Region:
    """A fluid with bodies in it, at one frequency."""

    fluid: Fluid  # the fluid around the bodies, called air
    attenuation: float  # its attenuation [Np/m]
    frequency: float  # frequency of the drive [Hz]
    bodies: tuple[Body, ...]  # may overlap; the later one counts
    # corners (lower, upper) [m] of the space that a grid of the whole domain covers
    domain: tuple[Vector, Vector]
    # positions of the transducers (M, 3) [m]; a grid stays symmetric where they are
    sources: Array
    mirrors: tuple[Mirror, ...] = ()  # planes that reflect

    @property
    def wavenumber(self) -> float:
        """Wavenumber in air [rad/m]."""
        return 2 * math.pi * self.frequency / self.fluid.phase_speed

    @property
    def wavelength(self) -> float:
        """Wavelength in air [m]."""
        return self.fluid.phase_speed / self.frequency

    @property
    def shortest_wavelength(self) -> float:
        """Wavelength [m] where sound is slowest."""
        return min(self.sound_speeds.values()) / self.frequency

    @property
    def unbounded(self) -> Self:
        """The region with an infinite domain."""
        return replace(self, domain=((-math.inf,) * 3, (math.inf,) * 3))

    @property
    def shapes(self) -> list[Shape]:
        """Shapes of the bodies."""
        return [body.shape for body in self.bodies]

    @property
    def walls(self) -> list[Shape]:
        """Shapes of the bodies that no sound enters."""
        return [body.shape for body in self.bodies if body.fluid is None]

    @property
    def sound_speeds(self) -> dict[str, float]:
        """Sound speeds [m/s] by place, for messages."""
        fluids = {f"obstacle {index}": body.fluid for index, body in enumerate(self.bodies)}
        everywhere = {"the medium": self.fluid} | fluids
        return {where: fluid.phase_speed for where, fluid in everywhere.items() if fluid}
