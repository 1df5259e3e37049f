"""What a transfer matrix takes: memory and time, counted from the geometry before anything is allocated."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from autdtorch.array import TransducerArray
from autdtorch.fdtd.kernels.contract import Kernel
from autdtorch.fdtd.stepping import assemble, drive_signal
from autdtorch.medium import Medium
from autdtorch.memory import require_memory
from autdtorch.propagator.cost import USUAL_PERIODS, GridCost
from autdtorch.scene import Scene

_ELEMENT_BYTES, _BULK_BYTES, _CELL_BYTES = 20_000.0, 1_500.0, 12.0
"""Memory [bytes] of the assembly: by element that a surface cuts, by cell of other sound speed, by cell."""

_ELEMENT_STEPS, _BULK_STEPS, _RUN_STEPS, _SCENE_STEPS = 40_000.0, 500.0, 2e6, 5e7
"""Time in steps of a cell: the assembly by element and by cell of other sound speed, a run, and all else."""

_INTERIOR, _VARYING = 0.35, 12.0
"""Time of a step of a cell outside the boundary layers, and of one that is not of air, over one inside."""


@dataclass(frozen=True)
class Estimate:
    """What the transfer matrix of a scene's control points takes.

    Attributes:
        method: "free_space", "box" or "full".
        spacing: edge of a cell [m]; None in free space.
        cells: of all grids, boundary layers included.
        runs: simulations, mirror images left out.
        memory: most that is in use at a time, beside what is in use already [bytes].
        seconds: on this machine as it is now [s].
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


@dataclass(frozen=True)
class Matter:
    """How much of a grid is not of uniform air.

    Attributes:
        elements: that surfaces cut, about.
        bulk: cells of another sound speed than that of air.
    """

    elements: float
    bulk: float

    @classmethod
    def of(cls, scene: Scene, spacing: float) -> Matter:
        """Count it in a scene on cells of `spacing` [m], from the surfaces of its obstacles in the domain."""
        area = volume = 0.0
        for obstacle in scene.obstacles:
            vertices, triangles = (part.numpy() for part in obstacle.surface())
            a, b, c = np.moveaxis(np.clip(vertices, *scene.domain)[triangles], 1, 0)
            area += float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / 2
            if obstacle.sound_speed not in (None, scene.medium.sound_speed):
                volume += abs(float((a * np.cross(b, c)).sum())) / 6
        return cls(area / spacing**2, volume / spacing**3)


def needed_memory(
    grids: Sequence[GridCost], matter: Matter, kept: int, number_bytes: int, at_once: int
) -> float:
    """Return the memory [bytes] that a transfer matrix takes.

    Args:
        grids: all that are assembled.
        matter: on all of them.
        kept: cells whose phasors a run keeps.
        number_bytes: of a number of the fields.
        at_once: runs side by side.
    """
    cells, block = sum(grid.cells for grid in grids), 3 * max(grid.steps_per_period for grid in grids)
    run = _FIELDS * number_bytes * cells + kept * (32 * phasors_kept(kept) + _RECORDED * block)
    assembly = _CELL_BYTES * cells + _ELEMENT_BYTES * matter.elements + _BULK_BYTES * matter.bulk
    return _LEAST_BYTES + assembly + at_once * run


def needed_steps(
    grids: Sequence[GridCost], matter: Matter, passes: int, runs: int, at_once: int, workers: int
) -> float:
    """Return the time that a transfer matrix takes, in steps of a cell inside a boundary layer.

    Args:
        grids: all that are assembled.
        matter: on all of them.
        passes: of each run through all grids.
        runs: simulations.
        at_once: of these side by side.
        workers: threads that step a grid.
    """
    step = sum(_cell_steps(grid) for grid in grids) + _VARYING * (3 * matter.elements + matter.bulk)
    steps = USUAL_PERIODS * passes * max(grid.steps for grid in grids)
    assembly = _SCENE_STEPS + _ELEMENT_STEPS * matter.elements + _BULK_STEPS * matter.bulk
    return assembly + math.ceil(runs / at_once) * (_RUN_STEPS + steps * step / workers)


def _cell_steps(grid: GridCost) -> float:
    interior = math.prod(grid.interior)
    return grid.cells + (_INTERIOR - 1) * interior


def cell_rate(kernel: Kernel) -> float:
    """Return how many cells inside a boundary layer a thread steps a second, measured on a small box of air."""
    array = TransducerArray([[0.0, 0.0, 0.0]], (1.0, 0.0, 0.0))
    scene = Scene(array, Medium(1.2, 340.0), 40e3, [[5e-3, 0.0, 0.0]], domain=((-0.02,) * 3, (0.02,) * 3))
    assembly = assemble(scene, 1e-3)
    sources = assembly.sources(scene.array.positions, torch.ones(1, dtype=torch.complex128))
    receivers, state = assembly.receivers(scene.control_points), assembly.silence(sources)
    signal = drive_signal(assembly.steps_per_period, 0, _MEASURED_STEPS).to(assembly.dtype)
    spent = math.inf
    for _ in range(4):  # the first loads the kernel
        begin = time.perf_counter()
        state, _ = kernel.advance(state, assembly.coefficients, sources, receivers, signal)
        spent = min(spent, time.perf_counter() - begin)
    shape, interior = assembly.grid.shape, assembly.grid.interior
    return _MEASURED_STEPS * (math.prod(shape) + (_INTERIOR - 1) * math.prod(interior)) / spent
