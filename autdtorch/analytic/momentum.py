"""Linear and angular momentum of spherical waves: their coefficients after -i grad / k and -i r x grad.

Both are Hermitian, and connect each wave to few others: neighbouring degrees and orders by the gradient, and
neighbouring orders by the rotation (Martin, Multiple Scattering (2006), sections 3.7 and 3.3).
"""

from __future__ import annotations

import functools

import torch

from autdtorch.analytic.spherical_waves import degrees, ladder, orders
from autdtorch.utils.array_types import REAL


def linear_momentum(waves: torch.Tensor) -> torch.Tensor:
    """Return -i grad / k of waves as coefficients (3, ..., N, R) along x, y, z.

    `waves` are coefficients (..., N, R), all regular or all outgoing. Degrees above the highest are cut.
    """
    degree = _degree(waves)
    above = torch.nn.functional.pad(waves, (0, 0, 0, 2 * degree + 3))  # the next degree
    up, down, along = (
        factor[:, 0, None] * above.index_select(-2, place[:, 0])
        + factor[:, 1, None] * above.index_select(-2, place[:, 1])
        for place, factor in ladder(degree)
    )
    return torch.stack([0.5j * (up + down), 0.5 * (down - up), 1j * along])


def angular_momentum(waves: torch.Tensor) -> torch.Tensor:
    """Return -i r x grad of waves as coefficients (3, ..., N, R) along x, y, z; see `linear_momentum`."""
    order, place, factor = _steps(_degree(waves))
    up, down = (factor[:, side, None] * waves.index_select(-2, place[:, side]) for side in (0, 1))
    return torch.stack([(up + down) / 2, (up - down) / 2j, order[:, None] * waves])


def pose_gradient(
    wavenumber: complex, axes: torch.Tensor, waves: torch.Tensor, gradient: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the gradients (..., 3) by the centre and (..., 3, 3) by the axes of regular waves around a body.

    A shift or a turn of the body changes the coefficients as the gradient, or x cross gradient, of the field.

    Args:
        wavenumber: k [rad/m].
        axes: of the body, columns (..., 3, 3).
        waves: coefficients (..., K, R), for all gradients with a degree more than `gradient`.
        gradient: by the coefficients (..., N, R), N <= K.
    """
    count = gradient.shape[-2]
    weights = 1j * gradient.conj()

    def weighed(slopes: torch.Tensor) -> torch.Tensor:  # (3, ..., K, R) to (..., 3, 1)
        return (weights * slopes[..., :count, :]).sum(dim=(-2, -1)).real.movedim(0, -1)[..., None]

    by_place = (axes @ weighed(wavenumber * linear_momentum(waves)))[..., 0]
    turn = weighed(angular_momentum(waves)).mT.expand(*axes.shape)
    return by_place, axes @ torch.linalg.cross(turn, torch.eye(3, **REAL).expand_as(turn)).mT / 2


def _degree(waves: torch.Tensor) -> int:
    return int(waves.shape[-2] ** 0.5 + 0.5) - 1


@functools.lru_cache(8)
def _steps(degree: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the orders (N,), and the places and factors (N, 2) of waves that L_x +- i L_y bring to each."""
    n, m = degrees(degree).to(torch.float64), orders(degree).to(torch.float64)
    factor = torch.stack([((n + m) * (n - m + 1)).sqrt(), ((n - m) * (n + m + 1)).sqrt()], dim=1)
    here = torch.arange(len(m), dtype=torch.int64, device="cpu")
    place = torch.stack([here - 1, here + 1], dim=1)
    return m, torch.where(factor != 0, place, 0), factor
