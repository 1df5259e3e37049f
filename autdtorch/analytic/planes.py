"""Point sources in front of an infinite rigid or pressure-release plane, fluid half-space or fluid slab."""

from __future__ import annotations

import math

import torch

from autdtorch.analytic.green import green
from autdtorch.analytic.layers import Layering, source_response
from autdtorch.utils.validation import (
    LENGTH_TOLERANCE,
    ArrayLike,
    Vector,
    boolean,
    finite_vector,
    points_tensor,
    positive,
    unit_vector,
)


def rigid_plane(
    points: ArrayLike,
    sources: ArrayLike,
    wavenumber: float,
    origin: Vector,
    normal: Vector,
    *,
    scattered: bool = False,
) -> torch.Tensor:
    """Return the field of point sources in front of a rigid plane: source plus image source.

    Args:
        points: (P, 3) [m], in front of the plane or on it.
        sources: (M, 3) [m], in front of the plane or on it.
        wavenumber: k [rad/m], > 0.
        origin: a point (3,) of the plane [m].
        normal: of the plane (3,), towards points and sources; any length.
        scattered: return the reflected wave alone.

    Returns:
        complex128 (P, M) [1/m], in units of `green`.

    Raises:
        ValueError: not finite, wrong shape, out of the ranges above, or a point on a source or its image.

    Source: Pierce, Acoustics, section 5-1.
    """
    image = _image_wave(points, sources, wavenumber, origin, normal)
    return image if boolean("scattered", scattered) else green(points, sources, wavenumber) + image


def soft_plane(
    points: ArrayLike,
    sources: ArrayLike,
    wavenumber: float,
    origin: Vector,
    normal: Vector,
    *,
    scattered: bool = False,
) -> torch.Tensor:
    """Return the field of point sources in front of a pressure-release plane: source minus image source.

    Arguments, returns and errors as for `rigid_plane`.
    """
    image = _image_wave(points, sources, wavenumber, origin, normal)
    return -image if boolean("scattered", scattered) else green(points, sources, wavenumber) - image


def fluid_half_space(
    points: ArrayLike,
    sources: ArrayLike,
    wavenumber: float,
    origin: Vector,
    normal: Vector,
    density_ratio: float,
    speed_ratio: float,
    *,
    scattered: bool = False,
) -> torch.Tensor:
    """Return the field of point sources in front of a fluid half-space, on both sides of its face.

    Arguments, returns and errors as for `rigid_plane`, with the ratios of `step_coefficients`; the points may
    be anywhere. With `scattered`, the field of the sources in the infinite medium is subtracted. The error is
    about 1e-10 of the direct wave.

    Source: Brekhovskikh & Godin, Acoustics of Layered Media II (1992), chapter 1.
    """
    layering = Layering(wavenumber, density_ratio, speed_ratio)
    return _layered_field(points, sources, layering, origin, normal, scattered)


def fluid_slab(
    points: ArrayLike,
    sources: ArrayLike,
    wavenumber: float,
    origin: Vector,
    normal: Vector,
    thickness: float,
    density_ratio: float,
    speed_ratio: float,
    *,
    scattered: bool = False,
) -> torch.Tensor:
    """Return the field of point sources in front of a fluid slab in a medium: in front, inside and behind.

    Arguments, returns and errors as for `rigid_plane`, otherwise as for `fluid_half_space`; the slab has a
    `thickness` [m], > 0.
    """
    layering = Layering(wavenumber, density_ratio, speed_ratio, positive("thickness", thickness, "m"))
    return _layered_field(points, sources, layering, origin, normal, scattered)


def _image_wave(
    points: ArrayLike, sources: ArrayLike, wavenumber: float, origin: Vector, normal: Vector
) -> torch.Tensor:
    targets = points_tensor("points", points)
    origins = points_tensor("sources", sources).to(targets.device)
    axis = targets.new_tensor(unit_vector("normal", normal))
    _heights("points", targets, origin, axis, -LENGTH_TOLERANCE)
    heights = _heights("sources", origins, origin, axis, -LENGTH_TOLERANCE)
    return green(targets, origins - 2 * heights[:, None] * axis, wavenumber)


def _layered_field(
    points: ArrayLike, sources: ArrayLike, layering: Layering, origin: Vector, normal: Vector, scattered: bool
) -> torch.Tensor:
    scattered = boolean("scattered", scattered)
    targets = points_tensor("points", points)
    origins = points_tensor("sources", sources).to(targets.device)
    axis = targets.new_tensor(unit_vector("normal", normal))
    heights = _heights("points", targets, origin, axis)
    above = _heights("sources", origins, origin, axis, LENGTH_TOLERANCE).tolist()
    between = targets[:, None] - origins
    offsets = (between - (between @ axis)[..., None] * axis).norm(dim=-1)
    rows = [
        [source_response(layering, offset, height, source) for offset, source in zip(row, above, strict=True)]
        for row, height in zip(offsets.tolist(), heights.tolist(), strict=True)
    ]
    field = torch.tensor(rows, dtype=torch.complex128, device=targets.device)
    # The integral is the reflected wave in front of the face, and the total field behind it.
    incident = (heights >= 0) != scattered
    if incident.any():
        sign = -1 if scattered else 1
        field[incident] += sign * green(targets[incident], origins, layering.wavenumber)
    return field


def _heights(
    name: str, positions: torch.Tensor, origin: Vector, axis: torch.Tensor, least: float = -math.inf
) -> torch.Tensor:
    """Return the heights [m] of positions over the plane, none below `least`."""
    heights = (positions - axis.new_tensor(finite_vector("origin", origin))) @ axis
    lowest = int(heights.argmin())
    if heights[lowest] < least:
        raise ValueError(
            f"{name}[{lowest}]: {tuple(positions[lowest].tolist())} m, {float(heights[lowest]):g} m in front "
            f"of the plane; must be at least {least:g} m"
        )
    return heights
