"""The protocol of propagators, what those of `make_propagator` share, and the field of a whole domain."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Literal, Protocol, Self, overload, runtime_checkable

import torch

from autdtorch.propagators.absorbed_power import AbsorbedPower
from autdtorch.scene.drive import validate_drive, validate_single_drive
from autdtorch.scene.obstacles.base import inside_any
from autdtorch.scene.reflectors import are_in_front
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import COMPLEX, REAL, device_of
from autdtorch.utils.spatial import nearest
from autdtorch.utils.validation import ArrayLike, boolean, invalid, points_grid, positive, require_kind

_CLEARANCE = 0.5  # wavelengths around a transducer, where its own 1/r would hide the field of the others
_MOST_CELLS = 10_000_000


@runtime_checkable
class Propagator(Protocol):
    """Computes the pressure that a scene's transducers cause at points.

    Attributes:
        scene: the scene.
    """

    scene: Scene

    def transfer_matrix(self, points: ArrayLike | None = None) -> torch.Tensor:
        """Return the pressure (P, M) [Pa], complex128, of unit drives at points (P, 3) [m]."""
        ...

    def field(self, drive: torch.Tensor, points: ArrayLike) -> torch.Tensor:
        """Return the pressure (..., P) [Pa], complex128, of drives (..., M) at points (P, 3) or a grid."""
        ...


class ScenePropagator(ABC):
    """A propagator that `make_propagator` makes.

    Attributes:
        scene: the scene it was made for.
    """

    scene: Scene

    @abstractmethod
    def for_scene(self, scene: Scene) -> Self:
        """Return the propagator of a changed scene, with these settings."""

    @abstractmethod
    def _matrix(self, points: ArrayLike | None, with_error: bool) -> tuple[torch.Tensor, float]:
        """Return the transfer matrix and, if asked for, its error; see `transfer_matrix`."""

    @abstractmethod
    def _field(self, drive: torch.Tensor, points: torch.Tensor, is_picture: bool) -> torch.Tensor:
        """Return the pressure (..., P) of drives (..., M) at points (P, 3), also in bodies in a picture."""

    @abstractmethod
    def _absorbed(self, drive: torch.Tensor) -> AbsorbedPower:
        """Return the power that drives (R, M) lose in obstacles (R, K) and reflectors (R, J)."""

    @overload
    def transfer_matrix(
        self, points: ArrayLike | None = None, return_error: Literal[False] = False
    ) -> torch.Tensor: ...
    @overload
    def transfer_matrix(
        self, points: ArrayLike | None = None, *, return_error: Literal[True]
    ) -> tuple[torch.Tensor, float]: ...
    def transfer_matrix(
        self, points: ArrayLike | None = None, return_error: bool = False
    ) -> torch.Tensor | tuple[torch.Tensor, float]:
        """Return the transfer matrix G, by Eq. 2 in free space.

        FDTD takes one simulation for each transducer or each point (reciprocity). Points or transducers in
        one symmetry orbit of the scene on its grid share a simulation.

        Args:
            points: (P, 3) [m]; by default the scene's control points. G is differentiable by points in free
                space, and by those that T-matrices serve.
            return_error: also return the estimated relative error (L2 of the whole matrix): of FDTD from a
                second grid and from the distance to the steady state, of T-matrices also from the waves left
                out. A coarser second grid takes a fifth of the time. Free space has an error of 0, or an
                infinite one if obstacles are ignored. `point_errors` returns the error of each point.

        Returns:
            complex128 (P, M) [Pa] on the device of `points`, and the error if asked for.

        Raises:
            ValueError: `points` are not finite, have another shape, are behind a reflector, outside the
                domain (method "full") or on a transducer (other methods).
        """
        with_error = boolean("return_error", return_error)
        matrix, error = self._matrix(points, with_error)
        matrix = matrix.to(device_of(points))
        return (matrix, error) if with_error else matrix

    def field(self, drive: torch.Tensor, points: ArrayLike) -> torch.Tensor:
        """Return the pressure of drives at points.

        FDTD takes a simulation for each drive, or those of the transfer matrix if these are fewer: for still
        more drives in later calls, multiply by `transfer_matrix`.

        Args:
            drive: (..., M) complex, |q| <= 1.
            points: (P, 3) or a grid such as (Nu, Nv, 3) [m], which may cross obstacles and reflectors; behind
                these it is 0.

        Returns:
            complex128 (..., P) or (..., Nu, Nv) [Pa] on the device of the drive, and differentiable by it.

        Raises:
            ValueError: drive or points of another shape or out of range, as in `transfer_matrix`.
        """
        device, drive = device_of(drive), validate_drive(drive, len(self.scene.array)).cpu()
        places, grid = points_grid("points", points)
        places, is_picture = places.cpu(), len(grid) > 1
        front = are_in_front(self.scene.reflectors, places.detach())
        if is_picture and not front.all():
            field = torch.zeros((*drive.shape[:-1], len(places)), **COMPLEX)
            if front.any():
                field[..., front] = self._field(drive, places[front], is_picture)
        else:
            field = self._field(drive, places, is_picture)
        return field.reshape(*drive.shape[:-1], *grid).to(device)

    def absorbed_power(self, drive: torch.Tensor) -> AbsorbedPower:
        """Return the power that each obstacle and each reflector absorbs; FDTD takes a run for each drive.

        Method "tmatrix" is exact for spheres, unless a reflector absorbs. Otherwise FDTD errs by more than in
        pressures: by 1, 11 and 29 % in balls of 5 mm, 4, 25 and 80 times as dense as air, on cells of 1 mm.
        On cells of 0.5 mm the errors are about a quarter of these.

        Args:
            drive: (..., M) complex, |q| <= 1.

        Returns:
            The power [W], float64, of the obstacles (..., K) and the reflectors (..., J), on the device of
            the drive. Power lost in the medium is not counted, and none in obstacles that free space ignores.
            Where obstacles that absorb touch, FDTD counts the cells at their common face for one of them.

        Raises:
            ValueError: a drive of another shape or out of range, or a reflector that absorbs and has a
                complex reflection or faces another.
        """
        device, drive = device_of(drive), validate_drive(drive, len(self.scene.array)).cpu().detach()
        power = self._absorbed(drive.reshape(-1, drive.shape[-1]))
        return AbsorbedPower(*(part.reshape(*drive.shape[:-1], part.shape[1]).to(device) for part in power))


def volume_field(propagator: Propagator, drive: ArrayLike, spacing: float | None = None) -> torch.Tensor:
    """Return the pressure of a drive at the centres of equal cells that fill the scene's domain.

    Args:
        propagator: the propagator of the scene.
        drive: complex (M,), |q| <= 1.
        spacing: approximate edge of a cell [m], > 0; by default a quarter of the wavelength.

    Returns:
        complex128 (Nx, Ny, Nz) [Pa], with Nx = Lx / spacing rounded and at least 2, likewise Ny and Nz. NaN
        in obstacles, behind reflectors and within half a wavelength of a transducer.

    Raises:
        ValueError: `drive` or `spacing` is out of range, or there are more than 10 million cells.
    """
    require_kind("propagator", propagator, Propagator)
    scene = propagator.scene
    drive = validate_single_drive(drive, len(scene.array))
    spacing = scene.wavelength / 4 if spacing is None else positive("spacing", spacing, "m")
    lower, upper = torch.tensor(scene.domain, **REAL)
    counts = [max(2, round(float(length) / spacing)) for length in upper - lower]
    if math.prod(counts) > _MOST_CELLS:
        raise invalid("spacing", spacing, f"gives {counts} cells, must give at most {_MOST_CELLS}", "m")
    steps = [torch.arange(count, **REAL) + 0.5 for count in counts]
    axes = zip(lower, upper, steps, counts, strict=True)
    points = torch.cartesian_prod(*(low + (high - low) * step / count for low, high, step, count in axes))
    valid = are_shown(scene, points)
    field = torch.full((len(points),), complex(math.nan, math.nan), **COMPLEX).to(drive.device)
    field[valid] = propagator.field(drive, points[None, valid])[0]  # a grid, which may touch obstacles
    return field.reshape(counts)


def are_shown(scene: Scene, points: torch.Tensor) -> torch.Tensor:
    """Return which points (N, 3) [m] are not in obstacles, behind reflectors or next to transducers."""
    gap, _ = nearest(points, scene.array.nodes.positions.reshape(-1, 3))
    clear = (gap > _CLEARANCE * scene.wavelength) & ~inside_any(points, scene.obstacles)
    return clear & are_in_front(scene.reflectors, points)
