"""A plan's grids and the runs on them: every result is a linear map, decided by the plan and the points."""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import torch

from autdtorch.fdtd.grouping import USUAL_PERIODS
from autdtorch.fdtd.kernels import make_kernel
from autdtorch.fdtd.resonances import Resonance, as_numbers, merged, of_numbers
from autdtorch.fdtd.steady_state import SILENCE, SteadyState, fewest_periods
from autdtorch.fdtd.stepping import Assembly
from autdtorch.fdtd.symmetry import Orbits, Symmetry, orbits_of_points, orbits_of_transducers, symmetries
from autdtorch.propagators.absorbed_power import (
    AbsorbedPower,
    Absorption,
    Radiators,
    power_into_reflectors,
    radiators_of_array,
)
from autdtorch.propagators.plan import Plan
from autdtorch.propagators.silent_points import in_filled_cavities, in_rigid
from autdtorch.propagators.store import Store
from autdtorch.scene.arrays import apertures_of, complex_strengths_of
from autdtorch.utils.apertures import Apertures
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.digest import digest_of
from autdtorch.utils.mirror_images import SPACE_ITSELF, Mirror
from autdtorch.utils.process import cached_property
from autdtorch.utils.progress import show_progress
from autdtorch.utils.text import counted
from autdtorch.utils.validation import ArrayLike, invalid, points_tensor

logger = logging.getLogger(__name__)
ResultT = TypeVar("ResultT")

Stepped = Callable[[int], None]


@dataclass(frozen=True)
class Run:
    """The course of one simulation.

    Attributes:
        periods: periods of the drive that were stepped, summed over boxes.
        remaining: estimated relative distance to the steady state.
        reached: whether that is within the tolerance.
        seconds: time taken, possibly beside other runs.
        resonances: those that rang.
    """

    periods: int
    remaining: float
    reached: bool
    seconds: float
    resonances: tuple[Resonance, ...] = ()

    @classmethod
    def of(cls, steady: SteadyState, seconds: float) -> Run:
        """Record a run that took `seconds`."""
        logger.debug("run of %d periods, %.1e from steady, %.1f s", steady.periods, steady.residual, seconds)
        return cls(steady.periods, steady.residual, steady.converged, seconds, steady.resonances)


@dataclass(frozen=True)
class PressureMap:
    """A linear map from drives to pressures at points: a transfer matrix, or the fields of some drives.

    Attributes:
        matrix: complex128 (P, M) [Pa], or (P, R) for R drives.
        residual: estimated relative distance to the steady state.
        periods: most periods of a run.
        runs: the simulations behind it; none if it was loaded.
        from_points: whether they began at the points (reciprocity), not at the transducers.
        resonances: those that rang, relative to all runs; at most `MOST_RESONANCES`.
    """

    matrix: torch.Tensor
    residual: float = 0.0
    periods: int = 0
    runs: tuple[Run, ...] = ()
    from_points: bool = True
    resonances: tuple[Resonance, ...] = ()

    @property
    def nbytes(self) -> int:
        """Memory [bytes]."""
        return self.matrix.nbytes

    @classmethod
    def of_runs(cls, matrix: torch.Tensor, runs: Sequence[Run], from_points: bool) -> PressureMap:
        """Return the map that runs gave."""
        residual, periods = max(run.remaining for run in runs), max(run.periods for run in runs)
        resonances = merged([run.resonances for run in runs])
        return cls(matrix, residual, periods, tuple(runs), from_points, resonances)


def mean_of_images(pressure: torch.Tensor, weights: torch.Tensor | None) -> torch.Tensor:
    """Return the pressure (P, R) from pressures at images (G P, R); see `Simulation.seen_twice`."""
    if weights is None:
        return pressure
    return (weights[..., None] * pressure.reshape(*weights.shape, -1)).sum(dim=0)


class Simulation(ABC):
    """A plan's grids, which are assembled at first use, and the runs on them.

    Attributes:
        plan: the plan.
        runs: all simulations in order.
        loaded_from: folder that a matrix was loaded from, or None.
    """

    def __init__(self, plan: Plan, store: Store) -> None:
        """Make the simulation of a plan, whose results are in a store; a plan with a refusal raises it.

        Nothing is computed yet.
        """
        if plan.refusal:
            raise ValueError(plan.refusal)
        self.plan, self._store = plan, store
        self.runs: list[Run] = []
        self.loaded_from: Path | None = None
        self._kernel = make_kernel(plan.kernel)

    @property
    @abstractmethod
    def assemblies(self) -> Sequence[Assembly]:
        """The assembled grids."""

    @abstractmethod
    def _in_enclosed_cells(self, points: torch.Tensor) -> torch.Tensor:
        """Return which points (..., 3) are in cells of air that rigid obstacles enclose."""

    @abstractmethod
    def _read_at(self, points: torch.Tensor) -> torch.Tensor:
        """Return the places (P, 3) that are read for points (P, 3); see `Assembly.read_at`."""

    @abstractmethod
    def _check(self, points: torch.Tensor) -> None:
        """Refuse points (P, 3) whose pressure cannot be computed."""

    @property
    @abstractmethod
    def absorptions(self) -> Sequence[Absorption]:
        """The absorption of the obstacles on each grid where some absorb."""

    @abstractmethod
    def radiators(self, drive: torch.Tensor) -> list[Radiators]:
        """Return what radiates instead of the obstacles, in runs of drives (R, M)."""

    @abstractmethod
    def _simulate(
        self, sources: Sequence[Apertures], strength: torch.Tensor, receivers: Apertures, stepped: Stepped
    ) -> tuple[torch.Tensor, list[Run]]:
        """Do the work of `_run`, also in obstacles; `stepped` is called with numbers of periods."""

    def checked(self, points: ArrayLike) -> torch.Tensor:
        """Return points (P, 3) after checking them; a `ValueError` names one that cannot be computed."""
        points = points_tensor("points", points).cpu()
        self._check(points)
        return points

    def transfer_matrix(self, points: torch.Tensor) -> PressureMap:
        """Return the transfer matrix of points (P, 3): strengths times the matrix of unit strengths."""
        key = digest_of(self.plan.key, points)
        unit = self._store.get(key, lambda: self._loaded(key, points) or self._saved(key, points))
        return replace(unit, matrix=complex_strengths_of(self.plan.scene.array) * unit.matrix)

    def fields(self, drive: torch.Tensor, points: torch.Tensor) -> PressureMap:
        """Return the pressure (P, R) of drives (R, M), none of them silent, at points (P, 3)."""
        key = digest_of(self.plan.key, points, self.sources_of(drive)[1])
        return self._store.get(key, lambda: self._audible_fields(drive, points))

    @property
    @abstractmethod
    def held_mirrors(self) -> Sequence[Mirror]:
        """The mirrors whose images are on grids."""

    def seen_twice(self, receivers: Apertures) -> tuple[Apertures, torch.Tensor | None]:
        """Return P receivers and their images on grids, and the weights (G, P) of these; None without any.

        A grid that follows tilted bodies is not its own image. The mean of both fields is reciprocal.
        """
        images = [SPACE_ITSELF]
        for mirror in self.held_mirrors:  # of two that face each other, this leaves out their series
            images += [mirror.image.after(image) for image in images]
        if len(images) == 1:
            return receivers, None
        everywhere, weights = receivers.with_images(images)
        return everywhere, weights.reshape(-1, len(receivers.centers)) / len(images)

    def absorbed_power(self, drive: torch.Tensor) -> AbsorbedPower:
        """Simulate drives (R, M), none of them silent; return the power [W] by obstacle and reflector."""
        scene = self.plan.scene
        obstacles = torch.zeros((len(scene.obstacles), len(drive)), **REAL)
        if self.absorptions:
            places = [each.places for each in self.absorptions]
            sources, receivers = self.sources_of(drive), Apertures(torch.cat(places))
            pressure, _ = self._recorded(
                len(drive), lambda stepped: self._simulate(*sources, receivers, stepped)
            )
            parts = torch.split(pressure.mT, list(map(len, places)))
            for each, part in zip(self.absorptions, parts, strict=True):
                obstacles += each.power(part, len(obstacles))
        absorbing = any(abs(reflector.reflection) < 1 for reflector in scene.reflectors)
        radiators = [radiators_of_array(scene, drive), *self.radiators(drive)] if absorbing else []
        return AbsorbedPower(obstacles.mT, power_into_reflectors(scene, radiators, len(drive)))

    def orbits(self, points: torch.Tensor) -> Orbits:
        """Return the fewest runs for a transfer matrix: from transducers or, by reciprocity, from points."""
        forward = self._orbits_of_transducers(points)
        backward = orbits_of_points(points, self.symmetries)
        fewer = (backward.runs, len(points)) < (forward.runs, len(self.plan.scene.array))
        return backward if fewer else forward

    @cached_property
    def symmetries(self) -> list[Symmetry]:
        """Symmetries of the scene on its grid."""
        axes = self.plan.grouping.grids[0].axes
        every = symmetries(self.assemblies, axes, self.transducers)
        return [each for each in every if each.keeps(self.plan.region.mirrors)]

    @cached_property
    def transducers(self) -> Apertures:
        """The transducers as sources or receivers."""
        return apertures_of(self.plan.scene.array, self.plan.scene.wavenumber)

    def sources_of(self, drive: torch.Tensor) -> tuple[list[Apertures], torch.Tensor]:
        """Return the sources of runs of drives (R, M) and their strengths (R, M) [Pa m]."""
        return [self.transducers] * len(drive), complex_strengths_of(self.plan.scene.array) * drive

    def imaged(self, sources: Apertures, strength: torch.Tensor) -> tuple[Apertures, torch.Tensor]:
        """Return sources of strength (N,) [Pa m] with all their images in the scene's reflectors."""
        everything, weights = sources.with_images(self.plan.scene.images)
        return everything, weights * strength.repeat(len(weights) // len(strength))

    @property
    def time_step(self) -> float:
        """The time step [s], on several grids the shortest."""
        most = max(assembly.steps_per_period for assembly in self.assemblies)
        return 1 / (self.plan.scene.frequency * float(most))

    def silent(self, nodes: torch.Tensor) -> torch.Tensor:
        """Return which receivers (P,), with nodes (P, n, 3) [m], are in rigid bodies or enclosed by some."""
        rigid = in_rigid(self.plan.region, nodes.reshape(-1, 3)).reshape(nodes.shape[:-1])
        return (rigid | self.enclosed(nodes)).any(dim=1)

    def enclosed(self, points: torch.Tensor) -> torch.Tensor:
        """Return which points (..., 3) are in air that rigid obstacles enclose."""
        filled = in_filled_cavities(self.plan.scene, self.plan.region, points)
        return filled | self._in_enclosed_cells(points)

    def _loaded(self, key: str, points: torch.Tensor) -> PressureMap | None:
        saved = self._store.load(key, (len(points), len(self.plan.scene.array)), 2 + len(as_numbers([])))
        if saved is None:
            return None
        self.loaded_from = self._store.folder
        logger.debug("transfer matrix of %s loaded from %s", self.plan.scene.name, self.loaded_from)
        matrix, (residual, periods, *rest) = saved
        return PressureMap(torch.from_numpy(matrix), residual, int(periods), resonances=of_numbers(rest))

    def _saved(self, key: str, points: torch.Tensor) -> PressureMap:
        """Simulate the transfer matrix of unit strengths, and save it if all runs converged."""
        result = self._audible(points)
        if all(run.reached for run in result.runs):
            self._store.save(
                key, result.matrix.numpy(), result.residual, result.periods, *as_numbers(result.resonances)
            )
        return result

    def _audible(self, points: torch.Tensor) -> PressureMap:
        """Simulate the transfer matrix of unit strengths; no run begins at a point that no sound reaches."""
        audible = ~self.silent(points[:, None])
        matrix = torch.zeros((len(points), len(self.plan.scene.array)), **COMPLEX)
        if not audible.any():
            return PressureMap(matrix)
        result = self._matrix(self._read_at(points[audible]))
        matrix[audible] = result.matrix
        return replace(result, matrix=matrix)

    def _audible_fields(self, drive: torch.Tensor, points: torch.Tensor) -> PressureMap:
        """Simulate the pressure of drives at points, by no run if no sound reaches any."""
        if self.silent(points[:, None]).all():
            return PressureMap(torch.zeros((len(points), len(drive)), **COMPLEX))
        return self._fields(drive, self._read_at(points))

    def _matrix(self, points: torch.Tensor) -> PressureMap:
        """Simulate the transfer matrix of unit strengths at points (P, 3), none of them silent."""
        return self._matrix_of_orbits(points, self.orbits(points))

    def _matrix_of_orbits(self, points: torch.Tensor, orbits: Orbits) -> PressureMap:
        """Simulate the transfer matrix of unit strengths by a run for each of the orbits' representatives."""
        targets, transducers = Apertures(points), self.transducers
        sources, receivers = (targets, transducers) if orbits.from_points else (transducers, targets)
        begins = "points" if orbits.from_points else "transducers"
        logger.debug("transfer matrix: %d runs serve %d %s", orbits.runs, len(orbits.representative), begins)
        strength = torch.ones((orbits.runs, 1), **COMPLEX)
        pressure, runs = self._run(sources.singly(orbits.representatives), strength, receivers)
        rows = orbits.expand(pressure)
        matrix = rows if orbits.from_points else rows.mT.contiguous()
        return PressureMap.of_runs(matrix, runs, orbits.from_points)

    def _fields(self, drive: torch.Tensor, points: torch.Tensor) -> PressureMap:
        pressure, runs = self._run(*self.sources_of(drive), Apertures(points))
        return PressureMap.of_runs(pressure.mT, runs, from_points=False)

    def _run(
        self, sources: Sequence[Apertures], strength: torch.Tensor, receivers: Apertures
    ) -> tuple[torch.Tensor, list[Run]]:
        """Return the pressure (R, P) [Pa] at P receivers of R runs with N sources each, and the runs.

        The strengths (R, N) [Pa m] of a run are not all zero; receivers take the mean over their nodes.
        """
        everywhere, weights = self.seen_twice(receivers)
        pressure, runs = self._recorded(
            len(sources), lambda stepped: self._simulate(sources, strength, everywhere, stepped)
        )
        pressure = mean_of_images(pressure.mT, weights).mT
        return pressure.masked_fill(self.silent(receivers.positions), 0), runs

    def _recorded(
        self, count: int, simulate: Callable[[Stepped], tuple[ResultT, list[Run]]]
    ) -> tuple[ResultT, list[Run]]:
        """Simulate so many runs, show their progress and record them."""
        plan, grids = self.plan, [assembly.grid for assembly in self.assemblies]
        for number in self._enclosed_transducers:
            place = tuple(plan.scene.array.positions[number].tolist())
            accepted = "is enclosed by rigid obstacles, which no sound leaves; must be outside"
            raise invalid(f"array.positions[{number}]", place, accepted, "m")
        what = f"simulating {plan.scene.name}"
        settings = plan.method, 1e3 * plan.spacing, counted(count, "run")
        logger.debug("%s: %s, cells of %.3g mm, %s", what, *settings)
        arrival = max(grid.arrival for grid in grids)
        with show_progress(math.ceil(count * USUAL_PERIODS * fewest_periods(arrival)), what) as progress:
            result, runs = simulate(progress.advance)
        self.runs += runs
        return result, runs

    def _orbits_of_transducers(self, points: torch.Tensor) -> Orbits:
        return orbits_of_transducers(points, self.symmetries)

    def _silence(self, points: torch.Tensor, sources: Apertures, strength: torch.Tensor) -> float:
        """Return the norm of the pressure [Pa] at points (P, n, 3) below which a run may end.

        It is -80 dB, or the least whose tolerance is above rounding, relative to free space, as if the
        sources of strength (N,) [Pa m] did not cancel each other.
        """
        faintest = max(SILENCE, torch.finfo(self.plan.dtype).eps / self.plan.tolerance)
        return faintest * sources.loudest(points.mean(dim=1), strength, self.plan.spacing / 2)

    @cached_property
    def _enclosed_transducers(self) -> list[int]:
        """Numbers of the transducers that rigid obstacles enclose."""
        enclosed = self.enclosed(self.plan.scene.array.nodes.positions).any(dim=1)
        return list(map(int, enclosed.nonzero()))
