"""The propagator that simulates."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from autdtorch.fdtd.grid_errors import (
    errors_by_grids,
    grid_errors,
    reading_errors,
    rigid_errors,
    shape_errors,
    sizes,
    usual_errors,
)
from autdtorch.propagators.absorbed_power import AbsorbedPower
from autdtorch.propagators.box import BoxSimulation
from autdtorch.propagators.free_space import PAIR_BYTES, free_space_matrix
from autdtorch.propagators.full import DomainSimulation
from autdtorch.propagators.notices import Notices, warn_of_unsettled
from autdtorch.propagators.plan import Plan
from autdtorch.propagators.propagator import ScenePropagator
from autdtorch.propagators.simulation import PressureMap, Run, Simulation
from autdtorch.propagators.store import Store
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import COMPLEX, REAL, device_of
from autdtorch.utils.process import cached_property, one_library_thread, require_memory
from autdtorch.utils.text import counted
from autdtorch.utils.validation import ArrayLike, invalid

_LONGER = 1.5
"""Ratio of periods from which another grid is next to a resonance that this one is not, and is left out."""


class SimulatedPropagator(ScenePropagator):
    """A propagator that simulates the steady state of the drive by FDTD.

    A result depends on the scene, the settings and the arguments of its call alone. The last ones are kept,
    up to 1 GB: transfer matrices, and by method "box" the outgoing fields of drives, from which other points
    outside the boxes take sums and no runs.

    Attributes:
        scene: the scene it was made for.
        method: "box" or "full".
        spacing: edge of a cell [m].
        tolerance: relative distance to the steady state at which a run ends.
        max_periods: periods after which a run ends in any case, with a `SteadyStateWarning`.
        plan: the plan.
    """

    def __init__(self, plan: Plan, store: Store | None = None, others: Sequence[Simulation] = ()) -> None:
        """Use `make_propagator`, which checks its arguments. A plan with a refusal raises it.

        `others` are simulations of the scene on other grids, for error estimates; by default one is made.
        """
        if plan.refusal:
            raise ValueError(plan.refusal)
        self.scene, self.method, self.spacing = plan.scene, plan.method, plan.spacing
        self.tolerance, self.max_periods = plan.tolerance, plan.max_periods
        self.plan, self._store, self._coarser = plan, store or Store(), tuple(others)

    def __repr__(self) -> str:
        settings = f"{self.method}, spacing {1e3 * self.spacing:.4g} mm, steady to {self.tolerance:g}"
        return f"SimulatedPropagator(scene {self.scene.name!r}, {settings}, {counted(len(self.runs), 'run')})"

    def for_scene(self, scene: Scene) -> SimulatedPropagator:
        """Return the propagator of a changed scene, with these settings."""
        return SimulatedPropagator(self.plan.of(scene), self._store)

    def coarser(self, factor: float) -> SimulatedPropagator:
        """Return the propagator of the same scene with cells larger by a factor."""
        return SimulatedPropagator(self.plan.at(factor * self.spacing, self.tolerance), self._store)

    @cached_property
    def simulation(self) -> Simulation:
        """The grids and the runs on them."""
        return simulation_of(self.plan, self._store)

    @cached_property
    def _notices(self) -> Notices:
        return Notices(self.simulation)

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
        places = self._places(points)
        results = self._results(places, with_error)
        matrix = results[0].matrix
        self._notices.of_cavities(places, matrix)
        if points is None:
            self._notices.of_faint_points(matrix, self._free(places))
        return matrix, self._error(results, places) if with_error else 0.0

    @one_library_thread()
    def point_errors(self, points: ArrayLike | None = None) -> torch.Tensor:
        """Return the estimated relative error of each point's row of the transfer matrix, float64 (P,).

        Points and errors are those of `transfer_matrix`.
        """
        places = self._places(points)
        results, free = self._results(places, with_error=True), self._free(places)
        matrix, residual = results[0].matrix, results[0].residual
        settling = torch.where(matrix.any(dim=1), residual * matrix.norm() / sizes(matrix, free), 0.0)
        reading = reading_errors(matrix, free, places, self.plan.region, self.spacing)
        return torch.hypot(self._errors(results, free) + reading, settling).to(device_of(points))

    @one_library_thread()
    def known_errors(self) -> tuple[float, float, float]:
        """Simulate the control points; return their error, and its parts by shapes and rigid bodies.

        The error is that by the grids given, infinite without any. For the last part see `rigid_errors`.
        """
        points = self.scene.control_points
        results = self._results(points, with_error=bool(self._coarser))
        matrix, free = (part.reshape(1, -1) for part in (results[0].matrix, self._free(points)))
        shape, rigid = (float(of(matrix, free, self.plan.region)) for of in (shape_errors, rigid_errors))
        return self._error(results, points) if self._coarser else math.inf, shape, rigid

    @one_library_thread()
    def usual_error(self, points: ArrayLike | None = None) -> float:
        """Simulate points, by default the control points; return the usual error of grids of this spacing."""
        points = self._places(points)
        matrix = self._results(points, with_error=False)[0].matrix.reshape(1, -1)
        return float(usual_errors(matrix, self._free(points).reshape(1, -1), self.spacing, self.plan.law))

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
        if self.plan.hides_losses:
            return simulation_of(self.plan.with_materials, self._store)
        return self.simulation

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

    def _results(self, points: torch.Tensor, with_error: bool) -> list[PressureMap]:
        """Return the transfer matrices of points, of this grid and, for its error, of others."""
        grids = self._others if with_error else ()  # a grid that is refused is so before the first run
        result = self.simulation.transfer_matrix(points)
        others = [other.transfer_matrix(points) for other in grids]
        judged = [result] if self._coarser else [result, *others]  # coarse grids on the way do not matter
        warn_of_unsettled([run for each in judged for run in each.runs], self.tolerance)
        return [result, *others]

    def _error(self, results: Sequence[PressureMap], points: torch.Tensor) -> float:
        """Return the relative error of the first matrix of points, estimated from those of other grids."""
        matrix, residual, free = results[0].matrix, results[0].residual, self._free(points)
        flat = [replace(each, matrix=each.matrix.reshape(1, -1)) for each in results]
        reading = reading_errors(matrix, free, points, self.plan.region, self.spacing) * sizes(matrix, free)
        whole = sizes(flat[0].matrix, free.reshape(1, -1))
        known = float(self._errors(flat, free.reshape(1, -1)) + reading.norm() / whole)
        return math.hypot(residual, known)

    def _errors(self, results: Sequence[PressureMap], free: torch.Tensor) -> torch.Tensor:
        """Return the errors (P,) of the rows of the first matrix by grid, shape and bodies taken as rigid.

        The other results are those of `_others`; `free` is the matrix in free space.
        """
        (result, *others), matrix = results, results[0].matrix
        self._notices.of_ringing(max(each.periods for each in results))
        pairs = list(zip(others, self._others, strict=True))
        calm = [pair for pair in pairs if pair[0].periods <= _LONGER * result.periods] or pairs[-1:]
        grids = [(other.matrix, simulation.plan.spacing) for other, simulation in calm]
        # only boxes know the incident field
        of_grids = errors_by_grids if self.method == "full" else grid_errors
        errors = of_grids(matrix, free, self.spacing, grids, self.plan.law)
        heard = torch.stack([each.matrix.any(dim=1) for each in results]).any(dim=0)
        errors = torch.where(heard, errors, 0.0)  # silence on all grids is exact
        region = self.plan.region
        return errors + shape_errors(matrix, free, region) + rigid_errors(matrix, free, region)

    def _free(self, points: torch.Tensor) -> torch.Tensor:
        return free_space_matrix(points, self.scene.array, self.scene.complex_wavenumber, self.scene.images)


def simulation_of(plan: Plan, store: Store) -> Simulation:
    """Make the simulation of a plan of method "box" or "full"."""
    return (DomainSimulation if plan.method == "full" else BoxSimulation)(plan, store)
