"""Exact fields of point sources, discs and pistons in free space."""

from __future__ import annotations

import math

import numpy as np
import torch

from autdtorch.utils.spatial import distances
from autdtorch.utils.units import real_wavenumber
from autdtorch.utils.validation import (
    LENGTH_TOLERANCE,
    ArrayLike,
    Vector,
    differentiable_points,
    invalid,
    not_negative,
    points_tensor,
    positive,
    real_tensor,
    unit_vector,
)

_SMALL = 1e-8  # Argument up to which 2 J_1(v) / v is 1; J_1 of the least numbers is 0
_HALVINGS = 30  # Halvings of the angle along the rim of a piston towards the point nearest to the receiver
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_PANEL_PHASE = 6.0  # Phase of a panel that 16 Gauss nodes integrate with errors below 1e-13 [rad]


def green(points: ArrayLike, sources: ArrayLike, wavenumber: complex) -> torch.Tensor:
    """Return Green's function of the Helmholtz equation, e^{i k r} / (4 pi r), outgoing with e^{-i w t}.

    Args:
        points: (P, 3) [m].
        sources: (M, 3) [m].
        wavenumber: k [rad/m], > 0, or k + i alpha with an attenuation alpha >= 0 [Np/m].

    Returns:
        complex128 (P, M) [1/m], on the device of `points`, differentiable by them.

    Raises:
        ValueError: an argument is not finite or has another shape, k <= 0, alpha < 0, or a point on a source.
    """
    targets = differentiable_points("points", points)
    origins = points_tensor("sources", sources).to(targets.device)
    if isinstance(wavenumber, complex):
        k = positive("wavenumber.real", wavenumber.real, "rad/m")
        alpha = not_negative("wavenumber.imag", wavenumber.imag, "Np/m")
    else:
        k, alpha = positive("wavenumber", wavenumber, "rad/m"), 0.0
    r = distances(targets, origins)
    if r.detach().min() < LENGTH_TOLERANCE:
        point, source = divmod(int(r.argmin()), len(origins))
        accepted = f"lies on source {source}, must be at least {LENGTH_TOLERANCE:g} m away"
        raise invalid(f"points[{point}]", tuple(targets[point].tolist()), accepted, "m")
    return torch.polar(torch.exp(-alpha * r) / (4 * math.pi * r), k * r)


def piston_field(
    points: ArrayLike, sources: ArrayLike, wavenumber: float, radius: float, normal: Vector
) -> torch.Tensor:
    """Return the pressure of circular pistons in an infinite rigid baffle, by the Rayleigh integral.

    The integral over the disc is exact along rays from the foot of the receiver's perpendicular. The integral
    along the rim remains, (1 / ik) oint (e^{ikR} - e^{ikz}) d phi (Schoch 1941, Akust. Z. 6, 318).

    Args:
        points: (P, 3) [m]; the field is equal on both sides of the disc.
        sources: centres of the pistons (M, 3) [m].
        wavenumber: k [rad/m], > 0.
        radius: a [m], > 0.
        normal: axis of all pistons (3,); any length.

    Returns:
        complex128 (P, M) [1/m]; e^{ikr} / (4 pi r) on the axis far away, as `green`.

    Raises:
        ValueError: not finite, wrong shape, or an argument <= 0.

    Source: Morse & Ingard, Theoretical Acoustics (1968), section 7.4; Pierce, Acoustics, section 5-2.
    """
    targets = points_tensor("points", points)
    centers = points_tensor("sources", sources).to(targets.device)
    wavenumber, radius = real_wavenumber(wavenumber), positive("radius", radius, "m")
    axis = targets.new_tensor(unit_vector("normal", normal))
    between = targets[:, None] - centers
    along = between @ axis
    offset = (between - along[..., None] * axis).norm(dim=-1)
    z = along.abs()
    total = torch.zeros_like(offset, dtype=torch.complex128)
    for angle, weight in _rim(wavenumber * radius):
        # 1 - cos as a square: next to the rim it alone keeps R from zero.
        from_nearest = 2 * math.sin(angle / 2) ** 2
        aside = (radius - offset) ** 2 + 2 * radius * offset * from_nearest
        rim = torch.sqrt(z**2 + aside)
        edge = radius * (radius - offset + offset * from_nearest)
        # aside = R^2 - z^2 in e^{ikR} - e^{ikz} cancels with the denominator of d phi / d angle.
        path = aside / (rim + z)
        factor = weight * edge / (rim + z) * torch.sinc(wavenumber * path / (2 * math.pi))
        total += factor * torch.exp(0.5j * wavenumber * (rim + z))
    return total / (4 * math.pi**2 * radius**2)


def piston_directivity(angle: ArrayLike, wavenumber: float, radius: float) -> torch.Tensor:
    """Return the directivity of a piston, 2 J_1(ka sin angle) / (ka sin angle), which is 1 on the axis.

    Args:
        angle: from the axis, any shape [rad].
        wavenumber: k [rad/m], > 0.
        radius: a [m], > 0.

    Returns:
        complex128 in the shape of `angle`.

    Raises:
        ValueError: not finite, or an argument <= 0.

    Source: Morse & Ingard, Theoretical Acoustics (1968), section 7.4; Pierce, Acoustics, chapter 5.
    """
    angles = real_tensor("angle", angle, "rad").detach()
    reach = real_wavenumber(wavenumber) * positive("radius", radius, "m")
    return directivity(reach * torch.sin(angles)).to(torch.complex128)


def directivity(argument: torch.Tensor) -> torch.Tensor:
    """Return 2 J_1(v) / v of arguments v, float64; it is 1 at 0."""
    safe = torch.where(argument.abs() < _SMALL, _SMALL, argument)
    ratio: torch.Tensor = 2 * torch.special.bessel_j1(safe) / safe
    return ratio


def piston_on_axis(distance: ArrayLike, wavenumber: float, radius: float) -> torch.Tensor:
    """Return the pressure on the axis of a piston: (e^{ik sqrt(z^2 + a^2)} - e^{ikz}) / (2 pi i k a^2).

    `distance` is z from the piston [m], any shape, >= 0; the rest is as for `piston_directivity`.
    The result [1/m], complex128 in the shape of `distance`, is e^{ikz} / (4 pi z) far away, as `green`.

    Source: Pierce, Acoustics, section 5-7; Morse & Ingard, Theoretical Acoustics (1968), section 7.4.
    """
    z = real_tensor("distance", distance, "m").detach()
    if (z < 0).any():
        raise ValueError(f"distance: {float(z.min()):g} m; every entry must be >= 0")
    wavenumber, radius = real_wavenumber(wavenumber), positive("radius", radius, "m")
    rim = torch.hypot(z, torch.full_like(z, radius))
    # Written as a product, the difference of the two waves does not cancel far away.
    half_path = radius**2 / (rim + z) / 2
    amplitude = torch.sinc(wavenumber * half_path / math.pi) / (2 * math.pi * (rim + z))
    return amplitude * torch.exp(0.5j * wavenumber * (rim + z))


def _rim(size: float) -> list[tuple[float, float]]:
    """Return angles over half the rim and weights over all of it, for a size of ka."""
    pieces = 1 + int(size * math.pi / 2 / _PANEL_PHASE)
    edges = [0.0]
    for halving in range(_HALVINGS, -1, -1):
        edges.extend(np.linspace(edges[-1], math.pi / 2**halving, 1 + pieces)[1:].tolist())
    lower, upper = np.array(edges[:-1])[:, None], np.array(edges[1:])[:, None]
    angles = (lower + upper) / 2 + (upper - lower) / 2 * _NODES
    return list(zip(angles.ravel().tolist(), ((upper - lower) * _WEIGHTS).ravel().tolist(), strict=True))
