"""T-matrices: simulate a body once, then place it anywhere, alone or among others.

Outside its circumscribed sphere a body is a linear map T from the regular waves that come in to the outgoing
waves that it scatters, b = T d (Waterman 1969, doi:10.1121/1.1911498). A column of T is one run of the box
solver, driven by one regular wave; the Huygens surface gives the outgoing ones. Several bodies are coupled by
`multiple_scattering`, which is exact while their circumscribed spheres do not overlap.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from autdtorch.analytic.disc_waves import mean_waves, powers_needed
from autdtorch.analytic.green import free_space_matrix
from autdtorch.analytic.spherical_waves import degrees, harmonics, mirrored, outgoing_waves, regular_radial
from autdtorch.fdtd.kernels.choice import available_kernel
from autdtorch.propagators.multiple_scattering import solved
from autdtorch.propagators.store import store_in
from autdtorch.propagators.tmatrix.body import Solver, placed
from autdtorch.scene.arrays import TransducerArray, apertures_of, complex_strengths_of
from autdtorch.scene.geometry import composed_rotation
from autdtorch.scene.medium import Medium
from autdtorch.scene.obstacles import Obstacle
from autdtorch.scene.reflectors import Reflector, require_arrangement
from autdtorch.scene.scene import require_in_front
from autdtorch.utils.apertures import Apertures
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.files import read_arrays, write_arrays
from autdtorch.utils.hints import renamed_keywords
from autdtorch.utils.images import Image, distinct, images_of
from autdtorch.utils.process import one_library_thread, require_memory
from autdtorch.utils.units import turn_tensor, warn_user
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

_AT_ONCE = 200_000
"""Waves at points that are computed at once: 3 MB, which fit into a cache."""

_SHELLS = (0.55, 0.7, 0.85, 0.99)
"""Radii of shells, relative to the circumscribed sphere: j_l is small on one of them at most."""

_ALIKE = 4
"""Discs of one radius and direction from which on their means are `mean_waves`, and not those over nodes."""

_ENTRY_BYTES = 48.0
"""Memory of a pair of waves in the system of equations [bytes]."""

_ARRAYS = ("matrix", "center", "axes", "radius", "wavenumber")


@dataclass(frozen=True, eq=False)
class TMatrix:
    """A body that scatters sound, outside its circumscribed sphere, in any pose.

    `TMatrix.of` simulates obstacles that move as one body.

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
    ) -> TMatrix:
        """Simulate the T-matrix of obstacles; for a single sphere it is exact.

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
        return cls(*placed(bodies, medium, frequency, solver).matrix(store_in(cache)))

    @property
    def degree(self) -> int:
        """The largest degree of the waves."""
        return math.isqrt(len(self.matrix)) - 1

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
        one = torch.eye(len(self.matrix), **COMPLEX)
        scattering = one + 2 * self.matrix
        return float((scattering.mH @ scattering - one).norm() / math.sqrt(len(one)))

    def moved(
        self,
        offset: ArrayLike = (0.0, 0.0, 0.0),
        rotation: ArrayLike = (0.0, 0.0, 0.0),
        *,
        rotation_degrees: ArrayLike | None = None,
    ) -> TMatrix:
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
        axes = composed_rotation(angles.cos(), angles.sin()) @ self.axes
        return replace(self, center=self.center + shift, axes=axes)

    def transfer_matrix(self, array: TransducerArray, points: ArrayLike) -> torch.Tensor:
        """Return transfer matrices (..., P, M), complex128 [Pa], of an array at points (..., P, 3) [m].

        Gradients of the body's place and turn pass.

        Raises:
            ValueError: a point or transducer within the circumscribed sphere. `make_propagator` serves those.
        """
        return TMatrixCluster([self]).transfer_matrix(array, points)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the T-matrix to a .npz file."""
        path = path_of("path", path, suffixes=(".npz",))
        values = {name: getattr(self, name) for name in _ARRAYS}
        tensors = (name for name, value in values.items() if isinstance(value, torch.Tensor))
        values |= {name: values[name].detach() for name in tensors}
        write_arrays(path, {name: np.asarray(value) for name, value in values.items()})

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


@dataclass(frozen=True, eq=False)
class TMatrixCluster:
    """Bodies that move on their own; `TMatrix.moved` places each.

    Attributes:
        bodies: their T-matrices, all with one wavenumber. Their circumscribed spheres must not overlap;
            obstacles that are nearer make one body.
        reflectors: planes that reflect, in front of all spheres, as in a `Scene`.

    Raises:
        ValueError: no body, other wavenumbers, or spheres that overlap or cross a reflector.
    """

    bodies: tuple[TMatrix, ...]
    reflectors: tuple[Reflector, ...]

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
                apart, least = float((body.center - other.center).detach().norm()), body.radius + other.radius
                if apart < least - LENGTH_TOLERANCE:
                    accepted = f"must be at least {least:.4g} m from that of another body"
                    raise invalid(f"bodies[{number}].center", f"{apart:.4g} m apart", accepted)
        object.__setattr__(self, "bodies", bodies)
        reflectors = members("reflectors", reflectors, Reflector)
        require_arrangement(reflectors, bodies[0].wavenumber)
        for number, body in enumerate(bodies):
            for index, reflector in enumerate(reflectors):
                height = float(reflector.mirror.height(body.center.detach()))
                if height < body.radius - LENGTH_TOLERANCE:
                    accepted = f"must be at least {body.radius:.4g} m in front of reflector {index}"
                    raise invalid(f"bodies[{number}].center", f"{height:.4g} m", accepted)
        object.__setattr__(self, "reflectors", reflectors)

    @property
    def operators(self) -> tuple[TMatrix, ...]:
        """The bodies, by a name of version 0.1."""
        warn_user("TMatrixCluster.operators is now TMatrixCluster.bodies", DeprecationWarning)
        return self.bodies

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
        for name, places in (("points", targets.detach()), ("array.positions", array.positions)):
            require_in_front(self.reflectors, name, places.reshape(-1, 3))
        everything = torch.cat(
            [targets.detach(), array.positions, *(body.center[None] for body in self.bodies)]
        )
        size = float((everything.amax(dim=0) - everything.amin(dim=0)).norm().detach())
        mirrors = [reflector.mirror for reflector in self.reflectors]
        images = images_of(mirrors, self.bodies[0].wavenumber, size)
        direct = free_space_matrix(targets, array, self.bodies[0].wavenumber, images)
        (scattered,) = scattered_waves(self, array, images)
        parts = [waves_at(self, part, images) @ scattered for part in parts_of(targets, len(scattered))]
        return (direct + torch.cat(parts)).reshape(*grid, -1)


def parts_of(points: torch.Tensor, waves: int) -> tuple[torch.Tensor, ...]:
    """Return points (P, ..., 3) in parts, so that few of so many waves at them are in memory at once."""
    each = points[0].numel() // 3
    return torch.split(points, max(1, _AT_ONCE // (each * waves)))


def waves_at(cluster: TMatrixCluster, points: torch.Tensor, images: Sequence[Image]) -> torch.Tensor:
    """Return the outgoing waves (P, N) of all bodies and their images at points (P, 3) [m]."""
    return torch.cat([_outgoing_waves(body, points, images) for body in cluster.bodies], dim=1)


def scattered_waves(
    cluster: TMatrixCluster, array: TransducerArray, images: Sequence[Image], left_out: Sequence[int] = (0,)
) -> list[torch.Tensor]:
    """Return the coefficients (N, M) [Pa] of all bodies' outgoing waves under unit drives of an array.

    Once for each number of highest degrees that are left out, whose coefficients are 0. Images of a body add
    no unknowns: their waves are its own, mirrored.
    """
    incident = [_incoming_waves(body, array, images) for body in cluster.bodies]
    count = sum(map(len, incident))
    require_memory("bodies", f"{count} waves", _ENTRY_BYTES * count**2)
    between = [
        [_regular_waves(body, other, images[1:] if other is body else images) for other in cluster.bodies]
        for body in cluster.bodies
    ]
    return [
        solved([_without_highest(body, fewer) for body in cluster.bodies], between, incident)
        for fewer in left_out
    ]


def _incoming_waves(body: TMatrix, array: TransducerArray, images: Sequence[Image]) -> torch.Tensor:
    """Return the coefficients (N, M) [Pa] of the regular waves of unit drives around a body."""
    transducers = apertures_of(array)
    _offsets(body, "array.positions", transducers.positions)
    waves = torch.zeros((len(array), len(body.matrix)), **COMPLEX)
    for index in transducers.alike():
        some = transducers.chosen(index)
        for image in distinct(images, some.positions):
            waves = waves.index_add(0, index, image.weight * _incoming_from(body, some, image))
    return 4j * math.pi * body.wavenumber * complex_strengths_of(array) * waves.mT


def _incoming_from(body: TMatrix, sources: Apertures, image: Image) -> torch.Tensor:
    """Return the regular waves (M, N) around a body, of images of points or of discs of one kind."""
    if sources.normals is not None and sources.radii is not None and len(sources.positions) >= _ALIKE:
        normal, radius = image.matrix @ sources.normals[0], float(sources.radii[0])
        offsets = image.of(sources.positions.mean(dim=1)) - body.center
        nearest = float(offsets.detach().norm(dim=1).min()) - radius
        powers = powers_needed(body.degree, body.wavenumber, nearest, radius)
        if powers is not None:
            return mean_waves(body.degree, body.wavenumber, offsets, normal, radius, body.axes, powers)
    offsets = _offsets(body, "array.positions", image.of(sources.positions))
    means = [
        torch.einsum(
            "mnk,n->mk",
            outgoing_waves(body.degree, body.wavenumber, some, conjugate=True),
            sources.weights.to(torch.complex128),
        )
        for some in parts_of(offsets, len(body.matrix))
    ]
    return torch.cat(means)


def _outgoing_waves(body: TMatrix, points: torch.Tensor, images: Sequence[Image]) -> torch.Tensor:
    """Return the outgoing waves (P, N) of a body and its images at points (P, 3) [m].

    A mirrored wave at a point is the wave at the mirrored point.
    """
    offsets = (_offsets(body, "points", image.of(points)) for image in images)
    waves = (outgoing_waves(body.degree, body.wavenumber, each) for each in offsets)
    none = torch.zeros((), **COMPLEX)
    return sum((image.weight * each for image, each in zip(images, waves, strict=True)), start=none)


def _regular_waves(body: TMatrix, other: TMatrix, images: Sequence[Image]) -> torch.Tensor:
    """Return S (N, K): outgoing waves of another body's images as regular waves around this one.

    The waves of the other are sampled on shells inside this body's sphere, where they are regular, and
    their harmonics are divided by j_l in the least-squares sense over shells.
    """
    if not images:
        return torch.zeros((len(body.matrix), len(other.matrix)), **COMPLEX)
    heights, weights = np.polynomial.legendre.leggauss(body.degree + other.degree + 1)
    count = 2 * (body.degree + other.degree + 1)
    turns = 2 * math.pi * torch.arange(count, **REAL) / count
    height = torch.from_numpy(heights)[:, None]
    across = (1 - height.square()).sqrt()
    places = across * turns.cos(), across * turns.sin(), height.expand(-1, count)
    directions = torch.stack(places, dim=-1).reshape(-1, 3)
    area = torch.from_numpy(np.repeat(weights * 2 * math.pi / count, count))
    back = (harmonics(body.degree, directions).conj() * area[:, None]).mT
    radii = torch.tensor(_SHELLS, **REAL) * body.radius
    sizes = regular_radial(body.degree, body.wavenumber * radii[:, None])
    waves: torch.Tensor = torch.zeros((len(body.matrix), len(other.matrix)), **COMPLEX)
    for radius, size in zip(radii, sizes, strict=True):
        shell = body.center + radius * directions @ body.axes.mT
        waves = waves + size.conj()[:, None] * (back @ _outgoing_waves(other, shell, images))
    return waves / sizes.abs().square().sum(dim=0)[:, None]


def _without_highest(body: TMatrix, fewer: int) -> torch.Tensor:
    """Return T (N, N) with 0 in place of its `fewer` highest degrees."""
    low = degrees(body.degree) <= body.degree - fewer
    return torch.where(low[:, None] & low, body.matrix, 0) if fewer else body.matrix


def _offsets(body: TMatrix, name: str, positions: torch.Tensor) -> torch.Tensor:
    """Return positions (..., 3) in the coordinates of a body, after checking that they are outside."""
    offsets = positions - body.center
    nearest = float(torch.linalg.vector_norm(offsets, dim=-1).detach().amin())
    if nearest < body.radius - LENGTH_TOLERANCE:
        accepted = f"must be at least {body.radius:.4g} m from the centre of the body"
        raise ValueError(f"{name}: {nearest:.4g} m at the nearest; {accepted}")
    return offsets @ body.axes
