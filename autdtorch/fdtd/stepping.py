"""From a scene to its steady state: assemble, step period by period, lock in, know when to stop."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from autdtorch.fdtd.bonds import steps_per_period, varying_cells
from autdtorch.fdtd.boundary import tuned_profile
from autdtorch.fdtd.grid import LAYER_CELLS, Grid, fill_medium, make_grid
from autdtorch.fdtd.kernels.contract import Coefficients, Kernel, Receivers, Sources, State, uniform_state
from autdtorch.fdtd.points import PointWeights, merged, point_weights
from autdtorch.fdtd.stencil import Stencil, tuned_stencil
from autdtorch.scene import Scene

logger = logging.getLogger(__name__)

RAMP_PERIODS = 8
"""The drive is switched on over this many periods, so that little else than its own frequency is excited: the
shortest waves of a grid stand almost still, and what the switch-on gives them stays (at 2 mm a ramp of 3
periods left changes of 1e-3 a period after 60 periods, this one 5e-5)."""

_FAINT = 1e-20
"""Pressure of the silence before a run, relative to the strongest force."""

_WINDOW = 4
"""Periods over which the decay of the transient is averaged when its end is foretold."""


_ONE_NODE = torch.ones(1, dtype=torch.float64)
"""Weights of the nodes of a point."""

_SLOWEST_DECAY = 0.995
"""Decay per period that the foretelling credits a transient with at least; rounding noise decays no more."""


@dataclass(frozen=True)
class Assembly:
    """A scene on a grid, ready to step.

    Attributes:
        grid: where the cells are.
        stencil: weights in air.
        steps_per_period: time steps a period of the drive.
        coefficients: what the kernel sees.
        rigid: flat indices of the cells that sound does not enter, ascending.
    """

    grid: Grid
    stencil: Stencil
    steps_per_period: int
    coefficients: Coefficients
    rigid: NDArray[np.int64]

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the fields."""
        return self.coefficients.varying_weight.dtype

    def silence(self, sources: Sources) -> State:
        """The state before anything is switched on: a uniform pressure, too faint to matter.

        Exact zeros would let the wave's forerunners decay into subnormal numbers, on which processors are
        slow (2.4 times, measured at 120^3 in float32).
        """
        faint = _FAINT * float(sources.force.detach().abs().max())
        return uniform_state(self.grid.shape, LAYER_CELLS, faint, self.dtype)

    def spread(self, points: torch.Tensor, weights: torch.Tensor = _ONE_NODE) -> PointWeights:
        """Cells and weights of points (P, 3) [m], or nodes (P, n, 3) with `weights` (n,), in the domain."""
        return merged(self._spread_nodes(points.reshape(-1, 3)), weights.numpy())

    def _spread_nodes(self, points: torch.Tensor) -> PointWeights:
        grid = self.grid
        spread = point_weights(grid.to_cells(points), grid.shape, grid.first, grid.last, grid.kappa)
        if len(self.rigid) == 0:
            return spread
        # At a rigid wall the pressure has no slope: what would fall behind it goes to the cells before it.
        weight = np.where(np.isin(spread.index, self.rigid), 0.0, spread.weight)
        total = weight.sum(axis=1, keepdims=True)
        return PointWeights(
            spread.index, np.divide(weight, total, out=np.zeros_like(weight), where=total > 0.1)
        )

    def receivers(self, points: torch.Tensor, weights: torch.Tensor = _ONE_NODE) -> Receivers:
        """Receivers at points (P, 3) [m], or means over nodes (P, n, 3) with `weights` (n,)."""
        spread = self.spread(points, weights)
        return Receivers(torch.from_numpy(spread.index), torch.from_numpy(spread.weight).to(self.dtype))

    def sources(
        self, points: torch.Tensor, strength: torch.Tensor, weights: torch.Tensor = _ONE_NODE
    ) -> Sources:
        """Point sources at (P, 3) [m] with far field strength e^{ikr}/r, strength (P,) complex [Pa m].

        Nodes (P, n, 3) with `weights` (n,) share the strength of a source. Differentiable by strength.
        """
        spread = self.spread(points, weights)
        factor = self.stencil.source_factor(self.steps_per_period) / self.grid.spacing
        index, inverse = np.unique(spread.index, return_inverse=True)
        force = (strength[:, None] * torch.from_numpy(factor * spread.weight)).reshape(-1)
        total = torch.zeros(len(index), dtype=force.dtype).index_add(
            0, torch.from_numpy(inverse.reshape(-1)), force
        )
        return Sources(
            torch.from_numpy(index),
            total.to(torch.complex128 if self.dtype == torch.float64 else torch.complex64),
        )


def assemble(scene: Scene, spacing: float, dtype: torch.dtype = torch.float32) -> Assembly:
    """Put a scene on a grid of `spacing` [m], with the largest time step that its operator's bound allows.

    Raises:
        ValueError: if the spacing is too coarse for the frequency.
    """
    grid = make_grid(scene, spacing)
    stencil = tuned_stencil(grid.kappa, scene.attenuation * spacing)
    medium = fill_medium(scene, grid)
    varying = varying_cells(medium, stencil, scene.medium.density, scene.medium.sound_speed)
    steps = steps_per_period(stencil, varying.bond_norm)
    damping = stencil.damping(steps)
    factor = stencil.time_factor(steps) / (1 + damping)
    keep = (1 - damping) / (1 + damping)
    profile = tuned_profile(grid.kappa, steps, LAYER_CELLS)
    face, edge, corner = factor * stencil.face, factor * stencil.edge, factor * stencil.corner
    coefficients = Coefficients(
        center=1 + keep - factor * stencil.total,
        face=face,
        edge=edge,
        corner=corner,
        keep=keep,
        varying_index=torch.from_numpy(varying.index),
        varying_weight=torch.from_numpy(factor * varying.weight).to(dtype),
        layer_decay=torch.from_numpy(profile.decay).to(dtype),
        layer_gain=torch.from_numpy(profile.gain).to(dtype),
    )
    logger.debug(
        "grid %s at %.3g mm, %d steps a period, %d varying cells",
        grid.shape, spacing * 1e3, steps, len(varying.index),
    )  # fmt: skip
    return Assembly(grid, stencil, steps, coefficients, np.flatnonzero(medium.rigid))


@dataclass(frozen=True)
class SteadyState:
    """Phasors at the receivers and how sure they are.

    Attributes:
        pressure: (R,) complex, amplitude of the pressure at each receiver.
        periods: periods stepped.
        remaining: estimated relative distance to the steady state, infinite while it cannot be told.
        reached: whether that is within the tolerance.
    """

    pressure: torch.Tensor
    periods: int
    remaining: float
    reached: bool


def drive_signal(steps: int, first: int, count: int) -> torch.Tensor:
    """Rows (count, 2) of cos(w t) and sin(w t) under the switch-on envelope, from step `first` on."""
    step = torch.arange(first, first + count, dtype=torch.float64)
    phase = 2 * math.pi * torch.remainder(step, steps) / steps
    ramp = (step / (RAMP_PERIODS * steps)).clamp(max=1)
    envelope = ramp**4 * (35 - 84 * ramp + 70 * ramp**2 - 20 * ramp**3)
    return torch.stack((envelope * torch.cos(phase), envelope * torch.sin(phase)), dim=1)


def lock_in(recorded: torch.Tensor) -> torch.Tensor:
    """Phasors (R,) of one period, recorded after each of its steps (steps, R)."""
    steps = len(recorded)
    turn = 2 * math.pi * torch.arange(1, steps + 1, dtype=torch.float64) / steps
    return torch.einsum("t,tr->r", 2 / steps * torch.exp(1j * turn), recorded.to(torch.complex128))


def periods(
    assembly: Assembly, kernel: Kernel, sources: Sources, receivers: Receivers
) -> Iterator[tuple[State, torch.Tensor]]:
    """Step period by period from silence, yielding the state and the receivers' phasors (R,) of each."""
    state, steps = assembly.silence(sources), assembly.steps_per_period
    first = 0
    while True:
        signal = drive_signal(steps, first, steps).to(assembly.dtype)
        state, recorded = kernel.advance(state, assembly.coefficients, sources, receivers, signal)
        first += steps
        yield state, lock_in(recorded)


def run_to_steady_state(
    assembly: Assembly,
    kernel: Kernel,
    sources: Sources,
    receivers: Receivers,
    tolerance: float,
    max_periods: int,
) -> tuple[State, SteadyState]:
    """Step until the receivers' phasors stand, to `tolerance` (relative), or `max_periods` have passed.

    The change from period to period decays geometrically once the slowest mode is left. From its size and its
    decay over a few periods the distance still to go is foretold; a small change alone would not tell, in a
    resonant scene. A run is not judged before sound has crossed the domain twice.
    """
    crossing = assembly.grid.diagonal / assembly.grid.wavelength
    earliest = RAMP_PERIODS + math.ceil(2 * crossing)
    stepped = periods(assembly, kernel, sources, receivers)
    state, phasor = next(stepped)
    count = 1
    changes: list[float] = []
    while True:
        remaining = _foretold(changes)
        reached = count >= earliest and remaining <= tolerance
        if reached or count >= max_periods:
            return state, SteadyState(phasor, count, remaining, reached)
        previous = phasor
        state, phasor = next(stepped)
        count += 1
        changes.append(_relative_change(phasor, previous))


def _relative_change(phasor: torch.Tensor, previous: torch.Tensor) -> float:
    size = float(phasor.detach().norm())
    return float((phasor - previous).detach().norm()) / size if size else math.inf


def _foretold(changes: list[float]) -> float:
    """Relative distance to the limit of a sequence, foretold from its latest relative changes."""
    if len(changes) < 2 * _WINDOW:
        return math.inf
    late, early = max(changes[-_WINDOW:]), max(changes[-2 * _WINDOW : -_WINDOW])
    if not math.isfinite(late):
        return math.inf
    ratio = min(math.pow(late / early, 1 / _WINDOW), _SLOWEST_DECAY) if early else 0.0
    return late * ratio / (1 - ratio)


def last_period(assembly: Assembly, kernel: Kernel, state: State, sources: Sources) -> torch.Tensor:
    """Phasor of every cell (nx, ny, nz) over one more period of a run in its steady state."""
    steps = assembly.steps_per_period
    nobody = Receivers(torch.zeros((0, 1), dtype=torch.int64), torch.zeros((0, 1), dtype=assembly.dtype))
    first = RAMP_PERIODS * steps
    spectrum = torch.zeros(assembly.grid.shape, dtype=sources.force.dtype)
    for step in range(steps):
        signal = drive_signal(steps, first + step, 1).to(assembly.dtype)
        state, _ = kernel.advance(state, assembly.coefficients, sources, nobody, signal)
        turn = 2 * math.pi * (step + 1) / steps
        spectrum = spectrum + state.now * complex(math.cos(turn), math.sin(turn)) * (2 / steps)
    return spectrum
