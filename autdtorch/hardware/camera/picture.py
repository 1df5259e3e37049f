"""A picture of the pressure in a plane, as a thermal camera saw it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from autdtorch.objectives.readings import Readings, deviation_by_square, deviation_of_square
from autdtorch.scene.geometry import Plane, cell_centers_of
from autdtorch.utils.array_types import REAL, Array
from autdtorch.utils.validation import (
    ArrayLike,
    finite_number,
    integer_at_least,
    invalid,
    points_tensor,
    positive,
    real_tensor,
    require_kind,
)

_OFF_PLANE = 0.02  # largest distance of a point from its plane, by the plane's longer edge
_WIDER = 3  # cells around a picture, for its splines
_MOST_CELLS = 2**22  # a camera has 2**20 pixels at most
_SMOOTHING, _FINEST = 0.2, 1e-4  # for the place of a focus, by the radius
_BETTER = 0.2  # by which a turned picture must correlate better with the expected one

_TURNS: dict[str, tuple[Callable[[torch.Tensor], torch.Tensor], bool]] = {  # true: swaps the axes
    "turned by half": (lambda map_: map_.rot90(2), False),
    "mirrored along u": (lambda map_: map_.flip(0), False),
    "mirrored along v": (lambda map_: map_.flip(1), False),
    "turned by a quarter": (lambda map_: map_.rot90(1), True),
    "turned by three quarters": (lambda map_: map_.rot90(3), True),
    "mirrored along a diagonal": (lambda map_: map_.T, True),
    "mirrored along the other diagonal": (lambda map_: map_.rot90(2).T, True),
}


@dataclass(frozen=True, eq=False, repr=False)
class Picture:
    """The pressure magnitudes in the cells of a plane, with their standard deviations.

    The frames show |p|^2, whose noise is equal in loud and in dark places. Deviations are those towards
    higher pressures: |p|^2 deviates by (pressure + deviation)^2 - pressure^2.

    Attributes:
        plane: the plane.
        pressure: peak amplitudes (Nu, Nv) [Pa] at `cell_centers(plane)`.
        deviation: standard deviations (Nu, Nv) [Pa].
        relative: True if all pressures have an unknown factor, common to all pictures of the screen.
        frames: number of frames used.
        latency: time from the start of the sound until the frames show it [s].
        doubts: what is wrong with the frames, a sentence each.

    `ValueError` for other shapes or kinds, or values that are not finite and >= 0.
    """

    plane: Plane
    pressure: torch.Tensor
    deviation: torch.Tensor
    relative: bool = False
    frames: int = 0
    latency: float = 0.0
    doubts: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        require_kind("plane", self.plane, Plane)
        for name in ("pressure", "deviation"):
            values = real_tensor(name, getattr(self, name), "Pa").detach().cpu()
            if values.ndim != 2 or not 0 < values.numel() <= _MOST_CELLS:
                raise ValueError(
                    f"{name}: shape {tuple(values.shape)}; must be (Nu, Nv), up to {_MOST_CELLS} cells"
                )
            if values.min() < 0:
                raise invalid(name, float(values.min()), "must be >= 0 in every cell", "Pa")
            object.__setattr__(self, name, values)
        if self.pressure.shape != self.deviation.shape:
            shape = tuple(self.deviation.shape)
            raise invalid("deviation", shape, f"must be {tuple(self.pressure.shape)}, as pressure")
        integer_at_least("frames", self.frames, 0)
        finite_number("latency", self.latency, "s")

    def __repr__(self) -> str:
        counts = " x ".join(map(str, self.pressure.shape))
        unit = "of an unknown unit" if self.relative else "Pa"
        return f"Picture({counts} cells, up to {self.pressure.max():.4g} {unit}, {self.frames} frames)"

    @property
    def cell_area(self) -> float:
        """Area of a cell [m^2], for `focus_metrics`."""
        return self.plane.size[0] * self.plane.size[1] / self.pressure.numel()

    @property
    def points(self) -> torch.Tensor:
        """The centres (P, 3) of the P = Nu Nv cells [m]."""
        return cell_centers_of(self.plane, self._counts).reshape(-1, 3)

    def at(self, points: ArrayLike) -> tuple[torch.Tensor, torch.Tensor]:
        """Return magnitudes and standard deviations (P,) [Pa] at points of the plane (P, 3) [m].

        |p|^2 is interpolated by a spline, because it is band-limited, and |p| is not.

        Raises:
            ValueError: a point is not in the plane.
        """
        cells = self._cells(plane_coordinates(self.plane, points))
        spline = _spline(self.pressure.square().numpy())
        pressure = torch.from_numpy(np.sqrt(np.maximum(_interpolated(spline, cells), 0.0)))
        of_square = deviation_of_square(self.pressure, self.deviation)
        spread = map_coordinates(of_square.numpy(), cells.T, order=1, mode="nearest")
        return pressure, deviation_by_square(pressure, torch.from_numpy(spread))

    def foci(self, near: ArrayLike, radius: float = 5e-3) -> torch.Tensor:
        """Return the places (P, 3) [m] of the largest |p| within a radius [m] of points (P, 3) [m].

        |p|^2 is smoothed over a fifth of the radius, because noise moves the top of a focus.

        Raises:
            ValueError: a point is not in the plane, or `radius` is not a finite number > 0.
        """
        radius = positive("radius", radius, "m")
        length = _SMOOTHING * radius
        starts = plane_coordinates(self.plane, near, "near")
        cells = length * np.asarray(self._counts) / np.asarray(self.plane.size)
        spline = _spline(gaussian_filter(self.pressure.square().numpy(), cells))
        places = np.stack([self._climb(spline, start, radius) for start in starts])
        u, v = (axis.numpy() for axis in self.plane.basis)
        return torch.from_numpy(np.asarray(self.plane.center) + places[:, :1] * u + places[:, 1:] * v)

    def readings(self, drive: torch.Tensor) -> Readings:
        """Return the picture as readings of a drive (M,) at all cells of the plane, with their deviations."""
        deviation = self.deviation.reshape(-1)
        return Readings(drive, self.pressure.reshape(-1), self.points, deviation=deviation)

    def _climb(self, spline: Array, start: Array, radius: float) -> Array:
        """Return the largest place (2,) of a spline near a start (2,), by ever finer patches of 5 x 5."""
        offsets = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
        step, bound = radius / 2, np.asarray(self.plane.size) / 2
        place = start = np.clip(start, -bound, bound)
        while step > _FINEST * radius:
            around = np.clip(place + step * offsets, -bound, bound)
            around = around[np.linalg.norm(around - start, axis=1) <= 1.01 * radius]
            best = around[_interpolated(spline, self._cells(around)).argmax()]
            if np.linalg.norm(best - place) < 1.5 * step:
                step /= 2
            place = best
        return np.asarray(place)

    @property
    def _counts(self) -> tuple[int, int]:
        return self.pressure.shape[0], self.pressure.shape[1]

    def _cells(self, coordinates: Array) -> Array:
        """Return the indices (P, 2), in parts of a cell, of coordinates (P, 2) [m]."""
        return np.asarray((coordinates / np.asarray(self.plane.size) + 0.5) * self._counts - 0.5)


def clarity(pressure: torch.Tensor, deviation: torch.Tensor) -> float:
    """Return the largest pressure of a map (Nu, Nv) in its median deviations, as of dark places."""
    return float(pressure.max() / deviation.median())


def _spline(values: Array) -> Array:
    """Return the coefficients of a spline of fifth order through cells (Nu, Nv) and beyond their edges."""
    wide = np.pad(values, _WIDER, mode="reflect", reflect_type="odd")
    return np.asarray(spline_filter(wide, order=5, mode="reflect"))


def _interpolated(spline: Array, cells: Array) -> Array:
    """Return the values (P,) of a spline of fifth order at indices (P, 2), in parts of a cell."""
    return np.asarray(map_coordinates(spline, cells.T + _WIDER, order=5, mode="reflect", prefilter=False))


def plane_coordinates(plane: Plane, points: ArrayLike, name: str = "points") -> Array:
    """Return the coordinates (P, 2) [m] along the axes (u, v) of a plane, from its centre.

    Raises:
        ValueError: a point is not in the plane.
    """
    offset = points_tensor(name, points).cpu() - torch.tensor(plane.center, **REAL)
    u, v = plane.basis
    coordinates = torch.stack((offset @ u, offset @ v), dim=1)
    half = torch.tensor(plane.size, **REAL) / 2
    tolerance = _OFF_PLANE * 2 * half.max()
    height = (offset @ torch.tensor(plane.normal, **REAL)).abs()
    outside = (height > tolerance) | (coordinates.abs() > half + tolerance).any(dim=1)
    if outside.any():
        index = int(outside.nonzero()[0])
        point = (offset + torch.tensor(plane.center, **REAL))[index].tolist()
        raise invalid(f"{name}[{index}]", point, "must be in the plane of the picture", "m")
    return np.asarray(coordinates.numpy(), dtype=np.float64)


def turned(picture: Picture, expected: torch.Tensor) -> str | None:
    """Return how a picture is turned against the expected pressure (Nu, Nv) [Pa]; None if it is not.

    A symmetric field does not show it.
    """
    seen, square = picture.pressure.square(), expected.square()
    is_square = seen.shape[0] == seen.shape[1]
    alike = {
        name: _correlation(turn(seen), square)
        for name, (turn, swaps) in _TURNS.items()
        if is_square or not swaps
    }
    best = max(alike, key=lambda name: alike[name])
    return best if alike[best] > _correlation(seen, square) + _BETTER else None


def _correlation(one: torch.Tensor, other: torch.Tensor) -> float:
    return float(torch.corrcoef(torch.stack([one.reshape(-1), other.reshape(-1)]))[0, 1])
