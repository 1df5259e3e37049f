"""The radiation force on a sphere and its stiffness, as Hermitian forms of the waves that come in.

With coefficients d of the regular waves around the centre, b = T d are those of the outgoing ones, and the
force is s `taken_up`, with P = -i grad / k and s = 1 / (2 rho w^2) (see `propagators.tmatrix.force`).
A shift of the sphere along x changes d by its derivative i k P_x d: the stiffness, -dF/dx, is a form of d,
too.
"""

from __future__ import annotations

import torch

from autdtorch.analytic.momentum import linear_momentum, taken_up
from autdtorch.analytic.spherical_waves import degrees
from autdtorch.utils.array_types import COMPLEX, ComplexArray

PAIRS = (0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)
"""PAIRS: axes of the six different entries of the stiffness."""


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
    one = torch.eye(len(each), **COMPLEX)
    force = scale * taken_up(linear_momentum, one, scattered)
    shift = 1j * wavenumber * linear_momentum(one)
    changes = [-(force[i] @ shift[j] + force[j] @ shift[i]) for i, j in PAIRS]
    return torch.cat([force, torch.stack([(each + each.mH) / 2 for each in changes])])
