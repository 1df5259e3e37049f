"""The region that is simulated: a fluid, bodies and mirrors in it, and the frequency of the drive.

With their images in the mirrors, bodies are in free space. A body next to a rigid or soft mirror, on it or
cut by it, shares a grid with its image.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import NamedTuple, Self

import numpy as np
import torch

from autdtorch.fdtd.grid_axes import FlatFaces, flat_faces, slender_faces
from autdtorch.fdtd.shapes import (
    Shape,
    Solids,
    bounds,
    distance_from,
    is_turned,
    turned_shape,
    with_image,
)
from autdtorch.utils.array_types import Array, Index, triple
from autdtorch.utils.mirror_images import Image, Mirror, images_of
from autdtorch.utils.process import cached_property
from autdtorch.utils.spatial import (
    areas_of,
    doubled_normals,
    edge_length,
    extents,
    mean_thickness,
    places_on,
    spread_evenly,
    volume_and_area,
)
from autdtorch.utils.validation import Vector, invalid, positive

logger = logging.getLogger(__name__)

CLEARANCE = 4.5
"""Distance [cells] of a mirror from the box around bodies up to which they share a grid with their images.
The Huygens surface is up to 4 cells from the bodies, and must not meet its own image."""

_AS_HEAVY = 1.1
"""Ratio of densities up to which cells on both sides of a surface interpolate better than those on one."""

_PLACES = 400  # Places of a surface where bodies of air may cut it
_HELD = 0.5  # Share of a fluid's surface from which rigid bodies hold it
_SKIN = 1e-6  # Distance [m] in front of and behind a surface where air is looked for

MIN_CELLS_PER_WAVELENGTH = 3.0  # Fewest cells per wavelength; coarser grids are refused
# Fewest cells per wavelength without a warning. On coarser grids points would need interpolation over more
# than 10 cells a side, and the layer reflects more than -61 dB.
FAIR_CELLS_PER_WAVELENGTH = 4.0
# Most cells per wavelength. The fit of the absorbing layer starts within its bounds up to about 700.
MAX_CELLS_PER_WAVELENGTH = 500
RATIO = 1.5  # Ratio of the spacings of the two grids: the coarser costs a fifth of the finer


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


@dataclass(frozen=True)
class Body:
    """A shape of one material."""

    shape: Shape
    fluid: Fluid | None  # its material, None if it is rigid or has an impedance
    continued: bool = False  # whether it continues through the absorbing layers instead of ending before them
    uncertainty: float = 0.0  # distance [m] by which its surface may be off (rms)
    rigid_error: float = 0.0  # relative difference of the field in front of it, of a body taken as rigid
    # impedance of its surface, locally reacting, as a ratio to air (density times sound speed); None if rigid
    impedance: complex | None = None
    # number of the obstacle that it is, or is an image of
    number: int = field(default=0, compare=False)

    @cached_property
    def faces(self) -> FlatFaces:
        """Its flat faces."""
        return flat_faces(self.shape)

    @property
    def surface(self) -> tuple[Array, Index]:
        """Vertices (V, 3) [m] and triangles (T, 3) of its surface."""
        vertices, triangles = self.shape.surface()
        return vertices.numpy(), triangles.numpy()

    @property
    def mean_thickness(self) -> float:
        """Twice its volume over its area [m]."""
        return mean_thickness(*self.surface)

    def is_along(self, axes: Array, spacing: float) -> bool:
        """Return whether its faces follow `axes`, one a row (3, 3), or it is slender on cells [m]."""
        if self.faces.all_aligned(axes):
            return True
        return slender_faces(self.surface[0] @ axes.T / spacing) is not None


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

    @cached_property
    def mean_thickness(self) -> float:
        """Twice the volume of all bodies that end over their area [m]; infinite without such bodies.

        Later bodies of air cut into those before.
        """
        carved = any(body.fluid == self.fluid for body in self.bodies)
        sizes = [
            self._remaining_volume_and_area(body) if carved else volume_and_area(*body.surface)
            for body in self.bodies
            if not body.continued
        ]
        volume, area = np.array(sizes).reshape(-1, 2).sum(axis=0).tolist()
        return 2 * volume / area if area else math.inf

    @cached_property
    def edges_per_area(self) -> float:
        """Length of all edges of bodies that end over their area [1/m]; infinite without such bodies."""
        area = sum(volume_and_area(*surface)[1] for surface in self._surfaces)
        return sum(edge_length(*surface) for surface in self._surfaces) / area if area else math.inf

    @cached_property
    def largest_extent(self) -> float:
        """Largest extent of the bodies that end [m]; infinite without such bodies."""
        return max((float(extents(vertices)[0]) for vertices, _ in self._surfaces), default=math.inf)

    @property
    def kink(self) -> float:
        """The largest share of the density's contrast in what a body scatters, relative to a rigid body.

        The pressure gradient jumps where densities differ; the rest is by the compressibility, which leaves
        it smooth. 34 balls of ratios from 0.01 to 1e4 have 0.2 to 2 times the usual error with this share.
        """
        return max((self._kink(body.fluid) for body in self.bodies), default=1.0)

    def _kink(self, fluid: Fluid | None) -> float:
        if fluid is None:
            return 1.0
        density = fluid.inertia / self.fluid.inertia
        compressibility = (self.fluid.phase_speed / fluid.phase_speed) ** 2 / density
        kinked, smooth = (abs(ratio - 1) / (ratio + 1) for ratio in (density, compressibility))
        return 2 * kinked / (kinked + smooth) if kinked else 0.0

    @property
    def largest_density(self) -> float:
        """The largest density of a fluid body relative to the air's; 0 without any."""
        fluids = (body.fluid for body in self.bodies if body.fluid)
        return max((float(abs(fluid.inertia) / self.fluid.inertia) for fluid in fluids), default=0.0)

    @cached_property
    def held_contrast(self) -> float:
        """The largest ratio of densities, from 1, of the air and of a fluid that is mostly in rigid bodies.

        A column of it resonates more sharply by this ratio than one of air.
        """
        largest = 1.0
        for number, body in enumerate(self.bodies):
            before = [each.shape for each in self.bodies[:number] if each.fluid is None]
            if body.fluid is None or body.continued or not before:
                continue
            vertices, triangles = (part.numpy() for part in body.shape.surface())
            places = torch.from_numpy(places_on(vertices[triangles], _PLACES))
            if float((distance_from(before, places) < 0).double().mean()) > _HELD:
                ratio = body.fluid.inertia / self.fluid.inertia
                largest = max(largest, ratio, 1 / ratio)
        return largest

    @property
    def _surfaces(self) -> list[tuple[Array, Index]]:
        """Vertices (V, 3) [m] and triangles (T, 3) of the bodies that end."""
        return [body.surface for body in self.bodies if not body.continued]

    def _remaining_volume_and_area(self, body: Body) -> tuple[float, float]:
        """Return the part of a body's surface in volume [m^3] and area [m^2] of what bodies of air leave.

        Places on the surface count where one side is air. Where that is inside, the volume is negative.
        """
        vertices, triangles = body.surface
        corners = vertices[triangles]
        normals = doubled_normals(corners)[spread_evenly(areas_of(corners), _PLACES)]
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        places = places_on(corners, _PLACES)
        # triangles are chords of curved faces
        places -= body.shape.signed_distance(torch.from_numpy(places)).numpy()[:, None] * normals
        solids = Solids(self.shapes, [body.fluid != self.fluid for body in self.bodies])
        inside, outside = (solids.distance(places + side * _SKIN * normals) < 0 for side in (-1, 1))
        facing = inside.astype(np.float64) - outside
        middle = 0.5 * (bounds(self.shapes)[0] + bounds(self.shapes)[1])
        height = ((places - middle) * normals).sum(axis=1)
        share = float(areas_of(corners).sum()) / _PLACES
        return share * float(facing @ height) / 3, share * float(np.abs(facing).sum())

    @property
    def unbounded(self) -> Self:
        """The region with an infinite domain."""
        return replace(self, domain=((-math.inf,) * 3, (math.inf,) * 3))

    @property
    def shapes(self) -> list[Shape]:
        """Shapes of the bodies."""
        return [body.shape for body in self.bodies]

    @property
    def walls(self) -> Solids:
        """The bodies that no sound enters."""
        return Solids(self.shapes, [body.fluid is None for body in self.bodies])

    @property
    def kinked(self) -> Solids:
        """The bodies at whose surface the pressure gradient jumps."""
        return Solids(self.shapes, [not self.is_as_heavy(body, _AS_HEAVY) for body in self.bodies])

    def is_as_heavy(self, body: Body, ratio: float) -> bool:
        """Return whether the density of a body is air's, within a ratio > 1."""
        return body.fluid is not None and 1 / ratio < body.fluid.inertia / self.fluid.inertia < ratio

    @property
    def sound_speeds(self) -> dict[str, float]:
        """Sound speeds [m/s] by place, for messages."""
        fluids = {f"obstacle {index}": body.fluid for index, body in enumerate(self.bodies)}
        everywhere = {"the medium": self.fluid} | fluids
        return {where: fluid.phase_speed for where, fluid in everywhere.items() if fluid}

    @property
    def coarsest_spacing(self) -> float:
        """The largest spacing [m] with a fair number of cells per wavelength everywhere."""
        return self.shortest_wavelength / FAIR_CELLS_PER_WAVELENGTH

    def second_spacing(self, spacing: float) -> float:
        """Return the spacing [m] of the second grid of an error estimate: coarser where fair, else finer."""
        coarser = RATIO * spacing
        return coarser if coarser <= self.coarsest_spacing else spacing / RATIO

    def require_spacing(self, spacing: float) -> None:
        """Check the number of cells per wavelength of a spacing [m]."""
        positive("spacing", spacing, "m")
        require_fine(self.sound_speeds, self.frequency, spacing)
        finest = self.wavelength / MAX_CELLS_PER_WAVELENGTH
        if spacing < finest:
            accepted = f"must be at least {finest:.3g} m, {MAX_CELLS_PER_WAVELENGTH} cells per wavelength"
            raise invalid("spacing", spacing, f"{accepted} in the medium at {self.frequency:g} Hz", "m")

    def turned(self, axes: Array) -> Self:
        """Return the region in the coordinates of other axes, one a row (3, 3); its domain is infinite."""
        if not is_turned(axes):
            return self
        bodies = tuple(replace(body, shape=turned_shape(body.shape, axes)) for body in self.bodies)
        return replace(self.unbounded, bodies=bodies, sources=self.sources @ axes.T)

    def part(self, group: Sequence[int], near: Sequence[int]) -> Self:
        """Return the region with a group of its bodies alone, and their images in mirrors near them."""
        bodies = tuple(self.bodies[index] for index in group)
        return replace(self, bodies=_with_images(bodies, [self.mirrors[number] for number in near]))

    @property
    def whole(self) -> Self:
        """The region with its images: the bodies in front of all mirrors and behind, in free space.

        The domain is cut at each mirror, and joined with its image.
        """
        if not self.mirrors:
            return self
        lower, upper = (np.array(corner) for corner in self.domain)
        sources = torch.from_numpy(self.sources)
        for mirror in self.mirrors:
            axis = int(np.abs(mirror.normal).argmax())
            plane = mirror.point[axis]
            half = upper[axis] - plane if mirror.normal[axis] > 0 else plane - lower[axis]
            lower[axis], upper[axis] = plane - half, plane + half
            sources = torch.cat([sources, mirror.image.of(sources)])
        bodies = _with_images(self.bodies, self.mirrors)
        domain = triple(lower.tolist()), triple(upper.tolist())
        return replace(self, bodies=bodies, domain=domain, sources=sources.numpy(), mirrors=())

    def can_hold(self, near: Sequence[int]) -> bool:
        """Return whether a grid can hold the images in some mirrors: rigid or soft, none facing another."""
        mirrors = [self.mirrors[number] for number in near]
        facing = any(one.is_parallel(other) for one, other in combinations(mirrors, 2))
        return not facing and all(mirror.reflection in (1, -1) for mirror in mirrors)

    def require_held(self, near: Sequence[int], spacing: float) -> None:
        """Refuse mirrors next to bodies whose images no grid can hold; see `can_hold`."""
        if self.can_hold(near):
            return
        beside = f"{1e3 * CLEARANCE * spacing:.3g} mm"
        for number in near:
            if self.mirrors[number].reflection not in (1, -1):
                accepted = f"must be 1 or -1 where an obstacle is within {beside}; or move the obstacle"
                raise invalid(f"reflectors[{number}].reflection", self.mirrors[number].reflection, accepted)
        accepted = f"must be {beside} or more from one of reflectors {[*near]}, of which two face each other"
        accepted += "; or take a rigid Box across the domain in place of one of the two"
        raise invalid("obstacles", "one grid next to both", accepted)

    def require_domain(self, name: str = "method", value: str = "full") -> None:
        """Refuse mirrors that a grid of the domain cannot have; the message names what asks for it."""
        for number, mirror in enumerate(self.mirrors):
            if np.abs(mirror.normal).max() < 1 or mirror.reflection not in (1, -1):
                plane = f"reflector {number}, of normal {mirror.normal} and reflection {mirror.reflection}"
                accepted = "it must be along an axis, and its reflection 1 or -1; take box"
                raise invalid(name, value, f"cannot have {plane}: {accepted}")
            if any(mirror.is_parallel(other) for other in self.mirrors[:number]):
                raise invalid(name, value, f"cannot have parallel reflectors, such as {number}; take box")

    def other_images(self, near: Sequence[int], images: Sequence[Image]) -> tuple[Image, ...]:
        """Return the images that a grid does not hold: one for each of its copies in all other mirrors."""
        if not near:
            return tuple(images)
        held = [self.mirrors[number] for number in near]
        size = float(np.linalg.norm(np.subtract(*self.domain)))
        return images_of(self.mirrors, complex(self.wavenumber, self.attenuation), size, held)


def require_fine(speeds: Mapping[str, float], frequency: float, spacing: float) -> None:
    """Check that a spacing [m] resolves sound speeds [m/s] by place."""
    for where, speed in speeds.items():
        coarsest = speed / frequency / MIN_CELLS_PER_WAVELENGTH
        if spacing > coarsest:
            reason = f"{MIN_CELLS_PER_WAVELENGTH:g} cells per wavelength in {where} at {frequency:g} Hz"
            raise invalid("spacing", spacing, f"must be at most {coarsest:.3g} m, {reason}", "m")


def warn_if_coarse(speeds: Mapping[str, float], frequency: float, spacing: float) -> None:
    """Log the places where a spacing [m] is coarse for sound speeds [m/s] by place."""
    places: dict[float, list[str]] = {}
    for where, speed in speeds.items():
        if spacing > speed / frequency / FAIR_CELLS_PER_WAVELENGTH:
            places.setdefault(speed / frequency / spacing, []).append(where)
    coarse = [f"{cells:.3g} cells per wavelength in {', '.join(where)}" for cells, where in places.items()]
    if coarse:
        logger.warning(
            "spacing %.3g mm is coarse, %s: from %g cells to %g the error in air rises from 0.5 to 3 %%, and"
            " that of the sound speed in obstacles from 0.3 to 1 %%: fields of slow ones are off by tens of"
            " per cent; transfer_matrix(return_error=True) estimates the error",
            spacing * 1e3, ", ".join(coarse), FAIR_CELLS_PER_WAVELENGTH, MIN_CELLS_PER_WAVELENGTH,
        )  # fmt: skip


def _with_images(bodies: tuple[Body, ...], mirrors: Sequence[Mirror]) -> tuple[Body, ...]:
    """Return bodies with their images in mirrors; a body on or across a mirror is one with its image."""
    for mirror in mirrors:
        bodies = tuple(
            replace(body, shape=shape) for body in bodies for shape in with_image(body.shape, mirror)
        )
    return bodies
