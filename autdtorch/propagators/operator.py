"""The scattering operator of a body: simulated once, then for any array, points and pose.

Outside its circumscribed sphere a body is a linear map T from the regular waves that come in to the outgoing
waves that it scatters, b = T d (Waterman 1969, doi:10.1121/1.1911498). A column of T is one run of the box
solver, driven by one regular wave; the Huygens surface gives the outgoing ones.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from autdtorch.analytic.green import free_space_matrix
from autdtorch.analytic.spherical_waves import mirrored, outgoing_waves
from autdtorch.fdtd.kernels.choice import available_kernel
from autdtorch.propagators.body_matrix import Solver, placed
from autdtorch.propagators.cache import disk_cache
from autdtorch.scene.arrays import TransducerArray, strengths_of
from autdtorch.scene.geometry import composed_rotation
from autdtorch.scene.medium import Medium
from autdtorch.scene.obstacles import Obstacle
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.files import read_arrays, write_arrays
from autdtorch.utils.threads import one_library_thread
from autdtorch.utils.units import turn_tensor
from autdtorch.utils.validation import (
    LENGTH_TOLERANCE,
    ArrayLike,
    finite_vector,
    invalid,
    members,
    number_between,
    path_of,
    points_grid,
    positive,
    real_tensor,
    require_kind,
    within,
)

_AT_ONCE = 200_000  # Waves at points that are computed at once: 3 MB, which fit into a cache
_ARRAYS = ("matrix", "center", "axes", "radius", "wavenumber")


@dataclass(frozen=True, eq=False)
class ScatteringOperator:
    """A body that scatters sound, outside its circumscribed sphere, in any pose.

    `ScatteringOperator.of` simulates obstacles that move as one body.

    Attributes:
        matrix: T (N, N), complex128, from regular to outgoing spherical waves around the centre, up to the
            degree N^(1/2) - 1.
        wavenumber: in the medium [rad/m], complex.
        radius: of the circumscribed sphere [m]; points and transducers must lie outside.
        center: of the sphere (3,) [m].
        axes: of the body in the scene, the columns of a matrix (3, 3).
    """

    matrix: torch.Tensor
    wavenumber: complex
    radius: float
    center: torch.Tensor
    axes: torch.Tensor

    @classmethod
    def of(
        cls,
        obstacles: Obstacle | Iterable[Obstacle],
        medium: Medium,
        frequency: float,
        spacing: float = 1e-3,
        error: float = 1e-3,
        kernel: str = "auto",
        *,
        device: torch.device | str | None = None,
        cache: str | os.PathLike[str] | Literal[False] | None = None,
    ) -> ScatteringOperator:
        """Simulate the operator of obstacles; for a single sphere it is exact.

        Args:
            obstacles: one, or several that move as one body.
            medium: around them.
            frequency: [Hz].
            spacing: edge of a cell [m].
            error: relative error at which degrees are left out, and tolerance of the simulations, in
                1e-8 to 0.1.
            kernel: as in `make_propagator`, as is `device`.
            device: where simulations run.
            cache: folder for simulated operators, as in `make_propagator`: used again for the same body,
                wherever it is.

        Raises:
            ValueError: a setting out of range, or a body of too many waves for the memory.
        """
        bodies = members("obstacles", [obstacles] if isinstance(obstacles, Obstacle) else obstacles, Obstacle)
        if not bodies:
            raise invalid("obstacles", obstacles, "must have at least one")
        require_kind("medium", medium, Medium)
        frequency = positive("frequency", frequency, "Hz")
        spacing, error = positive("spacing", spacing, "m"), number_between("error", error, 1e-8, 0.1)
        solver = Solver(spacing, error, available_kernel(kernel, device))
        return cls(*placed(bodies, medium, frequency, solver).matrix(disk_cache(cache)))

    @property
    def degree(self) -> int:
        """The largest degree of the waves."""
        return math.isqrt(len(self.matrix)) - 1

    @property
    def reciprocity(self) -> float:
        """The relative difference of T from its image under reciprocity, which an exact T equals."""
        place, sign = mirrored(self.degree)
        image = sign[:, None] * self.matrix.mT[place][:, place] * sign
        return float(
            (self.matrix - image).norm() / self.matrix.norm().clamp_min(torch.finfo(torch.float64).tiny)
        )

    @property
    def energy(self) -> float:
        """The rms of |S^H S - 1| over waves, S = 1 + 2 T: 0 for an exact T without losses."""
        scattering = torch.eye(len(self.matrix), **COMPLEX) + 2 * self.matrix
        left = scattering.mH @ scattering - torch.eye(len(self.matrix), **COMPLEX)
        return float(left.norm() / math.sqrt(len(left)))

    def moved(
        self,
        offset: ArrayLike = (0.0, 0.0, 0.0),
        rotation: ArrayLike = (0.0, 0.0, 0.0),
        *,
        rotation_degrees: ArrayLike | None = None,
    ) -> ScatteringOperator:
        """Return the body after a shift, and a rotation about its centre.

        Args:
            offset: (3,) [m].
            rotation: angles (3,) [rad] about the fixed axes x, y, z, in this order.
            rotation_degrees: these angles (3,) in degrees, in place of `rotation`.

        Gradients of all pass.
        """
        shift, angles = real_tensor("offset", offset, "m"), turn_tensor(rotation, rotation_degrees)
        if shift.shape != (3,):
            raise ValueError(f"offset: shape {tuple(shift.shape)}; must be (3,)")
        return replace(
            self, center=self.center + shift, axes=composed_rotation(angles.cos(), angles.sin()) @ self.axes
        )

    @one_library_thread()
    def transfer_matrix(self, array: TransducerArray, points: ArrayLike) -> torch.Tensor:
        """Return transfer matrices (..., P, M), complex128 [Pa], of an array at points (..., P, 3) [m].

        Gradients of the body's place and turn pass.

        Raises:
            ValueError: a point or transducer within the circumscribed sphere. `make_propagator` serves those.
        """
        require_kind("array", array, TransducerArray)
        places, grid = points_grid("points", points)
        targets = places.cpu()
        direct = free_space_matrix(targets, array, self.wavenumber)
        scattered = self.matrix @ incoming_waves(self, array).mT
        parts = [waves_at(self, part) @ scattered for part in parts_of(targets, len(self.matrix))]
        return (direct + torch.cat(parts)).reshape(*grid, -1)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the operator to a .npz file."""
        path = path_of("path", path, suffixes=(".npz",))
        values = {name: getattr(self, name) for name in _ARRAYS}
        plain = {
            name: value.detach() if isinstance(value, torch.Tensor) else value
            for name, value in values.items()
        }
        write_arrays(path, {name: np.asarray(value) for name, value in plain.items()})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> ScatteringOperator:
        """Read an operator that `save` wrote; `ValueError` for another file."""
        arrays = read_arrays(path_of("path", path, suffixes=(".npz",)))
        if missing := [name for name in _ARRAYS if name not in arrays]:
            raise ValueError(
                f"{path}: no array {', '.join(missing)}; must be written by ScatteringOperator.save"
            )
        with within(path):
            matrix = torch.from_numpy(arrays["matrix"]).to(torch.complex128)
            if (
                matrix.ndim != 2
                or matrix.shape[0] != matrix.shape[1]
                or math.isqrt(len(matrix)) ** 2 != len(matrix)
            ):
                raise ValueError(f"matrix: shape {tuple(matrix.shape)}; must be (N, N), N a square")
            center = torch.tensor(finite_vector("center", arrays["center"]), **REAL)
            axes = real_tensor("axes", arrays["axes"])
            if axes.shape != (3, 3):
                raise ValueError(f"axes: shape {tuple(axes.shape)}; must be (3, 3)")
            radius = positive("radius", float(arrays["radius"]), "m")
            return cls(matrix, complex(arrays["wavenumber"]), radius, center, axes)


def parts_of(points: torch.Tensor, waves: int) -> tuple[torch.Tensor, ...]:
    """Return points (P, ..., 3) in parts, so that few of so many waves at them are in memory at once."""
    each = points[0].numel() // 3
    return torch.split(points, max(1, _AT_ONCE // (each * waves)))


def incoming_waves(body: ScatteringOperator, array: TransducerArray) -> torch.Tensor:
    """Return the coefficients (M, N) [Pa] of the regular waves of unit drives around a body."""
    positions, weights = array.nodes
    offsets = _offsets(body, "array.positions", positions)
    means = [
        torch.einsum(
            "mnk,n->mk",
            outgoing_waves(body.degree, body.wavenumber, some, conjugate=True),
            weights.to(torch.complex128),
        )
        for some in parts_of(offsets, len(body.matrix))
    ]
    return 4j * math.pi * body.wavenumber * strengths_of(array)[:, None] * torch.cat(means)


def waves_at(body: ScatteringOperator, points: torch.Tensor) -> torch.Tensor:
    """Return the outgoing waves (P, N) of a body at points (P, 3) [m]."""
    return outgoing_waves(body.degree, body.wavenumber, _offsets(body, "points", points))


def _offsets(body: ScatteringOperator, name: str, positions: torch.Tensor) -> torch.Tensor:
    """Return positions (..., 3) in the coordinates of a body, after checking that they are outside."""
    offsets = positions - body.center
    nearest = float(torch.linalg.vector_norm(offsets, dim=-1).detach().amin())
    if nearest < body.radius - LENGTH_TOLERANCE:
        accepted = f"must be at least {body.radius:.4g} m from the centre of the body"
        raise ValueError(f"{name}: {nearest:.4g} m at the nearest; {accepted}")
    return offsets @ body.axes
