"""The choice and construction of a propagator for a scene, and of its spacing by tolerance.

Grids become finer until the estimated error is small enough.
"""

from __future__ import annotations

import functools
import logging
import math
import os
import time
from dataclasses import dataclass, field
from typing import Literal

import torch

from autdtorch.fdtd.region import Region
from autdtorch.propagators.free_space import FreeSpacePropagator
from autdtorch.propagators.notices import warn_of_scene
from autdtorch.propagators.plan import Plan, plan
from autdtorch.propagators.simulated import SimulatedPropagator, simulation_of
from autdtorch.propagators.simulation import Simulation
from autdtorch.propagators.store import Store, store_in
from autdtorch.propagators.tmatrix.propagator import TMatrixPropagator
from autdtorch.scene.scene import Scene
from autdtorch.utils.validation import invalid, positive

logger = logging.getLogger(__name__)

_FIRST_ERROR = 0.1
"""Tolerance relative to the `growth` of the first spacing, whose error is several times as large."""

_FINER_IF_SLOW = 1.6
"""Most by which the first spacing is finer where sound is slower than in air. Such bodies resonate, and what
a coarse grid gives next to a resonance tells nothing of the others."""

_SMALLEST_STEP, _LARGEST_STEP = 1.25, 1.6
"""Ratios of a spacing and the next: the smallest that tells two errors apart; the largest over which the fall
of an error is known."""

_BY_TWO_GRIDS, _BY_THREE_GRIDS = 0.45, 0.7
"""Estimated error, relative to the tolerance, that is accepted. Two coarse grids may agree by chance."""

_AIM = 0.5
"""Error for which a spacing is chosen, relative to the tolerance."""

_UNUSUAL = 3.5
"""Safety factor: the second spacing is chosen as if the first had this many times the usual error. Two grids
claim 0.3 to 3 times the usual error of the finer one."""

_SHAPE = 3.0
"""Ratio of the errors of uncertain surfaces and of the grid from which a finer grid is of no use."""

_RIGID_SHARE = 0.3
"""Error of bodies taken as rigid, relative to the tolerance, from which their materials count."""

_SETTLED = 0.05
"""Distance to the steady state at which runs end, relative to the tolerance."""


def make_propagator(
    scene: Scene,
    method: str = "auto",
    spacing: float | None = 1e-3,
    tolerance: float = 2e-3,
    *,
    device: torch.device | str | None = None,
    kernel: str = "auto",
    dtype: str | torch.dtype = "float32",
    max_periods: int = 600,
    time_step: float | None = None,
    seconds: float | None = None,
    memory: float | None = None,
    cache: str | os.PathLike[str] | Literal[False] | None = None,
) -> FreeSpacePropagator | TMatrixPropagator | SimulatedPropagator:
    """Make the propagator of a scene. Nothing is simulated before its first use.

    Args:
        scene: the scene.
        method: "free_space": exact, without obstacles. "full": FDTD on the whole domain. "box": FDTD of the
            scattered field in a box around the obstacles, exact elsewhere, also outside the domain. Distant
            obstacles get boxes of their own, coupled by a multiple-scattering iteration, where that is
            cheaper. Obstacles are simulated as a whole, including parts outside the domain. The grid of a
            box turns with tilted flat faces. "tmatrix": T-matrices of the obstacles, each
            simulated once for all poses, arrays and points, and known for spheres; see
            `TMatrix`. "auto": free space without obstacles; full where a wall continues through
            the absorbing layer; tmatrix where it takes fewer simulations (up to three spheres take none); box
            where other obstacles leave the domain or are tilted; otherwise the cheaper of box and full. The
            propagator's `method` is the one chosen; the reason is logged at level DEBUG.
        spacing: edge of a cell [m], at most a third of the wavelength. The error falls with its square, or
            faster along the grid (docs/decisions/error-bars.md). None: the scene is simulated on finer and
            finer grids, until the estimated error of the transfer matrix is within `tolerance`.
        tolerance: relative error, in (0, 1): the distance to the steady state at which a simulation ends,
            or the estimated error where the spacing is chosen; a warning tells where voxels are too coarse
            for it. Hard obstacles are simulated as rigid where the difference is smaller.
        device: where simulations run, and fields of many points are summed: "cpu", "cuda" (an NVIDIA GPU,
            the current one) or a `torch.device`; by default a GPU if there is one. Results are equal to
            rounding wherever they come from, and on the device of the drive or the points, by default the
            CPU.
        kernel: "cpu" (numba), "cuda" (Triton, on an NVIDIA GPU), "reference" (torch, slow, readable), or
            "auto" for the fastest available on the device.
        dtype: precision of the fields, float32 or float64.
        max_periods: periods of the drive after which a simulation ends in any case, with a
            `SteadyStateWarning`. Periods are stepped in blocks of a few; the last block is completed.
        time_step: upper limit of the time step [s]; the step used is within 3 % of it. By default the
            largest stable one.
        seconds: time for the choice of a spacing [s], about; the finest grid that fits is taken.
        memory: most memory for it [bytes].
        cache: folder for simulated transfer matrices, which are used again for the same scene, points,
            settings and version of this package. By default the environment variable AUTDTORCH_CACHE_DIR,
            or no cache if it is not set; False: no cache. Several processes may share the folder. Matrices
            used last are kept, up to about 1 GB, or as many GB as AUTDTORCH_CACHE_GB says.

    Returns:
        A propagator of the scene.

    Raises:
        ValueError: an argument is out of range, the device or kernel needs a GPU or a package that is not
            there, or the simulation needs more memory than available.
    """
    seconds = None if seconds is None else positive("seconds", seconds, "s")
    memory = None if memory is None else positive("memory", memory, "bytes")
    planned = plan(scene, method, spacing, tolerance, kernel, dtype, max_periods, time_step, device)
    if spacing is not None and (seconds, memory) != (None, None):
        raise invalid("spacing", spacing, "must be None where seconds or memory limit its choice", "m")
    store = store_in(cache)

    @functools.cache  # T-matrices need it for some points only; its time begins then
    def on_grids() -> SimulatedPropagator:
        if spacing is None:
            return _refined(planned.on_grids, _Budget(seconds, memory), store)
        return SimulatedPropagator(planned.on_grids, store)

    if not planned.runs:
        return TMatrixPropagator(planned, store, on_grids)
    propagator: TMatrixPropagator | SimulatedPropagator
    if planned.method == "tmatrix":
        settled = planned if spacing else planned.at(on_grids().spacing, tolerance, time_step)
        propagator = TMatrixPropagator(settled, store, on_grids)
    elif planned.method == "free_space":
        return FreeSpacePropagator(scene, planned.device)
    else:
        propagator = on_grids()
    if time_step is not None:
        logger.debug("time step %.4g us", 1e6 * propagator.time_step)  # refuses one that is not stable
    warn_of_scene(propagator.plan)
    return propagator


@dataclass(frozen=True)
class _Budget:
    """The time [s] and the memory [bytes] that a choice may take; None is no limit."""

    seconds: float | None = None
    memory: float | None = None
    begin: float = field(default_factory=time.perf_counter)

    @property
    def is_unlimited(self) -> bool:
        """True if neither time nor memory is limited."""
        return self.seconds is None and self.memory is None

    def fits(self, plan: Plan, last: Plan, taken: float) -> bool:
        """Return whether a plan is expected to fit, after the `last` one took `taken` [s].

        Without limits every plan does that the machine can hold.
        """
        if self.is_unlimited:
            return not plan.refusal
        spent = time.perf_counter() - self.begin
        in_time = self.seconds is None or spent + taken * plan.work / last.work <= self.seconds
        return in_time and (self.memory is None or plan.memory <= self.memory) and not plan.refusal


def _refined(pilot: Plan, budget: _Budget, store: Store) -> SimulatedPropagator:
    """Return the propagator of a plan, at a spacing whose estimated error is within its tolerance.

    Where the budget does not suffice, it is the finest that fits. Where the surface of an obstacle is not
    known well enough, it is one that does not add to that error. Warnings name the error.
    """
    tolerance, region, law = pilot.tolerance, pilot.region, pilot.law
    spacing = region.coarsest_spacing
    if budget.is_unlimited:
        spacing /= min(region.wavelength / region.shortest_wavelength, _FINER_IF_SLOW)
        spacing = min(spacing, law.spacing_of(tolerance / _FIRST_ERROR))
    plan = pilot.fitted(spacing, _SETTLED * tolerance, spacing)
    if plan.refusal:
        raise ValueError(f"tolerance: {tolerance}; its first grid has {plan.refusal}")
    others: list[Simulation] = []
    while True:
        begin, propagator = time.perf_counter(), SimulatedPropagator(plan, store, others)
        error, shape, rigid_error = propagator.known_errors()
        taken = time.perf_counter() - begin
        logger.debug("spacing %.3g mm: estimated error %.2g", 1e3 * plan.spacing, error)
        if rigid_error > _RIGID_SHARE * tolerance:
            logger.debug(
                "obstacles taken as rigid would leave an error of %.2g: their materials count", rigid_error
            )
            return _refined(pilot.with_materials, budget, store)
        known = shape + rigid_error
        grid_error = error - known if others else _UNUSUAL * propagator.usual_error()
        if others:
            accepted = tolerance * (_BY_TWO_GRIDS if len(others) == 1 else _BY_THREE_GRIDS)
            if grid_error <= max(accepted - known, shape / _SHAPE):
                _warn_of_shape(region, shape, error, tolerance)
                return propagator
            if not math.isfinite(error):
                reason = f"too few: at a spacing of {plan.spacing:.3g} m no run came near its steady state"
                raise ValueError(f"max_periods: {plan.max_periods}; {reason}")
        aim = max(_AIM * tolerance - known, shape / _SHAPE)
        wanted = aim / grid_error * law.growth(plan.spacing)
        step = min(max(plan.spacing / law.spacing_of(wanted), _SMALLEST_STEP), _LARGEST_STEP)
        for ratio in (step, _SMALLEST_STEP):
            finer = plan.fitted(plan.spacing / ratio, plan.tolerance, plan.spacing / _SMALLEST_STEP)
            if budget.fits(finer, plan, taken):
                break
        else:
            shown = 1e3 * plan.spacing, error, tolerance
            logger.warning("time or memory end at %.3g mm: estimated error %.2g, tolerance %g", *shown)
            return propagator
        # the store has its matrix: a simulation without grids, whose memory is given back
        plan, others = finer, [*others, simulation_of(plan, store)]


def _warn_of_shape(region: Region, shape: float, error: float, tolerance: float) -> None:
    """Log that the surface of an obstacle is not known well enough for a tolerance."""
    if error <= tolerance:
        return
    number, body = max(enumerate(region.bodies), key=lambda pair: pair[1].uncertainty)
    logger.warning(
        "the surface of obstacle %d is known to %.2g mm, which leaves an error of %.2g: estimated error %.2g,"
        " tolerance %g; smaller voxels are needed", number, 1e3 * body.uncertainty, shape, error, tolerance,
    )  # fmt: skip
