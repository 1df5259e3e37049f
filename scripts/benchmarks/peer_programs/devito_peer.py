"""Devito: staggered differences of any order, leapfrog in time, a split-field PML written in its symbols."""

from __future__ import annotations

import os

os.environ.setdefault("DEVITO_LANGUAGE", "openmp")
os.environ.setdefault("DEVITO_LOGGING", "ERROR")

import time

import numpy as np
from devito import (
    Dimension,
    Eq,
    Function,
    Grid,
    Operator,
    SparseTimeFunction,
    TimeFunction,
    VectorTimeFunction,
)
from task import Answer, Task, serve

LAYER_ATTENUATION = 10.0
"""Attenuation of a wave at normal incidence across the layer [Np]."""


def simulate(task: Task) -> Answer:
    begin = time.perf_counter()
    width = task.layer_cells
    density = np.pad(task.density, width, mode="edge")
    grid = Grid(density.shape, extent=[(n - 1) * task.spacing for n in density.shape], dtype=np.float32)
    step = grid.stepping_dim.spacing

    options = {"grid": grid, "space_order": task.order, "time_order": 1}
    pressure = TimeFunction(name="p", **options)
    velocity = VectorTimeFunction(name="v", **options)
    parts = [TimeFunction(name=f"q{axis}", **options) for axis in range(3)]  # pressure, split for the PML
    bulk = Function(name="bulk", grid=grid)
    bulk.data[:] = density * task.sound_speed**2
    updates = []
    for axis, dimension in enumerate(grid.dimensions):
        buoyancy = Function(name=f"b{axis}", grid=grid, staggered=dimension)
        buoyancy.data[:] = 2 / (density + np.roll(density, -1, axis))
        keep = profile(f"keep_v{axis}", grid, dimension, task, 0.5)
        slope = getattr(pressure, f"d{dimension.name}")
        updates.append(Eq(velocity[axis].forward, keep * (keep * velocity[axis] - step * buoyancy * slope)))
    for axis, dimension in enumerate(grid.dimensions):
        keep = profile(f"keep_q{axis}", grid, dimension, task, 0.0)
        slope = getattr(velocity[axis].forward, f"d{dimension.name}")
        updates.append(Eq(parts[axis].forward, keep * (keep * parts[axis] - step * bulk * slope)))
    updates.append(Eq(pressure.forward, sum(part.forward for part in parts)))

    source = sparse("source", grid, task, task.source_cells)
    # a sample acts half a step after the pressure of the same index is recorded
    source.data[: task.steps] = task.drive(0.5)[:, None] * task.source_weights
    receiver = sparse("receiver", grid, task, task.receiver_cells)
    injected = [source.inject(field.forward, expr=step * source) for field in (parts[0], pressure)]
    prepared = time.perf_counter()
    operator = Operator([*updates, *injected, receiver.interpolate(expr=pressure)])
    operator.cfunction  # noqa: B018, compiles
    compiled = time.perf_counter()
    operator.apply(time_m=0, time_M=task.steps - 1, dt=np.float32(task.time_step))
    done = time.perf_counter()
    return Answer(task.phasors(np.asarray(receiver.data[: task.steps])), prepared - begin, done - compiled)


def sparse(name: str, grid: Grid, task: Task, cells: np.ndarray) -> SparseTimeFunction:
    """Return time series at cells (n, 3) of the task."""
    points = SparseTimeFunction(name=name, grid=grid, npoint=len(cells), nt=task.steps + 1)
    points.coordinates.data[:] = (cells + task.layer_cells) * task.spacing
    return points


def profile(name: str, grid: Grid, dimension: Dimension, task: Task, shift: float) -> Function:
    """Return the damping factor of half a step along one axis, `shift` cells beside the nodes."""
    cells = grid.shape[grid.dimensions.index(dimension)]
    place = np.arange(cells) + shift
    width = task.layer_cells
    depth = np.maximum(width - place, place - (cells - 1 - width)).clip(0) / width
    courant = task.sound_speed * task.time_step / task.spacing
    factor = Function(
        name=name,
        grid=grid,
        dimensions=(dimension,),
        shape=(cells,),
        **({"staggered": dimension} if shift else {}),
    )
    factor.data[:] = np.exp(-LAYER_ATTENUATION * 3 / width * depth**2 * courant / 2)
    return factor


if __name__ == "__main__":
    serve(simulate)
