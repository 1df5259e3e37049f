"""A plan's grids and the runs on them."""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import cast

import torch

from autdtorch.fdtd.grids import USUAL_PERIODS
from autdtorch.fdtd.kernels.choice import make_kernel
from autdtorch.fdtd.steady_state import SILENCE, SteadyState, fewest_periods
from autdtorch.fdtd.stepping import Assembly
from autdtorch.fdtd.symmetry import (
    Orbits,
    Symmetry,
    orbits_of_points,
    orbits_of_transducers,
    symmetries,
)
from autdtorch.propagators.plan import Plan
from autdtorch.scene.arrays import apertures_of, strengths_of
from autdtorch.scene.obstacles import Obstacle
from autdtorch.utils.apertures import Apertures
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.cached import cached_property
from autdtorch.utils.display import counted
from autdtorch.utils.progress import Progress, show_progress
from autdtorch.utils.validation import ArrayLike, invalid, points_tensor

logger = logging.getLogger(__name__)

Stepped = Callable[[int], None]


@dataclass(frozen=True)
class Run:
    """The course of one simulation.

    Attributes:
        periods: periods of the drive that were stepped, summed over boxes.
        remaining: estimated relative distance to the steady state.
        reached: whether that is within the tolerance.
        seconds: time taken, possibly beside other runs.
    """

    periods: int
    remaining: float
    reached: bool
    seconds: float

    @classmethod
    def of(cls, steady: SteadyState, seconds: float) -> Run:
        """Record a run that took `seconds`."""
        logger.debug("run of %d periods, %.1e from steady, %.1f s", steady.periods, steady.residual, seconds)
        return cls(steady.periods, steady.residual, steady.converged, seconds)


@dataclass(frozen=True)
class TransferMatrix:
    """A simulated transfer matrix.

    Attributes:
        matrix: complex128 (P, M) [Pa].
        error: estimated relative error; from a single grid the distance to the steady state alone.
        periods: most periods of a run, also if it was kept or loaded.
        runs: the simulations it took; none if it was loaded.
        from_points: whether they began at the points (reciprocity), not at the transducers.
    """

    matrix: torch.Tensor
    error: float
    periods: int
    runs: tuple[Run, ...]
    from_points: bool


class Simulation(ABC):
    """A plan's grids, which are assembled at first use, and the runs on them."""

    def __init__(self, plan: Plan) -> None:
        """Make the simulation of a plan; nothing is computed yet."""
        self.plan = plan
        self._kernel = make_kernel(plan.kernel)

    @property
    @abstractmethod
    def assemblies(self) -> Sequence[Assembly]:
        """The assembled grids."""

    @abstractmethod
    def near_obstacle(self, points: torch.Tensor) -> bool:
        """Return whether the interpolation kernel of any point (N, 3) has heterogeneous cells."""

    @abstractmethod
    def _in_enclosed_cells(self, points: torch.Tensor) -> torch.Tensor:
        """Return which points (..., 3) are in cells of air that rigid obstacles enclose."""

    @abstractmethod
    def _check(self, points: torch.Tensor) -> None:
        """Refuse points (P, 3) whose pressure cannot be computed."""

    @abstractmethod
    def _simulate(
        self, sources: Sequence[Apertures], strength: torch.Tensor, receivers: Apertures, stepped: Stepped
    ) -> tuple[torch.Tensor, list[Run]]:
        """Do the work of `run`; `stepped` is called with numbers of periods."""

    def checked(self, points: ArrayLike) -> torch.Tensor:
        """Return points (P, 3) after checking them; a `ValueError` names one that cannot be computed."""
        points = points_tensor("points", points).cpu()
        self._check(points)
        return points

    def enclosed(self, points: torch.Tensor) -> torch.Tensor:
        """Return which points (..., 3) are in air that rigid obstacles enclose."""
        found = self._in_enclosed_cells(points)
        for obstacle, body in zip(self.plan.scene.obstacles, self.plan.region.bodies, strict=True):
            if body.shape is not obstacle:  # its cavities are filled
                found = found | (cast(Obstacle, body.shape).contains(points) & ~obstacle.contains(points))
        return found

    def silent(self, nodes: torch.Tensor) -> torch.Tensor:
        """Return which receivers (P,), with nodes (P, n, 3) [m], are in a rigid obstacle or enclosed by some.

        Of overlapping obstacles the later counts.
        """
        silent = torch.zeros(len(nodes), dtype=torch.bool, device="cpu")
        for body in self.plan.region.bodies:
            inside = cast(Obstacle, body.shape).contains(nodes).any(dim=1)
            silent = torch.where(inside, body.fluid is None, silent)
        return silent | self.enclosed(nodes).any(dim=1)

    @cached_property
    def _enclosed_transducers(self) -> torch.Tensor:
        """Numbers (n,) of the transducers that rigid obstacles enclose."""
        return self.enclosed(self.plan.scene.array.nodes.positions).any(dim=1).nonzero()[:, 0]

    def _refuse_enclosed_transducers(self) -> None:
        """Refuse transducers that rigid obstacles enclose: no sound leaves, and there is no steady state."""
        if len(self._enclosed_transducers):
            number = int(self._enclosed_transducers[0])
            place = tuple(self.plan.scene.array.positions[number].tolist())
            accepted = "is enclosed by rigid obstacles, which no sound leaves; must be outside"
            raise invalid(f"array.positions[{number}]", place, accepted, "m")

    @cached_property
    def symmetries(self) -> list[Symmetry]:
        """Symmetries of the scene on its grid."""
        return symmetries(self.assemblies, self.plan.grouping.axes[0], apertures_of(self.plan.scene.array))

    @property
    def time_step(self) -> float:
        """The time step [s], on several grids the shortest."""
        most = max(assembly.steps_per_period for assembly in self.assemblies)
        return 1 / (self.plan.scene.frequency * float(most))

    def orbits(self, points: torch.Tensor) -> Orbits:
        """Return the fewest runs for a transfer matrix: from transducers or, by reciprocity, from points."""
        forward = orbits_of_transducers(points, self.symmetries)
        if self.near_obstacle(points):
            return forward  # only these are accurate there
        backward = orbits_of_points(points, self.symmetries)
        fewer = (backward.runs, len(points)) < (forward.runs, len(self.plan.scene.array))
        return backward if fewer else forward

    def transfer_matrix(self, points: torch.Tensor) -> TransferMatrix:
        """Simulate the transfer matrix of points (P, 3); no run begins at one that no sound reaches."""
        heard = ~self.silent(points[:, None])
        matrix = torch.zeros((len(points), len(self.plan.scene.array)), **COMPLEX)
        if not heard.any():
            return TransferMatrix(matrix, 0.0, 0, (), from_points=True)
        found = self._matrix_of(points[heard])
        matrix[heard] = found.matrix
        return replace(found, matrix=matrix)

    def _matrix_of(self, points: torch.Tensor) -> TransferMatrix:
        """Simulate the transfer matrix of points (P, 3), none of them silent."""
        array, orbits = self.plan.scene.array, self.orbits(points)
        targets, transducers = Apertures.of_points(points), apertures_of(array)
        sources, receivers = (targets, transducers) if orbits.from_points else (transducers, targets)
        begins = "points" if orbits.from_points else "transducers"
        logger.debug("transfer matrix: %d runs serve %d %s", orbits.runs, len(orbits.representative), begins)
        strength = torch.ones((orbits.runs, 1), **COMPLEX)
        alone = [sources.chosen(slice(own, own + 1)) for own in orbits.representatives]
        found, runs = self.run(alone, strength, receivers)
        rows, remaining = orbits.expand(found), max(run.remaining for run in runs)
        periods = max(run.periods for run in runs)
        matrix = strengths_of(array) * (rows if orbits.from_points else rows.mT.contiguous())
        return TransferMatrix(matrix, remaining, periods, tuple(runs), orbits.from_points)

    def matrix_runs(self, points: torch.Tensor) -> int:
        """Return the number of runs that the transfer matrix of points (P, 3) takes."""
        return self.orbits(points).runs

    def matrix_pays(self, drives: int, points: torch.Tensor) -> bool:
        """Return whether so many drives take longer than the transfer matrix of points (P, 3)."""
        return drives > self.matrix_runs(points)

    def fields(self, drive: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, list[Run]]:
        """Return the pressure (R, P) [Pa] of drives (R, M), none of them silent, and the runs it took."""
        array = self.plan.scene.array
        sources, strength = [apertures_of(array)] * len(drive), strengths_of(array) * drive
        return self.run(sources, strength, Apertures.of_points(points))

    def run(
        self, sources: Sequence[Apertures], strength: torch.Tensor, receivers: Apertures
    ) -> tuple[torch.Tensor, list[Run]]:
        """Return the pressure (R, P) [Pa] at P receivers of R runs with N sources each, and the runs.

        The strengths (R, N) [Pa m] of a run are not all zero; receivers take the mean over their nodes.
        """
        self._refuse_enclosed_transducers()
        with self._progress(len(sources)) as progress:
            return self._simulate(sources, strength, receivers, progress.advance)

    def silence(self, points: torch.Tensor, sources: Apertures, strength: torch.Tensor) -> float:
        """Return the norm of the pressure [Pa] at points (P, n, 3) below which a run may end: -80 dB.

        It is relative to free space, as if the sources of strength (N,) [Pa m] did not cancel each other.
        """
        distance = torch.cdist(points.mean(dim=1), sources.positions.mean(dim=1))
        return SILENCE * float((strength.abs() / distance.clamp(min=self.plan.spacing / 2)).norm())

    def _progress(self, runs: int) -> AbstractContextManager[Progress]:
        """Show the progress of so many runs."""
        plan, grids = self.plan, [assembly.grid for assembly in self.assemblies]
        what = f"simulating {plan.scene.name}"
        count = counted(runs, "run")
        logger.debug("%s: %s, cells of %.3g mm, %s", what, plan.method, 1e3 * plan.spacing, count)
        arrival = max(grid.arrival for grid in grids)
        return show_progress(math.ceil(runs * USUAL_PERIODS * fewest_periods(arrival)), what)
