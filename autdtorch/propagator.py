"""Propagators: from drives to pressures, by exact free-space sums or by FDTD on the full domain."""

from __future__ import annotations

import logging
import math
import time
import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Protocol, overload

import numpy as np
import torch

from autdtorch.array import Nodes
from autdtorch.drive import validate_drive
from autdtorch.fdtd.kernels.contract import Kernel, Receivers
from autdtorch.fdtd.points import footprint
from autdtorch.fdtd.spacing import PILOT_CELLS, coarsest_spacing, grid_error, second_spacing, spacing_for
from autdtorch.fdtd.stepping import Assembly, SteadyState, assemble, last_block, run_to_steady_state
from autdtorch.freespace import free_space_matrix
from autdtorch.scene import Scene, require_inside
from autdtorch.validation import (
    ArrayLike,
    integer_at_least,
    invalid,
    points_tensor,
    positive,
)

logger = logging.getLogger(__name__)

METHODS = ("auto", "free_space", "full")
KERNELS = ("auto", "cpu", "reference")
DTYPES = {"float32": torch.float32, "float64": torch.float64}

MOST_RECEIVERS = 64
"""Points that are recorded in every step; of more, this many decide when the run has settled and all are read
at its end."""


_POINTS_AT_ONCE = 8192
"""Points that are read at once from a field, which bounds the memory for their weights."""


class SteadyStateWarning(UserWarning):
    """A simulation ended before its steady state was reached."""


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
        """Pressure [Pa] of drives (..., M) at points (P, 3) [m]: complex128 (..., P)."""
        ...


class FreeSpacePropagator:
    """The exact field of the array in free space; obstacles are left out.

    Attributes:
        scene: the scene it was made for.
    """

    def __init__(self, scene: Scene) -> None:
        """Remember the scene; a scene with obstacles is logged as such."""
        self.scene = scene
        if scene.obstacles:
            logger.warning(
                "free_space leaves out the %d obstacles of scene %r", len(scene.obstacles), scene.name
            )

    @overload
    def transfer_matrix(
        self, points: ArrayLike | None = None, return_error: Literal[False] = False
    ) -> torch.Tensor: ...

    @overload
    def transfer_matrix(
        self, points: ArrayLike | None = None, *, return_error: Literal[True]
    ) -> tuple[torch.Tensor, float]: ...

    def transfer_matrix(
        self, points: ArrayLike | None = None, return_error: bool = False
    ) -> torch.Tensor | tuple[torch.Tensor, float]:
        """Transfer matrix G (Eq. 2).

        Args:
            points: (P, 3) [m]; by default the scene's control points.
            return_error: also return the estimated relative error: 0, or infinite where obstacles are left
                out.

        Returns:
            complex128 (P, M) [Pa], and the error if asked for.

        Raises:
            ValueError: `points` are not finite, have another shape, or lie on a transducer.
        """
        points = self.scene.control_points if points is None else points
        matrix = free_space_matrix(points, self.scene.array, self.scene.complex_wavenumber)
        return (matrix, math.inf if self.scene.obstacles else 0.0) if return_error else matrix

    def field(self, drive: torch.Tensor, points: ArrayLike) -> torch.Tensor:
        """Pressure of drives at points.

        Args:
            drive: (..., M) complex, |q| <= 1.
            points: (P, 3) [m].

        Returns:
            complex128 (..., P) [Pa]; differentiable by the drive.

        Raises:
            ValueError: drive or points of another shape or out of range.
        """
        drive = validate_drive(drive, len(self.scene.array))
        return drive @ self.transfer_matrix(points).mT


@dataclass(frozen=True)
class Run:
    """One simulation, as it went.

    Attributes:
        periods: periods of the drive that were stepped.
        remaining: estimated relative distance to the steady state.
        reached: whether that is within the tolerance.
        seconds: time it took.
    """

    periods: int
    remaining: float
    reached: bool
    seconds: float


class FullPropagator:
    """FDTD on the whole domain, in the steady state of the drive.

    Attributes:
        scene: the scene it was made for.
        spacing: edge of a cell [m].
        tolerance: relative distance to the steady state at which a run ends.
        max_periods: periods after which it ends in any case, with a `SteadyStateWarning`.
        time_step: the one in use [s].
        runs: what every simulation took, in order.
    """

    def __init__(
        self,
        scene: Scene,
        spacing: float,
        tolerance: float,
        kernel: Kernel,
        dtype: torch.dtype,
        max_periods: int,
        time_step: float | None,
    ) -> None:
        """Use `make_propagator`, which checks its arguments."""
        self.scene = scene
        self.spacing = spacing
        self.tolerance = tolerance
        self.max_periods = max_periods
        self.runs: list[Run] = []
        self._kernel = kernel
        self._assembly: Assembly = assemble(scene, spacing, dtype, time_step)
        self.time_step = 1 / (scene.frequency * float(self._assembly.steps_per_period))

    @cached_property
    def _control_matrix(self) -> torch.Tensor:
        return self._simulated_matrix(self.scene.control_points)

    @cached_property
    def _second(self) -> FullPropagator:
        """The same on another grid, which tells the error of this one."""
        spacing = second_spacing(self.scene, self.spacing)
        return FullPropagator(
            self.scene, spacing, self.tolerance, self._kernel, self._assembly.dtype, self.max_periods, None
        )

    @overload
    def transfer_matrix(
        self, points: ArrayLike | None = None, return_error: Literal[False] = False
    ) -> torch.Tensor: ...

    @overload
    def transfer_matrix(
        self, points: ArrayLike | None = None, *, return_error: Literal[True]
    ) -> tuple[torch.Tensor, float]: ...

    def transfer_matrix(
        self, points: ArrayLike | None = None, return_error: bool = False
    ) -> torch.Tensor | tuple[torch.Tensor, float]:
        """Transfer matrix G from one simulation a point or one a transducer, whichever are fewer.

        Waves travel from a point to the transducers as they travel back (reciprocity): P simulations do
        instead of M, unless a point is next to an obstacle. The matrix of the control points is kept.

        Args:
            points: (P, 3) [m] inside the domain; by default the scene's control points.
            return_error: also return the estimated relative error (L2 of the whole matrix): what a second
                grid tells, a fifth of the cost where it is coarser, and the distance to the steady state.

        Returns:
            complex128 (P, M) [Pa], and the error if asked for.

        Raises:
            ValueError: `points` are not finite, have another shape or leave the domain.
        """
        before = 0 if points is None else len(self.runs)
        matrix = (
            self._control_matrix.clone() if points is None else self._simulated_matrix(self._inside(points))
        )
        if not return_error:
            return matrix
        steady = max((run.remaining for run in self.runs[before:]), default=0.0)
        second = self._second.transfer_matrix(points)
        return matrix, steady + grid_error(matrix, second, coarser=self._second.spacing > self.spacing)

    def field(self, drive: torch.Tensor, points: ArrayLike) -> torch.Tensor:
        """Pressure of drives at points, from a simulation a drive or from the transfer matrix.

        Args:
            drive: (..., M) complex, |q| <= 1.
            points: (P, 3) [m] inside the domain.

        Returns:
            complex128 (..., P) [Pa]; differentiable by the drive, through the transfer matrix.

        Raises:
            ValueError: drive or points of another shape or out of range.
        """
        drive, points = validate_drive(drive, len(self.scene.array)), self._inside(points)
        flat = drive.reshape(-1, drive.shape[-1])
        array, nodes = self.scene.array, self.scene.array.nodes
        fewest = len(points) if self._backward(points) else len(array)
        if drive.requires_grad or len(flat) > fewest:
            return drive @ self._simulated_matrix(points).mT
        field = torch.zeros((len(flat), len(points)), dtype=torch.complex128)
        for row, strength in zip(field, array.source_strength * flat, strict=True):
            row.copy_(self._simulate(nodes, strength, _single_nodes(points)))
        return field.reshape(*drive.shape[:-1], len(points))

    def _inside(self, points: ArrayLike) -> torch.Tensor:
        points = points_tensor("points", points).cpu()
        require_inside(self.scene.domain, "points", points)
        return points

    def _backward(self, points: torch.Tensor) -> bool:
        """Whether the transfer matrix is simulated from the points, by reciprocity."""
        fewer = len(points) < len(self.scene.array)
        return fewer and not self._touches_obstacle(points)

    def _simulated_matrix(self, points: torch.Tensor) -> torch.Tensor:
        transducers, targets = self.scene.array.nodes, _single_nodes(points)
        strength = torch.full((1,), self.scene.array.source_strength, dtype=torch.complex128)
        if self._backward(points):
            logger.info("transfer matrix: %d runs from the points", len(points))
            rows = [self._simulate(point, strength, transducers) for point in _one_by_one(targets)]
            return torch.stack(rows)
        logger.info("transfer matrix: %d runs from the transducers", len(self.scene.array))
        columns = [self._simulate(transducer, strength, targets) for transducer in _one_by_one(transducers)]
        return torch.stack(columns, dim=1)

    def _touches_obstacle(self, points: torch.Tensor) -> bool:
        """Whether a source there would not be all in air: then only the way from the transducers is right."""
        varying = self._assembly.coefficients.varying_index.numpy()
        return bool(np.isin(self._assembly.spread(points).index, varying).any())

    @torch.no_grad()
    def _simulate(self, origins: Nodes, strength: torch.Tensor, targets: Nodes) -> torch.Tensor:
        """Pressure (P,) of N origins with strengths (N,), as the mean over the nodes of each of P targets."""
        points = targets.positions
        if not strength.any():
            return torch.zeros(len(points), dtype=torch.complex128)
        begin = time.perf_counter()
        assembly, kernel = self._assembly, self._kernel
        if self._touches_obstacle(origins.positions.reshape(-1, 3)):
            logger.warning(
                "a source is within %.2g mm of an obstacle: less accurate; use a finer spacing than %.2g mm",
                1e3 * assembly.grid.spacing * footprint(assembly.grid.kappa) / 2,
                1e3 * assembly.grid.spacing,
            )
        sources = assembly.sources(origins.positions, strength, origins.weights)
        every = math.ceil(len(points) / MOST_RECEIVERS)
        receivers = assembly.receivers(points[::every], targets.weights)
        state, steady = run_to_steady_state(
            assembly, kernel, sources, receivers, self.tolerance, self.max_periods
        )
        if every == 1:
            pressure = steady.pressure
        else:
            field = last_block(assembly, kernel, state, sources)
            at_once = max(1, _POINTS_AT_ONCE // len(targets.weights))
            chunks = (points[n : n + at_once] for n in range(0, len(points), at_once))
            pressure = torch.cat([_read(field, assembly.receivers(at, targets.weights)) for at in chunks])
        self._note(steady, time.perf_counter() - begin)
        return pressure.to(torch.complex128)

    def _note(self, steady: SteadyState, seconds: float) -> None:
        self.runs.append(Run(steady.periods, steady.remaining, steady.reached, seconds))
        logger.info("run of %d periods, %.1e from steady, %.1f s", steady.periods, steady.remaining, seconds)
        if not steady.reached:
            warnings.warn(
                f"no steady state after {steady.periods} periods: still about {steady.remaining:.1e} away "
                f"(relative), tolerance {self.tolerance:g}; raise max_periods or tolerance",
                SteadyStateWarning,
                stacklevel=2,
            )


def _single_nodes(points: torch.Tensor) -> Nodes:
    """Points (P, 3) as sources or receivers of one node each."""
    return Nodes(points[:, None], torch.ones(1, dtype=torch.float64))


def _one_by_one(nodes: Nodes) -> list[Nodes]:
    return [Nodes(positions[None], nodes.weights) for positions in nodes.positions]


def _read(field: torch.Tensor, receivers: Receivers) -> torch.Tensor:
    return (field.reshape(-1)[receivers.index] * receivers.weight).sum(dim=-1)


def _make_kernel(name: str) -> Kernel:
    if name == "reference":
        from autdtorch.fdtd.kernels.reference import ReferenceKernel

        return ReferenceKernel()
    from autdtorch.fdtd.kernels.cpu import CpuKernel

    return CpuKernel()


def make_propagator(
    scene: Scene,
    method: str = "auto",
    spacing: float | None = 1e-3,
    tolerance: float = 2e-3,
    *,
    kernel: str = "auto",
    dtype: str | torch.dtype = "float32",
    max_periods: int = 600,
    time_step: float | None = None,
) -> FreeSpacePropagator | FullPropagator:
    """Choose and prepare a propagator.

    Args:
        scene: what is simulated.
        method: "free_space": exact, without obstacles. "full": FDTD on the whole domain. "auto": free space
            where the scene has no obstacles, else full.
        spacing: edge of a cell [m], at most a third of the wavelength. The error falls with it; see
            docs/numerics.md. None: two coarse grids are simulated, and the spacing is chosen with which the
            error of the transfer matrix should stay below `tolerance`.
        tolerance: relative error, in (0, 1): the distance to the steady state at which a simulation ends;
            half of that where the spacing is chosen, the other half being the grid's.
        kernel: "cpu" (numba), "reference" (torch, slow, readable), "auto": the fastest there is.
        dtype: precision of the fields, float32 or float64.
        max_periods: periods of the drive after which a simulation ends in any case, with a
            `SteadyStateWarning`. They are stepped in blocks of a few, and the last block is finished.
        time_step: at most this [s], and at least 97 % of it; by default the largest stable one.

    Returns:
        A propagator for the scene.

    Raises:
        ValueError: an argument out of range; the message names it.
    """
    if not isinstance(scene, Scene):
        raise invalid("scene", scene, "must be a Scene")
    _require_one_of("method", method, METHODS)
    _require_one_of("kernel", kernel, KERNELS)
    dtype_name = str(dtype).removeprefix("torch.")
    _require_one_of("dtype", dtype_name, tuple(DTYPES))
    if spacing is not None:
        spacing = positive("spacing", spacing, "m")
    tolerance = positive("tolerance", tolerance)
    if tolerance >= 1:
        raise invalid("tolerance", tolerance, "must be in (0, 1)")
    max_periods = integer_at_least("max_periods", max_periods, 1)
    if time_step is not None:
        time_step = positive("time_step", time_step, "s")
    chosen = method if method != "auto" else "full" if scene.obstacles else "free_space"
    propagator: FreeSpacePropagator | FullPropagator
    if chosen == "free_space":
        propagator = FreeSpacePropagator(scene)
    else:
        settings = _make_kernel(kernel), DTYPES[dtype_name], max_periods
        if spacing is None:
            tolerance /= 2
            spacing = _chosen_spacing(scene, tolerance, *settings)
        propagator = FullPropagator(scene, spacing, tolerance, *settings, time_step)
    if method == "auto":
        reason = (
            f"{len(scene.obstacles)} obstacles" if scene.obstacles else "no obstacles: nothing to simulate"
        )
        logger.info("method auto: %s (%s)", chosen, reason)
    return propagator


def _chosen_spacing(
    scene: Scene, tolerance: float, kernel: Kernel, dtype: torch.dtype, max_periods: int
) -> float:
    """Spacing [m] at which the grid's error should be `tolerance`, told from two coarse grids."""
    coarsest = coarsest_spacing(scene)
    pilot = min(scene.wavelength / PILOT_CELLS, coarsest)
    near_steady = max(tolerance, 1e-3)
    propagator = FullPropagator(scene, pilot, near_steady, kernel, dtype, max_periods, None)
    _, error = propagator.transfer_matrix(return_error=True)
    spacing = min(spacing_for(tolerance, error, pilot), coarsest)
    logger.info("spacing %.3g mm: the error at %.3g mm is about %.2g", 1e3 * spacing, 1e3 * pilot, error)
    return spacing


def _require_one_of(name: str, value: object, accepted: tuple[str, ...]) -> None:
    if value not in accepted:
        raise invalid(name, value, f"must be one of {', '.join(accepted)}")
