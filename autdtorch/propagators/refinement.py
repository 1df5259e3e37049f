"""The choice of a spacing by tolerance: grids become finer until the estimated error is small enough."""

from __future__ import annotations

import logging
import math
import time
from dataclasses import dataclass, field

from autdtorch.fdtd.grid import coarsest_spacing
from autdtorch.fdtd.region import Region
from autdtorch.propagators.plan import Plan
from autdtorch.propagators.simulated import SimulatedPropagator, simulation_of
from autdtorch.propagators.simulation import Simulation
from autdtorch.propagators.store import Store
from autdtorch.utils.validation import invalid

logger = logging.getLogger(__name__)

_FIRST_ERROR = 0.05
"""Tolerance relative to the `growth` of the first spacing, whose error is several times as large."""

_FINER_IF_SLOW = 1.6
"""Most by which the first spacing is finer where sound is slower than in air. Such bodies resonate, and what
a coarse grid gives next to a resonance tells nothing of the others."""

_SMALLEST_STEP, _LARGEST_STEP = 1.25, 1.6
"""Ratios of a spacing and the next: the smallest that tells two errors apart; the largest, also the first,
over which the fall of an error is known."""

_BY_TWO_GRIDS, _BY_THREE_GRIDS = 0.45, 0.7
"""Estimated error, relative to the tolerance, that is accepted. Two coarse grids may agree by chance."""

_AIM = 0.5
"""Error for which a spacing is chosen, relative to the tolerance."""

_SHAPE = 3.0
"""Ratio of the errors of uncertain surfaces and of the grid from which a finer grid is of no use."""

_RIGID_SHARE = 0.3
"""Error of bodies taken as rigid, relative to the tolerance, from which their materials count."""

_SETTLED = 0.05
"""Distance to the steady state at which runs end, relative to the tolerance."""


@dataclass(frozen=True)
class Budget:
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
            return plan.is_feasible()
        spent = time.perf_counter() - self.begin
        in_time = self.seconds is None or spent + taken * plan.work / last.work <= self.seconds
        return in_time and (self.memory is None or plan.memory <= self.memory) and plan.is_feasible()


def refined(pilot: Plan, budget: Budget, store: Store) -> SimulatedPropagator:
    """Return the propagator of a plan, at a spacing whose estimated error is within its tolerance.

    Where the budget does not suffice, it is the finest that fits. Where the surface of an obstacle is not
    known well enough, it is one that does not add to that error. Warnings name the error.
    """
    tolerance, region, law = pilot.tolerance, pilot.region, pilot.law
    spacing = coarsest_spacing(region)
    if budget.is_unlimited:
        spacing /= min(region.wavelength / region.shortest_wavelength, _FINER_IF_SLOW)
        spacing = min(spacing, law.spacing_of(tolerance / _FIRST_ERROR))
    plan = pilot.fitted(spacing, _SETTLED * tolerance, spacing)
    others: list[Simulation] = []
    while True:
        plan.require_feasible("tolerance", tolerance)
        begin, propagator = time.perf_counter(), SimulatedPropagator(plan, store, others)
        error, shape, rigid_error = propagator.known_errors()
        taken = time.perf_counter() - begin
        logger.debug("spacing %.3g mm: estimated error %.2g", 1e3 * plan.spacing, error)
        if rigid_error > _RIGID_SHARE * tolerance:
            logger.debug(
                "obstacles taken as rigid would leave an error of %.2g: their materials count", rigid_error
            )
            return refined(pilot.with_materials, budget, store)
        step = _LARGEST_STEP
        if others:
            accepted = tolerance * (_BY_TWO_GRIDS if len(others) == 1 else _BY_THREE_GRIDS)
            known = shape + rigid_error
            if error - known <= max(accepted - known, shape / _SHAPE):
                _warn_of_shape(region, shape, error, tolerance)
                return propagator
            if not math.isfinite(error):
                reason = f"too few: at a spacing of {plan.spacing:.3g} m no run came near its steady state"
                raise invalid("max_periods", plan.max_periods, reason)
            aim = max(_AIM * tolerance - known, shape / _SHAPE)
            wanted = aim / (error - known) * law.growth(plan.spacing)
            step = min(max(plan.spacing / law.spacing_of(wanted), _SMALLEST_STEP), _LARGEST_STEP)
        for ratio in (step, _SMALLEST_STEP):
            finer = plan.fitted(plan.spacing / ratio, plan.tolerance)
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
