"""Several bodies that scatter sound, each by its operator, coupled to one another.

With incoming waves d_i of the array at body i, its outgoing waves are b_i = T_i (d_i + sum_j S_ij b_j), where
S_ij gives the outgoing waves of body j as regular waves around body i (Waterman and Truell 1961,
doi:10.1063/1.1703737). It is exact while the circumscribed spheres do not overlap.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from autdtorch.analytic.green import free_space_matrix
from autdtorch.analytic.spherical_waves import degrees, harmonics, regular_radial
from autdtorch.propagators.operator import ScatteringOperator, incoming_waves, parts_of, waves_at
from autdtorch.scene.arrays import TransducerArray
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.memory import require_memory
from autdtorch.utils.threads import one_library_thread
from autdtorch.utils.validation import (
    LENGTH_TOLERANCE,
    ArrayLike,
    invalid,
    members,
    points_grid,
    require_kind,
)

_SHELLS = (0.55, 0.7, 0.85, 0.99)  # Radii over that of the circumscribed sphere: j_l is small on one at most
_ENTRY_BYTES = 48.0  # of a pair of waves, in the system of equations


@dataclass(frozen=True, eq=False)
class ScatteringBodies:
    """Bodies that move on their own; `ScatteringOperator.moved` places each.

    Attributes:
        operators: of the bodies, all with one wavenumber. Their circumscribed spheres must not overlap;
            obstacles that are nearer make one body.

    Raises:
        ValueError: no operator, other wavenumbers, or spheres that overlap.
    """

    operators: tuple[ScatteringOperator, ...]

    def __init__(self, operators: Iterable[ScatteringOperator]) -> None:
        """Check the bodies; see the class."""
        bodies = members("operators", operators, ScatteringOperator)
        if not bodies:
            raise invalid("operators", operators, "must have at least one")
        for number, body in enumerate(bodies):
            if abs(body.wavenumber - bodies[0].wavenumber) > 1e-9 * abs(bodies[0].wavenumber):
                raise invalid(f"operators[{number}].wavenumber", body.wavenumber, "must be that of the first")
            for other in bodies[:number]:
                apart = float((body.center - other.center).detach().norm())
                if apart < body.radius + other.radius - LENGTH_TOLERANCE:
                    accepted = (
                        f"must be at least {body.radius + other.radius:.4g} m from that of another body"
                    )
                    raise invalid(f"operators[{number}].center", f"{apart:.4g} m apart", accepted)
        object.__setattr__(self, "operators", bodies)

    @one_library_thread()
    def transfer_matrix(self, array: TransducerArray, points: ArrayLike) -> torch.Tensor:
        """Return transfer matrices (..., P, M), complex128 [Pa], of an array at points (..., P, 3) [m].

        Gradients of the bodies' places and turns pass.

        Raises:
            ValueError: a point or transducer within a circumscribed sphere.
        """
        require_kind("array", array, TransducerArray)
        places, grid = points_grid("points", points)
        targets = places.cpu()
        direct = free_space_matrix(targets, array, self.operators[0].wavenumber)
        (scattered,) = scattered_waves(self, array)
        parts = [bodies_at(self, part) @ scattered for part in parts_of(targets, len(scattered))]
        return (direct + torch.cat(parts)).reshape(*grid, -1)


def bodies_at(bodies: ScatteringBodies, points: torch.Tensor) -> torch.Tensor:
    """Return the outgoing waves (P, N) of all bodies at points (P, 3) [m]."""
    return torch.cat([waves_at(body, points) for body in bodies.operators], dim=1)


def scattered_waves(
    bodies: ScatteringBodies, array: TransducerArray, left_out: Sequence[int] = (0,)
) -> list[torch.Tensor]:
    """Return the coefficients (N, M) [Pa] of all bodies' outgoing waves under unit drives of an array.

    Once for each number of highest degrees that are left out, whose coefficients are 0.
    """
    operators = bodies.operators
    incoming = [incoming_waves(body, array).mT for body in operators]
    if len(operators) == 1:
        return [_without(operators[0], fewer) @ incoming[0] for fewer in left_out]
    count = sum(map(len, incoming))
    require_memory("operators", f"{count} waves", _ENTRY_BYTES * count**2)
    rows = [
        [
            torch.zeros_like(body.matrix) if other is body else _regular_waves(body, other)
            for other in operators
        ]
        for body in operators
    ]
    found = []
    for fewer in left_out:
        matrices = [_without(body, fewer) for body in operators]
        alone = torch.cat([own @ waves for own, waves in zip(matrices, incoming, strict=True)])
        coupled = torch.cat([own @ torch.cat(row, dim=1) for own, row in zip(matrices, rows, strict=True)])
        identity = torch.eye(count, **COMPLEX)
        found.append(torch.linalg.solve(identity - coupled, alone))
    return found


def _without(body: ScatteringOperator, fewer: int) -> torch.Tensor:
    """Return T (N, N) of a body with 0 in place of its highest degrees."""
    kept = degrees(body.degree) <= body.degree - fewer
    return torch.where(kept[:, None] & kept, body.matrix, 0) if fewer else body.matrix


def _regular_waves(body: ScatteringOperator, other: ScatteringOperator) -> torch.Tensor:
    """Return S (N, K): outgoing waves of another body as regular waves around this one.

    The waves of the other are sampled on shells inside this body's sphere, where they are regular, and their
    harmonics are divided by j_l in the least-squares sense over shells.
    """
    degree = body.degree
    nodes, weights = np.polynomial.legendre.leggauss(degree + other.degree + 1)
    count = 2 * (degree + other.degree + 1)
    turns = 2 * math.pi * torch.arange(count, **REAL) / count
    height = torch.from_numpy(nodes)
    across = (1 - height.square()).sqrt()
    directions = torch.stack(
        [across[:, None] * turns.cos(), across[:, None] * turns.sin(), height[:, None].expand(-1, count)],
        dim=-1,
    ).reshape(-1, 3)
    area = torch.from_numpy(np.repeat(weights * 2 * math.pi / count, count))
    back = (harmonics(degree, directions).conj() * area[:, None]).mT
    radii = torch.tensor(_SHELLS, **REAL) * body.radius
    sizes = regular_radial(degree, body.wavenumber * radii[:, None])
    found: torch.Tensor = torch.zeros((), **COMPLEX)
    for radius, size in zip(radii, sizes, strict=True):
        places = body.center + radius * directions @ body.axes.mT
        found = found + size.conj()[:, None] * (back @ waves_at(other, places))
    return found / sizes.abs().square().sum(dim=0)[:, None]
