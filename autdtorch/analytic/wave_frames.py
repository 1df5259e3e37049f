"""Spherical waves in other frames: along turned axes, and around another centre.

A turn maps the harmonics of each degree onto themselves; the map is fitted to their values at a few
directions. Outgoing waves around a centre are regular waves of the same order m around another, which is
higher along z by d:

    h_n(kr) Y_nm = sum_l S_lnm j_l(kr') Y_lm,   S_lnm = 4 pi sum_q i^(l + q - n) h_q(kd) Y_q0(z) I_lnqm.

I is the integral of Y_lm^* Y_nm Y_q0 over all directions (Martin, Multiple Scattering (2006), section 3.7).
Any other shift is one along z between two turns.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import torch

from autdtorch.analytic.spherical_waves import degrees, harmonics, orders, outgoing_waves
from autdtorch.scene.geometry import sphere_points
from autdtorch.utils.array_types import COMPLEX, AnyArray

_SAMPLES = 2
"""Directions for each harmonic of the highest degree, by which a turn is found."""


def turns(degree: int, turn: torch.Tensor) -> list[torch.Tensor]:
    """Return the map R (..., 2 l + 1, 2 l + 1) of the harmonics of each degree, Y' = Y R, differentiable.

    Y' are those along other axes, the columns of `turn` (..., 3, 3) in the coordinates of Y. Their
    handedness may differ.
    """
    directions, inverses = _directions(degree)
    after = harmonics(degree, directions @ turn)
    return [inverse @ after[..., n * n : (n + 1) ** 2] for n, inverse in enumerate(inverses)]


def turned(waves: torch.Tensor, maps: list[torch.Tensor]) -> torch.Tensor:
    """Return waves (..., M, N), in rows, times the map of each degree."""
    return torch.cat([waves[..., n * n : (n + 1) ** 2] @ each for n, each in enumerate(maps)], dim=-1)


def translation(
    wavenumber: complex,
    shift: torch.Tensor,
    regular: tuple[int, torch.Tensor],
    outgoing: tuple[int, torch.Tensor],
) -> torch.Tensor:
    """Return S (..., N, K): outgoing waves around one centre as regular waves around another.

    Args:
        wavenumber: k [rad/m].
        shift: from the centre of the outgoing waves to the other (..., 3) [m].
        regular: the largest degree of the regular waves, and their axes, columns (..., 3, 3).
        outgoing: those of the outgoing waves.

    Gradients of the shift and the axes pass.
    """
    (degree, axes), (other, other_axes) = regular, outgoing
    distance = torch.linalg.vector_norm(shift, dim=-1, keepdim=True)
    frame = _frame(shift / distance)
    radial = outgoing_waves(degree + other, wavenumber, distance * frame.new_tensor([0.0, 0.0, 1.0]))
    terms, place = _along_z(degree, other)
    along = torch.nn.functional.pad(radial[..., orders(degree + other) == 0] @ terms, (0, 1))[..., place]
    there = turns(other, frame.mT @ other_axes)  # as rows of orders -degree to degree:
    rows = [torch.nn.functional.pad(each, (0, 0, degree - n, degree - n)) for n, each in enumerate(there)]
    shifted = along[..., degrees(other)] * torch.cat(rows, dim=-1)[..., orders(degree) + degree, :]
    return turned(shifted.mT, [each.mT for each in turns(degree, axes.mT @ frame)]).mT


def _frame(z: torch.Tensor) -> torch.Tensor:
    """Return axes (..., 3, 3), columns, the last of which is a unit vector z (..., 3)."""
    aside = torch.nn.functional.one_hot(z.detach().abs().argmin(dim=-1), 3).to(z.dtype)
    x = torch.nn.functional.normalize(torch.linalg.cross(aside, z), dim=-1)
    return torch.stack([x, torch.linalg.cross(z, x), z], dim=-1)


@functools.lru_cache(4)
def _along_z(degree: int, other: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the terms (Q, C) of all S_lnm with m >= 0, and the places (N, other + 1) of each there.

    Pairs of waves with S = 0 have place C.
    """
    nodes, weights = np.polynomial.legendre.leggauss(degree + other + 1)
    across, most = np.sqrt(1 - nodes**2), degree + other
    values = harmonics(most, torch.from_numpy(np.stack([across, 0 * nodes, nodes], axis=1))).real.numpy()
    q = np.arange(most + 1)
    zonal = 8 * math.pi**2 * weights[:, None] * values[:, q * q + q]
    place = np.full(((degree + 1) ** 2, other + 1), -1)
    every: list[AnyArray] = []
    for m in range(min(degree, other) + 1):
        n, k = np.arange(m, degree + 1), np.arange(m, other + 1)
        products = values[:, n * n + n + m, None] * values[:, None, k * k + k + m]
        terms = (zonal.T @ products.reshape(len(nodes), -1)).reshape(len(q), len(n), len(k))
        power = q[:, None, None] + n[:, None] - k
        connected = (power % 2 == 0) & (abs(n[:, None] - k) <= q[:, None, None]) & (power <= 2 * n[:, None])
        here = sum(part.shape[1] for part in every) + np.arange(terms[0].size).reshape(terms[0].shape)
        for order in (m, -m):
            place[np.ix_(n * n + n + order, k)] = here
        every.append(np.where(connected, (1 - power % 4) * terms, 0.0).reshape(len(q), -1))
    terms = np.concatenate(every, axis=1)
    place[place < 0] = terms.shape[1]
    return torch.from_numpy(terms).to(COMPLEX["dtype"]), torch.from_numpy(place)


@functools.lru_cache(8)
def _directions(degree: int) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Return directions (n, 3), and the inverse (2 l + 1, n) of the harmonics of each degree at these."""
    directions = sphere_points((0.0, 0.0, 0.0), 1.0, _SAMPLES * (2 * degree + 1))
    values = harmonics(degree, directions)
    return directions, [torch.linalg.pinv(values[:, n * n : (n + 1) ** 2]) for n in range(degree + 1)]
