"""Data of pictures: units, levels, polygons in a domain, and checks that name what cannot be drawn."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TypeAlias

import numpy as np

from autdtorch.scene.drive import phases_of, validate_single_drive
from autdtorch.scene.geometry import Plane, cell_centers_of, plane_basis
from autdtorch.scene.obstacles import Obstacle
from autdtorch.scene.obstacles.base import inside_any
from autdtorch.scene.reflectors import Reflector, are_in_front
from autdtorch.utils.array_types import Array
from autdtorch.utils.units import warn_user
from autdtorch.utils.validation import (
    LENGTH_TOLERANCE,
    ArrayLike,
    Vector,
    invalid,
    magnitude_tensor,
    positive,
    real_tensor,
    require_kind,
)

ByMethod: TypeAlias = Mapping[str, ArrayLike]
Checked: TypeAlias = dict[str, dict[str, Array]]  # by scene and method

MM = 1e3  # pictures show lengths in millimetres
_UNITS = (("MPa", 1e6, 1e6), ("kPa", 1e3, 1e3), ("Pa", 1.0, 1e-2), ("mPa", 1e-3, 1e-5), ("µPa", 1e-6, 0.0))
"""Units of pressure, each with its size and the least pressure that it is used for [Pa]."""


def require_scenes(name: str, scenes: Mapping[str, ByMethod]) -> None:
    """Check that there is at least one scene, each with at least one method."""
    accepted = "must have at least one scene, each with at least one method"
    if not isinstance(scenes, Mapping):
        raise invalid(name, scenes, accepted)
    for scene, methods in scenes.items():
        if not isinstance(methods, Mapping):
            raise invalid(f"{name}[{scene!r}]", methods, "must be a mapping of method names to values")
    if not scenes or not all(scenes.values()):
        raise ValueError(f"{name}: scenes {list(scenes)}; {accepted}")


def require_each(name: str, entries: Mapping[str, object], wanted: Collection[str]) -> None:
    """Check that a mapping has an entry for each name of `wanted`."""
    require_kind(name, entries, Mapping)
    if missing := [key for key in wanted if key not in entries]:
        raise ValueError(f"{name}: none for {missing}; must have one for each of {list(wanted)}")


def labelled(
    name: str, numbers: Mapping[str, Mapping[str, ByMethod]], *axes: str, positive: int = 0
) -> dict[str, Checked]:
    """Return the numbers by label, scene and method, after checking them as `by_scene` does."""
    require_kind(name, numbers, Mapping)
    if not numbers:
        raise ValueError(f"{name}: empty; must have at least one")
    return {
        label: by_scene(f"{name}[{label!r}]", scenes, *axes, positive=positive)
        for label, scenes in numbers.items()
    }


def by_scene(name: str, numbers: Mapping[str, ByMethod], *axes: str, positive: int = 0) -> Checked:
    """Return the finite numbers by scene and method, after checking them.

    Of the `axes`, "2" is a length, other texts are names. The first `positive` columns must be > 0.
    """
    require_scenes(name, numbers)
    checked: Checked = {}
    for scene, methods in numbers.items():
        for method, of_method in methods.items():
            where = f"{name}[{scene!r}][{method!r}]"
            values: Array = real_tensor(where, of_method).detach().cpu().numpy()
            sizes = zip(axes, values.shape, strict=False)
            lengths = [int(axis) if axis.isdigit() else size for axis, size in sizes]
            if values.ndim != len(axes) or list(values.shape) != lengths or values.size == 0:
                accepted = f"must be ({', '.join(axes)}), none of them 0"
                raise ValueError(f"{where}: shape {values.shape}; {accepted}")
            if positive and (least := values[:, :positive].min()) <= 0:
                raise ValueError(f"{where}: {least:g}; must be > 0 on a logarithmic axis")
            checked.setdefault(scene, {})[method] = values
    return checked


def methods_of(scenes: Iterable[Mapping[str, object]]) -> list[str]:
    """Return the methods of all scenes, without repetition, in order of first appearance."""
    return list(dict.fromkeys(method for by_method in scenes for method in by_method))


def plane_magnitude(name: str, pressure: ArrayLike) -> Array:
    """Return |p| (Nu, Nv) of complex pressure, or of its magnitude, on a plane."""
    magnitude: Array = real_tensor(name, magnitude_tensor(name, pressure, "Pa"), "Pa").detach().cpu().numpy()
    if magnitude.ndim != 2 or magnitude.size == 0:
        raise ValueError(f"{name}: shape {magnitude.shape}; must be (Nu, Nv), the points of a plane")
    return magnitude


def outside_on_plane(
    magnitude: Array, plane: Plane, obstacles: Iterable[Obstacle], reflectors: Sequence[Reflector] = ()
) -> Array:
    """Return |p| (Nu, Nv) on a plane, NaN in cells with centres inside obstacles or behind reflectors.

    The field in a body may be many times stronger than in air, and would determine the colour scale.
    """
    _warn_of_swapped_axes(magnitude.shape, plane.size)
    points = cell_centers_of(plane, (magnitude.shape[0], magnitude.shape[1]))
    hidden = inside_any(points, obstacles) | ~are_in_front(reflectors, points)
    return np.where(hidden.numpy(), np.nan, magnitude)


def _warn_of_swapped_axes(counts: tuple[int, ...], size: tuple[float, ...]) -> None:
    """Warn of a map whose cells are oblong, and would be square if it were transposed."""
    sides = [MM * side / count for side, count in zip(size, counts, strict=True)]
    swapped = [side / count for side, count in zip(size, counts[::-1], strict=True)]
    if max(sides) > 1.5 * min(sides) and max(swapped) < 1.2 * min(swapped):
        cells = f"cells of {sides[0]:.3g} mm x {sides[1]:.3g} mm, and square ones if transposed"
        warn_user(f"pressure: shape {counts} has {cells}: are the axes (Nu, Nv) of the plane swapped?")


def largest(magnitude: Array) -> float:
    """Return the largest |p| [Pa] that is not NaN, 0 if there is none."""
    return float(np.nanmax(magnitude, initial=0.0))


def legible_unit(peak: float) -> tuple[str, float]:
    """Return a unit in which pressures up to a peak [Pa] are short numbers, and its size [Pa]."""
    return next((name, size) for name, size, least in _UNITS if (peak or 1.0) >= least)


def pressure_text(pressure: float) -> str:
    """Return a pressure [Pa] with three digits and its unit, such as "4.59 kPa"."""
    name, size = legible_unit(pressure)
    return f"{pressure / size:.3g} {name}"


def zero_level(reference: float | None, name: str, magnitude: Array) -> float:
    """Return the pressure of 0 dB [Pa]: the reference, by default the largest |p| of the field `name`."""
    if reference is not None:
        return positive("reference", reference, "Pa")
    peak = largest(magnitude)
    if peak == 0:
        raise ValueError(f"{name}: 0 Pa everywhere has no level; give the reference of 0 dB [Pa]")
    return peak


def in_decibels(magnitude: Array, zero: float) -> Array:
    """Return the level 20 lg(|p| / zero) [dB]; -inf for 0, NaN for NaN."""
    with np.errstate(divide="ignore"):
        level: Array = 20 * np.log10(magnitude / zero)
    return level


def single_drive_phases(drive: ArrayLike, transducers: int) -> Array:
    """Return the phases (M,) in [0, 2 pi) [rad] of one drive of an array of `transducers`."""
    phases: Array = phases_of(validate_single_drive(drive, transducers)).detach().cpu().numpy()
    return phases


def clipped(corners: Array, lower: Vector, upper: Vector, reflectors: Iterable[Reflector] = ()) -> Array:
    """Clip a convex polygon or a line (K, 3) [m] to a box and to the space in front of reflectors.

    Return L >= 0 corners (L, 3). A clipped line may run back to its start.
    """
    for inwards, corner in ((1.0, lower), (-1.0, upper)):
        for axis in range(3):
            corners = _cut(corners, inwards * (corners[:, axis] - corner[axis]))
    for reflector in reflectors:
        corners = _cut(corners, (corners - np.array(reflector.point)) @ np.array(reflector.normal))
    return corners


def _cut(corners: Array, height: Array) -> Array:
    """Return the part of a polygon (K, 3) where the height (K,) is >= 0 (Sutherland & Hodgman 1974)."""
    height = np.where(np.abs(height) < LENGTH_TOLERANCE, 0.0, height)  # a panel may be the domain's edge
    inside = []
    for here, there in enumerate(np.roll(np.arange(len(corners)), -1)):
        if height[here] >= 0:
            inside.append(corners[here])
        if height[here] * height[there] < 0:
            share = height[here] / (height[here] - height[there])
            inside.append(corners[here] + share * (corners[there] - corners[here]))
    return np.array(inside).reshape(-1, 3)


def parts_of_reflectors(reflectors: Sequence[Reflector], domain: tuple[Vector, Vector]) -> list[Array]:
    """Return the corners (K, 3) [m] of each reflector's part in a domain and in front of the others."""
    lower, upper = (np.array(corner) for corner in domain)
    parts = []
    for reflector in reflectors:
        normal, middle = np.array(reflector.normal), (lower + upper) / 2
        middle = middle - (middle - np.array(reflector.point)) @ normal * normal
        u, v = (float(np.linalg.norm(upper - lower)) * axis.numpy() for axis in plane_basis(reflector.normal))
        corners = middle + np.array([u + v, v - u, -u - v, u - v])
        parts.append(clipped(corners, *domain, [other for other in reflectors if other is not reflector]))
    return parts
