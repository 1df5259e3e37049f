"""What simulations take, counted from the geometry alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from autdtorch.fdtd.grid import (
    MAX_CELLS_PER_WAVELENGTH,
    MIN_CELLS_PER_WAVELENGTH,
    Extent,
    layer_cells,
)
from autdtorch.fdtd.stability import fewest_steps
from autdtorch.fdtd.steady_state import fewest_periods
from autdtorch.fdtd.stencil import tuned_stencil
from autdtorch.propagators.scene_region import region_of
from autdtorch.scene.scene import Scene

_LAYER = 4.0
"""What a step of a cell in a boundary layer costs, in steps of a cell outside: fits the rates of boxes and
domains in docs/performance.md, all on one core."""

_BESIDE = 2_000_000
"""What a run in a box costs beside its steps, in steps of a cell: sums over Green's function."""

_PAIR = 1.0
"""What a term of a sum over Green's function costs, in steps of a cell: 6 ns and 2 to 8 ns on one core."""

USUAL_PERIODS = 1.7
"""Periods of a usual run among obstacles over the fewest: 1.0 to 3.5, by how long they ring."""


@dataclass(frozen=True)
class GridCost:
    """What a run on a grid takes, at least. Cavities that ring take more steps, on any grid.

    Attributes:
        interior: cells per axis inside the boundary layer.
        shape: of the whole array, boundary layers included.
        steps: of a run.
        steps_per_period: time steps a period of the drive.
    """

    interior: tuple[int, int, int]
    shape: tuple[int, int, int]
    steps: int
    steps_per_period: float

    @property
    def cells(self) -> int:
        """Cells of the whole array."""
        return math.prod(self.shape)

    @property
    def radiating(self) -> int:
        """Cells of a box that radiate, and whose phasors a run keeps."""
        return _shrunk(self, 4) - _shrunk(self, 8)

    @property
    def work(self) -> float:
        """Cost of the steps, in steps of a cell outside the layers."""
        return self.steps * (_LAYER * self.cells + (1 - _LAYER) * math.prod(self.interior))


def grid_cost(scene: Scene, extent: Extent, spacing: float) -> GridCost:
    """What a run takes on a grid of `spacing` [m] over an extent of a scene."""
    finest, coarsest = (
        scene.wavelength / cells for cells in (MAX_CELLS_PER_WAVELENGTH, MIN_CELLS_PER_WAVELENGTH)
    )
    spacing = max(finest, min(spacing, coarsest))  # others are refused later
    kappa = scene.wavenumber * spacing
    interior = x, y, z = extent.interior(spacing)
    rim = layer_cells(kappa) + 1
    stencil = tuned_stencil(kappa, scene.attenuation * spacing)
    periods = fewest_periods(spacing * math.hypot(*interior) / scene.wavelength)
    fastest = max(region_of(scene).sound_speeds.values()) / scene.medium.sound_speed
    steps_per_period = fewest_steps(stencil, stencil.largest_symbol * fastest**2)
    shape = x + 2 * rim, y + 2 * rim, z + 2 * rim
    return GridCost(interior, shape, math.ceil(periods * steps_per_period), steps_per_period)


def most_runs(scene: Scene) -> int:
    """Return the simulations of the control points' transfer matrix, symmetries left out."""
    return min(len(scene.control_points), len(scene.array))


def full_cost(grid: GridCost, runs: int) -> float:
    """Cost of runs on a domain, in steps of a cell."""
    return runs * grid.work


def box_cost(grids: Sequence[GridCost], passes: int, runs: int) -> float:
    """Cost of runs in boxes, each simulated in `passes`, in steps of a cell.

    Between two passes the boxes hear each other: from the cells that radiate, at those in and next to an
    obstacle, for all runs at once.
    """
    steps = sum(grid.work + _BESIDE for grid in grids)
    radiating = [grid.radiating for grid in grids]
    heard = [_shrunk(grid, 8) for grid in grids]
    pairs = sum(radiating) * sum(heard) - sum(map(math.prod, zip(radiating, heard, strict=True)))
    return runs * passes * steps + (passes - 1) * _PAIR * pairs


def _shrunk(grid: GridCost, cells: int) -> int:
    return math.prod(max(0, length - cells) for length in grid.interior)
