"""A scene on a grid, ready to step; its drive, and what is locked in to it."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import torch

from autdtorch.fdtd.assembly.elements import elements_of
from autdtorch.fdtd.assembly.heterogeneous import HeterogeneousCells, heterogeneous_cells
from autdtorch.fdtd.assembly.layer_columns import layer_columns, scaled_cells
from autdtorch.fdtd.boundary import tuned_profile
from autdtorch.fdtd.grid import Grid, make_grid
from autdtorch.fdtd.interpolation import Interpolation, average_nodes, exclude_cells, interpolate_points
from autdtorch.fdtd.kernels.contract import Coefficients, Receivers, Sources, State, uniform_state
from autdtorch.fdtd.region import Region
from autdtorch.fdtd.stability import fewest_steps, largest_eigenvalue, whole_steps
from autdtorch.fdtd.stencil import Stencil, tuned_stencil
from autdtorch.utils.validation import invalid

logger = logging.getLogger(__name__)

RAMP_PERIODS = 8
"""The drive is switched on over this many periods, so that little else than its own frequency is excited: the
shortest waves of a grid stand almost still, and what the switch-on gives them stays (at 2 mm a ramp of 3
periods left changes of 1e-3 a period after 60 periods, this one 5e-5)."""

_FAINT = 1e-20
"""Pressure of the silence before a run, relative to the strongest force."""

_ONE_NODE = torch.ones(1, dtype=torch.float64, device="cpu")
"""Weights of the nodes of a point."""


@dataclass(frozen=True)
class Assembly:
    """A scene on a grid, ready to step.

    Attributes:
        grid: where the cells are.
        stencil: weights in air.
        steps_per_period: time steps a period of the drive: steps a block (numerator) over periods a block
            (denominator).
        coefficients: what the kernel sees.
        heterogeneous: the cells that are not of uniform air.
    """

    grid: Grid
    stencil: Stencil
    steps_per_period: Fraction
    coefficients: Coefficients
    heterogeneous: HeterogeneousCells

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the fields."""
        return self.coefficients.heterogeneous_weight.dtype

    def silence(self, sources: Sources) -> State:
        """The state before anything is switched on: a uniform pressure, too faint to matter.

        Exact zeros would let the wave's forerunners decay into subnormal numbers, on which processors are
        slow (2.4 times, measured at 120^3 in float32).
        """
        faint = _FAINT * float(sources.force.detach().abs().max())
        return uniform_state(self.grid.shape, self.coefficients, faint)

    def interpolation(self, points: torch.Tensor, weights: torch.Tensor = _ONE_NODE) -> Interpolation:
        """Cells and weights of points (P, 3) [m], or nodes (P, n, 3) with `weights` (n,), in the domain."""
        return average_nodes(self._interpolation_of_nodes(points.reshape(-1, 3)), weights.numpy())

    def _interpolation_of_nodes(self, points: torch.Tensor) -> Interpolation:
        grid = self.grid
        found = self._in_air(points)
        sound_hard = np.isin(found.index, self.heterogeneous.sound_hard)  # their pressure is not defined
        return exclude_cells(found, grid.to_cells(points), sound_hard, grid.shape, grid.kappa)

    def _in_air(self, points: torch.Tensor) -> Interpolation:
        """Interpolation as if all cells were of air."""
        grid = self.grid
        return interpolate_points(grid.to_cells(points), grid.shape, grid.first, grid.last, grid.kappa)

    def touches_heterogeneous(self, points: torch.Tensor) -> bool:
        """Return whether any of the points (N, 3) [m], in the domain, uses cells that are not of air."""
        return len(points) > 0 and bool(np.isin(self._in_air(points).index, self.heterogeneous.index).any())

    def receivers(self, points: torch.Tensor, weights: torch.Tensor = _ONE_NODE) -> Receivers:
        """Receivers at points (P, 3) [m], or means over nodes (P, n, 3) with `weights` (n,)."""
        found = self.interpolation(points, weights)
        return Receivers(torch.from_numpy(found.index), torch.from_numpy(found.weight).to(self.dtype))

    def sources(
        self, points: torch.Tensor, strength: torch.Tensor, weights: torch.Tensor = _ONE_NODE
    ) -> Sources:
        """Point sources at (P, 3) [m] with far field strength e^{ikr}/r, strength (P,) complex [Pa m].

        Nodes (P, n, 3) with `weights` (n,) share the strength of a source. Differentiable by strength.
        """
        found = self.interpolation(points, weights)
        factor = self.stencil.source_factor(float(self.steps_per_period)) / self.grid.spacing
        index, inverse = np.unique(found.index, return_inverse=True)
        force = (strength[:, None] * torch.from_numpy(factor * found.weight)).reshape(-1)
        total = torch.zeros(len(index), dtype=force.dtype, device="cpu").index_add(
            0, torch.from_numpy(inverse.reshape(-1)), force
        )
        total = total / torch.from_numpy(self.heterogeneous.mass_of(index))
        return Sources(torch.from_numpy(index), torch.view_as_real(total).to(self.dtype))


def assemble(
    region: Region, spacing: float, dtype: torch.dtype = torch.float32, time_step: float | None = None
) -> Assembly:
    """Put a region on a grid of its domain, of `spacing` [m]; see `assemble_on`.

    Raises:
        ValueError: the spacing is too coarse for the frequency, or the time step is not stable.
    """
    return assemble_on(make_grid(region, spacing), region, dtype, time_step)


def assemble_on(grid: Grid, region: Region, dtype: torch.dtype, time_step: float | None) -> Assembly:
    """Put a region on a grid, with a time step of `time_step` [s] or just below.

    By default that is the largest stable one.

    Raises:
        ValueError: the time step is not stable.
    """
    stencil = air_stencil(grid, region)
    heterogeneous = heterogeneous_cells(elements_of(region, grid, stencil), stencil)
    return assembly_of(grid, stencil, heterogeneous, region.frequency, dtype, time_step)


def air_stencil(grid: Grid, region: Region) -> Stencil:
    """Weights of a region's air on a grid."""
    return tuned_stencil(grid.kappa, region.attenuation * grid.spacing)


def assembly_of(
    grid: Grid,
    stencil: Stencil,
    heterogeneous: HeterogeneousCells,
    frequency: float,
    dtype: torch.dtype,
    time_step: float | None,
) -> Assembly:
    """Make a grid ready to step whose heterogeneous cells are known; see `assemble_on`."""
    largest = largest_eigenvalue(heterogeneous.index, heterogeneous.weight, stencil, grid.shape)
    fewest = fewest_steps(stencil, largest)
    steps_per_period = whole_steps(_wanted_steps(fewest, time_step, frequency))
    steps = float(steps_per_period)
    damping = stencil.damping(steps)
    factor = stencil.time_factor(steps) / (1 + damping)
    keep = (1 - damping) / (1 + damping)
    profile = tuned_profile(grid.kappa, steps, grid.layer_cells)
    face, edge, corner = factor * stencil.face, factor * stencil.edge, factor * stencil.corner
    layer_index, layer_scale = scaled_cells(heterogeneous, stencil, grid, dtype)
    columns, crossed, crossing = layer_columns(heterogeneous, stencil, grid, factor, dtype)
    coefficients = Coefficients(
        center=1 + keep - factor * stencil.total,
        face=face,
        edge=edge,
        corner=corner,
        keep=keep,
        heterogeneous_index=torch.from_numpy(heterogeneous.index),
        heterogeneous_weight=torch.from_numpy(factor * heterogeneous.weight).to(dtype),
        sound_hard_index=torch.from_numpy(heterogeneous.shell),
        layer_decay=torch.from_numpy(profile.decay).to(dtype),
        layer_gain=torch.from_numpy(profile.gain).to(dtype),
        layer_index=layer_index,
        layer_scale=layer_scale,
        columns=columns,
        crossed=crossed,
        crossing=crossing,
    )
    logger.info(
        "grid %s at %.3g mm, %d heterogeneous cells; %d steps in %d periods: %.4g us, %.1f %% of the limit",
        grid.shape, grid.spacing * 1e3, len(heterogeneous.index), steps_per_period.numerator,
        steps_per_period.denominator, 1e6 / (steps * frequency), 100 * fewest / steps,
    )  # fmt: skip
    return Assembly(grid, stencil, steps_per_period, coefficients, heterogeneous)


def _wanted_steps(fewest: float, time_step: float | None, frequency: float) -> float:
    """Steps a period of a wanted time step [s], which must be stable; `fewest` by default."""
    if time_step is None:
        return fewest
    limit = 1 / (frequency * fewest)
    if time_step > limit:
        # rounded down, so that the number shown is accepted
        shown = f"{limit * (1 - 5e-5):.5g} s"
        raise invalid("time_step", time_step, f"must be at most {shown}, the stability limit here", "s")
    return 1 / (frequency * time_step)


def drive_signal(steps_per_period: Fraction, first: int, count: int) -> torch.Tensor:
    """Rows (count, 2) of cos(w t) and sin(w t) under the switch-on envelope, from step `first` on."""
    step = torch.arange(first, first + count, device="cpu")
    block, turns = steps_per_period.numerator, steps_per_period.denominator
    phase = 2 * math.pi / block * torch.remainder(step * turns, block).double()
    ramp = (step.double() / float(RAMP_PERIODS * steps_per_period)).clamp(max=1)
    envelope = ramp**4 * (35 - 84 * ramp + 70 * ramp**2 - 20 * ramp**3)
    return torch.stack((envelope * torch.cos(phase), envelope * torch.sin(phase)), dim=1)


def drive_dft(recorded: torch.Tensor, periods: int) -> torch.Tensor:
    """Phasors (R,) of one block of `periods`, recorded after each of its steps (steps, R)."""
    steps = len(recorded)
    turn = 2 * math.pi * periods / steps * torch.arange(1, steps + 1, dtype=torch.float64, device="cpu")
    basis = 2 / steps * torch.stack((torch.cos(turn), torch.sin(turn)))
    # in single precision PyTorch may take products of a few bits (torch.set_float32_matmul_precision)
    cosine, sine = basis.to(recorded.device) @ recorded.double()
    return torch.complex(cosine, sine)
