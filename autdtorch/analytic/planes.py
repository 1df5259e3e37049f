"""Point sources in front of an infinite plane: rigid, soft, with an impedance, or the face of a fluid."""

from __future__ import annotations

import cmath
import math

import numpy as np
import torch

from autdtorch.analytic.green import green
from autdtorch.analytic.layering import Layering, source_response
from autdtorch.utils.fluids import passive_impedance
from autdtorch.utils.units import real_wavenumber
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

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_PANEL_PHASE = 6.0  # phase of a panel that 16 Gauss nodes integrate with errors below 1e-13 [rad]
_DECAY = 36.0  # nepers after which the line of images ends
_DIRECTION = math.radians(60)  # angle of 1 + b times the depth on the line of images
_LEAST = math.radians(5)  # angle of the line of images to both axes,
_OFF_BRANCH = 1e-6  # but to the imaginary one where weights would grow along it [rad]
_IN_FRONT = -LENGTH_TOLERANCE, -LENGTH_TOLERANCE  # least heights of points and sources


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
    targets, origins, axis, _, above = _placed(points, sources, origin, normal, *_IN_FRONT)
    image = green(targets, origins - 2 * above[:, None] * axis, wavenumber)
    return image if boolean("scattered", scattered) else green(targets, origins, wavenumber) + image


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
    image = -rigid_plane(points, sources, wavenumber, origin, normal, scattered=True)
    return image if boolean("scattered", scattered) else green(points, sources, wavenumber) + image


def impedance_plane(
    points: ArrayLike,
    sources: ArrayLike,
    wavenumber: float,
    origin: Vector,
    normal: Vector,
    impedance: complex,
    *,
    scattered: bool = False,
) -> torch.Tensor:
    """Return the field of point sources in front of a plane with an impedance: sources and lines of images.

    Arguments, returns and errors as for `rigid_plane`, with the `impedance` of the surface as a ratio to
    rho c of the medium: pressure over the velocity into it, with a real part >= 0. The error is about 1e-11
    of the direct wave, and 1e-7 where a surface without losses guides waves.

    The images of a source lie on a line from its mirror image, at the distance R, into complex depths s:

        e^{ikR} / R + 2 i k b int_0^inf e^{ikbs} e^{ik R(s)} / R(s) ds,    R(s)^2 = r^2 + (h + s)^2,

    with the admittance b = 1 / impedance, the distance r along the plane, and the sum h of both heights.

    Source: Thomasson (1976), J. Acoust. Soc. Am. 59, 780; Di & Gilbert (1993), J. Acoust. Soc. Am. 93, 714.
    """
    wavenumber, scattered = real_wavenumber(wavenumber), boolean("scattered", scattered)
    admittance = 1 / passive_impedance("impedance", impedance)
    targets, origins, axis, heights, above = _placed(points, sources, origin, normal, *_IN_FRONT)
    images = origins - 2 * above[:, None] * axis
    apart = (heights[:, None] + above).clamp(min=0)
    image = green(targets, images, wavenumber)
    lines = [
        [_line(wavenumber, admittance, offset, height) for offset, height in zip(row, sums, strict=True)]
        for row, sums in zip(_offsets(targets, images, axis).tolist(), apart.tolist(), strict=True)
    ]
    line = torch.tensor(lines, dtype=torch.complex128, device=targets.device)
    reflected = image + 0.5j / math.pi * wavenumber * admittance * line
    return reflected if scattered else reflected + green(targets, origins, wavenumber)


def fluid_half_space(
    points: ArrayLike,
    sources: ArrayLike,
    wavenumber: float,
    origin: Vector,
    normal: Vector,
    density_ratio: complex,
    speed_ratio: complex,
    *,
    scattered: bool = False,
) -> torch.Tensor:
    """Return the field of point sources in front of a fluid half-space, on both sides of its face.

    Arguments, returns and errors as for `rigid_plane`, with the ratios rho_1 / rho > 0 and c_1 / c > 0, both
    complex in a fluid that absorbs, as of an `Obstacle`; the points may be anywhere. With `scattered`, the
    field of the sources in the infinite medium is subtracted. The error is about 1e-10 of the direct wave.

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
    density_ratio: complex,
    speed_ratio: complex,
    *,
    scattered: bool = False,
) -> torch.Tensor:
    """Return the field of point sources in front of a fluid slab in a medium: in front, inside and behind.

    Arguments, returns and errors as for `rigid_plane`, otherwise as for `fluid_half_space`; the slab has a
    `thickness` [m], > 0.
    """
    layering = Layering(wavenumber, density_ratio, speed_ratio, positive("thickness", thickness, "m"))
    return _layered_field(points, sources, layering, origin, normal, scattered)


def _layered_field(
    points: ArrayLike, sources: ArrayLike, layering: Layering, origin: Vector, normal: Vector, scattered: bool
) -> torch.Tensor:
    scattered = boolean("scattered", scattered)
    targets, origins, axis, heights, above = _placed(
        points, sources, origin, normal, -math.inf, LENGTH_TOLERANCE
    )
    rows = [
        [
            source_response(layering, offset, height, source)
            for offset, source in zip(row, above.tolist(), strict=True)
        ]
        for row, height in zip(_offsets(targets, origins, axis).tolist(), heights.tolist(), strict=True)
    ]
    field = torch.tensor(rows, dtype=torch.complex128, device=targets.device)
    # The integral is the reflected wave in front of the face, and the total field behind it.
    incident = (heights >= 0) != scattered
    if incident.any():
        sign = -1 if scattered else 1
        field[incident] += sign * green(targets[incident], origins, layering.wavenumber)
    return field


def _placed(
    points: ArrayLike,
    sources: ArrayLike,
    origin: Vector,
    normal: Vector,
    lowest_point: float,
    lowest_source: float,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return points, sources, the unit normal, and the heights [m] of both, none below the lowest."""
    targets = points_tensor("points", points)
    origins = points_tensor("sources", sources).to(targets.device)
    axis = targets.new_tensor(unit_vector("normal", normal))
    heights = _heights("points", targets, origin, axis, lowest_point)
    return targets, origins, axis, heights, _heights("sources", origins, origin, axis, lowest_source)


def _offsets(targets: torch.Tensor, origins: torch.Tensor, axis: torch.Tensor) -> torch.Tensor:
    """Return the distances (P, M) [m] along the plane."""
    between = targets[:, None] - origins
    offsets: torch.Tensor = (between - (between @ axis)[..., None] * axis).norm(dim=-1)
    return offsets


def _heights(
    name: str, positions: torch.Tensor, origin: Vector, axis: torch.Tensor, least: float
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


def _line(wavenumber: float, admittance: complex, offset: float, height: float) -> complex:
    """Return the integral over the images of a source, at a distance along the plane and a sum of heights.

    They decay as e^{ik (b + 1) s} far along the line, and at least as their weights e^{ikbs} everywhere. The
    direction of the line keeps off the branch point of R(s).
    """
    turn = cmath.phase(1 + admittance)
    direction = min(max(_DIRECTION - turn, _LEAST), math.pi / 2 - _LEAST)
    # On surfaces with guided waves, weights grow along the line unless it is steep.
    direction = max(direction, min(cmath.phase(admittance.conjugate()), math.pi / 2 - _OFF_BRANCH))
    along = cmath.rect(1.0, direction)
    weights_end = _DECAY / wavenumber / max((admittance * along).imag, 1e-9)
    length = min(2 * offset + _DECAY / wavenumber / ((1 + admittance) * along).imag, weights_end)
    edges = [0.0]
    while edges[-1] < length:  # panels are shorter than half the way to the branch point, and than some waves
        depth = height + edges[-1] * along
        slope = abs(depth) / max(abs(cmath.sqrt(offset**2 + depth**2)), _OFF_BRANCH * offset)
        rate = abs(admittance) + max(1.0, slope)
        edges.append(edges[-1] + min(abs(depth - 1j * offset) / 2, _PANEL_PHASE / (wavenumber * rate)))
    half = np.diff(edges)[:, None] / 2
    depths = np.complex128(along) * (np.array(edges[:-1])[:, None] + half * (1 + _NODES))
    distance = np.sqrt(offset**2 + (height + depths) ** 2)
    terms = np.exp(1j * wavenumber * (admittance * depths + distance)) / distance
    return complex(along * np.sum(half * _WEIGHTS * terms))
