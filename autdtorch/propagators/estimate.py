"""The cost of a simulation on this machine, told before anything is allocated."""

from __future__ import annotations

import functools
import math
import time
from dataclasses import dataclass

import torch

from autdtorch.analytic.green import PAIR_BYTES
from autdtorch.fdtd.grid import domain_extent, require_spacing
from autdtorch.fdtd.kernels.contract import Kernel
from autdtorch.fdtd.spacing import pilot_spacing
from autdtorch.fdtd.stepping import assemble, drive_signal
from autdtorch.propagators import SIMULATED
from autdtorch.propagators.auto import method_for
from autdtorch.propagators.cost import grid_cost, most_runs
from autdtorch.propagators.scene_region import region_of
from autdtorch.propagators.stepper import KERNELS, make_kernel, precision_of, relative_tolerance
from autdtorch.propagators.workload import Workload, memory_for
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.medium import Medium
from autdtorch.scene.scene import Scene
from autdtorch.utils.memory import available_memory
from autdtorch.utils.validation import positive, require_kind, require_one_of

_MEASURED_STEPS, _MEASURED_CELLS = 80, (300_000, 1_000_000)
"""Steps that are timed, and cells of the grids that they are timed on."""

_AIR_SPACING, _AIR_RIM = 1e-3, 28
"""Spacing [m] of that grid, and cells on each side of its domain."""

_NODE_SECONDS = 4e-8
"""Time [s] of a point and a node of a transducer in free space."""


@dataclass(frozen=True)
class Estimate:
    """The cost of the transfer matrix of a scene's control points.

    Attributes:
        method: "free_space", "box" or "full".
        spacing: edge of a cell [m]; None in free space.
        cells: of all grids, boundary layers included.
        runs: simulations; what follows from others by symmetry takes none.
        memory: most that is in use at a time, beside what is in use already [bytes].
        seconds: time on this machine, as busy as it is now [s].
    """

    method: str
    spacing: float | None
    cells: int
    runs: int
    memory: float
    seconds: float

    def __repr__(self) -> str:
        """All of it, with units."""
        grid = "" if self.spacing is None else f" at {1e3 * self.spacing:.4g} mm, {self.cells:,} cells"
        return (
            f"Estimate({self.method}{grid}, {self.runs} runs, {self.memory / 1e6:,.0f} MB, "
            f"{self.seconds:.2g} s)"
        )


def estimate(
    scene: Scene,
    spacing: float = 1e-3,
    tolerance: float = 2e-3,
    *,
    method: str = "auto",
    kernel: str = "auto",
    dtype: str | torch.dtype = "float32",
) -> Estimate:
    """Tell what the transfer matrix of a scene's control points takes, from its geometry.

    The runs are counted on a coarse grid; where not even that fits into memory, without symmetries. How fast
    cells are stepped is measured once in a process, on a box of air. How long obstacles ring is not known
    beforehand: the time is that of a usual scene, and right within a factor of two for most. Its error
    estimate (`return_error`) takes a fifth more.

    Args:
        scene: what would be simulated.
        spacing: edge of a cell [m].
        tolerance: relative distance to the steady state, in (0, 1).
        method: as of `make_propagator`.
        kernel: as of `make_propagator`.
        dtype: as of `make_propagator`.

    Returns:
        Cells, runs, memory and time.

    Raises:
        ValueError: an argument out of range; the message names it.
    """
    require_kind("scene", scene, Scene)
    spacing, tolerance = positive("spacing", spacing, "m"), relative_tolerance(tolerance)
    require_one_of("kernel", kernel, KERNELS)
    precision = precision_of(dtype)
    method = method_for(scene, method, spacing, tolerance)
    if method == "free_space":
        pairs, nodes = len(scene.array) * len(scene.control_points), len(scene.array.nodes.weights)
        return Estimate(method, None, 0, 0, PAIR_BYTES * pairs, _NODE_SECONDS * nodes * pairs)
    require_spacing(region_of(scene), spacing)
    stepper = make_kernel(kernel)
    # a multiple: what is symmetric on the one grid is mostly so on the other
    pilot = spacing * max(1, math.floor(pilot_spacing(region_of(scene)) / spacing))
    runs = most_runs(scene)
    if memory_for(scene, method, pilot, tolerance, precision, stepper) < available_memory():
        runs = SIMULATED[method](scene, pilot, tolerance, stepper, precision, 1, None, None).planned_runs
    workload = Workload.of(scene, method, spacing, tolerance)
    small, large = _MEASURED_CELLS
    cells = small if max(grid.cells for grid in workload.grids) < large / 2 else large
    seconds = workload.steps(runs, stepper) / _rate(type(stepper), precision, cells)
    memory = workload.memory(precision.itemsize, stepper, runs)
    return Estimate(method, spacing, workload.cells, runs, memory, seconds)


@functools.cache
def _rate(kernel: type[Kernel], dtype: torch.dtype, cells: int) -> float:
    """Steps of a cell in a second, timed on a box of air of about so many cells."""
    half = _AIR_SPACING * max(1, round(cells ** (1 / 3)) - 2 * _AIR_RIM) / 2
    array = TransducerArray([[0.0, 0.0, 0.0]], (1.0, 0.0, 0.0))
    domain = (-half,) * 3, (half,) * 3
    scene = Scene(array, Medium(1.2, 340.0), 40e3, [[half / 2, 0.0, 0.0]], domain=domain)
    assembly, stepper = assemble(region_of(scene), _AIR_SPACING, dtype), kernel()
    sources = assembly.sources(array.positions, torch.ones(1, dtype=torch.complex128, device="cpu"))
    receivers, state = assembly.receivers(scene.control_points), assembly.silence(sources)
    signal = drive_signal(assembly.steps_per_period, 0, _MEASURED_STEPS).to(dtype)
    spent = math.inf
    for _ in range(3):  # the first one loads the kernel
        begin = time.perf_counter()
        state, recorded = stepper.advance(state, assembly.coefficients, sources, receivers, signal)
        recorded.cpu()  # waits for a GPU
        spent = min(spent, time.perf_counter() - begin)
    grid = grid_cost(scene, domain_extent(region_of(scene), _AIR_SPACING), _AIR_SPACING)
    return grid.work / grid.steps * _MEASURED_STEPS / spent
