"""The radiation force and torque on bodies with known T-matrices.

Let d be the coefficients of the regular waves that come in on a body and b = T d those of its outgoing waves.
Far away, both are waves towards the body, d / 2, and away from it, d / 2 + b. The former bring momentum, the
latter take some away; the force is the difference.

    F = -1 / (2 rho w^2) Re (d + b)^H P b,   P = -i grad / k,

and, with L = -i r x grad for k P, the torque. Sums over neighbouring degrees and orders (Silva 2011,
doi:10.1121/1.3652894; Gong and Baudoin 2021, doi:10.1121/10.0005491), they are exact for the linear field.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch

from autdtorch.analytic.momentum import angular_momentum, linear_momentum, taken_up
from autdtorch.propagators.tmatrix.propagator import TMatrixPropagator
from autdtorch.propagators.tmatrix.scattering import waves_of_body
from autdtorch.propagators.tmatrix.tmatrix import TMatrix, TMatrixCluster, broadcast
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.drive import validate_drive
from autdtorch.scene.medium import Medium
from autdtorch.scene.reflectors import require_in_front
from autdtorch.utils.array_types import device_of
from autdtorch.utils.mirror_images import Image
from autdtorch.utils.process import one_library_thread
from autdtorch.utils.validation import ArrayLike, integer_at_least, invalid, require_kind

_Momentum = Callable[[torch.Tensor], torch.Tensor]
"""`linear_momentum` or `angular_momentum`."""


def radiation_force(
    bodies: TMatrixPropagator | TMatrixCluster | TMatrix,
    drive: ArrayLike,
    body: int = 0,
    *,
    array: TransducerArray | None = None,
    medium: Medium | None = None,
) -> torch.Tensor:
    """Return the mean radiation force [N] on a body, among others and before reflectors.

    Exact for the linear field and its T-matrix, for bodies that absorb, too. Gradients by the drive and by
    poses pass. Streaming of the air is not included. In air that absorbs, it is the force that the waves at
    the body exert in air that does not.

    Args:
        bodies: a propagator of method "tmatrix", or bodies in any poses, with an array and a medium.
        drive: (..., M) complex, |q| <= 1. With bodies in many poses, leading dimensions are broadcast.
        body: its index in `TMatrixPropagator.bodies.bodies`, or `TMatrixCluster.bodies`.
        array: that drives the bodies; a propagator has its own.
        medium: around the bodies; a propagator has its own.

    Returns:
        float64 (..., 3) along the axes of the scene.

    Raises:
        ValueError: an argument of another kind, shape or range.
    """
    return _Driven.of(bodies, body, array, medium).sums(linear_momentum, drive)


def radiation_torque(
    bodies: TMatrixPropagator | TMatrixCluster | TMatrix,
    drive: ArrayLike,
    body: int = 0,
    *,
    array: TransducerArray | None = None,
    medium: Medium | None = None,
) -> torch.Tensor:
    """Return the mean radiation torque (..., 3) [N m] on a body about its centre; see `radiation_force`.

    The centre is its circumscribed sphere's, `TMatrix.center`. About another point, add the
    cross product of the centre's offset from it and the force.
    """
    return _Driven.of(bodies, body, array, medium).sums(angular_momentum, drive)


def force_matrices(
    bodies: TMatrixPropagator | TMatrixCluster | TMatrix,
    body: int = 0,
    *,
    array: TransducerArray | None = None,
    medium: Medium | None = None,
) -> torch.Tensor:
    """Return Hermitian A (..., 3, M, M) [N], complex128: the force on a body is q^H A q.

    Leading dimensions are those of the poses. Arguments and errors are those of `radiation_force`.
    """
    return _Driven.of(bodies, body, array, medium).matrices()


@dataclass(frozen=True)
class _Driven:
    """A body among others that an array drives; `scale` is 1 / (2 rho w^2)."""

    cluster: TMatrixCluster
    number: int
    array: TransducerArray
    images: Sequence[Image]
    scale: float

    @classmethod
    def of(
        cls,
        bodies: TMatrixPropagator | TMatrixCluster | TMatrix,
        number: int,
        array: TransducerArray | None,
        medium: Medium | None,
    ) -> Self:
        if isinstance(bodies, TMatrixPropagator):
            for name, value in (("array", array), ("medium", medium)):
                if value is not None:
                    raise invalid(name, value, "must be left out: the propagator's scene has it")
            scene = bodies.scene
            cluster, array, medium, images = bodies.bodies, scene.array, scene.medium, scene.images
        else:
            cluster = TMatrixCluster([bodies]) if isinstance(bodies, TMatrix) else bodies
            require_kind("bodies", cluster, TMatrixCluster)
            require_kind("array", array, TransducerArray)
            require_kind("medium", medium, Medium)
            assert array is not None
            assert medium is not None
            require_in_front(cluster.reflectors, "array.positions", array.positions)
            images = cluster.images_around(array.positions)
        number, count = integer_at_least("body", number, 0), len(cluster.bodies)
        if number >= count:
            raise invalid("body", number, f"must be in 0 to {count - 1}")
        frequency = cluster.bodies[number].wavenumber.real * medium.sound_speed
        return cls(cluster, number, array, images, 1 / (2 * medium.density * frequency**2))

    @one_library_thread()
    def sums(self, momentum: _Momentum, drive: ArrayLike) -> torch.Tensor:
        """Return what a body takes up of a momentum (..., 3) under drives (..., M)."""
        device, together = device_of(drive), self.cluster.together_on(self.number)
        drive = validate_drive(drive, len(self.array)).cpu()

        def of_drives(bodies: Sequence[TMatrix], drives: torch.Tensor) -> torch.Tensor:  # (..., R, M)
            regular, outgoing = waves_of_body(bodies, self.number, self.array, self.images, drives, together)
            taken = -(momentum(regular + outgoing).conj() * outgoing).sum(dim=-2).real
            return (self._to_scene(bodies, momentum) @ taken.movedim(0, -2)).mT

        beside = f" beside poses {self.cluster.poses}"
        every = broadcast("drive", drive, beside, self.cluster.poses, drive.shape[:-1])
        poses = (1,) * (len(every) - len(self.cluster.poses)) + self.cluster.poses
        order = sorted(range(len(every)), key=lambda dimension: poses[dimension] == 1)  # of drives alone last
        drives = drive.expand(*every, -1).permute(*order, -1).reshape(math.prod(poses), -1, len(self.array))
        forces = self.cluster.by_poses(
            poses, len(self.array), lambda bodies, part: of_drives(bodies, drives[part])
        )
        forces = forces.reshape(*(every[dimension] for dimension in order), 3)
        return forces.permute(*np.argsort(order), -1).to(device)

    @one_library_thread()
    def matrices(self) -> torch.Tensor:
        """Return the Hermitian matrices (..., 3, M, M) of the linear momentum's `sums`."""
        together = self.cluster.together_on(self.number)

        def of_units(bodies: Sequence[TMatrix], _: slice = slice(None)) -> torch.Tensor:
            regular, outgoing = waves_of_body(bodies, self.number, self.array, self.images, together=together)
            taken = taken_up(linear_momentum, regular, outgoing).movedim(0, -3)
            scene = self._to_scene(bodies, linear_momentum).to(taken.dtype)
            return torch.einsum("...ij,...jmn->...imn", scene, taken)

        poses = self.cluster.poses
        if not poses:
            return of_units(self.cluster.bodies)
        matrices = self.cluster.by_poses(poses, len(self.array), of_units)
        return matrices.reshape(*poses, *matrices.shape[-3:])

    def _to_scene(self, bodies: Sequence[TMatrix], momentum: _Momentum) -> torch.Tensor:
        """Return the map (..., 3, 3) from momentum along a body's axes to that in the scene [SI]."""
        body = bodies[self.number]
        if momentum is linear_momentum:
            return self.scale * body.axes
        handedness: torch.Tensor = torch.linalg.det(body.axes)[..., None, None]
        return self.scale / body.wavenumber.real * handedness * body.axes
