"""The grid: cubic cells over a domain, with an absorbing layer around it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist
from torch import Tensor

from autdtorch.fdtd.interpolation import interpolation_width
from autdtorch.fdtd.perfectly_matched_layer import DOMAIN_LAYER, Thickness, box_layer
from autdtorch.fdtd.placement import grid_offset
from autdtorch.fdtd.region import Region
from autdtorch.fdtd.shapes import Shape, bounds
from autdtorch.fdtd.stencil import places_of
from autdtorch.utils.array_types import Array, Index, triple
from autdtorch.utils.process import cached_property
from autdtorch.utils.spatial import parts_of, places_on
from autdtorch.utils.validation import invalid

MAX_CELLS = 10**9  # Most cells of a grid: more would take over 30 GB in single precision
# Cells of air between the obstacles and the absorbing layer of a box. The first may be heterogeneous, the
# next two are the Huygens surface, and the last two serve the interpolation of points next to it
# (`scattered_field.py`).
AROUND = 5
# Places on the few separate surfaces in a box, as many on each however small, and the share of their pairs
# between which sound has arrived before a run may end. Sources drive all of them at once; what later comes
# from corner to corner of a plate or a cube is below 5e-4 of the field. More surfaces fill their box.
_PLACES, _REACHED, _FEW = 256, 0.995, 8


@dataclass(frozen=True)
class Grid:
    """Cubic cells; from cell (0, 0, 0) inwards a ring of zeros, the absorbing layer and the interior."""

    spacing: float  # edge of a cell [m]
    interior: tuple[int, int, int]  # cells per axis inside the absorbing layer
    origin: tuple[float, float, float]  # centre of cell (0, 0, 0) [m]
    kappa: float  # wavenumber in air times spacing [rad]
    layer_cells: int  # thickness of the absorbing layer
    path: float  # way of sound before it has arrived everywhere [m]

    @property
    def rim(self) -> int:
        """Cells between the array's face and the interior."""
        return self.layer_cells + 1

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of the whole array."""
        return triple(cells + 2 * self.rim for cells in self.interior)

    @property
    def first(self) -> tuple[int, int, int]:
        """First interior cell."""
        return self.rim, self.rim, self.rim

    @property
    def last(self) -> tuple[int, int, int]:
        """One past the last interior cell."""
        return triple(self.rim + cells for cells in self.interior)

    @property
    def crossing(self) -> float:
        """Time of sound in air along the longest path through the interior [periods]."""
        return math.hypot(*self.interior) * self.kappa / (2 * math.pi)

    @property
    def arrival(self) -> float:
        """Time after which sound has arrived everywhere [periods]."""
        return self.path / self.spacing * self.kappa / (2 * math.pi)

    @cached_property
    def centers(self) -> tuple[Array, Array, Array]:
        """Coordinates of the cell centres along each axis [m]."""
        return triple(
            np.asarray(origin + self.spacing * np.arange(cells), np.float64)
            for origin, cells in zip(self.origin, self.shape, strict=True)
        )

    def to_cells(self, points: Tensor) -> Array:
        """Return positions (..., 3) [m] in cells; cell centres are whole numbers."""
        return np.asarray((points.numpy() - np.array(self.origin)) / self.spacing, np.float64)

    def deeper(self, depth: int) -> tuple[slice, ...]:
        """Return the slices of the interior without `depth` cells at its rim."""
        ends = zip(self.first, self.last, strict=True)
        return tuple(slice(first + depth, last - depth) for first, last in ends)

    def centers_of(self, index: Index) -> Array:
        """Return the centres (n, 3) [m] of cells of flat `index` (n,)."""
        return np.asarray(np.array(self.origin) + self.spacing * places_of(index, self.shape), np.float64)

    def inside(self, index: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which cells of flat `index` (...) are interior."""
        places = places_of(index, self.shape)
        return np.asarray(((places >= np.array(self.first)) & (places < np.array(self.last))).all(axis=-1))

    def clip(self, cells: Array) -> Array:
        """Return positions (..., 3) in cells, moved from the absorbing layer to the nearest interior cell."""
        return np.clip(cells, self.first, np.array(self.last) - 1)


@dataclass(frozen=True)
class Extent:
    """The space that a grid covers."""

    lower: Sequence[float]  # corner with the smallest coordinates (3,) [m]
    upper: Sequence[float]  # corner with the largest coordinates (3,) [m]
    margin: int  # cells around that, before the absorbing layer begins
    layer: Thickness  # of the absorbing layer
    path: float  # way of sound before it has arrived everywhere [m]

    def interior(self, spacing: float, offset: Sequence[float] = (0.0, 0.0, 0.0)) -> tuple[int, int, int]:
        """Return the cells per axis that cover it, the first `offset` (3,) [cells] below the lower corner."""
        return triple(
            math.ceil((high - low) / spacing + first - 1e-6) + 2 * self.margin
            for low, high, first in zip(self.lower, self.upper, offset, strict=True)
        )


def domain_extent(region: Region, spacing: float) -> Extent:
    """Return the region's domain, with the air that the interpolation of points near its faces needs.

    Sound crosses it once, and again as an echo.
    """
    margin, (lower, upper) = interpolation_width(region.wavenumber * spacing) // 2 - 1, region.domain
    crossing = math.dist(lower, upper) + 2 * math.sqrt(3) * margin * spacing
    return Extent(lower, upper, margin, DOMAIN_LAYER, crossing * (2 if region.bodies else 1))


def bodies_extent(region: Region) -> Extent:
    """Return the extent of the region's bodies and the air around them in a box."""
    lower, upper = bounds(region.shapes)
    layer = box_layer(float((upper - lower).max()) / region.wavelength)
    path = round(path_between(region.shapes) + region.wavelength, 6)  # alike wherever the bodies are
    return Extent(lower.tolist(), upper.tolist(), AROUND, layer, path)


def path_between(shapes: Sequence[Shape]) -> float:
    """Return the distance [m] that few pairs of places on the surfaces of shapes exceed; see `_REACHED`."""
    if len(shapes) > _FEW:
        return math.dist(*bounds(shapes))
    surfaces = [[tensor.numpy() for tensor in shape.surface()] for shape in shapes]
    parts = [part for surface in surfaces for part in parts_of(*surface)]
    if len(parts) > _FEW:
        return math.dist(*bounds(shapes))
    places = [places_on(part, _PLACES // len(parts)) for part in parts]
    return float(np.quantile(pdist(np.concatenate(places)), _REACHED))


def make_grid(region: Region, spacing: float) -> Grid:
    """Return a grid of `spacing` [m] over the region's domain, placed for flat faces (`placement.py`)."""
    return _covering(region, spacing, domain_extent(region, spacing))


def make_box(region: Region, spacing: float, extent: Extent | None = None) -> Grid:
    """Return a grid over an extent, by default of the region's bodies, whatever its domain."""
    return _covering(region.unbounded, spacing, extent or bodies_extent(region))


def _covering(region: Region, spacing: float, extent: Extent) -> Grid:
    region.require_spacing(spacing)
    kappa = region.wavenumber * spacing
    offset = grid_offset(region, spacing, extent.lower, extent.upper)
    layer = extent.layer.cells(kappa)
    rim = layer + 1 + extent.margin - 0.5
    origin = triple(low - (rim + first) * spacing for low, first in zip(extent.lower, offset, strict=True))
    grid = Grid(spacing, extent.interior(spacing, offset), origin, kappa, layer, extent.path)
    require_cells(grid.shape, spacing)
    return grid


def require_cells(shape: tuple[int, int, int], spacing: float) -> None:
    """Check the number of cells of a grid of a shape."""
    if math.prod(shape) > MAX_CELLS:
        cells = " x ".join(map(str, shape))
        raise invalid("spacing", spacing, f"gives {cells} cells, must be at most {MAX_CELLS:.0e} in all", "m")
