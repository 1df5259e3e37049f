"""The propagator that simulates, and the protocol of all propagators."""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, Protocol, overload, runtime_checkable

import torch

from autdtorch.analytic.green import PAIR_BYTES, free_space_matrix
from autdtorch.fdtd.grid_errors import errors_by_grids, grid_errors, rigid_errors, shape_errors, sizes
from autdtorch.fdtd.thin_walls import warn_of_thin_walls
from autdtorch.propagators.box import BoxSimulation
from autdtorch.propagators.cache import DiskCache, cache_key
from autdtorch.propagators.full import DomainSimulation
from autdtorch.propagators.kept_fields import KeepingSimulation
from autdtorch.propagators.kept_matrices import KeptMatrices
from autdtorch.propagators.plan import Plan
from autdtorch.propagators.scene_region import warn_of_near_points
from autdtorch.propagators.simulation import Run, TransferMatrix
from autdtorch.scene.drive import validate_drive
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.cached import cached_property
from autdtorch.utils.display import counted
from autdtorch.utils.memory import require_memory
from autdtorch.utils.threads import one_library_thread
from autdtorch.utils.validation import ArrayLike, boolean, points_grid

logger = logging.getLogger(__name__)

# Periods from which a run tells of a resonance. Runs of bodies without any take 15 to 60; a quality factor is
# about half the periods, and a grid of 1.3 mm shifts frequencies by 0.2 %
_RINGING = 100

_FAINT = 1e-7  # Pressure relative to that in free space, -140 dB, which is rounding in single precision

# Ratio of periods from which another grid is next to a resonance that this one is not: it tells of that alone
_LONGER = 1.5


class SteadyStateWarning(UserWarning):
    """A simulation ended before its steady state was reached."""


@runtime_checkable
class Propagator(Protocol):
    """Computes the pressure that a scene's transducers cause at points.

    Attributes:
        scene: the scene.
    """

    scene: Scene

    def transfer_matrix(self, points: ArrayLike | None = None) -> torch.Tensor:
        """Return the pressure (P, M) [Pa], complex128, of unit drives at points (P, 3) [m]."""
        ...

    def field(self, drive: torch.Tensor, points: ArrayLike) -> torch.Tensor:
        """Return the pressure (..., P) [Pa], complex128, of drives (..., M) at points (P, 3) or a grid."""
        ...


class SimulatedPropagator:
    """A propagator that simulates the steady state of the drive by FDTD.

    By method "box" and without a cache, the outgoing fields of the last drives are kept. Those of all
    transducers are simulated and kept once they pay: after as many runs from points. More points outside the
    boxes, and more drives, then take sums and no runs.

    The last transfer matrices are kept, up to 250 MB in all; a larger one is simulated whenever it is needed.
    Points that are given as a grid (Nu, Nv, 3), such as a plane, are likely to be looked at again. Without a
    cache, their matrix is simulated once drives there have taken as many runs as the matrix takes, if it can
    be kept; more drives then take no runs.

    Attributes:
        scene: the scene it was made for.
        method: "box" or "full".
        spacing: edge of a cell [m].
        tolerance: relative distance to the steady state at which a run ends.
        max_periods: periods after which a run ends in any case, with a `SteadyStateWarning`.
        runs: all simulations in order. A run in several boxes counts as one; symmetry images and loaded
            matrices take none.
        loaded_from: folder of the cache that a matrix came from, or None.
    """

    def __init__(
        self, plan: Plan, cache: DiskCache | None = None, others: Sequence[SimulatedPropagator] = ()
    ) -> None:
        """Use `make_propagator`, which checks its arguments. Nothing is computed here.

        `others` are propagators of the scene on other grids, for error estimates; by default one is made.
        """
        self.scene, self.method, self.spacing = plan.scene, plan.method, plan.spacing
        self.tolerance, self.max_periods = plan.tolerance, plan.max_periods
        self.runs: list[Run] = []
        self.loaded_from: Path | None = None
        self._reported = 0
        self._plan, self._cache, self._given = plan, cache, tuple(others)
        # What a folder holds must not decide how later fields are computed: nothing is kept beside a cache.
        boxes = KeepingSimulation if cache is None else BoxSimulation
        self._simulation = DomainSimulation(plan) if plan.method == "full" else boxes(plan)
        self._kept = KeptMatrices(len(plan.scene.array))
        self._transducers_ran = self._near_logged = False
        self._near_points_logged = self._enclosed_logged = False
        self._ringing_logged = self._faint_logged = False

    def __repr__(self) -> str:
        """Scene, settings and number of runs."""
        settings = f"{self.method}, spacing {1e3 * self.spacing:.4g} mm, steady to {self.tolerance:g}"
        return f"SimulatedPropagator(scene {self.scene.name!r}, {settings}, {counted(len(self.runs), 'run')})"

    @property
    def time_step(self) -> float:
        """The time step [s], of several boxes the shortest."""
        return self._simulation.time_step

    @property
    def cells(self) -> int:
        """Number of cells of all grids."""
        return self._plan.cells

    def warn_of_thin_walls(self) -> None:
        """Log which obstacles have walls thinner than a cell, oblique to their grid."""
        grids = zip(self._plan.grouping.groups, self._plan.grouping.axes, strict=True)
        warn_of_thin_walls(self._plan.region, self.spacing, grids)

    def warn_of_ringing(self) -> None:
        """Log if the control points' sound rings, where grids may agree and be wrong together."""
        self._report_ringing(self._with_error(None).periods)

    @property
    def planned_runs(self) -> int:
        """Number of simulations of the control points' transfer matrix."""
        return self._simulation.matrix_runs(self.scene.control_points)

    @cached_property
    def _others(self) -> tuple[SimulatedPropagator, ...]:
        """Simulations on other grids, for the error estimate."""
        return self._given or (SimulatedPropagator(self._plan.second, self._cache),)

    @overload
    def transfer_matrix(
        self, points: ArrayLike | None = None, return_error: Literal[False] = False
    ) -> torch.Tensor: ...
    @overload
    def transfer_matrix(
        self, points: ArrayLike | None = None, *, return_error: Literal[True]
    ) -> tuple[torch.Tensor, float]: ...
    @one_library_thread()
    def transfer_matrix(
        self, points: ArrayLike | None = None, return_error: bool = False
    ) -> torch.Tensor | tuple[torch.Tensor, float]:
        """Return the transfer matrix G, from one simulation for each transducer or each point (reciprocity).

        Simulations start at the transducers if a point is next to an obstacle. Points or transducers in one
        symmetry orbit of the scene on its grid share a simulation. The last matrices are kept, up to 250 MB.

        Args:
            points: (P, 3) [m]; by default the scene's control points.
            return_error: also return the estimated relative error (L2 of the whole matrix), from a second
                grid, which takes a fifth of the time where it is coarser, and the distance to the steady
                state. `point_errors` has that of each point.

        Returns:
            complex128 (P, M) [Pa], and the error if asked for.

        Raises:
            ValueError: `points` are not finite, have another shape, are outside the domain (method "full")
                or on a transducer (method "box").
        """
        with_error = boolean("return_error", return_error)
        places = None if points is None else self._simulation.checked(points)
        if places is not None:
            require_memory("points", (len(places), 3), PAIR_BYTES * len(self.scene.array) * len(places))
        result = self._with_error(places) if with_error else self._result(places)
        if places is not None:
            self._report_near(places)
        self._report_enclosed(self.scene.control_points if places is None else places, result.matrix.mT)
        if places is None:
            self._report_faint(result.matrix)
        if with_error:
            self._report_ringing(result.periods)
        self._report()
        return (result.matrix, result.error) if with_error else result.matrix

    @one_library_thread()
    def point_errors(self, points: ArrayLike | None = None) -> torch.Tensor:
        """Return the estimated relative error of each point's row of the transfer matrix, float64 (P,).

        Points and errors are those of `transfer_matrix`.
        """
        places = None if points is None else self._simulation.checked(points)
        result = self._result(places)
        others = [(other._result(places), other.spacing) for other in self._others]
        free = self._free(places)
        settling = result.error * result.matrix.norm() / sizes(result.matrix, free)
        settling = torch.where(result.matrix.any(dim=1), settling, 0.0)
        self._report_ringing(max(one.periods for one in (result, *(other for other, _ in others))))
        return self._errors(result, others, free) + settling

    def _errors(
        self, result: TransferMatrix, others: Sequence[tuple[TransferMatrix, float]], free: torch.Tensor
    ) -> torch.Tensor:
        """Return the errors (P,) of the rows of a matrix by grid, shape and bodies taken as rigid.

        Rows of the matrices on `others`, grids and their spacings [m], and in free space belong to them.
        """
        calm = [other for other in others if other[0].periods <= _LONGER * result.periods] or others[-1:]
        matrix, grids = result.matrix, [(other.matrix, spacing) for other, spacing in calm]
        # only boxes know the incident field
        of_grids = errors_by_grids if self.method == "full" else grid_errors
        errors = of_grids(matrix, free, self.spacing, grids, self._plan.law)
        errors = torch.where(matrix.any(dim=1), errors, 0.0)  # silence is exact
        region = self._plan.region
        return errors + shape_errors(matrix, free, region) + rigid_errors(matrix, free, region)

    def _free(self, points: torch.Tensor | None) -> torch.Tensor:
        """Return the matrix of points in free space, by default of the control points."""
        points = self.scene.control_points if points is None else points
        return free_space_matrix(points, self.scene.array, self.scene.complex_wavenumber)

    @one_library_thread()
    def field(self, drive: torch.Tensor, points: ArrayLike) -> torch.Tensor:
        """Return the pressure of drives at points, from a simulation for each drive or the transfer matrix.

        Args:
            drive: (..., M) complex, |q| <= 1, on any device.
            points: (P, 3) or a grid such as (Nu, Nv, 3) [m].

        Returns:
            complex128 (..., P) or (..., Nu, Nv) [Pa], on the CPU; differentiable by the drive.

        Raises:
            ValueError: drive or points of another shape or out of range, as in `transfer_matrix`.
        """
        drive = validate_drive(drive, len(self.scene.array)).cpu()
        points, grid = points_grid("points", points)
        points = self._simulation.checked(points)
        if len(grid) == 1:  # others are pictures, which may cross obstacles
            self._report_near(points)
        flat = drive.reshape(-1, drive.shape[-1])
        # Planes are looked at again, with other drives. Beside a cache, earlier calls decide nothing.
        revisited = len(grid) > 1 and self._cache is None
        drives = len(flat) + (self._kept.runs(points) if revisited else 0)
        known = revisited and self._kept.get(points) is not None
        by_matrix = known or drive.requires_grad or self._simulation.matrix_pays(drives, points)
        rows = len(self.scene.array) if by_matrix else len(flat)
        require_memory("points", (*grid, 3), PAIR_BYTES * rows * len(points))
        if by_matrix:
            result = self._executed(points)
            self._report()
            if len(grid) == 1:
                self._report_enclosed(points, result.matrix.mT)
            return (drive @ result.matrix.mT).reshape(*drive.shape[:-1], *grid)
        field = torch.zeros((len(flat), len(points)), **COMPLEX)
        if (loud := flat.any(dim=1)).any():
            field[loud], runs = self._simulation.fields(flat[loud], points)
            self.runs += runs
            if revisited:
                self._kept.count(points, len(runs))
            self._transducers_ran |= bool(runs)
            self._report()
            if len(grid) == 1:
                self._report_enclosed(points, field[loud])
        return field.reshape(*drive.shape[:-1], *grid)

    def _result(self, points: torch.Tensor | None) -> TransferMatrix:
        """Return the matrix of points, by default of the control points; it may be changed."""
        points = self.scene.control_points if points is None else points
        result = self._executed(points)
        own = self._kept.get(points) is not result
        return result if own else replace(result, matrix=result.matrix.clone())

    def _executed(self, points: torch.Tensor) -> TransferMatrix:
        """Return the matrix of points: kept, from the cache or simulated. The cache gets those converged.

        It is not to be changed if it is kept.
        """
        if (kept := self._kept.get(points)) is not None:
            return kept
        result = self._loaded(points)
        if result is None:
            result = self._simulation.transfer_matrix(points)
            self.runs += result.runs
            self._transducers_ran |= bool(result.runs) and not result.from_points
            if self._cache is not None and all(run.reached for run in result.runs):
                numbers = result.error, result.periods
                self._cache.save(cache_key(self._plan, points), result.matrix.numpy(), *numbers)
        return self._kept.add(points, result) or result

    def _loaded(self, points: torch.Tensor) -> TransferMatrix | None:
        """Return the matrix of points from the cache, if it is there."""
        if self._cache is None:
            return None
        shape = len(points), len(self.scene.array)
        if (found := self._cache.load(cache_key(self._plan, points), shape, 2)) is None:
            return None
        self.loaded_from = self._cache.folder
        logger.debug("transfer matrix of %s loaded from %s", self.scene.name, self.loaded_from)
        matrix, (error, periods) = found
        return TransferMatrix(torch.from_numpy(matrix), error, int(periods), (), from_points=True)

    @one_library_thread()
    def _with_error(self, points: torch.Tensor | None) -> TransferMatrix:
        """Return the matrix of points with its error, estimated from other grids."""
        result, others = self._result(points), [other._result(points) for other in self._others]
        flat, *rest = (replace(one, matrix=one.matrix.reshape(1, -1)) for one in (result, *others))
        grids = [(one, other.spacing) for one, other in zip(rest, self._others, strict=True)]
        whole = self._errors(flat, grids, self._free(points).reshape(1, -1))
        periods = max(one.periods for one in (result, *others))
        return replace(result, error=result.error + float(whole), periods=periods)

    @one_library_thread()
    def known_errors(self) -> tuple[float, float, float]:
        """Simulate the control points; return their error, and its parts by uncertain surfaces and hardening.

        The error is that by the grids given, infinite without any. For the last part see `rigid_errors`.
        """
        result = self._with_error(None) if self._given else self._result(None)
        matrix, free = (part.reshape(1, -1) for part in (result.matrix, self._free(None)))
        shape, hardening = (float(of(matrix, free, self._plan.region)) for of in (shape_errors, rigid_errors))
        return result.error if self._given else math.inf, shape, hardening

    def _report_near(self, points: torch.Tensor) -> None:
        """Log once, of the points of any call, which are next to a surface."""
        if not self._near_points_logged:
            self._near_points_logged = warn_of_near_points(self.scene, "points", points, self.spacing)

    def _report_enclosed(self, points: torch.Tensor, pressure: torch.Tensor) -> None:
        """Log once that points (P, 3) of pressure (R, P) are in a cavity of rigid obstacles."""
        silent = points[(pressure == 0).all(dim=0)]
        if not self._enclosed_logged and len(silent) and (found := self._simulation.enclosed(silent)).any():
            self._enclosed_logged, count = True, int(found.sum())
            place = tuple(round(1e3 * entry, 3) for entry in silent[found][0].tolist())
            more = f", and of {count - 1} more," if count > 1 else ""
            logger.warning("rigid obstacles enclose the point at %s mm: its pressure%s is 0", place, more)

    def _report_faint(self, matrix: torch.Tensor) -> None:
        """Log once that what control points get is rounding: methods would make foci of it."""
        size, free = matrix.norm(dim=1), self._free(None).norm(dim=1)
        faint = self.scene.control_points[(size > 0) & (size < _FAINT * free)]
        if len(faint) and not self._faint_logged:
            self._faint_logged = True
            place = tuple(round(1e3 * entry, 3) for entry in faint[0].tolist())
            more = f", nor {len(faint) - 1} more" if len(faint) > 1 else ""
            logger.warning("no sound reaches the point at %s mm%s: its pressure is rounding", place, more)

    def _report_ringing(self, periods: int) -> None:
        """Log once that obstacles resonate; see `warn_of_ringing`."""
        if periods > _RINGING and not self._ringing_logged:
            self._ringing_logged = True
            logger.warning(
                "sound rings for %d periods in or between obstacles: next to a resonance a small shift of its"
                " frequency changes the field, and the error may be larger than estimated", periods,
            )  # fmt: skip

    def _unreported(self) -> list[Run]:
        """Return the runs since the last call."""
        runs, self._reported = self.runs[self._reported :], len(self.runs)
        return runs

    def _report(self) -> None:
        """Warn of new runs that did not converge; log once if a source is next to an obstacle.

        Coarse grids on the way to a tolerance do not matter.
        """
        runs = self._unreported()
        if not self._given and "_others" in vars(self):
            runs += [run for other in self._others for run in other._unreported()]
        if self._transducers_ran and not self._near_logged:
            self._near_logged = True
            if any(map(self._simulation.near_obstacle, self.scene.array.nodes.positions)):
                logger.warning(
                    "a source is within %.2g mm of an obstacle: less accurate; use a finer spacing than %.2g"
                    " mm", 1e3 * self._plan.source_clearance, 1e3 * self.spacing,
                )  # fmt: skip
        if unsettled := [run for run in runs if not run.reached]:
            periods, error = max(run.periods for run in unsettled), max(run.remaining for run in unsettled)
            warnings.warn(
                f"no steady state after {periods} periods in {len(unsettled)} of {counted(len(runs), 'run')}"
                f": estimated relative error up to {error:.1e}, tolerance {self.tolerance:g}; raise "
                "max_periods or tolerance", SteadyStateWarning,
                stacklevel=4,  # the caller of the public, decorated method
            )  # fmt: skip
