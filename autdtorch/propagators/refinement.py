"""The choice of a spacing by tolerance: grids become finer until the estimated error is small enough."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from autdtorch.fdtd.region import Region
from autdtorch.propagators.plan import Plan
from autdtorch.propagators.simulated import SimulatedPropagator, simulation_of
from autdtorch.propagators.simulation import Simulation
from autdtorch.propagators.store import Store
from autdtorch.utils.text import counted

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

_NOTICED, _LONG = 10.0, 300.0
"""Times of further grids [s] from which the log and a warning tell them; shorter ones only a verbose log."""


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
            return not plan.refusal
        spent = time.perf_counter() - self.begin
        in_time = self.seconds is None or spent + taken * plan.work / last.work <= self.seconds
        return in_time and (self.memory is None or plan.memory <= self.memory) and not plan.refusal


def refined(pilot: Plan, budget: Budget, store: Store) -> SimulatedPropagator:
    """Return the propagator of a plan, at a spacing whose estimated error is within its tolerance.

    Where the budget does not suffice, it is the finest that fits. Where the surface of an obstacle is not
    known well enough, it is one that does not add to that error. Warnings name the error.
    """
    tolerance, region = pilot.tolerance, pilot.region
    plan = first_plan(pilot, budget.is_unlimited)
    if plan.refusal:
        raise ValueError(f"tolerance: {tolerance}; its first grid has {plan.refusal}")
    others: list[Simulation] = []
    while True:
        begin, propagator = time.perf_counter(), SimulatedPropagator(plan, store, others)
        error, shape, rigid_error = propagator.known_errors()
        taken = time.perf_counter() - begin
        if rigid_error > _RIGID_SHARE * tolerance:
            logger.debug(
                "obstacles taken as rigid would leave an error of %.2g: their materials count", rigid_error
            )
            return refined(pilot.with_materials, budget, store)
        aim = _Aim(tolerance, shape, shape + rigid_error)
        grid_error = error - aim.known if others else propagator.usual_error()
        if others:
            if aim.is_met(grid_error, len(others)):
                _warn_of_shape(region, shape, error, tolerance)
                return propagator
            if not math.isfinite(error):
                reason = f"too few: at a spacing of {plan.spacing:.3g} m no run came near its steady state"
                raise ValueError(f"max_periods: {plan.max_periods}; {reason}")
        ahead = _plans_ahead(plan, grid_error, len(others), aim)
        _, coarsest = _next_spacings(plan)
        for finer in (ahead[0], plan.fitted(coarsest, coarsest)):
            if budget.fits(finer, plan, taken):
                break
        else:
            known = f"estimated error {error:.2g}"
            if not others:
                known = f"error not estimated, which takes a second grid (usually {grid_error:.2g})"
            logger.warning(
                "time or memory end at %.3g mm: %s, tolerance %g", 1e3 * plan.spacing, known, tolerance
            )
            return propagator
        _log_cost(plan, ahead, taken, grid_error, budget, is_second=len(others) == 1)
        # the store has its matrix: a simulation without grids, whose memory is given back
        plan, others = finer, [*others, simulation_of(plan, store)]


def first_plan(pilot: Plan, is_unlimited: bool = True) -> Plan:
    """Return the plan of the first grid of a choice; without a budget it is finer where that saves a grid."""
    region, spacing = pilot.region, pilot.region.coarsest_spacing
    if is_unlimited:
        spacing /= min(region.wavelength / region.shortest_wavelength, _FINER_IF_SLOW)
        spacing = min(spacing, pilot.law.spacing_of(pilot.tolerance / _FIRST_ERROR))
    settled = replace(pilot, tolerance=_SETTLED * pilot.tolerance, grids=pilot.grouping)
    return settled.fitted(spacing, spacing)


def usual_plans(first: Plan, usual: float, tolerance: float) -> list[Plan]:
    """Return the plans of a choice from the `first` on, if its grids have their `usual` error."""
    return [first, *_plans_ahead(first, usual, 0, _Aim(tolerance))]


@dataclass(frozen=True)
class _Aim:
    """The tolerance, and the errors of uncertain surfaces and of all that no grid lowers, in it."""

    tolerance: float
    shape: float = 0.0
    known: float = 0.0

    def is_met(self, grid_error: float, others: int) -> bool:
        """Return whether an error estimated from so many other grids is accepted."""
        accepted = self.tolerance * (_BY_TWO_GRIDS if others == 1 else _BY_THREE_GRIDS)
        return grid_error <= max(accepted - self.known, self.shape / _SHAPE)

    def finer(self, plan: Plan, grid_error: float) -> Plan:
        """Return the next plan after one whose grid has an error."""
        aim = max(_AIM * self.tolerance - self.known, self.shape / _SHAPE)
        wanted = plan.law.spacing_of(aim / grid_error * plan.law.growth(plan.spacing))
        finest, coarsest = _next_spacings(plan)
        return plan.fitted(min(max(wanted, finest), coarsest), coarsest)


def _plans_ahead(plan: Plan, grid_error: float, others: int, aim: _Aim) -> list[Plan]:
    """Return the finer plans, at least one, that a choice takes after a grid if errors fall as expected.

    The error of the first grid, without `others`, is the usual one.
    """
    plans = [aim.finer(plan, grid_error if others else _UNUSUAL * grid_error)]
    while True:
        others += 1
        error = grid_error * plan.law.growth(plans[-1].spacing) / plan.law.growth(plan.spacing)
        if aim.is_met(error, others):
            return plans
        plans.append(aim.finer(plans[-1], error))


def _next_spacings(plan: Plan) -> tuple[float, float]:
    """Return the finest and the coarsest spacing [m] of the grid after a plan's."""
    return plan.spacing / _LARGEST_STEP, plan.spacing / _SMALLEST_STEP


def _log_cost(
    plan: Plan, ahead: Sequence[Plan], taken: float, error: float, budget: Budget, is_second: bool
) -> None:
    """Log the time that the grids `ahead` take, after the last one `taken` [s]: more loudly the longer it is.

    Only the second grid warns: in the first one's time is the start of kernels, and later ones repeat it.
    """
    seconds = taken * sum(each.work for each in ahead) / plan.work
    is_long = is_second and seconds > _LONG and budget.seconds is None
    logger.log(
        logging.WARNING if is_long else logging.INFO if seconds > _NOTICED else logging.DEBUG,
        "spacing %.3g mm: estimated error %.2g; %s down to %.3g mm for a tolerance of %g: about %.2g s%s",
        1e3 * plan.spacing, error, counted(len(ahead), "finer grid"), 1e3 * ahead[-1].spacing,
        plan.tolerance / _SETTLED, seconds, "; limit them by seconds=" if is_long else "",
    )  # fmt: skip


def _warn_of_shape(region: Region, shape: float, error: float, tolerance: float) -> None:
    """Log that the surface of an obstacle is not known well enough for a tolerance."""
    if error <= tolerance:
        return
    number, body = max(enumerate(region.bodies), key=lambda pair: pair[1].uncertainty)
    logger.warning(
        "the surface of obstacle %d is known to %.2g mm, which leaves an error of %.2g: estimated error %.2g,"
        " tolerance %g; smaller voxels are needed", number, 1e3 * body.uncertainty, shape, error, tolerance,
    )  # fmt: skip
