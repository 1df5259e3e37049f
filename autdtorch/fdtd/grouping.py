"""The grids of a simulation, the whole domain or boxes of obstacles, and their cost.

The unit of time is one step of one cell of air. Constants fit runs on one core at 0.6 to 2 mm.
"""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, permutations
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray

from autdtorch.fdtd.box_coupling import usual_numbers
from autdtorch.fdtd.grid import Extent, bodies_extent, domain_extent
from autdtorch.fdtd.grid_axes import axes_along, is_tilted
from autdtorch.fdtd.perfectly_matched_layer import Thickness
from autdtorch.fdtd.region import CLEARANCE, MAX_CELLS_PER_WAVELENGTH, MIN_CELLS_PER_WAVELENGTH, Region
from autdtorch.fdtd.stability import fewest_steps
from autdtorch.fdtd.steady_state import fewest_periods
from autdtorch.fdtd.stencil import tuned_stencil
from autdtorch.utils.array_types import Array, triple
from autdtorch.utils.process import cached_property

logger = logging.getLogger(__name__)

MOST_PASSES = 12  # Most passes of the iteration between boxes; beyond, one box is cheaper
_MOST_OBSTACLES = 64  # Most obstacles that are grouped; more share one box
# Periods of a usual run among obstacles, relative to the fewest; 1.0 to 3.5 depending on the resonances
USUAL_PERIODS = 1.7
# The first axis of a grid of at least so many cells whose shortest axis is at most this part of the next: the
# kernel is 1.3 to 1.8 times as fast where that is the shortest (60 x 60 x 25 to 432 x 432 x 29 cells)
_LARGE, _FLAT = 20_000, 0.5
# Time of a step of a cell in an absorbing layer, of a run in a box beside its steps, and of a term of a sum
# over Green's function
_LAYER, _BOX_RUN, _PAIR = 4.0, 2_000_000, 1.0
# Time of a number of the matrices of waves that mirrors send back: once, and after each block of periods
_ECHO_MADE, _ECHO_OF_BLOCK, _BLOCK_PERIODS = 60.0, 0.5, 3
# Ratio of costs up to which a box holds images that it need not hold: their surfaces are assembled too
_CHEAPER = 0.5


@dataclass(frozen=True, eq=False)
class PlannedGrid:
    """A grid of some bodies of a region, and the fewest steps of a run on it.

    Attributes:
        group: ascending indices of these bodies.
        mirrors: ascending indices of the mirrors next to them, whose images the grid holds.
        part: the region of these bodies and images alone.
        axes: of the grid, one a row (3, 3).
        extent: along these axes.
        aligned: whether every face is parallel to the axes.
        spacing: edge of a cell [m].
        gaps: distances [m] to its images in the other mirrors.
    """

    group: tuple[int, ...]
    mirrors: tuple[int, ...]
    part: Region = field(compare=False)
    axes: Array
    extent: Extent
    aligned: bool
    spacing: float
    gaps: tuple[float, ...] = ()

    @cached_property
    def interior(self) -> tuple[int, int, int]:
        """Cells per axis inside the absorbing layer."""
        return self.extent.interior(self.spacing)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Cells per axis, absorbing layers included."""
        rim = self.extent.layer.cells(self.kappa) + 1
        return triple(length + 2 * rim for length in self.interior)

    @property
    def cells(self) -> int:
        """Number of cells, absorbing layers included."""
        return math.prod(self.shape)

    @property
    def kappa(self) -> float:
        """Wavenumber in air times spacing [rad]."""
        return self.part.wavenumber * self.spacing

    @cached_property
    def steps_per_period(self) -> float:
        """The fewest steps in a period."""
        stencil = tuned_stencil(self.kappa, self.part.attenuation * self.spacing)
        fastest = max(self.part.sound_speeds.values()) / self.part.fluid.phase_speed
        return fewest_steps(stencil, stencil.largest_symbol * fastest**2)

    @property
    def steps(self) -> int:
        """The fewest steps of a run."""
        return math.ceil(self.periods * self.steps_per_period)

    @property
    def periods(self) -> int:
        """The fewest periods of a run."""
        return fewest_periods(self.extent.path / self.part.wavelength)

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

    @property
    def echo_numbers(self) -> float:
        """Numbers of the matrices of waves that mirrors send back to it."""
        wavelength = self.part.wavelength
        return sum(usual_numbers(self.radiating, self.spacing, gap, wavelength) for gap in self.gaps)

    def echo_work(self, runs: int) -> float:
        """Return the time that these matrices take in runs."""
        blocks = runs * USUAL_PERIODS * self.periods / _BLOCK_PERIODS
        return (_ECHO_MADE + _ECHO_OF_BLOCK * blocks) * self.echo_numbers

    @property
    def is_possible(self) -> bool:
        """True if it can hold the images in its mirrors."""
        return self.part.can_hold(self.mirrors)

    @property
    def middle(self) -> Array:
        """Its centre (3,) [m], in the coordinates of the scene."""
        return np.asarray((np.array(self.extent.lower) + self.extent.upper) / 2 @ self.axes)

    @property
    def half(self) -> Array:
        """Half of the lengths of the edges around its bodies (3,) [m]."""
        return np.asarray(np.subtract(self.extent.upper, self.extent.lower) / 2)

    def reach(self, directions: Array) -> Array:
        """Return how far its interior reaches from its centre along directions (n, 3) [m], at most."""
        around = (self.extent.margin + 1) * self.spacing  # one for the offset
        return np.asarray(np.abs(directions @ self.axes.T) @ (self.half + around))

    def covers(self, places: Array) -> NDArray[np.bool_]:
        """Return which places (n, 3) [m] are in its interior."""
        away = np.abs((places - self.middle) @ self.axes.T)
        return np.asarray((away <= self.reach(self.axes)).all(axis=1))

    def _inner(self, cells: int) -> int:
        return math.prod(max(0, length - cells) for length in self.interior)


@dataclass(frozen=True, eq=False)
class Grouping:
    """Grids, and the expected passes of the iteration between them."""

    grids: tuple[PlannedGrid, ...] = ()
    passes: int = 1

    @property
    def aligned(self) -> bool:
        """True if every face is parallel to the axes of its grid."""
        return all(grid.aligned for grid in self.grids)

    @property
    def cells(self) -> int:
        """Cells of all grids, absorbing layers included."""
        return sum(grid.cells for grid in self.grids)

    @property
    def coupled_pairs(self) -> int:
        """Pairs of a radiating cell of one box and a scattering cell of another."""
        return sum(one.radiating * other.scattering for one, other in permutations(self.grids, 2))

    def with_rim(self, margin: int, layer: Thickness) -> Self:
        """Return the same grids with other cells of air and absorbing layers around bodies."""
        grids = [
            replace(grid, extent=replace(grid.extent, margin=margin, layer=layer)) for grid in self.grids
        ]
        return replace(self, grids=tuple(grids))

    def box_cost(self, runs: int) -> float:
        """Return the time of runs in boxes, in steps of a cell; boxes are coupled for all runs at once."""
        steps = sum(grid.work + _BOX_RUN for grid in self.grids)
        echoes = sum(grid.echo_work(runs) for grid in self.grids)
        return runs * self.passes * steps + (self.passes - 1) * _PAIR * self.coupled_pairs + echoes


def choose_grids(
    region: Region, method: str, spacing: float, tolerance: float, runs: int
) -> tuple[str, Grouping]:
    """Return the method and its grids; for "auto" the cheapest of "box" and "full" that is accurate."""
    limits = MAX_CELLS_PER_WAVELENGTH, MIN_CELLS_PER_WAVELENGTH
    finest, coarsest = (region.wavelength / cells for cells in limits)
    spacing = max(finest, min(spacing, coarsest))  # others are refused later
    walls = any(body.continued for body in region.bodies)
    if method in ("box", "tmatrix") or (method == "auto" and region.mirrors and not walls):
        return "box", cheapest_boxes(region, spacing, tolerance, runs)
    domain = Grouping((domain_grid(region, spacing),))
    if method == "full":
        return method, domain
    boxes = cheapest_boxes(region, spacing, tolerance, runs)
    gain = runs * domain.grids[0].work / boxes.box_cost(runs)
    first, last = region.domain
    outside = any(
        (np.less(shape.lower, first) | np.greater(shape.upper, last)).any() for shape in region.shapes
    )
    tilted = any(is_tilted(grid.axes) for grid in boxes.grids)
    method, grouping = ("full", domain) if walls or not (outside or tilted or gain > 1) else ("box", boxes)
    logger.debug(
        "method auto: %s; full would take %.2g times as long as box (walls through the absorbing layer: %s,"
        " obstacles that leave the domain: %s, tilted obstacles: %s)", method, gain, walls, outside, tilted,
    )  # fmt: skip
    return method, grouping


def one_box(region: Region, spacing: float) -> Grouping:
    """Return one box of `spacing` [m] for all obstacles."""
    return Grouping((box_grid(region, range(len(region.bodies)), spacing),))


def cheapest_boxes(region: Region, spacing: float, tolerance: float, runs: int) -> Grouping:
    """Return the cheapest boxes among those that arise from joining the nearest groups, pair after pair.

    The interiors of boxes, with the air around their obstacles, do not overlap.
    """
    choices = list(_partitions(region, spacing, tolerance))
    possible = [choice for choice in choices if all(grid.is_possible for grid in choice.grids)]
    cheapest = min(possible or choices, key=lambda grouping: grouping.box_cost(runs))
    return _with_images(region, cheapest, runs) if len(cheapest.grids) == 1 else cheapest


def _with_images(region: Region, alone: Grouping, runs: int) -> Grouping:
    """Return one box, or one that also holds images in mirrors at a distance if that is much cheaper.

    Sound that goes back and forth between a large body and a mirror costs less on a grid. Faces stay
    parallel to it, and sources outside, where they cost nothing.
    """
    (best,) = alone.grids
    for number in range(len(region.mirrors)):
        if number in best.mirrors:
            continue
        box = box_grid(region, best.group, best.spacing, (*best.mirrors, number))
        if not box.is_possible or box.aligned != best.aligned or box.covers(region.sources).any():
            continue
        if Grouping((box,)).box_cost(runs) < _CHEAPER * Grouping((best,)).box_cost(runs):
            best = box
    return Grouping((best,))


def _partitions(region: Region, spacing: float, tolerance: float) -> Iterator[Grouping]:
    """Yield one box, and those apart."""
    yield one_box(region, spacing)
    if not 1 < len(region.bodies) <= _MOST_OBSTACLES:
        return
    boxes = [box_grid(region, [index], spacing) for index in range(len(region.bodies))]
    while len(boxes) > 1:
        gaps = _gaps(boxes)
        if gaps.min() > 0 and (passes := _expected_passes(boxes, tolerance)) <= MOST_PASSES:
            yield Grouping(tuple(boxes), passes)
        first, second = sorted(map(int, np.unravel_index(gaps.argmin(), gaps.shape)))
        both = sorted((*boxes[first].group, *boxes.pop(second).group))
        boxes[first] = box_grid(region, both, spacing)


def box_grid(region: Region, group: Sequence[int], spacing: float, held: tuple[int, ...] = ()) -> PlannedGrid:
    """Return the box of a group of bodies, of `spacing` [m], turned along their faces.

    It holds the images in mirrors next to it, and in those `held`. It is not turned where its corners would
    reach a mirror whose image no grid can hold.
    """
    turned = _box_along(region, group, spacing, held, along_faces=True)
    if turned.is_possible:
        return turned
    straight = _box_along(region, group, spacing, held, along_faces=False)
    return straight if straight.is_possible else turned


def _box_along(
    region: Region, group: Sequence[int], spacing: float, held: tuple[int, ...], along_faces: bool
) -> PlannedGrid:
    near: tuple[int, ...] | None = None
    reached = held
    while reached != near:  # the box with images in these mirrors may reach others
        near, part = reached, region.part(group, reached)
        axes = axes_along([body.faces for body in part.bodies]) if along_faces else np.eye(3)
        extent = bodies_extent(part.turned(axes))
        heights = _heights_above_mirrors(region, extent, axes, spacing)
        reached = tuple(number for number, height in enumerate(heights) if height < 0 or number in held)
    gaps = tuple(2 * height for number, height in enumerate(heights) if number not in reached)
    aligned = all(body.faces.all_aligned(axes) for body in part.bodies)
    if turns := _turns_to_flat(extent.interior(spacing)):
        axes = np.roll(axes, turns, axis=0)
        roll = functools.partial(np.roll, shift=turns)
        extent = replace(extent, lower=roll(extent.lower), upper=roll(extent.upper))
    return PlannedGrid(tuple(group), near, part, axes, extent, aligned, spacing, gaps)


def _heights_above_mirrors(region: Region, extent: Extent, axes: Array, spacing: float) -> list[float]:
    """Return the heights [m] of a box, of an extent along `axes`, above all mirrors; negative if next to."""
    beside = CLEARANCE * spacing
    ends = np.stack([np.array(extent.lower) - beside, np.array(extent.upper) + beside])
    corners = np.stack(np.meshgrid(*ends.T, indexing="ij"), axis=-1).reshape(-1, 3) @ axes
    return [float(mirror.height(torch.from_numpy(corners)).min()) for mirror in region.mirrors]


def domain_grid(region: Region, spacing: float) -> PlannedGrid:
    """Return the grid of the whole domain, of `spacing` [m], which follows the axes of the scene."""
    whole, axes, group = region.whole, np.eye(3), tuple(range(len(region.bodies)))
    aligned = bool(group) and all(body.faces.all_aligned(axes) for body in region.bodies)
    return PlannedGrid(group, (), whole, axes, domain_extent(whole, spacing), aligned, spacing)


def _turns_to_flat(interior: tuple[int, int, int]) -> int:
    """Return by how many places axes are rolled so that the shortest of a large flat grid comes first."""
    shortest, middle, _ = sorted(interior)
    if shortest > _FLAT * middle or math.prod(interior) < _LARGE:
        return 0
    return -interior.index(shortest) % 3


def _gaps(boxes: Sequence[PlannedGrid]) -> Array:
    """Distances (B, B) [m] of boxes' interiors, along the axis where it is largest; infinite to itself."""
    gaps = np.full((len(boxes), len(boxes)), math.inf)
    for (i, one), (j, other) in combinations(enumerate(boxes), 2):
        axes = np.concatenate((one.axes, other.axes))
        apart = np.abs(axes @ (one.middle - other.middle)) - (one.reach(axes) + other.reach(axes))
        gaps[i, j] = gaps[j, i] = apart.max()
    return gaps


def _expected_passes(boxes: Sequence[PlannedGrid], tolerance: float) -> int:
    """Expected passes: a large body of radius a scatters a / 2d of an incident field to a distance d."""
    middle = np.array([box.middle for box in boxes])
    radius = np.array([np.linalg.norm(box.half) for box in boxes])
    apart = np.linalg.norm(middle[:, None] - middle, axis=-1)
    np.fill_diagonal(apart, math.inf)
    share = float((radius / (2 * apart)).sum(axis=1).max())
    return max(2, math.ceil(math.log(tolerance) / math.log(share))) if share < 1 else MOST_PASSES + 1
