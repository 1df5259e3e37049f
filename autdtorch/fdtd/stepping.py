"""A region on a grid, ready to step; the drive signal and its Fourier transform."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from autdtorch.fdtd.assembly.elements import elements_of
from autdtorch.fdtd.assembly.heterogeneous import HeterogeneousCells, heterogeneous_cells
from autdtorch.fdtd.assembly.neighbours import corners_around, flat_index
from autdtorch.fdtd.assembly.unions import Union, measured, nearest_normals, rigid_distance, unions_of
from autdtorch.fdtd.damping import at_time_step, fewest_stable_steps
from autdtorch.fdtd.grid import Grid, make_grid
from autdtorch.fdtd.interpolation import (
    AT_CENTRE,
    ONE_SIDED_REACH,
    Interpolation,
    average_nodes,
    exclude_cells,
    interpolate_points,
)
from autdtorch.fdtd.kernels.contract import CPU, Coefficients, Receivers, Sources, WaveState, uniform_state
from autdtorch.fdtd.perfectly_matched_layer import layer_columns, tuned_profile
from autdtorch.fdtd.region import Region
from autdtorch.fdtd.shapes import Solids, sees
from autdtorch.fdtd.stability import whole_steps
from autdtorch.fdtd.stencil import Stencil, places_of, tuned_stencil
from autdtorch.utils.array_types import REAL, Array, Index
from autdtorch.utils.process import cached_property
from autdtorch.utils.spatial import distinct_cells, places_among
from autdtorch.utils.validation import LENGTH_TOLERANCE, invalid

logger = logging.getLogger(__name__)

_MOST_SINGLE = 1000
"""Steps in a period up to which single precision serves. Rounding of the coefficients (1e-7) makes slow waves
grow by up to its square root in a step; from 3000 steps on that is more than they lose by leaving."""

# Periods over which the drive is switched on. A short ramp excites the shortest waves of the grid, whose
# group velocity is almost zero: at 2 mm, 3 periods left changes of 1e-3 per period after 60 periods. Free
# space at 1 mm has errors of 0.056, 0.120, 0.074 and 0.050 % with 5 to 8 periods.
RAMP_PERIODS = 8
# Initial uniform pressure, relative to the largest force. From exact zeros the wave's precursors would decay
# into subnormal numbers, on which processors are slow (2.4 times, measured at 120^3 in float32).
_BACKGROUND = 1e-20
_CELL_BYTES = 20  # Memory of an assembled cell
_FEWEST_IDLE = 32  # Cells of a row from which it is quicker to skip them than to step them
_LOOKING = 512  # Points whose kernels are looked at together
# Cosine of the angle between the normals at a point and at a cell, at most, of faces with an edge in between
_AROUND_AN_EDGE = 0.2
_LAYERS = 4  # Cells along an axis, two on each side of a point, that tell whether it is in a slit
_BLOCK = np.moveaxis(np.indices((_LAYERS,) * 3), 0, -1).reshape(-1, 3)  # those of all axes, from the first
_ONE_NODE = torch.ones(1, **REAL)  # Weight of a point with a single node


@dataclass(frozen=True)
class Assembly:
    """A region on a grid, ready to step."""

    grid: Grid
    region: Region  # in the coordinates of the grid
    stencil: Stencil  # weights in air
    # time steps per period of the drive: steps (numerator) and periods (denominator) of a block
    steps_per_period: Fraction
    coefficients: Coefficients  # the input of the kernel
    heterogeneous: HeterogeneousCells  # the cells that are not of uniform air, at this time step

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the fields."""
        return self.coefficients.heterogeneous_weight.dtype

    @property
    def nbytes(self) -> int:
        """Memory [bytes], about."""
        return _CELL_BYTES * math.prod(self.grid.shape)

    def silence(self, sources: Sources, device: torch.device = CPU) -> WaveState:
        """Return the state of all runs, on a device, before the drive is switched on."""
        faint = _BACKGROUND * sources.force.detach().abs().amax(dim=(1, 2)).double().to(device)
        runs = len(sources.force)
        return uniform_state(self.grid.shape, self.coefficients, faint[:, None, None, None], runs, device)

    def interpolation(self, points: Tensor, weights: Tensor = _ONE_NODE) -> Interpolation:
        """Return cells and weights of points (P, 3) [m], or of nodes (P, n, 3) with `weights` (n,)."""
        nodes, grid = points.reshape(-1, 3), self.grid
        kernels = interpolate_points(grid.to_cells(nodes), grid.shape, grid.first, grid.last, grid.kappa)
        excluded = np.isin(kernels.index, self.heterogeneous.rigid)  # their pressure is not defined
        excluded |= self._behind_surfaces(nodes.numpy(), kernels.index, excluded)
        kernels = exclude_cells(kernels, grid.to_cells(nodes), excluded, grid.shape, grid.kappa)
        return average_nodes(kernels, weights.numpy())

    def read_at(self, points: Tensor) -> Tensor:
        """Return the places (P, 3) [m] that are read for points (P, 3) [m]; they differ in narrow slits.

        A single layer of cells between two walls does not tell the slope of the pressure across. The slope is
        small there, but a box adds the incident field, whose slope is not. So points in such a slit are moved
        into the layer.
        """
        grid, cells = self.grid, self.grid.to_cells(points)
        around = self.region.kinked.distance(points.numpy())
        some = np.flatnonzero((around > -LENGTH_TOLERANCE) & (around < grid.spacing))
        if not len(some):
            return points
        first = np.floor(cells[some]).astype(np.int64) - 1
        block = np.ravel_multi_index(tuple(np.moveaxis(first[:, None] + _BLOCK, -1, 0)), grid.shape)
        rigid = np.isin(block, self.heterogeneous.rigid)
        behind = self._behind_surfaces(points[some].numpy(), block, rigid)
        off = np.abs(first[:, None] + _BLOCK - cells[some, None])
        beside, seen = off < 1 - AT_CENTRE, ~(rigid | behind) & (off < 2 - AT_CENTRE).all(axis=2)
        places = points.clone()
        for axis in range(3):
            column = seen & np.delete(beside, axis, axis=2).all(axis=2)  # the cells beside the point across
            cube = np.moveaxis(column.reshape(-1, *(_LAYERS,) * 3), axis + 1, 1)
            layers = np.asarray(cube.any(axis=(2, 3)))
            only = (layers.sum(axis=1) == 1) & (column & beside[..., axis]).any(axis=1)
            layer = first[only, axis] + layers[only].argmax(axis=1)
            places[some[only], axis] = torch.from_numpy(grid.origin[axis] + grid.spacing * layer)
        return places

    def _behind_surfaces(self, points: Array, cells: Index, rigid: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return which cells (P, n) a surface parts from points (P, 3) [m]: the pressure has a kink there.

        Of points in fluid bodies only rigid surfaces part cells.
        """
        behind, kinked, walls = np.zeros(cells.shape, bool), self.region.kinked, self.region.walls
        outside = kinked.distance(points) > -LENGTH_TOLERANCE
        for solids, some in ((kinked, outside), (walls, ~outside)):
            if solids and some.any():
                behind[some] = self._behind(solids, points[some], cells[some], rigid[some])
        return behind

    def _behind(
        self, solids: Solids, points: Array, cells: Index, rigid: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Return which cells (P, n) are behind solid bodies or around their edges, from points (P, 3) [m].

        Points in these see all cells, and so do those in gaps where only `rigid` cells (P, n) are in sight.
        The pressure bends around edges more than waves do: kernels with some cells in a body do without those
        beyond the plane of the nearest face.
        """
        spacing = self.grid.spacing
        behind, reach = np.zeros(cells.shape, bool), ONE_SIDED_REACH * spacing
        around = solids.distance(points)
        farthest = math.sqrt(3) * spacing * round(cells.shape[1] ** (1 / 3))
        near = np.flatnonzero((around > -LENGTH_TOLERANCE) & (around < farthest))
        if not len(near):
            return behind
        count = math.prod(self.grid.shape)
        numbers = distinct_cells(cells[near], count)
        place_of, centers = places_among(numbers, count), self.grid.centers_of(numbers)
        free, of_cells = solids.distance(centers), (centers, self._outward(numbers), solids.normals(centers))
        centers, outward, normals = (np.ascontiguousarray(each.T) for each in of_cells)
        for first in range(0, len(near), _LOOKING):
            some = near[first : first + _LOOKING]
            place = place_of[cells[some]]
            ends, clear = centers[:, place], free[place]
            way = ends - points[some].T[..., None]
            seen = np.sqrt((way * way).sum(axis=0)) <= around[some, None] + clear
            off = np.abs(way).max(axis=0)
            row, cell = np.nonzero((off < reach) & (clear > 0) & ~seen)
            seen[row, cell] = sees(points[some[row]], ends[:, row, cell].T, solids, spacing)
            seen |= (outward[:, place] * way).sum(axis=0) < 0
            face = solids.normals(points[some]).T[..., None]
            beyond = (way * face).sum(axis=0) < -around[some, None] - LENGTH_TOLERANCE
            around_edge = beyond & (clear > 0) & (~seen | rigid[some]).any(axis=1)[:, None]
            around_edge &= (normals[:, place] * face).sum(axis=0) < _AROUND_AN_EDGE
            beside = ~rigid[some] & (off < (1 - AT_CENTRE) * spacing)
            seen &= ~around_edge | ~(beside & seen & ~around_edge).any(axis=1)[:, None]
            behind[some] = ~seen & ((off < reach) | (clear <= 0)) & (beside & seen).any(axis=1)[:, None]
        return behind

    def _outward(self, cells: Index) -> Array:
        """Return the normals (n, 3) of the nearest faces at cells (n,) in rigid bodies, 0 outside.

        Cells in those at an angle to the grid extend the pressure on their nearest side. Others extend none.
        """
        places, bodies = places_of(cells, self.grid.shape).astype(np.float64), self._extending
        normals = np.zeros((len(cells), 3))
        if any(body.rigid for body in bodies):
            inside = rigid_distance(bodies, places, self.grid) < 0
            normals[inside] = nearest_normals(bodies, places[inside], self.grid)
        return normals

    @cached_property
    def _extending(self) -> list[Union]:
        """The bodies without rigid ones along the grid."""
        bodies, _ = unions_of(self.region, self.grid, self.stencil)
        return measured([body for body in bodies if not (body.rigid and body.aligned)], self.grid.spacing)

    def is_enclosed(self, points: Tensor) -> NDArray[np.bool_]:
        """Return whether points (N, 3) [m] are nearer to enclosed cells than to others of air.

        Cells behind rigid bodies do not count.
        """
        if not len(self.heterogeneous.enclosed):
            return np.zeros(len(points), bool)
        cells = self.grid.to_cells(points)
        corners = corners_around(cells)
        far = ((corners - cells[:, None]) ** 2).sum(axis=2)
        index = flat_index(corners, self.grid.shape)
        enclosed = np.isin(index, self.heterogeneous.enclosed)
        open_air = ~np.isin(index, self.heterogeneous.rigid)
        if len(both := np.flatnonzero(enclosed.any(axis=1) & open_air.any(axis=1))):
            places = np.array(self.grid.origin) + self.grid.spacing * corners[both]
            seen = sees(points.numpy()[both, None], places, self.region.walls, self.grid.spacing)
            enclosed[both] &= seen
            open_air[both] &= seen
        nearest = [np.where(kind, far, np.inf).min(axis=1) for kind in (enclosed, open_air)]
        return np.asarray(nearest[0] < nearest[1])

    def receivers(self, points: Tensor) -> Receivers:
        """Return receivers at points (P, 3) [m]."""
        kernels = self.interpolation(points)
        return Receivers(torch.from_numpy(kernels.index), torch.from_numpy(kernels.weight).to(self.dtype))

    def sources(self, points: Tensor, strength: Tensor, weights: Tensor = _ONE_NODE) -> Sources:
        """Return point sources at (P, 3) [m] with far field strength e^{ikr}/r, strength (P,) complex [Pa m].

        They drive one run. Nodes (P, n, 3) with `weights` (n,) share the strength of a source. Differentiable
        by strength.
        """
        index, force = self.forces(self.interpolation(points, weights), strength)
        force = force / torch.from_numpy(self.heterogeneous.mass_of(index))
        return Sources(torch.from_numpy(index), torch.view_as_real(force)[None].to(self.dtype))

    def forces(self, kernels: Interpolation, strength: Tensor) -> tuple[Index, Tensor]:
        """Return the cells (k,) of the kernels of sources, and the forces (k,) as if all were of air."""
        factor = self.stencil.source_factor(float(self.steps_per_period)) / self.grid.spacing
        index, inverse = np.unique(kernels.index, return_inverse=True)
        force = (strength[:, None] * torch.from_numpy(factor * kernels.weight)).reshape(-1)
        return index, force.new_zeros(len(index)).index_add(0, torch.from_numpy(inverse.reshape(-1)), force)


def assemble(
    region: Region, spacing: float, dtype: torch.dtype = torch.float32, time_step: float | None = None
) -> Assembly:
    """Assemble a region on a grid of its domain with cells of `spacing` [m]; see `assemble_on`."""
    return assemble_on(make_grid(region, spacing), region, dtype, time_step)


def assemble_on(grid: Grid, region: Region, dtype: torch.dtype, time_step: float | None) -> Assembly:
    """Assemble a region on a grid, with at most a time step of `time_step` [s], by default the largest."""
    stencil = air_stencil(grid, region)
    sources = grid.to_cells(torch.from_numpy(region.sources))
    cells = heterogeneous_cells(elements_of(region, grid, stencil), stencil, sources)
    return assembly_of(grid, region, cells, dtype, time_step)


def air_stencil(grid: Grid, region: Region) -> Stencil:
    """Return the stencil of a region's air on a grid."""
    return tuned_stencil(grid.kappa, region.attenuation * grid.spacing)


def assembly_of(
    grid: Grid, region: Region, cells: HeterogeneousCells, dtype: torch.dtype, time_step: float | None
) -> Assembly:
    """Return the assembly of a grid with known heterogeneous cells; see `assemble_on`."""
    stencil, frequency = air_stencil(grid, region), region.frequency
    fewest = fewest_stable_steps(cells, stencil, grid.shape)
    steps_per_period = whole_steps(_wanted_steps(fewest, time_step, frequency))
    steps = float(steps_per_period)
    if dtype == torch.float32 and steps > _MOST_SINGLE:
        logger.info("%d steps in a period: in double precision, as rounding would grow in single", steps)
        dtype = torch.float64
    cells, loss, ground = at_time_step(cells, stencil, steps)
    damping = stencil.damping(steps)
    factor = stencil.time_factor(steps) / (1 + damping)
    keep = (1 - damping) / (1 + damping)
    profile = tuned_profile(grid.kappa, steps, grid.layer_cells)
    in_layers = ~grid.inside(cells.index)
    index, weight = cells.index[in_layers], cells.weight[in_layers]
    scale = weight.sum(axis=1) / stencil.total
    rows = weight - scale[:, None] * stencil.weights
    columns, crossed, crossing = layer_columns(
        index, rows, stencil, grid.shape, grid.layer_cells, factor, dtype
    )
    coefficients = Coefficients(
        center=1 + keep - factor * stencil.total,
        face=factor * stencil.face,
        edge=factor * stencil.edge,
        corner=factor * stencil.corner,
        keep=keep,
        heterogeneous_index=torch.from_numpy(cells.index),
        heterogeneous_weight=torch.from_numpy(factor * cells.weight).to(dtype),
        sound_hard_index=torch.from_numpy(cells.shell),
        layer_decay=torch.from_numpy(profile.decay).to(dtype),
        layer_gain=torch.from_numpy(profile.gain).to(dtype),
        layer_index=torch.from_numpy(index),
        layer_scale=torch.from_numpy(scale).to(dtype),
        columns=columns,
        crossed=crossed,
        crossing=crossing,
        loss_index=torch.from_numpy(cells.index[cells.lossy]),
        loss_weight=loss.to(dtype),
        loss_ground=ground.to(dtype),
        idle=torch.from_numpy(_idle(grid, cells)),
    )
    logger.debug(
        "grid %s at %.3g mm, %d heterogeneous cells; %d steps in %d periods: %.4g us, %.1f %% of the limit",
        grid.shape, grid.spacing * 1e3, len(cells.index), steps_per_period.numerator,
        steps_per_period.denominator, 1e6 / (steps * frequency), 100 * fewest / steps,
    )  # fmt: skip
    return Assembly(grid, region, stencil, steps_per_period, coefficients, cells)


def _idle(grid: Grid, cells: HeterogeneousCells) -> Index:
    """Return the runs (g, 2) of cells behind the shell of rigid bodies; see `Coefficients`."""
    if len(cells.rigid) == len(cells.shell):
        return np.zeros((0, 2), np.int64)
    mask, behind = np.zeros((2, math.prod(grid.shape)), bool)
    mask[cells.rigid], mask[cells.shell] = True, False
    inner = grid.deeper(0)
    behind.reshape(grid.shape)[inner] = mask.reshape(grid.shape)[inner]
    runs = np.flatnonzero(np.diff(behind, prepend=False, append=False)).reshape(-1, 2)
    return runs[np.diff(runs, axis=1)[:, 0] >= _FEWEST_IDLE]


def _wanted_steps(fewest: float, time_step: float | None, frequency: float) -> float:
    """Return steps per period for a time step [s], which must be stable; `fewest` by default."""
    if time_step is None:
        return fewest
    limit = 1 / (frequency * fewest)
    if time_step > limit:
        # rounded down, so that the number shown is accepted
        shown = f"{limit * (1 - 5e-5):.5g} s"
        raise invalid("time_step", time_step, f"must be at most {shown}, the stability limit here", "s")
    return 1 / (frequency * time_step)


def drive_signal(
    steps_per_period: Fraction, first: int, count: int, ramp_periods: int = RAMP_PERIODS
) -> Tensor:
    """Return cos(w t) and sin(w t) under the switch-on envelope, (count, 2), from step `first` on."""
    step = torch.arange(first, first + count, device="cpu")
    block, turns = steps_per_period.numerator, steps_per_period.denominator
    phase = 2 * math.pi / block * torch.remainder(step * turns, block).double()
    ramp = (step.double() / float(ramp_periods * steps_per_period)).clamp(max=1)
    envelope = ramp**4 * (35 - 84 * ramp + 70 * ramp**2 - 20 * ramp**3)
    return torch.stack((envelope * torch.cos(phase), envelope * torch.sin(phase)), dim=1)


def drive_basis(steps: int, periods: int) -> Tensor:
    """Return the weights (2, steps) of the real and imaginary part of a phasor, for records of `periods`."""
    turn = 2 * math.pi * periods / steps * torch.arange(1, steps + 1, **REAL)
    return 2 / steps * torch.stack((torch.cos(turn), torch.sin(turn)))


def fourier_sum(basis: Tensor, recorded: Tensor) -> Tensor:
    """Return sums (..., q) of records (..., steps, q) with the weights (2, steps) of a phasor."""
    # in single precision PyTorch may take products of a few bits (torch.set_float32_matmul_precision)
    if recorded.device.type == "cpu" and not recorded.requires_grad:
        sums = torch.from_numpy(basis.to(recorded.dtype).numpy() @ recorded.numpy()).double()
    else:
        sums = basis.to(recorded.device) @ recorded.double()
    cosine, sine = sums.unbind(-2)
    return torch.complex(cosine, sine)


def drive_dft(recorded: Tensor, periods: int) -> Tensor:
    """Return phasors (..., q) at the drive frequency of records (..., steps, q) of `periods`."""
    return fourier_sum(drive_basis(recorded.shape[-2], periods), recorded)
