"""The cost of a simulation on this machine, before anything is allocated."""

from __future__ import annotations

import functools
import math
import time
from dataclasses import dataclass, replace
from statistics import mean

import torch

from autdtorch.fdtd.grouping import domain_grid
from autdtorch.fdtd.kernels import make_kernel
from autdtorch.fdtd.region import Fluid, Region
from autdtorch.fdtd.stepping import assemble, drive_signal
from autdtorch.propagators.free_space import PAIR_BYTES
from autdtorch.propagators.plan import Plan, plan
from autdtorch.propagators.simulated import Aim, SimulatedPropagator, first_plan, plans_ahead
from autdtorch.propagators.tmatrix.costs import WaveCosts
from autdtorch.propagators.tmatrix.propagator import TMatrixPropagator, placed_bodies
from autdtorch.scene.scene import Scene
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.process import available_memory, one_library_thread
from autdtorch.utils.text import counted
from autdtorch.utils.validation import positive

_MEASURED_STEPS, _MEASURED_CELLS = 80, (300_000, 1_000_000)
_AIR_SPACING, _AIR_RIM = 1e-3, 28
"""Timed steps on a small and a large grid of so many cells; their spacing [m] and cells beside the domain."""

_PILOT_CELLS = 6
"""Cells per wavelength in air of the coarse grid that symmetries are found on."""

_PILOT_POINTS, _PILOT_SECONDS = 4, 10.0
"""Most points that are simulated on the first grid of a choice by tolerance, and their most time [s]."""

_RINGING = 3.4
"""Periods of runs there, relative to the fewest, from which a scene resonates: twice the usual ones."""

_PAIR_SECONDS = 1e-8
"""Time [s] of a pair of a point and a transducer in free space."""


@dataclass(frozen=True)
class Estimate:
    """The cost of the transfer matrix of a scene's control points.

    Attributes:
        method: "free_space", "box", "full" or "tmatrix".
        spacing: edge of a cell [m]; None where nothing is simulated.
        cells: cells of all grids, absorbing layers included.
        runs: number of simulations, with symmetries.
        memory: most memory in use at a time, without what is in use already [bytes].
        seconds: time on this machine, as busy as it is now [s].
        resonates: whether sound is slower in an obstacle than in the medium, or rings on the first grid of a
            choice by tolerance. Then `seconds` is the least: ringing takes longer runs and by a tolerance
            finer grids.
    """

    method: str
    spacing: float | None
    cells: int
    runs: int
    memory: float
    seconds: float
    resonates: bool = False

    def __repr__(self) -> str:
        grid = "" if self.spacing is None else f" at {1e3 * self.spacing:.4g} mm, {self.cells:,} cells"
        least = "at least " if self.resonates else ""
        cost = f"{counted(self.runs, 'run')}, {self.memory / 1e6:,.0f} MB, {least}{self.seconds:.2g} s"
        return f"Estimate({self.method}{grid}, {cost})"


@one_library_thread()
def estimate(
    scene: Scene,
    spacing: float | None = 1e-3,
    tolerance: float = 2e-3,
    *,
    method: str = "auto",
    device: torch.device | str | None = None,
    kernel: str = "auto",
    dtype: str | torch.dtype = "float32",
) -> Estimate:
    """Estimate the cost of the transfer matrix of a scene's control points from its plan.

    Symmetries are found on a coarse grid, if that fits into memory. The speed of the kernel is measured once
    in a process, on a box of air. The time is within a factor of two for most scenes. Resonances are not
    known in advance: where sound is slow in an obstacle, the time is the least. An error estimate
    (`return_error`) takes a fifth more, and the first matrix of a process about two seconds more, in which
    kernels are loaded.

    Args:
        scene: the scene.
        spacing: edge of a cell [m]. None: that which `make_propagator` is expected to choose by `tolerance`,
            from runs on its first grid of up to 10 s; the time is the sum over all its grids.
        tolerance: relative distance to the steady state, or without a spacing the estimated error, in (0, 1).
        method: as in `make_propagator`, as are `device`, `kernel` and `dtype`.
        device: where simulations would run.
        kernel: the kernel.
        dtype: precision of the fields.

    Raises:
        ValueError: an argument is out of range.
    """
    spacing = None if spacing is None else positive("spacing", spacing, "m")
    planned = plan(scene, method, spacing, tolerance, kernel=kernel, dtype=dtype, device=device)
    memory, seconds = _without_runs(planned)
    if planned.method == "free_space" or not planned.runs:
        return Estimate(planned.method, None, 0, 0, memory, seconds)
    choice = [] if spacing else _choice(planned.on_grids)
    if choice and planned.method != "tmatrix":
        *choice, planned = choice
    else:
        planned = _with_symmetries(planned if spacing else planned.by_waves(choice[-1].spacing))
    plans = [*choice, planned]
    memory, seconds = max(memory, *(each.memory for each in plans)), seconds + sum(map(_seconds_of, plans))
    resonates = planned.region.shortest_wavelength < planned.region.wavelength
    resonates |= any(each.ringing is not None and each.ringing > _RINGING for each in plans)
    return Estimate(planned.method, planned.spacing, planned.cells, planned.runs, memory, seconds, resonates)


def _without_runs(planned: Plan) -> tuple[float, float]:
    """Return the memory [bytes] and the time [s] of what needs no run: free space, and waves of bodies."""
    array, points, images = planned.scene.array, planned.scene.control_points, len(planned.scene.images)
    pairs = len(array) * len(points)
    memory, seconds = PAIR_BYTES * pairs, _PAIR_SECONDS * images * pairs
    if planned.method != "tmatrix":
        return memory, seconds
    waves = [(placed.body.degree + 1) ** 2 for placed in placed_bodies(planned)]
    costs = WaveCosts(waves, images, len(array), len(points))
    return memory + costs.memory, seconds + costs.seconds


def _with_symmetries(planned: Plan) -> Plan:
    """Return the plan with its runs by the symmetries of a coarse grid, if that fits into memory.

    Its spacing is a multiple: a scene that is symmetric on one of both grids mostly is on the other.
    """
    coarse = min(planned.region.wavelength / _PILOT_CELLS, planned.region.coarsest_spacing)
    factor = max(1, math.floor(coarse / planned.spacing))
    pilot = planned.at(planned.spacing * factor, planned.tolerance)
    if pilot.memory >= available_memory():
        return planned
    kind = TMatrixPropagator if planned.method == "tmatrix" else SimulatedPropagator
    return replace(planned, runs=kind(pilot).planned_runs)


def _choice(pilot: Plan) -> list[Plan]:
    """Return the plans of the grids that a choice by tolerance is expected to take.

    Some points are simulated on the first one for how much is scattered, how long that rings and what errors
    no grid lowers. If that is refused or long, all sound is taken to be scattered. The symmetries are those
    of the first grid.
    """
    first, points, tolerance = first_plan(pilot), pilot.scene.control_points, pilot.tolerance
    usual, aim, runs, ringing = first.law.usual(first.spacing), Aim(tolerance), first.runs, None
    if not first.refusal:
        propagator, some = SimulatedPropagator(first), points[:: math.ceil(len(points) / _PILOT_POINTS)]
        runs = propagator.planned_runs
        if _seconds_of(replace(first, runs=min(runs, len(some)))) < _PILOT_SECONDS:
            comparison = propagator.compared(some)
            if comparison.needs_materials(tolerance):
                return [replace(first, runs=runs), *_choice(pilot.with_materials)]
            shape, rigid_error = comparison.lasting_errors
            usual, aim = comparison.usual_error, Aim(tolerance, shape, shape + rigid_error)
            ringing = comparison.ringing
    plans = [first, *plans_ahead(first, usual, 0, aim)]
    return [replace(each, runs=runs, ringing=ringing, grids=each.grouping) for each in plans]


def _seconds_of(planned: Plan) -> float:
    """Return the time [s] of the runs of a plan, by the rate of kernels on grids about as large."""
    small, large = _MEASURED_CELLS
    is_small = max(grid.cells for grid in planned.grouping.grids) < large / 2
    return planned.work / _rate(planned.kernel, planned.dtype, small if is_small else large)


@functools.cache
def _rate(kernel: str, dtype: torch.dtype, cells: int) -> float:
    """Return the steps of a cell in a second, timed on a box of air with about this many cells."""
    half = _AIR_SPACING * max(1, round(cells ** (1 / 3)) - 2 * _AIR_RIM) / 2
    place = torch.zeros((1, 3), **REAL)
    region = Region(Fluid(1.2, 340.0), 0.0, 40e3, (), ((-half,) * 3, (half,) * 3), place.numpy())
    assembly, stepper = assemble(region, _AIR_SPACING, dtype), make_kernel(kernel)
    sources = assembly.sources(place, torch.ones(1, **COMPLEX))
    receivers, state = assembly.receivers(place + half / 2), assembly.silence(sources)
    signal = drive_signal(assembly.steps_per_period, 0, _MEASURED_STEPS).to(dtype)
    spent = []
    for _ in range(3):
        begin = time.perf_counter()
        state, recorded = stepper.advance(state, assembly.coefficients, sources, receivers, signal)
        recorded.cpu()  # waits for a GPU
        spent.append(time.perf_counter() - begin)
    grid = domain_grid(region, _AIR_SPACING)
    # the first one loads the kernel; the mean counts what else the machine does
    return grid.work / grid.steps * _MEASURED_STEPS / mean(spent[1:])
