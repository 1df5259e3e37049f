"""The grids of a simulation, the whole domain or boxes of obstacles, and their cost.

The unit of time is one step of one cell of air. Constants fit runs on one core at 0.6 to 2 mm.
"""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations

import numpy as np

from autdtorch.fdtd.grid import (
    MAX_CELLS_PER_WAVELENGTH,
    MIN_CELLS_PER_WAVELENGTH,
    Extent,
    bodies_extent,
    crossing_time,
    domain_extent,
)
from autdtorch.fdtd.reflection import can_hold, near_mirrors, whole_region, with_images
from autdtorch.fdtd.region import Body, Region, bounds
from autdtorch.fdtd.stability import fewest_steps
from autdtorch.fdtd.steady_state import fewest_periods
from autdtorch.fdtd.stencil import tuned_stencil
from autdtorch.fdtd.turning import FlatFaces, axes_along, flat_faces, is_tilted, turned_shape
from autdtorch.utils.array_types import Array

logger = logging.getLogger(__name__)

MOST_PASSES = 12  # Most passes of the iteration between boxes; beyond, one box is cheaper
_MOST_OBSTACLES = 64  # Most obstacles that are grouped; more share one box
# Periods of a usual run among obstacles, relative to the fewest; 1.0 to 3.5 depending on the resonances
USUAL_PERIODS = 1.7
# The first axis of a grid of at least so many cells whose shortest axis is at most this part of the next: the
# kernel is 1.8 times as fast where that is the shortest (432 x 432 x 29 cells)
_LARGE, _FLAT = 250_000, 0.5
# Time of a step of a cell in a boundary layer, of a run in a box beside its steps, and of a term of a sum
# over Green's function
_LAYER, _BOX_RUN, _PAIR = 4.0, 2_000_000, 1.0


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
    rim = extent.layer_cells(kappa) + 1
    stencil = tuned_stencil(kappa, region.attenuation * spacing)
    periods = fewest_periods(extent.crossings * crossing_time(interior, kappa))
    fastest = max(region.sound_speeds.values()) / region.fluid.phase_speed
    steps_per_period = fewest_steps(stencil, stencil.largest_symbol * fastest**2)
    shape = x + 2 * rim, y + 2 * rim, z + 2 * rim
    return GridCost(interior, shape, math.ceil(periods * steps_per_period), steps_per_period)


@dataclass(frozen=True, eq=False)
class Grouping:
    """Grids with the ascending indices of the obstacles on each, their axes, and the expected passes.

    Axes are rows of matrices (3, 3). Passes are those of the iteration between boxes. Grids are aligned if
    every face is parallel to the axes of its grid. A grid holds the images of its obstacles in its `mirrors`,
    ascending indices of those next to them.
    """

    groups: tuple[tuple[int, ...], ...]
    axes: tuple[Array, ...]
    grids: tuple[GridCost, ...]
    passes: int
    aligned: bool
    mirrors: tuple[tuple[int, ...], ...] = ()

    @property
    def cells(self) -> int:
        """Cells of all grids, boundary layers included."""
        return sum(grid.cells for grid in self.grids)

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
    """Return the method and its grids; for "auto" the cheapest of "box" and "full" that is accurate."""
    if method in ("box", "tmatrix"):
        return method, cheapest_boxes(region, spacing, tolerance, runs)
    walls = any(body.continued for body in region.bodies)
    if method == "auto" and region.mirrors and not walls:
        return "box", cheapest_boxes(region, spacing, tolerance, runs)
    domain = _grids(region, spacing, [_Outline.of_domain(region, spacing)])
    if method == "full":
        return method, domain
    boxes = cheapest_boxes(region, spacing, tolerance, runs)
    gain = runs * domain.grids[0].work / boxes.box_cost(runs)
    first, last = region.domain
    outside = any((np.less(one.lower, first) | np.greater(one.upper, last)).any() for one in region.shapes)
    tilted = any(map(is_tilted, boxes.axes))
    method, grouping = ("full", domain) if walls or not (outside or tilted or gain > 1) else ("box", boxes)
    logger.debug(
        "method auto: %s; full would take %.2g times as long as box (walls through the boundary layer: %s,"
        " obstacles that leave the domain: %s, tilted obstacles: %s)", method, gain, walls, outside, tilted,
    )  # fmt: skip
    return method, grouping


def one_box(region: Region, spacing: float) -> Grouping:
    """Return one box of `spacing` [m] for all obstacles."""
    surfaces = list(map(flat_faces, region.shapes))
    return _grids(region, spacing, [_Outline.around(region, range(len(surfaces)), surfaces, spacing)])


def cheapest_boxes(region: Region, spacing: float, tolerance: float, runs: int) -> Grouping:
    """Return the cheapest boxes among those that arise from joining the nearest groups, pair after pair.

    The interiors of boxes, with the air around their obstacles, do not overlap.
    """
    choices = [
        _grids(region, spacing, boxes, passes) for boxes, passes in _partitions(region, spacing, tolerance)
    ]
    possible = [choice for choice in choices if all(can_hold(region, near) for near in choice.mirrors)]
    return min(possible or choices, key=lambda grouping: grouping.box_cost(runs))


def _partitions(region: Region, spacing: float, tolerance: float) -> Iterator[tuple[Sequence[_Outline], int]]:
    """Yield one box and those apart, with the passes of the iteration between them."""
    surfaces = list(map(flat_faces, region.shapes))
    numbers = range(len(surfaces))
    yield [_Outline.around(region, numbers, surfaces, spacing)], 1
    if len(surfaces) > _MOST_OBSTACLES:
        return
    boxes = [_Outline.around(region, [index], surfaces, spacing) for index in numbers]
    while len(boxes) > 1:
        gaps = _gaps(boxes, spacing)
        if gaps.min() > 0 and (passes := _expected_passes(boxes, tolerance)) <= MOST_PASSES:
            yield list(boxes), passes
        first, second = sorted(map(int, np.unravel_index(gaps.argmin(), gaps.shape)))
        both = sorted((*boxes[first].group, *boxes.pop(second).group))
        boxes[first] = _Outline.around(region, both, surfaces, spacing)


@dataclass(frozen=True)
class _Outline:
    """The obstacles of a box, its axes, one a row (3, 3), and its extent along them.

    It is aligned if every face of its obstacles is parallel to them. It holds their images in its `mirrors`.
    """

    group: tuple[int, ...]
    axes: Array
    extent: Extent
    aligned: bool
    mirrors: tuple[int, ...] = ()

    @classmethod
    def around(
        cls, region: Region, group: Sequence[int], surfaces: Sequence[FlatFaces], spacing: float
    ) -> _Outline:
        """Return the outline of the box of a group, turned along its faces.

        It is not turned where its corners would reach a mirror whose image no grid can hold.
        """
        turned = cls._along(region, group, surfaces, spacing, along_faces=True)
        if can_hold(region, turned.mirrors):
            return turned
        straight = cls._along(region, group, surfaces, spacing, along_faces=False)
        return straight if can_hold(region, straight.mirrors) else turned

    @classmethod
    def _along(
        cls,
        region: Region,
        group: Sequence[int],
        surfaces: Sequence[FlatFaces],
        spacing: float,
        along_faces: bool,
    ) -> _Outline:
        bodies: Sequence[Body] = [region.bodies[index] for index in group]
        faces = [surfaces[index] for index in group]
        reached: tuple[int, ...] = ()
        near: tuple[int, ...] | None = None
        while reached != near:  # the box with images in these mirrors may reach others
            near, held = reached, bodies
            if near:
                held = with_images(bodies, [region.mirrors[number] for number in near])
                faces = [flat_faces(body.shape) for body in held]
            axes = axes_along(faces) if along_faces else np.eye(3)
            shapes = [turned_shape(body.shape, axes) for body in held]
            reached = near_mirrors(region, *bounds(shapes), axes, spacing)
        aligned = all(each.all_aligned(axes) for each in faces)
        extent = bodies_extent(shapes, region.wavelength)
        if turns := _turns_to_flat(extent.interior(spacing)):
            axes = np.roll(axes, turns, axis=0)
            roll = functools.partial(np.roll, shift=turns)
            extent = replace(extent, lower=roll(extent.lower), upper=roll(extent.upper))
        return cls(tuple(group), axes, extent, aligned, reached)

    @classmethod
    def of_domain(cls, region: Region, spacing: float) -> _Outline:
        """Return the outline of the whole domain, which follows the axes of the scene."""
        axes, shapes = np.eye(3), region.shapes
        aligned = bool(shapes) and all(flat_faces(shape).all_aligned(axes) for shape in shapes)
        return cls(tuple(range(len(shapes))), axes, domain_extent(whole_region(region), spacing), aligned)

    @property
    def middle(self) -> Array:
        """Its centre (3,) [m], in the coordinates of the scene."""
        return np.asarray((np.array(self.extent.lower) + self.extent.upper) / 2 @ self.axes)

    @property
    def half(self) -> Array:
        """Half of the lengths of its edges (3,) [m]."""
        return np.asarray(np.subtract(self.extent.upper, self.extent.lower) / 2)


def _turns_to_flat(interior: tuple[int, int, int]) -> int:
    """Return by how many places axes are rolled so that the shortest of a large flat grid comes first."""
    shortest, middle, _ = sorted(interior)
    if shortest > _FLAT * middle or math.prod(interior) < _LARGE:
        return 0
    return -interior.index(shortest) % 3


def _grids(region: Region, spacing: float, boxes: Sequence[_Outline], passes: int = 1) -> Grouping:
    grids = tuple(grid_cost(region, box.extent, spacing) for box in boxes)
    groups, axes = tuple(box.group for box in boxes), tuple(box.axes for box in boxes)
    mirrors = tuple(box.mirrors for box in boxes)
    return Grouping(groups, axes, grids, passes, all(box.aligned for box in boxes), mirrors)


def _gaps(boxes: Sequence[_Outline], spacing: float) -> Array:
    """Distances (B, B) [m] of boxes' interiors, along the axis where it is largest; infinite to itself."""
    gaps = np.full((len(boxes), len(boxes)), math.inf)
    for (i, one), (j, other) in combinations(enumerate(boxes), 2):
        axes = np.concatenate((one.axes, other.axes))
        reach = sum(
            np.abs(axes @ box.axes.T) @ (box.half + (box.extent.margin + 1) * spacing)  # one: for the offset
            for box in (one, other)
        )
        gaps[i, j] = gaps[j, i] = (np.abs(axes @ (one.middle - other.middle)) - reach).max()
    return gaps


def _expected_passes(boxes: Sequence[_Outline], tolerance: float) -> int:
    """Expected passes: a large body of radius a scatters a / 2d of an incident field to a distance d."""
    middle = np.array([box.middle for box in boxes])
    radius = np.array([np.linalg.norm(box.half) for box in boxes])
    apart = np.linalg.norm(middle[:, None] - middle, axis=-1)
    np.fill_diagonal(apart, math.inf)
    share = float((radius / (2 * apart)).sum(axis=1).max())
    return max(2, math.ceil(math.log(tolerance) / math.log(share))) if share < 1 else MOST_PASSES + 1
