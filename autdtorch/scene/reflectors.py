"""Planes that reflect: the panel of an array, tables and walls, by images."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Self

import numpy as np
import torch

from autdtorch.scene.arrays import TransducerArray
from autdtorch.utils.array_types import REAL
from autdtorch.utils.mirror_images import Mirror, resonates
from autdtorch.utils.validation import (
    LENGTH_TOLERANCE,
    ArrayLike,
    Vector,
    complex_number,
    finite_vector,
    invalid,
    require_kind,
    unit_vector,
)

logger = logging.getLogger(__name__)

_FLAT = 1e-6
"""Distance [m] by which transducers may be off the plane of their panel."""


@dataclass(frozen=True, init=False)
class Reflector:
    """An infinite plane that reflects all sound in front of it, exactly, by images.

    A transducer in the plane is its own image: with a reflection of 1, the pressure of a monopole doubles,
    and a disc is a piston in an infinite baffle. Two or three planes may be at right angles, and two may face
    each other. Obstacles that cross a plane end there. A magnitude below 1 is an approximation, as the factor
    of a real surface depends on the angle (docs/room.md has the error).

    Attributes:
        point: a point of the plane (3,) [m].
        normal: unit normal (3,), into the space that is simulated.
        reflection: pressure that returns, relative to the incident one: 1 for a rigid plane, -1 for one that
            gives way; also complex, with a magnitude up to 1.

    Raises:
        ValueError: a coordinate that is not finite, a normal of length 0, or a reflection above 1.
    """

    point: Vector
    normal: Vector
    reflection: float | complex

    def __init__(self, point: ArrayLike, normal: ArrayLike, reflection: complex = 1.0) -> None:
        """Check the plane.

        Args:
            point: (3,) [m].
            normal: (3,) of any length.
            reflection: see the class.
        """
        object.__setattr__(self, "point", finite_vector("Reflector.point", point))
        object.__setattr__(self, "normal", unit_vector("Reflector.normal", normal))
        factor = complex_number("Reflector.reflection", reflection)
        if abs(factor) > 1 + LENGTH_TOLERANCE:
            raise invalid("Reflector.reflection", reflection, "its magnitude must be at most 1")
        object.__setattr__(self, "reflection", factor)

    @classmethod
    def behind(cls, array: TransducerArray, reflection: complex = 1.0) -> Self:
        """Return the panel that an array stands in, flush with its transducers.

        Raises:
            ValueError: the transducers are not in one plane, or do not face along its normal.
        """
        require_kind("array", array, TransducerArray)
        normal, point = array.normals[0], array.positions.mean(dim=0)
        turned = (array.normals - normal).norm(dim=1).max()
        beside = ((array.positions - point) @ normal).abs().max()
        if turned > LENGTH_TOLERANCE or beside > _FLAT:
            reason = "face in several directions" if turned > LENGTH_TOLERANCE else "are not in one plane"
            raise invalid("array", array, f"its transducers {reason}; a panel needs a flat array")
        return cls(point, normal, reflection)

    @property
    def mirror(self) -> Mirror:
        """The plane as solvers take it."""
        return Mirror(self.point, self.normal, self.reflection)


def require_arrangement(reflectors: Sequence[Reflector], wavenumber: complex) -> None:
    """Refuse planes that are not at right angles; one pair may face each other, a wavelength apart.

    Those that face each other where the air between them resonates are logged.
    """
    wavelength, pairs = 2 * math.pi / wavenumber.real, 0
    for (first, one), (second, other) in combinations(enumerate(reflectors), 2):
        name, plane = f"Scene.reflectors[{second}].normal", f"reflector {first}"
        if one.mirror.is_perpendicular(other.mirror):
            continue
        if not one.mirror.is_parallel(other.mirror):
            accepted = f"must be at a right angle to that of {plane}, or against it"
            raise invalid(name, other.normal, accepted)
        gap = float(one.mirror.height(torch.tensor(other.point, **REAL)))
        if np.dot(one.normal, other.normal) > 0:
            raise invalid(name, other.normal, f"must be against that of {plane}, which is parallel")
        if gap < wavelength:
            place = f"{abs(gap):.4g} m {'in front of' if gap >= 0 else 'behind'} {plane}"
            accepted = f"is {place}, must be in front of it by at least a wavelength, {wavelength:.4g} m"
            raise invalid(f"Scene.reflectors[{second}].point", other.point, accepted, "m")
        pairs += 1
        if pairs > 1:
            raise invalid(name, other.normal, "must not face another: at most one pair of reflectors does")
        if resonates(one.mirror, other.mirror, wavenumber):
            logger.warning(
                "%s and reflector %d are next to a resonance of the air between them: their images are summed"
                " with an error above 1e-4, and a small shift of either changes the field", plane, second,
            )  # fmt: skip


def is_panel(plane: Reflector, array: TransducerArray) -> bool:
    """Return whether an array stands in a plane, as in `Reflector.behind`."""
    return bool((plane.mirror.height(array.positions).abs() <= _FLAT).all())


def are_in_front(reflectors: Sequence[Reflector], points: torch.Tensor) -> torch.Tensor:
    """Return which points (..., 3) [m] are in front of all reflectors or in them, bool (...)."""
    front = torch.ones(points.shape[:-1], dtype=torch.bool, device=points.device)
    for reflector in reflectors:
        front &= reflector.mirror.height(points) >= -LENGTH_TOLERANCE
    return front


def kinds_of(reflectors: Iterable[Reflector]) -> list[str]:
    """Return the number of reflectors of each factor as texts."""
    names: dict[complex, str] = {1: "rigid", -1: "soft"}
    ratios = [reflector.reflection for reflector in reflectors]
    counts = Counter(names.get(ratio, f"reflection {ratio:.3g}") for ratio in ratios)
    return [f"{count} x {kind}" for kind, count in counts.items()]


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
