"""Linear and angular momentum of spherical waves: their coefficients after -i grad / k and -i r x grad.

Both are Hermitian, and connect each wave to few others: neighbouring degrees and orders by the gradient, and
neighbouring orders by the rotation (Martin, Multiple Scattering (2006), sections 3.7 and 3.3).

With coefficients d of the regular waves around a sphere, b = T d are those of the outgoing ones, and the
force on it is s `taken_up`, with P = -i grad / k and s = 1 / (2 rho w^2) (see `propagators.tmatrix.force`). A
shift of the sphere along x changes d by its derivative i k P_x d: the stiffness, -dF/dx, is a form of d, too.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import torch

from autdtorch.analytic.spherical_waves import degrees, ladder, orders
from autdtorch.utils.array_types import COMPLEX, REAL, ComplexArray
from autdtorch.utils.process import cached_tensors

PAIRS = (0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)
"""PAIRS: axes of the six different entries of the stiffness."""


def linear_momentum(waves: torch.Tensor) -> torch.Tensor:
    """Return -i grad / k of waves as coefficients (3, ..., N, R) along x, y, z.

    `waves` are coefficients (..., N, R), all regular or all outgoing. Degrees above the highest are cut.
    """
    degree = math.isqrt(waves.shape[-2]) - 1
    above = torch.nn.functional.pad(waves, (0, 0, 0, 2 * degree + 3))  # the next degree
    return torch.stack(_along_axes(*_slopes(degree, above, -2)))


def angular_momentum(waves: torch.Tensor) -> torch.Tensor:
    """Return -i r x grad of waves as coefficients (3, ..., N, R) along x, y, z; see `linear_momentum`."""
    return torch.stack(_about_axes(*_rotations(waves, -2)))


def taken_up(
    momentum: Callable[[torch.Tensor], torch.Tensor], regular: torch.Tensor, outgoing: torch.Tensor
) -> torch.Tensor:
    """Return Hermitian forms (3, ..., R, R): the momentum that a body takes up, -Re (d + b)^H P b.

    Args:
        momentum: P, `linear_momentum` or `angular_momentum`.
        regular: coefficients d (..., N, R) of the waves that come in.
        outgoing: b (..., N, R) of those that it scatters.
    """
    taken = -(momentum(regular + outgoing).mH @ outgoing)
    return (taken + taken.mH) / 2


def gradient_by_place(
    wavenumber: complex, axes: torch.Tensor, waves: torch.Tensor, gradient: torch.Tensor, dim: int = -2
) -> torch.Tensor:
    """Return the gradient (..., 3) by the centre of regular waves, which a shift changes like the field.

    Args:
        wavenumber: k [rad/m].
        axes: of the waves, columns (..., 3, 3).
        waves: their coefficients (..., K, R), with a degree more than `gradient`.
        gradient: by the coefficients (..., N, R).
        dim: dimension of both that counts waves.
    """
    degree = math.isqrt(gradient.shape[dim]) - 1
    slopes = (_weighed(each, gradient, dim) for each in _slopes(degree, waves, dim))
    shift = -torch.stack([(wavenumber * part).imag for part in _along_axes(*slopes)], dim=-1)
    by_place: torch.Tensor = axes @ shift[..., None]
    return by_place[..., 0]


def gradient_by_turn(
    axes: torch.Tensor, waves: torch.Tensor, gradient: torch.Tensor, dim: int = -2
) -> torch.Tensor:
    """Return the gradient (..., 3, 3) by the axes of regular waves (..., K, R); see `gradient_by_place`."""
    some = waves.narrow(dim, 0, gradient.shape[dim])
    rotations = (_weighed(each, gradient, dim) for each in _rotations(some, dim))
    turn = -torch.stack([part.imag for part in _about_axes(*rotations)], dim=-1)[..., None, :]
    turn = turn.expand(*axes.shape)
    by_turn: torch.Tensor = axes @ torch.linalg.cross(turn, torch.eye(3, **REAL).expand_as(turn)).mT
    return by_turn / 2


def _weighed(slope: torch.Tensor, gradient: torch.Tensor, dim: int) -> torch.Tensor:
    """Return the change (...) with slopes of waves by their gradient."""
    products: torch.Tensor = torch.linalg.vecdot(gradient, slope, dim=dim)
    return products.sum(dim=-1)


def _slopes(degree: int, waves: torch.Tensor, dim: int) -> list[torch.Tensor]:
    """Return (d/dx + i d/dy, d/dx - i d/dy, d/dz) / k of waves with a degree more."""
    return [_neighbours(waves, place, factor, dim) for place, factor in ladder(degree)]


def _along_axes(
    up: torch.Tensor, down: torch.Tensor, along: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return 0.5j * (up + down), 0.5 * (down - up), 1j * along


def _rotations(waves: torch.Tensor, dim: int) -> list[torch.Tensor]:
    """Return L_x + i L_y, L_x - i L_y and L_z of waves."""
    degree = math.isqrt(waves.shape[dim]) - 1
    return [_neighbours(waves, place, factor, dim) for place, factor in _steps(degree)]


def _about_axes(
    up: torch.Tensor, down: torch.Tensor, about: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return (up + down) / 2, (up - down) / 2j, about


def _neighbours(waves: torch.Tensor, place: torch.Tensor, factor: torch.Tensor, dim: int) -> torch.Tensor:
    """Return the sums of waves at places (N, n), times factors (N, n)."""
    shape = [1] * waves.ndim
    shape[dim] = -1
    pairs = zip(place.mT, factor.mT, strict=True)
    parts = [share.reshape(shape) * waves.index_select(dim, each) for each, share in pairs]
    total: torch.Tensor = functools.reduce(torch.add, parts)
    return total


@cached_tensors(8)
def _steps(degree: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Return the places (N, 1) of waves, and factors, that L_x + i L_y, L_x - i L_y and L_z bring to each."""
    n, m = degrees(degree).to(torch.float64), orders(degree).to(torch.float64)
    here = torch.arange(len(m), dtype=torch.int64, device="cpu")
    result = []
    for step, squared in ((-1, (n + m) * (n - m + 1)), (1, (n - m) * (n + m + 1)), (0, m * m)):
        place = torch.where(squared != 0, here + step, 0)
        result.append((place[:, None], (squared.sqrt() if step else m)[:, None]))
    return result


def force_forms(ratios: ComplexArray, wavenumber: float, scale: float) -> torch.Tensor:
    """Return Hermitian forms (9, N, N) of the force along x, y, z and of the symmetric stiffness by `PAIRS`.

    Args:
        ratios: b_l / d_l of the sphere (L + 1,); see `sphere_coefficients`.
        wavenumber: k [rad/m].
        scale: s = 1 / (2 rho w^2) [m^3 s^2 / kg].

    Returns:
        Forms of d (N,), N = (L + 3)^2, [N/Pa^2] and [N/m/Pa^2]. The degrees above L only shift with the
        sphere.
    """
    degree = len(ratios) + 1
    each = degrees(degree)
    padded = torch.cat([torch.from_numpy(ratios), torch.zeros(2, **COMPLEX)])
    scattered = torch.diag(padded[each])
    identity = torch.eye(len(each), **COMPLEX)
    force = scale * taken_up(linear_momentum, identity, scattered)
    shift = 1j * wavenumber * linear_momentum(identity)
    changes = [-(force[i] @ shift[j] + force[j] @ shift[i]) for i, j in PAIRS]
    return torch.cat([force, torch.stack([(each + each.mH) / 2 for each in changes])])
