"""T-matrices: simulate a body once, then place it anywhere, alone or among others.

Outside its circumscribed sphere a body is a linear map T from the regular waves that come in to the outgoing
waves that it scatters, b = T d (Waterman 1969, doi:10.1121/1.1911498). A column of T is one run of the box
solver, driven by one regular wave; the Huygens surface gives the outgoing ones. Several bodies are coupled by
`multiple_scattering`, which is exact while their circumscribed spheres do not overlap.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch

from autdtorch.analytic.spherical_waves import mirrored
from autdtorch.fdtd.kernels import available_kernel
from autdtorch.propagators.free_space import free_space_matrix
from autdtorch.propagators.store import store_in
from autdtorch.propagators.tmatrix.body_matrix import BodyMatrix
from autdtorch.propagators.tmatrix.body_simulation import Solver, placed
from autdtorch.propagators.tmatrix.scattering import joined, joined_on, scattered_field
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.geometry import composed_rotation
from autdtorch.scene.medium import Medium
from autdtorch.scene.obstacles import Obstacle
from autdtorch.scene.reflectors import Reflector, require_arrangement, require_in_front
from autdtorch.utils.array_types import COMPLEX, REAL, device_of
from autdtorch.utils.files import path_of, read_arrays, write_arrays
from autdtorch.utils.hints import renamed_keywords
from autdtorch.utils.mirror_images import NO_MIRRORS, Image, images_of
from autdtorch.utils.process import cached_property, one_library_thread, spread
from autdtorch.utils.units import turn_tensor, warn_user
from autdtorch.utils.validation import (
    LENGTH_TOLERANCE,
    ArrayLike,
    finite_vector,
    invalid,
    members,
    number_between,
    points_grid,
    positive,
    real_tensor,
    require_kind,
    within,
)

_AT_ONCE = 200_000
"""Waves of transducers in many poses that are computed at once: 3 MB, which fit into a cache."""

_FEWEST = 64
"""Fewest poses at once of bodies that send one another waves, whose operations on a pose are small."""

_ARRAYS = ("matrix", "center", "axes", "radius", "wavenumber")


@dataclass(frozen=True, eq=False)
class TMatrix(BodyMatrix):
    """A body that scatters sound, outside its circumscribed sphere, in any pose.

    `TMatrix.of` simulates obstacles that move as one body.

    Attributes:
        matrix: T (N, N), complex128, from regular to outgoing spherical waves around the centre, up to the
            degree N^(1/2) - 1.
        wavenumber: in the medium [rad/m], complex.
        radius: of the circumscribed sphere [m]; points and transducers must lie outside.
        center: of the sphere (3,) [m], or (..., 3) of many poses.
        axes: of the body in the scene, the columns of a matrix (3, 3), or (..., 3, 3).
    """

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
    ) -> TMatrix:
        """Simulate the T-matrix of obstacles; for a single sphere it is exact.

        A body of few cells is coarse: a bead in air that absorbs needs a `spacing` far below its radius.

        Args:
            obstacles: one, or several that move as one body.
            medium: around them.
            frequency: [Hz].
            spacing: edge of a cell [m].
            error: relative error at which degrees are left out, and tolerance of the simulations, in
                1e-8 to 0.1.
            kernel: as in `make_propagator`, as is `device`.
            device: where simulations run.
            cache: folder for simulated T-matrices, as in `make_propagator`: used again for the same body,
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
        return cls(**vars(placed(bodies, medium, frequency, solver).matrix(store_in(cache))))

    @property
    def reciprocity(self) -> float:
        """The relative difference of T from its image under reciprocity, which an exact T equals."""
        place, sign = mirrored(self.degree)
        image = sign[:, None] * self.matrix.mT[place][:, place] * sign
        least = torch.finfo(torch.float64).tiny
        return float((self.matrix - image).norm() / self.matrix.norm().clamp_min(least))

    @property
    def energy(self) -> float:
        """The rms of |S^H S - 1| over waves, S = 1 + 2 T: 0 for an exact T of a body that absorbs nothing."""
        identity = torch.eye(len(self.matrix), **COMPLEX)
        scattering = identity + 2 * self.matrix
        return float((scattering.mH @ scattering - identity).norm() / math.sqrt(len(identity)))

    def moved(
        self,
        offset: ArrayLike = (0.0, 0.0, 0.0),
        rotation: ArrayLike = (0.0, 0.0, 0.0),
        *,
        rotation_degrees: ArrayLike | None = None,
    ) -> TMatrix:
        """Return the body after a shift, and a rotation about its centre.

        Args:
            offset: (3,) [m], or (..., 3) for many poses at once.
            rotation: angles (3,) or (..., 3) [rad] about the fixed axes x, y, z, in this order.
            rotation_degrees: these angles (3,) or (..., 3) in degrees, in place of `rotation`.

        Gradients of all pass. Transfer matrices of many poses have their leading dimensions.
        """
        shift = real_tensor("offset", offset, "m").cpu()
        angles = turn_tensor(rotation, rotation_degrees).cpu()
        if shift.ndim == 0 or shift.shape[-1] != 3 or not shift.numel():
            raise ValueError(f"offset: shape {tuple(shift.shape)}; must be (3,), or (..., 3) for many poses")
        before = np.broadcast_shapes(self.center.shape[:-1], self.axes.shape[:-2])
        beside = f" beside a rotation of {tuple(angles.shape)}" + (f" and poses {before}" if before else "")
        poses = broadcast("offset", shift, beside, shift.shape[:-1], angles.shape[:-1], before)
        axes = composed_rotation(angles.cos(), angles.sin()) @ self.axes
        return replace(self, center=self.center + shift, axes=axes).in_poses(poses)

    def transfer_matrix(self, array: TransducerArray, points: ArrayLike) -> torch.Tensor:
        """Return transfer matrices (..., P, M) [Pa]; see `TMatrixCluster.transfer_matrix`.

        Raises:
            ValueError: a point or transducer within the circumscribed sphere. `make_propagator` serves those.
        """
        return TMatrixCluster([self]).transfer_matrix(array, points)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the T-matrix to a .npz file."""
        path = path_of("path", path, suffixes=(".npz",))
        if self.center.ndim > 1:
            raise ValueError(f"center: shape {tuple(self.center.shape)}; a file holds one pose, (3,)")
        tensors = {name: getattr(self, name).detach() for name in ("matrix", "center", "axes")}
        values = vars(replace(self, **tensors))
        write_arrays(path, {name: np.asarray(values[name]) for name in _ARRAYS})

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> TMatrix:
        """Read a T-matrix that `save` wrote; `ValueError` for another file."""
        arrays = read_arrays(path_of("path", path, suffixes=(".npz",)))
        if missing := [name for name in _ARRAYS if name not in arrays]:
            raise ValueError(f"{path}: no array {', '.join(missing)}; must be written by TMatrix.save")
        with within(path):
            matrix = torch.from_numpy(arrays["matrix"]).to(torch.complex128)
            count = len(matrix) if matrix.ndim == 2 else 0
            if matrix.shape != (count, count) or math.isqrt(count) ** 2 != count:
                raise ValueError(f"matrix: shape {tuple(matrix.shape)}; must be (N, N), N a square")
            center = torch.tensor(finite_vector("center", arrays["center"]), **REAL)
            axes = real_tensor("axes", arrays["axes"])
            if axes.shape != (3, 3):
                raise ValueError(f"axes: shape {tuple(axes.shape)}; must be (3, 3)")
            radius = positive("radius", float(arrays["radius"]), "m")
            return cls(matrix, complex(arrays["wavenumber"]), radius, center, axes)


def broadcast(name: str, value: torch.Tensor, beside: str, *shapes: Sequence[int]) -> tuple[int, ...]:
    """Return what leading dimensions broadcast to; the message names a value and what is beside it."""
    try:
        return np.broadcast_shapes(*map(tuple, shapes))
    except ValueError:
        shape = f"{tuple(value.shape)}{beside}"
        raise ValueError(f"{name}: shape {shape}; leading dimensions must broadcast") from None


@dataclass(frozen=True, eq=False)
class TMatrixCluster:
    """Bodies that move on their own, by `TMatrix.moved`, or as one, by `moved`.

    Attributes:
        bodies: their T-matrices, all with one wavenumber. Their circumscribed spheres must not overlap;
            obstacles that are nearer make one body.
        reflectors: planes that reflect, in front of all spheres, as in a `Scene`.

    Raises:
        ValueError: no body, other wavenumbers, or spheres that overlap or cross a reflector.
    """

    bodies: tuple[TMatrix, ...]
    reflectors: tuple[Reflector, ...]
    # the bodies, at rest, that have moved as one
    _before: TMatrixCluster | None = field(init=False, repr=False)

    @renamed_keywords(operators="bodies")
    def __init__(self, bodies: Iterable[TMatrix], reflectors: Iterable[Reflector] = ()) -> None:
        """Check the bodies; see the class."""
        bodies = members("bodies", bodies, TMatrix)
        if not bodies:
            raise invalid("bodies", bodies, "must have at least one")
        for number, body in enumerate(bodies):
            if abs(body.wavenumber - bodies[0].wavenumber) > 1e-9 * abs(bodies[0].wavenumber):
                raise invalid(f"bodies[{number}].wavenumber", body.wavenumber, "must be that of the first")
            for other in bodies[:number]:
                others = f" beside {tuple(other.center.shape)}"
                poses = body.center.shape[:-1], other.center.shape[:-1]
                broadcast(f"bodies[{number}].center", body.center, others, *poses)
                least = body.radius + other.radius
                apart = float((body.center - other.center).detach().norm(dim=-1).min())
                if apart < least - LENGTH_TOLERANCE:
                    accepted = f"must be at least {least:.4g} m from that of another body"
                    raise invalid(f"bodies[{number}].center", f"{apart:.4g} m apart", accepted)
        object.__setattr__(self, "bodies", bodies)
        reflectors = members("reflectors", reflectors, Reflector)
        require_arrangement(reflectors, bodies[0].wavenumber)
        for number, body in enumerate(bodies):
            for index, reflector in enumerate(reflectors):
                height = float(reflector.mirror.height(body.center.detach()).min())
                if height < body.radius - LENGTH_TOLERANCE:
                    accepted = f"must be at least {body.radius:.4g} m in front of reflector {index}"
                    raise invalid(f"bodies[{number}].center", f"{height:.4g} m", accepted)
        object.__setattr__(self, "reflectors", reflectors)
        object.__setattr__(self, "_before", None)

    @property
    def operators(self) -> tuple[TMatrix, ...]:
        """The bodies, by a name of version 0.1."""
        warn_user("TMatrixCluster.operators is now TMatrixCluster.bodies", DeprecationWarning)
        return self.bodies

    def moved(
        self,
        offset: ArrayLike = (0.0, 0.0, 0.0),
        rotation: ArrayLike = (0.0, 0.0, 0.0),
        *,
        rotation_degrees: ArrayLike | None = None,
    ) -> TMatrixCluster:
        """Return the bodies after a shift, and a rotation about the mean of their centres, as one.

        Reflectors stay. Without any, the bodies' T-matrices are joined once for all these poses.

        Args:
            offset: (3,) [m], or (..., 3) for many poses at once.
            rotation: angles (3,) or (..., 3) [rad] about the fixed axes x, y, z, in this order.
            rotation_degrees: these angles (3,) or (..., 3) in degrees, in place of `rotation`.
        """
        pivot = torch.stack([body.center.expand(*self.poses, 3) for body in self.bodies]).mean(dim=0)
        bodies = []
        for body in self.bodies:
            alone = body.moved(offset, rotation, rotation_degrees=rotation_degrees)
            turn = alone.axes @ body.axes.mT
            aside = (turn @ (body.center - pivot)[..., None])[..., 0] - (body.center - pivot)
            bodies.append(replace(alone, center=alone.center + aside))
        cluster = TMatrixCluster(bodies, self.reflectors)
        is_still = not self.poses and not any(body.varies for body in self.bodies)
        if self._before is not None or (is_still and not self.reflectors and len(bodies) > 1):
            object.__setattr__(cluster, "_before", self._before or self)
        return cluster

    @cached_property
    @torch.inference_mode(False)
    @one_library_thread()
    def _joined(self) -> torch.Tensor:
        """The map (N, N) from regular waves on all bodies to outgoing waves of all."""
        return joined(self.bodies, NO_MIRRORS)

    @property
    def poses(self) -> tuple[int, ...]:
        """The leading dimensions of the bodies' poses; none for a single pose."""
        return np.broadcast_shapes(*(body.center.shape[:-1] for body in self.bodies))

    @one_library_thread()
    def transfer_matrix(self, array: TransducerArray, points: ArrayLike) -> torch.Tensor:
        """Return transfer matrices (..., P, M), complex128 [Pa], of an array at points (..., P, 3) [m].

        Leading dimensions of the points and of the bodies' poses are broadcast. Gradients of points, places
        and turns pass. The result is on the device of the points.

        Raises:
            ValueError: a point or transducer within a circumscribed sphere.
        """
        require_kind("array", array, TransducerArray)
        places, grid = points_grid("points", points)
        targets, of_points = places.cpu(), places.reshape(*grid, 3)
        every = broadcast("points", of_points, f" beside poses {self.poses}", self.poses, grid[:-1])
        for name, places in (("points", targets.detach()), ("array.positions", array.positions)):
            require_in_front(self.reflectors, name, places.reshape(-1, 3))
        images = self.images_around(torch.cat([targets.detach(), array.positions]))
        direct = free_space_matrix(targets, array, self.bodies[0].wavenumber, images).reshape(*grid, -1)
        if not self.poses:
            scattered = scattered_field(self.bodies, array, targets, images, self.together)
            return (direct + scattered.reshape(direct.shape)).to(device_of(points))
        sets = targets.reshape(*grid, 3).expand(*every, -1, -1).reshape(-1, grid[-1], 3)

        def of_poses(bodies: Sequence[TMatrix], part: slice) -> torch.Tensor:
            return scattered_field(bodies, array, sets[part], images, self.together)

        scattered = self.by_poses(every, len(array), of_poses)
        return (direct + scattered.reshape(*every, *direct.shape[-2:])).to(device_of(points))

    @property
    def together(self) -> torch.Tensor | None:
        """The map (N, N) from regular waves on all bodies to all outgoing ones, if they have moved as one.

        Of a body alone it is the T-matrix.
        """
        if self._before is not None:
            return self._before._joined
        is_alone = len(self.bodies) == 1 and not self.reflectors
        return self.bodies[0].matrix if is_alone else None

    def together_on(self, number: int) -> tuple[torch.Tensor, torch.Tensor] | None:
        """Return the maps (n, N) of `joined_on` for a body, if all have moved as one."""
        still = self._before
        return None if still is None else joined_on(still.bodies, number, still._joined)

    def images_around(self, places: torch.Tensor) -> tuple[Image, ...]:
        """Return the images of the space, as they are needed between the bodies and places (n, 3) [m]."""
        everything = torch.cat([places, *(body.center.reshape(-1, 3) for body in self.bodies)])
        size = float((everything.amax(dim=0) - everything.amin(dim=0)).norm().detach())
        return images_of([each.mirror for each in self.reflectors], self.bodies[0].wavenumber, size)

    def by_poses(
        self, poses: Sequence[int], columns: int, work: Callable[[Sequence[TMatrix], slice], torch.Tensor]
    ) -> torch.Tensor:
        """Return what `work` does for the bodies in each of the poses (...), flat, a few poses at a time.

        It has so many columns of waves.
        """
        bodies = [body.in_poses(poses) for body in self.bodies]
        waves = sum(len(body.matrix) for body in bodies)
        count = max(1 + _AT_ONCE // (waves * columns), _FEWEST if self.together is None else 1)
        gradients = torch.is_grad_enabled()

        def part(first: int) -> torch.Tensor:
            with torch.set_grad_enabled(gradients):  # which holds in one thread only
                return work([body.some_poses(first, count) for body in bodies], slice(first, first + count))

        return torch.cat(spread(part, range(0, math.prod(poses), count)))
