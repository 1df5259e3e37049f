"""The transducer array: positions, directions, strength and size of the transducers."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch

from autdtorch.scene.boards import (
    AUTD3_SOURCE_STRENGTH,
    AUTD3_TRANSDUCERS,
    OPENMPD_SOURCE_STRENGTH,
    SONICSURFACE_SOURCE_STRENGTH,
    TRANSDUCER_RADIUS,
    autd3_places,
    grid_places,
    square_places,
)
from autdtorch.scene.drive import warn_of_degrees
from autdtorch.scene.geometry import Coordinates, in_plane, plane_basis
from autdtorch.scene.transducer_values import disc_radius, for_each, unit_normals
from autdtorch.utils.apertures import Apertures
from autdtorch.utils.array_types import REAL
from autdtorch.utils.hints import suggesting
from autdtorch.utils.process import require_memory
from autdtorch.utils.spatial import require_distinct
from autdtorch.utils.text import counted
from autdtorch.utils.validation import (
    ArrayLike,
    finite_number,
    points_tensor,
    positive,
    positive_integers,
    real_tensor,
    require_kind,
)

PAPER_SOURCE_STRENGTH = 1 / (4 * math.pi)
"""Source strength in the paper's Eq. 2: on-axis pressure at full drive times distance [Pa m]."""

_TRANSDUCER_BYTES = 500.0  # memory for each transducer [bytes], with the search for its neighbours


class Nodes(NamedTuple):
    """The monopoles of N sources or receivers, n each, in float64."""

    positions: torch.Tensor  # (N, n, 3) [m]
    weights: torch.Tensor  # (n,), with the sum 1


class Recipe(NamedTuple):
    """The function and the arguments that make an array, as numbers and lists, for files."""

    kind: str  # "positions", or the name of a method such as "autd3"
    arguments: dict[str, Any]
    transducers: int


@dataclass(frozen=True, eq=False, init=False, repr=False)
class TransducerArray:
    """An array of M transducers. Its tensors are copies on the CPU.

    `array + other` joins two arrays: the transducers of `array`, then those of `other`.

    A transducer is a point, or a disc of monopoles: Rayleigh's integral for a flat circular piston of uniform
    velocity. The far field of a disc has the directivity 2 J1(k a sin t) / (k a sin t) at the angle t from
    its normal. Without a baffle, the field behind the disc mirrors the field in front.

    Attributes:
        positions: (M, 3) [m], float64, all different.
        normals: directions of emission (M, 3), float64, of length 1.
        source_strength: on-axis pressure in the far field at full drive, times distance [Pa m], > 0: a number
            if equal for all, otherwise (M,), float64.
        radius: of the discs [m]; 0 for point sources: a number if equal for all, otherwise (M,), float64.
        phase: of the sound relative to the drive's [rad], positive if late: p = S e^{i phase} q e^{ikr} / r.
            A number if equal for all, otherwise (M,), float64.
    """

    positions: torch.Tensor
    normals: torch.Tensor
    source_strength: float | torch.Tensor
    radius: float | torch.Tensor
    phase: float | torch.Tensor

    def __init__(
        self,
        positions: ArrayLike,
        normals: ArrayLike,
        source_strength: ArrayLike = PAPER_SOURCE_STRENGTH,
        radius: ArrayLike | None = None,
        phase: ArrayLike = 0.0,
    ) -> None:
        """Check and copy the input; the arguments are the attributes, see `TransducerArray`.

        A single normal (3,), of any length, serves all, as does a single strength, radius or phase. The radii
        of two transducers are together at most their distance; None or 0 for points.

        Raises:
            ValueError: not finite, wrong shape, zero normal, strength <= 0, two transducers at one position,
                or discs that could overlap.

        Warns:
            ScaleWarning: the phases seem to be in degrees.
        """
        places = points_tensor("TransducerArray.positions", positions).cpu()
        require_distinct("TransducerArray.positions", places)
        object.__setattr__(self, "positions", places.as_subclass(Coordinates))
        directions = unit_normals(normals, len(places))
        object.__setattr__(self, "normals", directions.as_subclass(Coordinates))
        strength = for_each("TransducerArray.source_strength", source_strength, len(places), positive, "Pa m")
        object.__setattr__(self, "source_strength", strength)
        object.__setattr__(self, "radius", disc_radius(radius, places))
        delay = for_each("TransducerArray.phase", phase, len(places), finite_number, "rad")
        warn_of_degrees("TransducerArray.phase", torch.as_tensor(delay, **REAL))
        object.__setattr__(self, "phase", delay)

    @classmethod
    @suggesting
    def grid(
        cls,
        shape: tuple[int, int],
        pitch: float,
        center: ArrayLike,
        normal: ArrayLike = (1.0, 0.0, 0.0),
        source_strength: ArrayLike = PAPER_SOURCE_STRENGTH,
        radius: ArrayLike | None = None,
        angle: float = 0.0,
    ) -> TransducerArray:
        """Return a flat rectangular array; transducer i * shape[1] + j is i pitches along u and j along v.

        Args:
            shape: numbers of transducers along u and v, the axes of `plane_basis(normal)` turned by `angle`.
            pitch: distance between neighbours [m], > 0.
            center: centre of the array (3,) [m].
            normal: direction of emission (3,).
            source_strength: [Pa m], > 0, a number or (M,).
            radius: of the discs [m], a number or (M,), at most half the pitch; None or 0 for point sources.
            angle: by which the array is turned in its plane [rad], from u towards v.

        Raises:
            ValueError: an argument is not finite, has the wrong shape or is out of range.
        """
        count_u, count_v = positive_integers("shape", shape, 2)
        require_memory("shape", shape, _TRANSDUCER_BYTES * count_u * count_v)
        pitch = positive("pitch", pitch, "m")
        places = grid_places(count_u, count_v, pitch)
        more = {"shape": [count_u, count_v], "pitch": pitch}
        return flat_array("grid", places, center, normal, angle, source_strength, radius, **more)

    @classmethod
    @suggesting
    def autd3(
        cls,
        center: ArrayLike,
        normal: ArrayLike = (1.0, 0.0, 0.0),
        angle: float = 0.0,
        units: tuple[int, int] = (1, 1),
        source_strength: ArrayLike = AUTD3_SOURCE_STRENGTH,
        radius: ArrayLike | None = TRANSDUCER_RADIUS,
    ) -> TransducerArray:
        """Return an array of AUTD3 units, 249 transducers each, in the order of the device, unit by unit.

        Args:
            center: centre of all units (3,) [m]; a unit has 18 x 14 grid places.
            normal: direction of emission (3,), the device's z.
            angle: of the device's x from u towards v [rad], with (u, v) = `plane_basis(normal)`.
            units: numbers of units along the device's x and y; unit i * units[1] + j is the i-th along x and
                the j-th along y.
            source_strength: [Pa m], > 0, a number or (M,); by default the value of the AUTD3 SDK.
            radius: of the discs [m], a number or (M,); None or 0 for point sources.

        Raises:
            ValueError: an argument is not finite, has the wrong shape or is out of range.
        """
        count_x, count_y = positive_integers("units", units, 2)
        require_memory("units", units, _TRANSDUCER_BYTES * AUTD3_TRANSDUCERS * count_x * count_y)
        places = autd3_places(count_x, count_y)
        units = count_x, count_y
        return flat_array("autd3", places, center, normal, angle, source_strength, radius, units=list(units))

    @classmethod
    @suggesting
    def sonicsurface(
        cls,
        center: ArrayLike,
        normal: ArrayLike = (1.0, 0.0, 0.0),
        angle: float = 0.0,
        source_strength: ArrayLike = SONICSURFACE_SOURCE_STRENGTH,
        radius: ArrayLike | None = TRANSDUCER_RADIUS,
    ) -> TransducerArray:
        """Return the array of a SonicSurface: 16 x 16 transducers row by row from the largest y, x fastest.

        Arguments and errors as for `TransducerArray.autd3`; the default source strength is Ultraino's.
        The order follows the table of emitters in the device's Python program. Frames are encoded in the
        order of channels, which the firmware needs.
        """
        places = square_places().transpose(0, 1).reshape(-1, 2)
        return flat_array("sonicsurface", places, center, normal, angle, source_strength, radius)

    @classmethod
    @suggesting
    def openmpd(
        cls,
        center: ArrayLike,
        normal: ArrayLike = (1.0, 0.0, 0.0),
        angle: float = 0.0,
        source_strength: ArrayLike = OPENMPD_SOURCE_STRENGTH,
        radius: ArrayLike | None = TRANSDUCER_RADIUS,
    ) -> TransducerArray:
        """Return the array of an OpenMPD board: 16 x 16 transducers column by column from the largest y.

        Arguments and errors as for `TransducerArray.autd3`; the default source strength is AcousTools'.
        Positions are nominal; `OpenMPDBoard.load` reads the positions and calibration of one board.
        """
        places = square_places().reshape(-1, 2)
        return flat_array("openmpd", places, center, normal, angle, source_strength, radius)

    def __add__(self, other: TransducerArray) -> TransducerArray:
        """Return both arrays as one, the transducers of `other` after those of this one.

        Raises:
            ValueError: `other` is no array, or the arrays overlap.
        """
        require_kind("TransducerArray + other", other, TransducerArray)
        joined = TransducerArray(
            torch.cat([self.positions, other.positions]),
            torch.cat([self.normals, other.normals]),
            torch.cat([strengths_of(self), strengths_of(other)]),
            torch.cat([radii_of(self), radii_of(other)]),
            torch.cat([phase_offsets_of(self), phase_offsets_of(other)]),
        )
        object.__setattr__(joined, "_recipes", _forms_of(self) + _forms_of(other))
        return joined

    def calibrated(self, gain: ArrayLike = 1.0, phase: ArrayLike = 0.0) -> TransducerArray:
        """Return the array with strengths multiplied by a gain, and with a phase added to its own.

        Args:
            gain: > 0, a number or (M,).
            phase: [rad], positive if the sound is late, a number or (M,).

        Raises:
            ValueError: not finite, wrong shape, or a gain <= 0.
        """
        factor = torch.as_tensor(for_each("gain", gain, len(self), positive, ""), **REAL)
        delay = torch.as_tensor(for_each("phase", phase, len(self), finite_number, "rad"), **REAL)
        strength = strengths_of(self) * factor
        array = replace(self, source_strength=strength, phase=phase_offsets_of(self) + delay)
        object.__setattr__(array, "_recipes", _forms_of(self))
        return array

    @property
    def nodes(self) -> Nodes:
        """The monopoles of each transducer: one for a point, 80 for a disc.

        A disc of radius a has 5 rings at Gauss points in r^2, each of 16 equal angles and turned by half a
        step against the next (Peirce, J. SIAM 5 (1957) 66-73). For k a <= 6 the error in the far field is
        1e-6 at all angles. At a distance of a/2 from the disc it is 1e-4 of the largest pressure. Fields are
        those of the discs; grids take as many monopoles as k a needs.
        """
        apertures = apertures_of(self)
        return Nodes(apertures.positions, apertures.weights)

    @property
    def half_extents(self) -> torch.Tensor:
        """Half the extents of the transducers along x, y and z (M, 3) [m]."""
        return radii_of(self)[:, None] * (1 - self.normals**2).clamp(min=0).sqrt()

    def __len__(self) -> int:
        return len(self.positions)

    def __repr__(self) -> str:
        x, y, z = (1e3 * self.positions.mean(dim=0)).tolist()
        size = f"radius {range_text(radii_of(self), 1e3)} mm, " if radii_of(self).any() else ""
        return (
            f"TransducerArray({counted(len(self), 'transducer')} around ({x:.4g}, {y:.4g}, {z:.4g}) mm, "
            f"{size}source strength {strengths_text(self)})"
        )


FORMS: dict[str, Callable[..., TransducerArray]] = {
    "grid": TransducerArray.grid,
    "positions": TransducerArray,
    "autd3": TransducerArray.autd3,
    "sonicsurface": TransducerArray.sonicsurface,
    "openmpd": TransducerArray.openmpd,
}
"""The functions that make an array, by its `type` in scene files."""


def flat_array(
    form: str,
    places: torch.Tensor,
    center: ArrayLike,
    normal: ArrayLike,
    angle: float,
    source_strength: ArrayLike,
    radius: ArrayLike | None,
    **arguments: Any,
) -> TransducerArray:
    """Return the array of `places` (M, 2) [m] in a plane, with the recipe of a form and its arguments."""
    array = TransducerArray(in_plane(places, center, normal, angle), normal, source_strength, radius)
    pose = {"center": _numbers(center), "normal": _numbers(normal), "angle": float(angle)}
    object.__setattr__(array, "_recipes", (Recipe(form, arguments | pose, len(array)),))
    return array


def recipes_of(array: TransducerArray) -> tuple[Recipe, ...]:
    """Return the recipes of the arrays that were joined to an array, or the one of a single array.

    Their arguments are those of the form and, where some phases are not 0, a `phase`.
    """
    recipes = _forms_of(array)
    counts = [recipe.transducers for recipe in recipes]
    values = strengths_of(array), radii_of(array), phase_offsets_of(array)
    parts = [torch.split(each, counts) for each in values]
    result = []
    for recipe, strength, radius, phase in zip(recipes, *parts, strict=True):
        arguments = {**recipe.arguments, "source_strength": _shared(strength), "radius": _shared(radius)}
        if phase.any():
            arguments["phase"] = _shared(phase)
        result.append(recipe._replace(arguments=arguments))
    return tuple(result)


def _forms_of(array: TransducerArray) -> tuple[Recipe, ...]:
    """Return recipes without strengths, radii and phases."""
    recipes: tuple[Recipe, ...] | None = vars(array).get("_recipes")
    if recipes is not None:
        return recipes
    normals = array.normals.tolist()
    alike = all(normal == normals[0] for normal in normals)
    places = {"positions": array.positions.tolist(), "normals": normals[0] if alike else normals}
    return (Recipe("positions", places, len(array)),)


def _shared(values: torch.Tensor) -> float | list[float]:
    """Return the number that all values are, or else a list."""
    numbers: list[float] = values.tolist()
    return numbers[0] if len(set(numbers)) == 1 else numbers


def _numbers(values: ArrayLike) -> Any:
    """Return values as a number or list, with full precision."""
    return real_tensor("values", values).tolist()


def strengths_of(array: TransducerArray) -> torch.Tensor:
    """Return the source strength of each transducer (M,) [Pa m]."""
    return _expanded(array.source_strength, len(array))


def complex_strengths_of(array: TransducerArray) -> torch.Tensor:
    """Return S e^(i phase) of each transducer (M,) [Pa m]: complex128, or float64 if all phases are 0."""
    strengths, phases = strengths_of(array), phase_offsets_of(array)
    return torch.polar(strengths, phases) if phases.any() else strengths


def phase_offsets_of(array: TransducerArray) -> torch.Tensor:
    """Return the phase of each transducer's sound relative to its drive (M,) [rad]."""
    return _expanded(array.phase, len(array))


def radii_of(array: TransducerArray) -> torch.Tensor:
    """Return the radius of each transducer (M,) [m]."""
    return _expanded(array.radius, len(array))


def _expanded(values: float | torch.Tensor, count: int) -> torch.Tensor:
    each = torch.as_tensor(values, **REAL)
    return each.as_subclass(torch.Tensor).expand(count)


def strengths_text(array: TransducerArray) -> str:
    """Return the strengths, and the phases if there are any, as text with units."""
    phases = phase_offsets_of(array)
    text = f"{range_text(strengths_of(array))} Pa m"
    return f"{text}, phase {range_text(phases)} rad" if phases.any() else text


def range_text(values: torch.Tensor, factor: float = 1.0) -> str:
    """Return values for messages, multiplied by `factor`: one number, or the least and the largest."""
    least, most = (f"{factor * float(end):.4g}" for end in (values.min(), values.max()))
    return least if least == most else f"{least} to {most}"


def apertures_of(array: TransducerArray, wavenumber: float = 0.0) -> Apertures:
    """Return the transducers as sources or receivers, of waves that monopoles in their stead can resolve."""
    radii = radii_of(array)
    if not radii.any():
        return Apertures(array.positions)
    normals, facing = torch.unique(array.normals, dim=0, return_inverse=True)  # most arrays have one
    axes = torch.stack([torch.stack([*plane_basis(normal), normal]) for normal in normals])[facing]
    return Apertures(array.positions, axes, radii, wavenumber * float(radii.max()))
