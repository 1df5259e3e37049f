"""Bases of planes, rotations, points on circles and spheres, and the observation plane."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from autdtorch.utils.array_types import REAL
from autdtorch.utils.process import require_memory
from autdtorch.utils.units import angle as checked_angle
from autdtorch.utils.validation import (
    LENGTH_TOLERANCE,
    ArrayLike,
    Vector,
    boolean,
    finite_vector,
    integer_at_least,
    invalid,
    points_tensor,
    positive,
    positive_entries,
    real_tensor,
    unit_vector,
)

_POINT_BYTES = 100.0  # for each generated point


class Coordinates(torch.Tensor):
    """A tensor on the CPU that `numpy.array` takes without a warning. Operations return plain tensors.

    NumPy 2 warns that the `__array__` of plain tensors does not accept `copy`.
    """

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    def __array__(self, dtype: npt.DTypeLike | None = None, copy: bool | None = None) -> npt.NDArray[Any]:
        return np.array(self.numpy(), dtype=dtype, copy=copy)

    def __deepcopy__(self, memo: dict[int, Any]) -> Coordinates:
        return self.clone().as_subclass(Coordinates)

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Pickle as a plain tensor, which `torch.load` accepts."""
        return self.as_subclass(torch.Tensor).__reduce_ex__(protocol)  # type: ignore[no-untyped-call]


def plane_basis(normal: ArrayLike) -> tuple[torch.Tensor, torch.Tensor]:
    """Return orthonormal axes (u, v), (3,) each, of the plane with `normal` (3,): u x v = normal / |normal|.

    u is the projection into the plane of the coordinate axis that cyclically follows the axis nearest to
    `normal`. So normal +x gives (y, z), +y (z, x), +z (x, y), and -x gives (y, -z).
    """
    n = torch.tensor(unit_vector("normal", normal), **REAL)
    axis = (int(n.abs().argmax()) + 1) % 3
    u = -n[axis] * n
    u[axis] += 1.0
    u = u / torch.linalg.vector_norm(u)
    v = torch.linalg.cross(n, u)
    # Adding 0 turns -0 into 0 for printing.
    return u + 0.0, v + 0.0


def in_plane(places: ArrayLike, center: ArrayLike, normal: ArrayLike, angle: float = 0.0) -> torch.Tensor:
    """Transform positions (M, 2) or (M, 3) [m] from the coordinates of a device to those of the scene.

    A third column has heights along `normal`. The device has its origin at `center` (3,) [m] and the axes of
    `device_axes`. Returns (M, 3) [m], float64.
    """
    local = real_tensor("places", places, "m").detach().cpu()
    if local.ndim != 2 or local.shape[1] not in (2, 3):
        raise ValueError(f"places: shape {tuple(local.shape)}; must be (M, 2) or (M, 3)")
    origin = torch.tensor(finite_vector("center", center), **REAL)
    return origin + local @ device_axes(normal, angle)[: local.shape[1]]


def device_axes(normal: ArrayLike, angle: float = 0.0) -> torch.Tensor:
    """Return the axes x, y and z of a device, the rows of (3, 3).

    z is along `normal`; x is turned by `angle` [rad] from u towards v, with (u, v) = `plane_basis(normal)`.
    """
    turn = checked_angle("angle", angle)
    u, v = plane_basis(normal)
    x = math.cos(turn) * u + math.sin(turn) * v
    y = math.cos(turn) * v - math.sin(turn) * u
    return torch.stack((x, y, torch.tensor(unit_vector("normal", normal), **REAL)))


def rotation_matrix(rotation: Vector) -> torch.Tensor:
    """Return the matrix R (3, 3) of the rotation by angles (a, b, c) [rad] about the fixed axes x, y, z.

    R = Rz(c) Ry(b) Rx(a), for column vectors (extrinsic Euler angles); (0, 0, pi/2) turns x into y.
    """
    return _rotation_matrix(tuple(rotation)).clone()


@functools.lru_cache(64)
def _rotation_matrix(rotation: Vector) -> torch.Tensor:
    return composed_rotation(list(map(math.cos, rotation)), list(map(math.sin, rotation)))


def composed_rotation(
    cosines: Sequence[float] | torch.Tensor, sines: Sequence[float] | torch.Tensor
) -> torch.Tensor:
    """Return the matrices (..., 3, 3) of rotations by angles (..., 3), from their cosines and sines."""
    cosines, sines = torch.as_tensor(cosines, **REAL), torch.as_tensor(sines, **REAL)
    matrix = torch.eye(3, **REAL)
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        turn = torch.eye(3, **REAL).repeat(*cosines.shape[:-1], 1, 1)
        turn[..., first, first] = turn[..., second, second] = cosines[..., axis]
        turn[..., second, first] = sines[..., axis]
        turn[..., first, second] = -sines[..., axis]
        matrix = turn @ matrix
    return matrix


def circle_points(
    center: ArrayLike, radius: float, count: int, normal: ArrayLike, angle: float = 0.0
) -> torch.Tensor:
    """Return equidistant points on a circle: center + radius (cos(angle + 2 pi n / count) u + sin(...) v).

    Args:
        center: centre of the circle (3,) [m].
        radius: its radius [m], > 0.
        count: number of points, >= 1.
        normal: normal of its plane (3,); (u, v) = `plane_basis(normal)`.
        angle: of point 0 from u towards v [rad].

    Returns:
        Points (count, 3) [m], float64.

    Raises:
        ValueError: an argument is not finite, has the wrong shape or is out of range.
    """
    origin, radius, count = _round(center, radius, count)
    u, v = plane_basis(normal)
    start = checked_angle("angle", angle)
    angles = start + 2 * math.pi * torch.arange(count, **REAL) / count
    return origin + radius * (angles.cos()[:, None] * u + angles.sin()[:, None] * v)


def polyline_points(corners: ArrayLike, count: int, closed: bool = True) -> torch.Tensor:
    """Return points at equal distances along straight lines from corner to corner.

    Args:
        corners: (K, 3), K >= 2 [m]; the first point is the first corner.
        count: number of points, >= 1, and >= 2 if not closed.
        closed: whether a line leads from the last corner to the first, which does not come twice: two corners
            are a line there and back. Otherwise the last point is the last corner.

    Returns:
        Points (count, 3) [m], float64.

    Raises:
        ValueError: an argument is not finite, has the wrong shape or is out of range, or all corners are in
            one place.
    """
    places = points_tensor("corners", corners).detach().cpu()
    if len(places) < 2:
        raise ValueError(f"corners: shape {tuple(places.shape)}; must be (K, 3) with K >= 2")
    closed = boolean("closed", closed)
    count = integer_at_least("count", count, 1 if closed else 2)
    if closed:
        places = torch.cat([places, places[:1]])
    lengths = places.diff(dim=0).norm(dim=1)
    passed = torch.cat([torch.zeros(1, **REAL), lengths.cumsum(dim=0)])
    if passed[-1] <= LENGTH_TOLERANCE:
        raise invalid("corners", corners, "must not all be in one place")
    way = passed[-1] * torch.arange(count, **REAL) / (count if closed else count - 1)
    line = (torch.searchsorted(passed, way, right=True) - 1).clamp(max=len(lengths) - 1)
    part = (way - passed[line]) / lengths[line].clamp(min=LENGTH_TOLERANCE)
    return torch.lerp(places[line], places[line + 1], part.clamp(max=1)[:, None])


def path_foci(path: ArrayLike) -> torch.Tensor:
    """Return the foci (T, P, 3) [m] of a path (T, 3) of one focus, or (T, P, 3) of P; T, P >= 1.

    `ValueError` for not finite numbers or another shape.
    """
    places = real_tensor("path", path, "m").detach().cpu()
    foci = places[:, None] if places.ndim == 2 else places
    if foci.ndim != 3 or foci.shape[-1] != 3 or foci.numel() == 0:
        raise ValueError(f"path: shape {tuple(places.shape)}; must be (T, 3) or (T, P, 3) with T, P >= 1")
    return foci


def sphere_points(center: ArrayLike, radius: float, count: int) -> torch.Tensor:
    """Return evenly spread points on a sphere: a Fibonacci lattice.

    Each point has the area 4 pi radius^2 / count around it; their distances are about the root of it.

    Args:
        center: centre of the sphere (3,) [m].
        radius: its radius [m], > 0.
        count: number of points, >= 1.

    Returns:
        Points (count, 3) [m], float64.

    Raises:
        ValueError: an argument is not finite, has the wrong shape or is out of range.
    """
    origin, radius, count = _round(center, radius, count)
    number = torch.arange(count, **REAL)
    height = 1 - (2 * number + 1) / count
    angle, across = math.pi * (3 - math.sqrt(5)) * number, (1 - height.square()).sqrt()
    return origin + radius * torch.stack((across * angle.cos(), across * angle.sin(), height), dim=1)


def _round(center: ArrayLike, radius: float, count: int) -> tuple[torch.Tensor, float, int]:
    """Return centre (3,) [m], radius [m] and number of points after checking them."""
    origin = torch.tensor(finite_vector("center", center), **REAL)
    radius = positive("radius", radius, "m")
    count = integer_at_least("count", count, 1)
    require_memory("count", count, _POINT_BYTES * count)
    return origin, radius, count


@dataclass(frozen=True)
class Plane:
    """A rectangle on which a field is sampled.

    Attributes:
        center: centre (3,) [m].
        normal: normal (3,), stored with length 1.
        size: edge lengths (Lu, Lv) [m] along the axes (u, v) of `basis`, > 0.

    Raises:
        ValueError: an attribute is not finite, has the wrong shape or is out of range.
    """

    center: Vector
    normal: Vector
    size: tuple[float, float]

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", finite_vector("Plane.center", self.center))
        object.__setattr__(self, "normal", unit_vector("Plane.normal", self.normal))
        object.__setattr__(self, "size", positive_entries("Plane.size", self.size, 2))

    @property
    def basis(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Unit tensors (u, v), (3,) each, along the edges; see `plane_basis`."""
        return plane_basis(self.normal)

    @property
    def corners(self) -> torch.Tensor:
        """The four corners (4, 3) [m]."""
        signs = torch.tensor([-1.0, 1.0], **REAL)
        return self._at(signs * self.size[0] / 2, signs * self.size[1] / 2).reshape(4, 3)

    def points(self, spacing: float) -> torch.Tensor:
        """Return the centres (Nu, Nv, 3) [m], float64, of equal cells that fill the plane.

        Args:
            spacing: wanted edge [m], > 0; Nu is Lu / spacing, rounded to at least 1, and Nv likewise.

        Raises:
            ValueError: `spacing` is not a finite number > 0.
        """
        spacing = positive("spacing", spacing, "m")
        counts = [max(1.0, round(length / spacing, 0)) for length in self.size]
        require_memory("spacing", spacing, _POINT_BYTES * math.prod(counts), "m")
        return cell_centers_of(self, (int(counts[0]), int(counts[1])))

    def _at(self, along_u: torch.Tensor, along_v: torch.Tensor) -> torch.Tensor:
        u, v = self.basis
        center = torch.tensor(self.center, **REAL)
        return center + along_u[:, None, None] * u + along_v[None, :, None] * v


def cell_centers_of(plane: Plane, counts: tuple[int, int]) -> torch.Tensor:
    """Return the centres (Nu, Nv, 3) [m] of `counts` = (Nu, Nv) equal cells that fill a plane."""
    along = [
        length * ((torch.arange(count, **REAL) + 0.5) / count - 0.5)
        for length, count in zip(plane.size, counts, strict=True)
    ]
    return plane._at(along[0], along[1])
