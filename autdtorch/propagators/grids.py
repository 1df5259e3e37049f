"""The grids of a simulation, the whole domain or boxes of obstacles, and their cost.

The unit of time is one step of one cell of air. Constants fit runs on one core at 0.6 to 2 mm.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from autdtorch.fdtd.grid import (
    MAX_CELLS_PER_WAVELENGTH,
    MIN_CELLS_PER_WAVELENGTH,
    Extent,
    bodies_extent,
    domain_extent,
    layer_cells,
)
from autdtorch.fdtd.region import Region
from autdtorch.fdtd.stability import fewest_steps
from autdtorch.fdtd.steady_state import fewest_periods
from autdtorch.fdtd.stencil import tuned_stencil
from autdtorch.utils.array_types import Array

logger = logging.getLogger(__name__)

MOST_PASSES = 12
"""Most passes of the multiple-scattering iteration between boxes; one box is cheaper than more."""

_MOST_OBSTACLES = 64
"""Most obstacles that are grouped; more share one box."""

USUAL_PERIODS = 1.7
"""Periods of a usual run among obstacles, relative to the fewest; 1.0 to 3.5 depending on the resonances."""

_LAYER, _BOX_RUN, _PAIR = 4.0, 2_000_000, 1.0
"""Time of a step of a cell in a boundary layer, of a run in a box beside its steps, and of a term of a sum
over Green's function."""


@dataclass(frozen=True)
class GridCost:
    """The cells per axis of a grid, without and with its boundary layers, and the fewest steps of a run."""

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
class Grouping:
    """Grids with the ascending indices of the obstacles on each, and the expected passes between boxes."""

    groups: tuple[tuple[int, ...], ...]
    grids: tuple[GridCost, ...]
    passes: int

    @property
    def coupled_pairs(self) -> int:
        """Pairs of a radiating cell of one box and a scattering cell of another."""
        return sum(one.radiating * other.scattering for one, other in permutations(self.grids, 2))

    def box_cost(self, runs: int) -> float:
        """Return the time of runs in boxes, in steps of a cell; boxes are coupled for all runs at once."""
        steps = sum(grid.work + _BOX_RUN for grid in self.grids)
        return runs * self.passes * steps + (self.passes - 1) * _PAIR * self.coupled_pairs


def choose_grids(
    region: Region, method: str, spacing: float, tolerance: float, runs: int
) -> tuple[str, Grouping]:
    """Return "box" or "full" and its grids; for "auto" the cheapest that is accurate for the region."""
    if method == "box":
        return method, cheapest_boxes(region, spacing, tolerance, runs)
    domain = _one_grid(region, domain_extent(region, spacing), spacing)
    if method == "full":
        return method, domain
    boxes = cheapest_boxes(region, spacing, tolerance, runs)
    gain = runs * domain.grids[0].work / boxes.box_cost(runs)
    walls = any(body.continued for body in region.bodies)
    first, last = region.domain
    outside = any((np.less(one.lower, first) | np.greater(one.upper, last)).any() for one in region.shapes)
    method, grouping = ("full", domain) if walls or not (outside or gain > 1) else ("box", boxes)
    logger.debug(
        "method auto: %s; full would take %.2g times as long as box (walls through the boundary layer: %s,"
        " obstacles that leave the domain: %s)", method, gain, walls, outside,
    )  # fmt: skip
    return method, grouping


def one_box(region: Region, spacing: float) -> Grouping:
    """Return one box of `spacing` [m] for all obstacles."""
    return _one_grid(region, bodies_extent(region.shapes), spacing)


def cheapest_boxes(region: Region, spacing: float, tolerance: float, runs: int) -> Grouping:
    """Return the cheapest boxes among those that arise from joining the nearest groups, pair after pair.

    The interiors of boxes, with the air around their obstacles, do not overlap.
    """
    best, shapes = one_box(region, spacing), region.shapes
    if len(shapes) > _MOST_OBSTACLES:
        return best
    groups: list[tuple[int, ...]] = [(index,) for index in range(len(shapes))]
    while len(groups) > 1:
        extents = [bodies_extent([shapes[index] for index in group]) for group in groups]
        gaps = _gaps(extents, spacing)
        if gaps.min() > 0 and (passes := _expected_passes(extents, tolerance)) <= MOST_PASSES:
            grids = tuple(grid_cost(region, extent, spacing) for extent in extents)
            best = min(best, Grouping(tuple(groups), grids, passes), key=lambda found: found.box_cost(runs))
        first, second = sorted(map(int, np.unravel_index(gaps.argmin(), gaps.shape)))
        groups[first] = tuple(sorted((*groups[first], *groups.pop(second))))
    return best


def _one_grid(region: Region, extent: Extent, spacing: float) -> Grouping:
    return Grouping((tuple(range(len(region.bodies))),), (grid_cost(region, extent, spacing),), 1)


def _gaps(extents: Sequence[Extent], spacing: float) -> Array:
    """Distances (B, B) [m] of boxes' interiors, along the axis where it is largest; infinite to itself."""
    margin = np.array([(extent.margin + 1) * spacing for extent in extents])  # one: for the grid's offset
    lower = np.array([extent.lower for extent in extents]) - margin[:, None]
    upper = np.array([extent.upper for extent in extents]) + margin[:, None]
    above = lower[:, None] - upper[None]
    gaps: Array = np.maximum(above, above.transpose(1, 0, 2)).max(axis=-1)
    np.fill_diagonal(gaps, math.inf)
    return gaps


def _expected_passes(extents: Sequence[Extent], tolerance: float) -> int:
    """Expected passes: a large body of radius a scatters a / 2d of an incident field to a distance d."""
    lower, upper = (np.array([getattr(extent, end) for extent in extents]) for end in ("lower", "upper"))
    middle, radius = (lower + upper) / 2, np.linalg.norm(upper - lower, axis=1) / 2
    apart = np.linalg.norm(middle[:, None] - middle, axis=-1)
    np.fill_diagonal(apart, math.inf)
    share = float((radius / (2 * apart)).sum(axis=1).max())
    return max(2, math.ceil(math.log(tolerance) / math.log(share))) if share < 1 else MOST_PASSES + 1
