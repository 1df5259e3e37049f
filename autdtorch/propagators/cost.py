"""The cost of a grid and of the heterogeneous cells on it, from the geometry alone.

The unit of time is one step of one cell of air. The constants were fitted to transfer matrices of boxes and
domains at 0.6 to 2 mm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from autdtorch.fdtd.grid import (
    MAX_CELLS_PER_WAVELENGTH,
    MIN_CELLS_PER_WAVELENGTH,
    Extent,
    layer_cells,
)
from autdtorch.fdtd.region import Region
from autdtorch.fdtd.stability import fewest_steps
from autdtorch.fdtd.steady_state import fewest_periods
from autdtorch.fdtd.stencil import tuned_stencil
from autdtorch.scene.obstacles import Mesh
from autdtorch.utils.arrays import Array

USUAL_PERIODS = 1.7
"""Periods of a usual run among obstacles, relative to the fewest; 1.0 to 3.5 depending on the resonances."""

_LAYER = 4.0
"""Time of a step of a cell in a boundary layer; fits the rates in docs/performance.md on one core."""

_BESIDE_RIGID, _BESIDE_FLUID, _SHARE_INSIDE = 1.5, 2.0, 0.5
"""Heterogeneous cells for each area of a cell of a rigid or fluid surface; their share of the cuboid around
an obstacle of another sound speed."""


@dataclass(frozen=True)
class GridCost:
    """The size of a grid and the fewest steps of a run on it.

    Attributes:
        interior: cells per axis inside the boundary layer.
        shape: cells per axis, boundary layers included.
        steps: steps of a run without resonances.
        steps_per_period: time steps in a period of the drive.
    """

    interior: tuple[int, int, int]
    shape: tuple[int, int, int]
    steps: int
    steps_per_period: float

    @property
    def cells(self) -> int:
        """Number of cells, boundary layers included."""
        return math.prod(self.shape)

    @property
    def scattering(self) -> int:
        """Cells of a box in and next to its obstacles, where an incident field acts."""
        return self._inner(8)

    @property
    def radiating(self) -> int:
        """Cells of the Huygens surface of a box, whose phasors a run keeps."""
        return self._inner(4) - self._inner(8)

    @property
    def work(self) -> float:
        """Time of the steps of a run."""
        return self.steps * (_LAYER * self.cells + (1 - _LAYER) * math.prod(self.interior))

    def _inner(self, cells: int) -> int:
        return math.prod(max(0, length - cells) for length in self.interior)


def grid_cost(region: Region, extent: Extent, spacing: float) -> GridCost:
    """Return the cost of a grid of `spacing` [m] over an extent of a region."""
    finest, coarsest = (
        region.wavelength / cells for cells in (MAX_CELLS_PER_WAVELENGTH, MIN_CELLS_PER_WAVELENGTH)
    )
    spacing = max(finest, min(spacing, coarsest))  # others are refused later
    kappa = region.wavenumber * spacing
    interior = x, y, z = extent.interior(spacing)
    rim = layer_cells(kappa) + 1
    stencil = tuned_stencil(kappa, region.attenuation * spacing)
    periods = fewest_periods(spacing * math.hypot(*interior) / region.wavelength)
    fastest = max(region.sound_speeds.values()) / region.fluid.sound_speed
    steps_per_period = fewest_steps(stencil, stencil.largest_symbol * fastest**2)
    shape = x + 2 * rim, y + 2 * rim, z + 2 * rim
    return GridCost(interior, shape, math.ceil(periods * steps_per_period), steps_per_period)


@dataclass(frozen=True)
class Heterogeneity:
    """Estimated numbers of cells and elements that are not uniform air, on all grids of a scene.

    Attributes:
        cut: elements that surfaces cut.
        cells: heterogeneous cells: beside surfaces, and inside another medium.
        columns: elements that surfaces cut in the boundary layers.
        meshed: heterogeneous cells at meshes.
    """

    cut: float
    cells: float
    columns: float
    meshed: float


def heterogeneity(region: Region, spacing: float, whole_domain: bool) -> Heterogeneity:
    """Count what is not uniform air on cells of `spacing` [m].

    Args:
        region: the region.
        spacing: edge of a cell [m].
        whole_domain: whether the grid is that of the domain, whose boundary layers continue the obstacles, or
            boxes that hold all obstacles.
    """
    inner = outer = np.array([[-np.inf] * 3, [np.inf] * 3])
    if whole_domain:
        inner = np.array(region.domain)
        outer = inner + spacing * layer_cells(region.wavenumber * spacing) * np.array([[-1.0], [1.0]])
    cut = cells = columns = meshed = 0.0
    for body in region.bodies:
        vertices, triangles = (part.numpy() for part in body.shape.surface())
        doubled = _doubled_areas(np.clip(vertices, *inner)[triangles])
        continued = _doubled_areas(np.clip(vertices, *outer)[triangles])
        area = float(np.linalg.norm(doubled, axis=1).sum()) / 2
        # a plane of normal n cuts |nx| + |ny| + |nz| elements for each area of a cell
        cut += float(np.abs(doubled).sum()) / 2 / spacing**2
        columns += (float(np.linalg.norm(continued, axis=1).sum()) / 2 - area) / spacing**2
        beside = (_BESIDE_FLUID if body.fluid else _BESIDE_RIGID) * area / spacing**2
        cells += beside
        meshed += beside if isinstance(body.shape, Mesh) else 0.0
        if body.fluid and body.fluid.sound_speed != region.fluid.sound_speed:
            box = np.clip([body.shape.lower, body.shape.upper], *inner)
            cells += _SHARE_INSIDE * float(np.prod(box[1] - box[0])) / spacing**3
    return Heterogeneity(cut, cells, columns, meshed)


def _doubled_areas(triangles: Array) -> Array:
    """Normals (T, 3) of triangles (T, 3, 3), twice as long as their areas."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    return np.asarray(np.cross(b - a, c - a))
