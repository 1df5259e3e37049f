"""What propagators have in common: their protocol, and how one that simulates makes a transfer matrix."""

from __future__ import annotations

import logging
import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import ClassVar, Literal, Protocol, Self, overload, runtime_checkable

import numpy as np
import torch

from autdtorch.analytic.green import PAIR_BYTES
from autdtorch.fdtd.grid import require_spacing
from autdtorch.fdtd.interpolation import interpolation_width
from autdtorch.fdtd.kernels.contract import Kernel
from autdtorch.fdtd.spacing import grid_error, second_spacing
from autdtorch.fdtd.steady_state import SteadyState, fewest_periods
from autdtorch.fdtd.stepping import Assembly
from autdtorch.propagators.cache import DiskCache
from autdtorch.propagators.cost import USUAL_PERIODS
from autdtorch.propagators.scene_region import region_of
from autdtorch.propagators.symmetry import Plan, Symmetry, backward_plan, forward_plan, symmetries
from autdtorch.propagators.workload import memory_for
from autdtorch.scene.arrays import Nodes
from autdtorch.scene.drive import validate_drive
from autdtorch.scene.scene import Scene
from autdtorch.utils.digest import digest_of
from autdtorch.utils.memory import require_memory
from autdtorch.utils.progress import show_progress
from autdtorch.utils.provenance import package_versions, source_digest
from autdtorch.utils.threads import one_torch_thread
from autdtorch.utils.validation import ArrayLike, boolean, points_grid

logger = logging.getLogger(__name__)


_NOT_HEARD = ("control_points", "observation_plane", "name")
"""What of a scene decides nothing of what is heard in it."""


class SteadyStateWarning(UserWarning):
    """A simulation ended before its steady state was reached."""


@runtime_checkable
class Propagator(Protocol):
    """What carries sound from a scene's transducers to points.

    Attributes:
        scene: the scene it was made for.
    """

    scene: Scene

    def transfer_matrix(self, points: ArrayLike | None = None) -> torch.Tensor:
        """Pressure [Pa] at points (P, 3) [m] per unit drive of each transducer: complex128 (P, M)."""
        ...

    def field(self, drive: torch.Tensor, points: ArrayLike) -> torch.Tensor:
        """Pressure [Pa] of drives (..., M) at points (P, 3) or on a grid of them: complex128 (..., P).

        Args:
            drive: (..., M) complex.
            points: (P, 3) [m]; a grid such as (Nu, Nv, 3) gives (..., Nu, Nv).
        """
        ...


@dataclass(frozen=True)
class Run:
    """One simulation, as it went.

    Attributes:
        periods: periods of the drive that were stepped, in several boxes their sum.
        remaining: estimated relative distance to the steady state.
        reached: whether that is within the tolerance.
        seconds: time it took, beside others that went on at once.
    """

    periods: int
    remaining: float
    reached: bool
    seconds: float


class SimulatedPropagator(ABC):
    """A propagator that steps a grid to the steady state of the drive.

    Attributes:
        method: by which `make_propagator` calls it.
        scene: the scene it was made for.
        spacing: edge of a cell [m].
        tolerance: relative distance to the steady state at which a run ends.
        max_periods: periods after which it ends in any case, with a `SteadyStateWarning`.
        runs: what every simulation took, in order; one in several boxes counts as one, mirror images and what
            was kept on disk take none.
    """

    method: ClassVar[str]

    @one_torch_thread()
    def __init__(
        self,
        scene: Scene,
        spacing: float,
        tolerance: float,
        kernel: Kernel,
        dtype: torch.dtype,
        max_periods: int,
        cache: DiskCache | None,
        time_step: float | None,
    ) -> None:
        """Use `make_propagator`, which checks its arguments.

        Raises:
            ValueError: it would need more memory than there is.
        """
        self.scene = scene
        self.spacing = spacing
        self.tolerance = tolerance
        self.max_periods = max_periods
        self.runs: list[Run] = []
        self._near_told = False
        self._kernel = kernel
        self._cache = cache
        require_spacing(region_of(scene), spacing)
        needed = memory_for(scene, self.method, spacing, tolerance, dtype, kernel)
        require_memory("spacing", spacing, needed, "m")
        self._assemblies = self._assembled(dtype, time_step)

    def __repr__(self) -> str:
        """Scene, settings and runs so far."""
        return (
            f"{type(self).__name__}(scene {self.scene.name!r}, spacing {1e3 * self.spacing:.4g} mm, "
            f"tolerance {self.tolerance:g}, {len(self.runs)} runs)"
        )

    @property
    def time_step(self) -> float:
        """The time step in use [s], of several boxes the shortest."""
        most = max(assembly.steps_per_period for assembly in self._assemblies)
        return 1 / (self.scene.frequency * float(most))

    @property
    def planned_runs(self) -> int:
        """Simulations that the transfer matrix of the control points takes, or took."""
        return self._plan(self.scene.control_points).runs

    @abstractmethod
    def _assembled(self, dtype: torch.dtype, time_step: float | None) -> Sequence[Assembly]:
        """The scene on its grid, or on several."""

    @abstractmethod
    def _checked(self, points: ArrayLike) -> torch.Tensor:
        """Points (P, 3) where the field can be told."""

    @abstractmethod
    def _near_obstacle(self, points: torch.Tensor) -> bool:
        """Whether a source at any of the points (N, 3) would not be all in air, on the grid."""

    @abstractmethod
    def _simulate(
        self,
        origins: Sequence[Nodes],
        strength: torch.Tensor,
        targets: Nodes,
        stepped: Callable[[int], None],
    ) -> torch.Tensor:
        """Pressure (R, P) of R runs, each with N origins of strengths (R, N), none of them silent.

        Of each of P targets it is the mean over the nodes. `stepped` is called with numbers of periods.
        """

    def _watched(self, origins: Sequence[Nodes], strength: torch.Tensor, targets: Nodes) -> torch.Tensor:
        """`_simulate`, with its progress shown."""
        crossing = max(assembly.grid.diagonal / assembly.grid.wavelength for assembly in self._assemblies)
        periods = math.ceil(len(origins) * USUAL_PERIODS * fewest_periods(crossing))
        with show_progress(periods, f"simulating {self.scene.name}") as progress:
            return self._simulate(origins, strength, targets, progress.advance)

    def _plan(self, points: torch.Tensor) -> Plan:
        """The fewest simulations for a transfer matrix: from the transducers or, by reciprocity, from points.

        Next to an obstacle only the way from the transducers is right.
        """
        forward = forward_plan(points, self._symmetries)
        if self._near_obstacle(points):
            return forward
        backward = backward_plan(points, self._symmetries)
        fewer = (backward.runs, len(points)) < (forward.runs, len(self.scene.array))
        return backward if fewer else forward

    def _warn_near_obstacle(self) -> None:
        """Log once, for runs from the transducers, that one is next to an obstacle."""
        if self._near_told:
            return
        self._near_told = True
        if any(self._near_obstacle(nodes) for nodes in self.scene.array.nodes.positions):
            grid = self._assemblies[0].grid
            logger.warning(
                "a source is within %.2g mm of an obstacle: less accurate; use a finer spacing than %.2g mm",
                1e3 * grid.spacing * interpolation_width(grid.kappa) / 2, 1e3 * grid.spacing,
            )  # fmt: skip

    def _warn_unsettled(self, runs: Sequence[Run]) -> None:
        unsettled = [run for run in runs if not run.reached]
        if unsettled:
            warnings.warn(
                f"no steady state after {max(run.periods for run in unsettled)} periods in {len(unsettled)} "
                f"of {len(runs)} runs: still up to about {max(run.remaining for run in unsettled):.1e} away "
                f"(relative), tolerance {self.tolerance:g}; raise max_periods or tolerance",
                SteadyStateWarning,
                stacklevel=4,  # the caller of the public method, beyond its decorator
            )

    @cached_property
    def _control_matrix(self) -> tuple[torch.Tensor, float]:
        return self._kept_matrix(self.scene.control_points)

    @cached_property
    def _symmetries(self) -> list[Symmetry]:
        return symmetries(self._assemblies, self.scene.array.nodes)

    @cached_property
    def _second(self) -> Self:
        """The same on another grid, which tells the error of this one."""
        spacing = second_spacing(region_of(self.scene), self.spacing)
        return type(self)(
            self.scene, spacing, self.tolerance, self._kernel, self._assemblies[0].dtype, self.max_periods,
            self._cache, None,
        )  # fmt: skip

    @overload
    def transfer_matrix(
        self, points: ArrayLike | None = None, return_error: Literal[False] = False
    ) -> torch.Tensor: ...

    @overload
    def transfer_matrix(
        self, points: ArrayLike | None = None, *, return_error: Literal[True]
    ) -> tuple[torch.Tensor, float]: ...

    @one_torch_thread()
    def transfer_matrix(
        self, points: ArrayLike | None = None, return_error: bool = False
    ) -> torch.Tensor | tuple[torch.Tensor, float]:
        """Transfer matrix G from one simulation a point or one a transducer, whichever are fewer.

        Waves travel from a point to the transducers as they travel back (reciprocity): P simulations do
        instead of M, unless a point is next to an obstacle. Where scene and grid are symmetric, one
        simulation does for all points or transducers that are images of each other: mirrored along axes, or
        with axes exchanged. The matrix of the control points is kept.

        Args:
            points: (P, 3) [m], for `FullPropagator` inside the domain; by default the scene's control points.
            return_error: also return the estimated relative error (L2 of the whole matrix): what a second
                grid tells, a fifth of the cost where it is coarser, and the distance to the steady state.

        Returns:
            complex128 (P, M) [Pa], and the error if asked for.

        Raises:
            ValueError: `points` are not finite, have another shape, leave the domain (`FullPropagator`) or
                lie on a transducer (`BoxPropagator`).
        """
        with_error = boolean("return_error", return_error)
        places = None if points is None else self._checked(points)
        if places is not None:
            require_memory("points", (len(places), 3), PAIR_BYTES * len(self.scene.array) * len(places))
        if not self._plan(self.scene.control_points if places is None else places).backward:
            self._warn_near_obstacle()
        if with_error:
            matrix, error, runs = self._estimated(places)
            self._warn_unsettled(runs)
            return matrix, error
        before = len(self.runs)
        matrix, _ = self._matrix(places)
        self._warn_unsettled(self.runs[before:])
        return matrix

    def _estimated(self, points: torch.Tensor | None = None) -> tuple[torch.Tensor, float, list[Run]]:
        """Return what `transfer_matrix` does with the error, and the runs that it took; nothing is warned of.

        Args:
            points: (P, 3) [m], checked; by default the scene's control points.

        Returns:
            complex128 (P, M) [Pa], the error, and the runs on both grids.
        """
        begun = len(self.runs), len(self._second.runs)
        matrix, remaining = self._matrix(points)
        second, _ = self._second._matrix(points)
        error = remaining + grid_error(matrix, second, coarser=self._second.spacing > self.spacing)
        return matrix, error, self.runs[begun[0] :] + self._second.runs[begun[1] :]

    def _matrix(self, points: torch.Tensor | None) -> tuple[torch.Tensor, float]:
        """Matrix of points, by default the control points, and its distance to the steady state."""
        if points is not None:
            return self._kept_matrix(points)
        matrix, remaining = self._control_matrix
        return matrix.clone(), remaining

    @one_torch_thread()
    def field(self, drive: torch.Tensor, points: ArrayLike) -> torch.Tensor:
        """Pressure of drives at points, from a simulation a drive or from the transfer matrix.

        Args:
            drive: (..., M) complex, |q| <= 1.
            points: (P, 3) or a grid such as (Nu, Nv, 3) [m], for `FullPropagator` inside the domain.

        Returns:
            complex128 (..., P) or (..., Nu, Nv) [Pa]; differentiable by the drive, through the transfer
            matrix.

        Raises:
            ValueError: drive or points of another shape or out of range.
        """
        drive = validate_drive(drive, len(self.scene.array))
        points, grid = points_grid("points", points)
        points = self._checked(points)
        flat = drive.reshape(-1, drive.shape[-1])
        array, nodes = self.scene.array, self.scene.array.nodes
        plan, before = self._plan(points), len(self.runs)
        by_matrix = drive.requires_grad or len(flat) > plan.runs
        rows = len(self.scene.array) if by_matrix else len(flat)
        require_memory("points", (*grid, 3), PAIR_BYTES * rows * len(points))
        if not (by_matrix and plan.backward):
            self._warn_near_obstacle()
        if by_matrix:
            field = drive @ self._kept_matrix(points)[0].mT
            self._warn_unsettled(self.runs[before:])
            return field.reshape(*drive.shape[:-1], *grid)
        field = torch.zeros((len(flat), len(points)), dtype=torch.complex128, device="cpu")
        loud = flat.any(dim=1)
        runs = [nodes] * int(loud.sum())
        if runs:
            field[loud] = self._watched(runs, array.source_strength * flat[loud], single_nodes(points))
            self._warn_unsettled(self.runs[before:])
        return field.reshape(*drive.shape[:-1], *grid)

    def _kept_matrix(self, points: torch.Tensor) -> tuple[torch.Tensor, float]:
        """Transfer matrix and its distance to the steady state, from disk if it is there."""
        digest = "" if self._cache is None else self._digest(points)
        shape = len(points), len(self.scene.array)
        if self._cache is not None and (found := self._cache.load(digest, shape)) is not None:
            logger.info("transfer matrix from %s: no run", self._cache.folder)
            return torch.from_numpy(found[0]), found[1]
        before = len(self.runs)
        matrix, runs = self._simulated_matrix(points), self.runs[before:]
        remaining = max((run.remaining for run in runs), default=0.0)
        if self._cache is not None and all(run.reached for run in runs):
            self._cache.save(digest, matrix.numpy(), remaining)
        return matrix, remaining

    def _digest(self, points: torch.Tensor) -> str:
        """Of all that decides the transfer matrix of points (P, 3) [m]."""
        scene = {entry.name: getattr(self.scene, entry.name) for entry in fields(self.scene)}
        settings = {
            "method": self.method,
            "spacing": self.spacing,
            "tolerance": self.tolerance,
            "max_periods": self.max_periods,
            "grids": [assembly.grid for assembly in self._assemblies],
            "steps_per_period": [str(assembly.steps_per_period) for assembly in self._assemblies],
            "dtype": str(self._assemblies[0].dtype),
            "kernel": type(self._kernel).__name__,
        }
        heard = {name: part for name, part in scene.items() if name not in _NOT_HEARD}
        return digest_of(source_digest(), package_versions(), settings, heard, points)

    def _simulated_matrix(self, points: torch.Tensor) -> torch.Tensor:
        transducers, targets = self.scene.array.nodes, single_nodes(points)
        plan = self._plan(points)
        origins, heard = (targets, transducers) if plan.backward else (transducers, targets)
        whence, count = "points" if plan.backward else "transducers", len(plan.stands)
        logger.info("transfer matrix: %d runs from %s", plan.runs, whence)
        if plan.runs < count:
            logger.info("by symmetry, %d of %d %s stand for all", plan.runs, count, whence)
        own = np.flatnonzero(plan.stands == np.arange(count))
        runs = [Nodes(origins.positions[index : index + 1], origins.weights) for index in own]
        strength = torch.full(
            (len(runs), 1), self.scene.array.source_strength, dtype=torch.complex128, device="cpu"
        )
        rows = torch.zeros((count, len(heard.positions)), dtype=torch.complex128, device="cpu")
        rows[own] = self._watched(runs, strength, heard)
        for index in np.flatnonzero(plan.stands != np.arange(count)):
            rows[index] = rows[plan.stands[index], plan.images[plan.by[index]]]
        return rows if plan.backward else rows.mT.contiguous()

    def _note(self, steady: SteadyState, seconds: float) -> None:
        self.runs.append(Run(steady.periods, steady.residual, steady.converged, seconds))
        logger.info("run of %d periods, %.1e from steady, %.1f s", steady.periods, steady.residual, seconds)


def single_nodes(points: torch.Tensor) -> Nodes:
    """Points (P, 3) as sources or receivers of one node each."""
    return Nodes(points[:, None], torch.ones(1, dtype=torch.float64, device="cpu"))
