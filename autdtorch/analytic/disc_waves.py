"""The mean of outgoing waves over discs, by which a body's T-matrix takes an array of discs at once.

The mean of a solution of the Helmholtz equation over a disc of radius a with the normal n is

    2 J1(v) / v f,   v^2 = a^2 (k^2 + d^2/dn^2),

at its centre, as a power series of an operator. The derivative of a wave along z is two waves of neighbouring
degrees (Martin, Multiple Scattering (2006), section 3.7). So the mean is a sum of waves of the same order
and of up to twice as many more degrees as powers, in a frame with z along the normal.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import torch

from autdtorch.analytic.spherical_waves import harmonics, outgoing_waves
from autdtorch.scene.geometry import plane_basis, sphere_points

_ERROR = 1e-10
"""Size of the first power that is left out, relative to the wave at the centre."""

_MOST_POWERS = 24

_SAMPLES = 2
"""Directions for each harmonic of the highest degree, by which a turn is found."""


def powers_needed(degree: int, wavenumber: complex, distance: float, radius: float) -> int | None:
    """Return the powers of the series for waves up to a degree at a distance [m]; None if they are too many.

    Across the normal, waves oscillate with at most k or, of high degrees near the centre, degree / distance.
    """
    term = 1.0
    for power in range(1, _MOST_POWERS + 1):
        steepest = max(abs(wavenumber), (degree + 2 * power) / distance)
        term *= (radius * steepest / 2) ** 2 / (power * (power + 1))
        if term < _ERROR:
            return power
    return None


def mean_waves(
    degree: int,
    wavenumber: complex,
    offsets: torch.Tensor,
    normal: torch.Tensor,
    radius: float,
    axes: torch.Tensor,
    powers: int,
) -> torch.Tensor:
    """Return the means (M, N) over discs of h_l(kr) Y_lm^*, the harmonics along `axes`.

    Args:
        degree: the largest l.
        wavenumber: k [rad/m].
        offsets: centres of the discs (M, 3) [m] from the centre of the waves, differentiable.
        normal: of all discs (3,).
        radius: of all discs [m].
        axes: columns (3, 3), differentiable.
        powers: of the series, see `powers_needed`.
    """
    frame = torch.stack([*plane_basis(normal), normal], dim=1)
    waves = outgoing_waves(degree + 2 * powers, wavenumber, offsets @ frame, conjugate=True)
    sources, targets, means = zip(*_means(degree, wavenumber * radius, powers), strict=True)
    parts = [waves[:, source] @ mean for source, mean in zip(sources, means, strict=True)]
    return turned_waves(torch.cat(parts, dim=1)[:, torch.cat(targets).argsort()], frame.mT @ axes)


def turned_waves(waves: torch.Tensor, turn: torch.Tensor) -> torch.Tensor:
    """Return waves (M, N) of Y_lm^* as waves along other axes, the columns of a matrix (3, 3) in these.

    Harmonics of a degree turn into those of the same degree, by a map that their values at a few directions
    decide.
    """
    directions, inverses = _directions(math.isqrt(waves.shape[1]) - 1)
    after = harmonics(len(inverses) - 1, directions @ turn).conj()
    parts = [slice(n * n, (n + 1) ** 2) for n in range(len(inverses))]
    pairs = zip(parts, inverses, strict=True)
    return torch.cat([waves[:, part] @ (inverse @ after[:, part]) for part, inverse in pairs], dim=1)


@functools.lru_cache(16)
def _means(degree: int, size: complex, powers: int) -> list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Return for each order the places of its waves, those of their means, and the map from all to these."""
    result = []
    for least in range(degree + 1):
        every = np.arange(least, degree + 2 * powers + 1)
        upper = np.sqrt((every[1:] ** 2 - least**2) / (4.0 * every[1:] ** 2 - 1))
        slope = np.diag(upper, -1) - np.diag(upper, 1)  # d/dz of the waves of a degree, in a row
        step = -((size / 2) ** 2) * (np.eye(len(every)) + slope @ slope)
        term = total = np.eye(len(every), dtype=np.complex128)
        for power in range(1, powers + 1):
            term = term @ step / (power * (power + 1))
            total = total + term
        means = torch.from_numpy(total[: degree + 1 - least].T.copy())
        for order in {least, -least}:
            places = torch.from_numpy(every**2 + every + order)
            result.append((places, places[: means.shape[1]], means))
    return result


@functools.lru_cache(8)
def _directions(degree: int) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Return directions (n, 3), and the inverse (2 l + 1, n) of the Y_lm^* of each degree at these."""
    directions = sphere_points((0.0, 0.0, 0.0), 1.0, _SAMPLES * (2 * degree + 1))
    values = harmonics(degree, directions).conj()
    return directions, [torch.linalg.pinv(values[:, n * n : (n + 1) ** 2]) for n in range(degree + 1)]
