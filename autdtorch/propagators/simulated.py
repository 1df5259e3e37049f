"""The propagator that simulates, and the choice of its spacing by tolerance.

Grids become finer until the estimated error is small enough.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from autdtorch.propagators.absorbed_power import AbsorbedPower
from autdtorch.propagators.box import BoxSimulation
from autdtorch.propagators.free_space import PAIR_BYTES
from autdtorch.propagators.full import DomainSimulation
from autdtorch.propagators.grid_comparison import GridComparison
from autdtorch.propagators.notices import Notices, warn_of_unsettled
from autdtorch.propagators.plan import Budget, Plan
from autdtorch.propagators.propagator import ScenePropagator
from autdtorch.propagators.simulation import PressureMap, Run, Simulation
from autdtorch.propagators.store import Store
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import COMPLEX, REAL, device_of
from autdtorch.utils.process import cached_property, one_library_thread, require_memory
from autdtorch.utils.text import counted
from autdtorch.utils.validation import ArrayLike, boolean, invalid

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

_SETTLED = 0.05
"""Distance to the steady state at which runs end, relative to the tolerance."""

_SLOW = 2e8
"""Steps of a cell in a second on a slow machine, by which a budget has time for two grids or the coarsest."""

_NOTICED, _LONG = 10.0, 300.0
"""Times of further grids [s] from which the log and a warning tell them; shorter ones only a verbose log."""


class SimulatedPropagator(ScenePropagator):
    """A propagator that simulates the steady state of the drive by FDTD.

    A result depends on the scene, the settings and the arguments of its call alone. The last ones are kept,
    up to 1 GB: transfer matrices and, by method "box", fields of drives: other points take no runs.

    Attributes:
        scene: the scene it was made for.
        method: "box" or "full".
        spacing: edge of a cell [m].
        tolerance: relative distance to the steady state at which a run ends.
        max_periods: periods after which a run ends in any case, with a `SteadyStateWarning`.
        plan: the plan.
    """

    def __init__(
        self, plan: Plan, store: Store | None = None, others: Sequence[Simulation] = (),
        may_look: bool = True, logged: set[str] | None = None,
    ) -> None:  # fmt: skip
        """Use `make_propagator`, which checks its arguments. A plan with a refusal raises it.

        `others` are simulations on other grids for error estimates, by default one, with notices `logged`.
        These look for gaps to silent points on cells half as large, unless a budget does not allow that.
        """
        if plan.refusal:
            raise ValueError(plan.refusal)
        self.scene, self.method, self.spacing = plan.scene, plan.method, plan.spacing
        self.tolerance, self.max_periods = plan.tolerance, plan.max_periods
        self.plan, self._store, self._coarser = plan, store or Store(), tuple(others)
        self._may_look, self._logged = may_look, set() if logged is None else logged

    def __repr__(self) -> str:
        settings = f"{self.method}, spacing {1e3 * self.spacing:.4g} mm, steady to {self.tolerance:g}"
        return f"SimulatedPropagator(scene {self.scene.name!r}, {settings}, {counted(len(self.runs), 'run')})"

    def for_scene(self, scene: Scene) -> SimulatedPropagator:
        """Return the propagator of a changed scene, with these settings."""
        return SimulatedPropagator(self.plan.of(scene), self._store)

    def coarser(self, factor: float) -> SimulatedPropagator:
        """Return the propagator of the scene with cells larger by a factor, at most the coarsest allowed."""
        spacing = max(self.spacing, min(factor * self.spacing, self.plan.region.coarsest_spacing))
        return SimulatedPropagator(self.plan.at(spacing, self.tolerance), self._store)

    @cached_property
    def simulation(self) -> Simulation:
        """The grids and the runs on them."""
        return simulation_of(self.plan, self._store)

    @cached_property
    def _notices(self) -> Notices:
        return Notices(self.simulation, self._logged)

    @property
    def runs(self) -> list[Run]:
        """All simulations in order.

        A run in several boxes counts as one; symmetry images and loaded matrices take none.
        """
        return self.simulation.runs

    @property
    def loaded_from(self) -> Path | None:
        """Folder of the cache that a matrix came from, or None."""
        return self.simulation.loaded_from

    @property
    def time_step(self) -> float:
        """The time step [s], of several boxes the shortest."""
        return self.simulation.time_step

    @property
    def cells(self) -> int:
        """Number of cells of all grids."""
        return self.plan.cells

    @property
    def planned_runs(self) -> int:
        """Number of simulations of the control points' transfer matrix."""
        return self.simulation.orbits(self.scene.control_points).runs

    @one_library_thread()
    def _matrix(self, points: ArrayLike | None, with_error: bool) -> tuple[torch.Tensor, float]:
        comparison = self.compared(points, with_error)
        matrix = comparison.result.matrix
        self._notices.of_cavities(comparison.points, matrix)
        if points is None:
            self._notices.of_faint_points(matrix, comparison.free)
        return matrix, comparison.error if with_error else 0.0

    def point_errors(self, points: ArrayLike | None = None) -> torch.Tensor:
        """Return the estimated relative error of each point's row of the transfer matrix, float64 (P,).

        Points and errors are those of `transfer_matrix`.
        """
        return self.compared(points, with_error=True).point_errors.to(device_of(points))

    @property
    def known_error(self) -> float:
        """The error of the control points' matrix by the grids given; infinite without any."""
        return self.compared(with_error=bool(self._coarser)).error

    @property
    def resonance_error(self) -> float:
        """The error of the control points' matrix by shifted resonances, relative to what is scattered."""
        return self.compared(with_error=True).resonance_error

    @one_library_thread()
    def compared(self, points: ArrayLike | None = None, with_error: bool = False) -> GridComparison:
        """Simulate points, by default the control points; for their errors also on other grids."""
        places, with_error = self._places(points), boolean("with_error", with_error)
        grids = self._others if with_error else ()  # a grid that is refused is so before the first run
        result = self.simulation.transfer_matrix(places)
        others = [(grid.transfer_matrix(places), grid.plan.spacing) for grid in grids]
        every = [result, *(other for other, _ in others)]
        judged = [result] if self._coarser else every  # coarse grids on the way do not matter
        warn_of_unsettled([run for each in judged for run in each.runs], self.tolerance)
        missed = torch.zeros(len(places), dtype=torch.bool, device="cpu")
        if with_error:
            self._notices.of_ringing(max(each.periods for each in every))
            missed = self._missed(places, every)
        return GridComparison(self.plan, places, result, others, missed)

    def _missed(self, points: torch.Tensor, results: Sequence[PressureMap]) -> torch.Tensor:
        """Return which points (P, 3) are silent in all results, but open to the air on cells half as large.

        Where such cells are refused, none is, and the log says why.
        """
        missed = ~torch.stack([each.matrix.any(dim=1) for each in results]).any(dim=0)
        missed[missed.clone()] = self.simulation.enclosed(points[missed])
        if missed.any():
            finer = self.plan.halved
            if reason := finer.refusal if self._may_look else "seconds or memory do not allow them":
                self._notices.of_unknown_gaps(finer.spacing, reason)
                return torch.zeros_like(missed)
            missed[missed.clone()] = ~simulation_of(finer, self._store).enclosed(points[missed])
        return missed

    @one_library_thread()
    def _field(self, drive: torch.Tensor, points: torch.Tensor, is_picture: bool) -> torch.Tensor:
        points = self.simulation.checked(points)
        if not is_picture:
            self._notices.of_points(points)
        flat = drive.reshape(-1, drive.shape[-1])
        loud = flat.detach().any(dim=1)
        by_matrix = drive.requires_grad or int(loud.sum()) > self.simulation.orbits(points).runs
        rows = len(self.scene.array) if by_matrix else len(flat)
        require_memory("points", tuple(points.shape), PAIR_BYTES * rows * len(points))
        field = torch.zeros((len(flat), len(points)), **COMPLEX)
        if by_matrix:
            result = self.simulation.transfer_matrix(points)
            field = flat @ result.matrix.mT
        elif loud.any():
            result = self.simulation.fields(flat[loud], points)
            field[loud] = result.matrix.mT
        else:
            result = PressureMap(field.mT)
        warn_of_unsettled(result.runs, self.tolerance)
        if not is_picture:
            self._notices.of_cavities(points, result.matrix)
        return field.reshape(*drive.shape[:-1], len(points))

    @one_library_thread()
    def _absorbed(self, drive: torch.Tensor) -> AbsorbedPower:
        loud = drive.any(dim=1)
        counts = len(self.scene.obstacles), len(self.scene.reflectors)
        power = AbsorbedPower(*(torch.zeros((len(drive), count), **REAL) for count in counts))
        if loud.any():
            for whole, part in zip(power, self._absorbing.absorbed_power(drive[loud]), strict=True):
                whole[loud] = part
        return power

    @cached_property
    def _absorbing(self) -> Simulation:
        """The simulation in which no body that absorbs is taken as rigid."""
        plan = self.plan
        return simulation_of(plan.with_materials, self._store) if plan.hides_losses else self.simulation

    def _places(self, points: ArrayLike | None) -> torch.Tensor:
        """Return points (P, 3) after checking them, by default the control points."""
        if points is None:
            return self.scene.control_points
        places = self.simulation.checked(points)
        require_memory("points", (len(places), 3), PAIR_BYTES * len(self.scene.array) * len(places))
        self._notices.of_points(places)
        return places

    @cached_property
    def _others(self) -> tuple[Simulation, ...]:
        """Simulations on other grids, for the error estimate."""
        if self._coarser:
            return self._coarser
        second = self.plan.second
        if reason := second.refusal:
            raise invalid("spacing", self.spacing, f"the second grid of its error estimate has {reason}", "m")
        return (simulation_of(second, self._store),)


def simulation_of(plan: Plan, store: Store) -> Simulation:
    """Make the simulation of a plan of method "box" or "full"."""
    return (DomainSimulation if plan.method == "full" else BoxSimulation)(plan, store)


def refined(pilot: Plan, budget: Budget, store: Store) -> SimulatedPropagator:
    """Return the propagator of a plan, at a spacing whose estimated error is within its tolerance.

    Where the budget does not suffice, it is the finest that fits. Where the surface of an obstacle is not
    known well enough, it is one that does not add to that error. Warnings name the error.
    """
    tolerance = pilot.tolerance
    plan = first_plan(pilot)
    second = plan.at(plan.spacing / _SMALLEST_STEP, plan.tolerance)
    if not (budget.is_unlimited or budget.fits(second, second, 2 * second.work / _SLOW)):
        plan = first_plan(pilot, is_coarsest=True)
    if plan.refusal:
        raise ValueError(f"tolerance: {tolerance}; its first grid has {plan.refusal}")
    others, logged, may_look = list[Simulation](), set[str](), budget.is_unlimited
    while True:
        begin, propagator = time.perf_counter(), SimulatedPropagator(plan, store, others, may_look, logged)
        comparison = propagator.compared(with_error=bool(others))
        error, (shape, rigid_error) = comparison.error, comparison.lasting_errors
        taken = time.perf_counter() - begin
        if comparison.needs_materials(tolerance):
            logger.debug("obstacles as rigid leave an error of %.2g: their materials count", rigid_error)
            return refined(pilot.with_materials, budget, store)
        aim = Aim(tolerance, shape, shape + rigid_error)
        grid_error = error - aim.known if others else comparison.usual_error
        if others:
            if aim.is_met(grid_error, len(others)):
                if error > tolerance:
                    _warn_of_shape(pilot, shape, error)
                return propagator
            if not math.isfinite(error):
                reason = f"too few: at a spacing of {plan.spacing:.3g} m no run came near its steady state"
                raise ValueError(f"max_periods: {plan.max_periods}; {reason}")
        ahead = plans_ahead(plan, grid_error, len(others), aim)
        finer, (_, coarsest) = ahead[0], _next_spacings(plan)
        if not budget.fits(finer, plan, taken):
            finer = plan.fitted(coarsest, coarsest)
        if not budget.fits(finer, plan, taken):
            known = f"estimated error {error:.2g}"
            if not others:
                known = f"error not estimated, which takes a second grid (usually {grid_error:.2g})"
            text = "time or memory end at %.3g mm: %s, tolerance %g"
            logger.warning(text, 1e3 * plan.spacing, known, tolerance)
            return propagator
        may_look = budget.is_unlimited or budget.fits(finer.halved, plan, taken)
        _log_cost(plan, ahead, taken, grid_error, budget, is_second=len(others) == 1)
        # the store has its matrix: a simulation without grids, whose memory is given back
        plan, others = finer, [*others, simulation_of(plan, store)]


def first_plan(pilot: Plan, is_coarsest: bool = False) -> Plan:
    """Return the plan of the first grid of a choice: the coarsest, or finer where that saves a grid."""
    region, spacing = pilot.region, pilot.region.coarsest_spacing
    if not is_coarsest:
        spacing /= min(region.wavelength / region.shortest_wavelength, _FINER_IF_SLOW)
        spacing = min(spacing, pilot.law.spacing_of(pilot.tolerance / _FIRST_ERROR))
    settled = replace(pilot, tolerance=_SETTLED * pilot.tolerance, grids=pilot.grouping)
    return settled.fitted(spacing, spacing)


@dataclass(frozen=True)
class Aim:
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


def plans_ahead(plan: Plan, grid_error: float, others: int, aim: Aim) -> list[Plan]:
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


def _warn_of_shape(pilot: Plan, shape: float, error: float) -> None:
    number, body = max(enumerate(pilot.region.bodies), key=lambda pair: pair[1].uncertainty)
    logger.warning(
        "the surface of obstacle %d is known to %.2g mm, an error of %.2g: estimated %.2g, tolerance %g;"
        " smaller voxels are needed", number, 1e3 * body.uncertainty, shape, error, pilot.tolerance,
    )  # fmt: skip
