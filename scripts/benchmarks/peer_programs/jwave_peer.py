"""j-Wave: k-space pseudospectral, in JAX; the absorbing layer is part of the grid."""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp
import numpy as np
from jwave import FourierSeries
from jwave.acoustics import simulate_wave_propagation
from jwave.acoustics.time_varying import TimeWavePropagationSettings
from jwave.geometry import Domain, Medium, Sensors, Sources, TimeAxis
from task import Answer, Task, serve


def simulate(task: Task) -> Answer:
    begin = time.perf_counter()
    width = task.layer_cells
    shape = tuple(n + 2 * width for n in task.density.shape)
    domain = Domain(shape, (task.spacing,) * 3)
    density = FourierSeries(jnp.asarray(np.pad(task.density, width, mode="edge"))[..., None], domain)
    medium = Medium(domain=domain, sound_speed=task.sound_speed, density=density, pml_size=width)
    # a recorded sample is half a step later than the source sample with its index
    signals = task.source_weights[:, None] * task.drive(-0.5)[None]
    sources = Sources(
        places(task.source_cells, width), jnp.asarray(signals, jnp.float32), task.time_step, domain
    )
    sensors = Sensors(places(task.receiver_cells, width))
    axis = TimeAxis(dt=task.time_step, t_end=(task.steps - 0.5) * task.time_step)
    settings = TimeWavePropagationSettings(checkpoint=False)

    def run(medium: Medium, sources: Sources) -> jax.Array:
        return simulate_wave_propagation(medium, axis, settings=settings, sources=sources, sensors=sensors)

    prepared = time.perf_counter()
    compiled = jax.jit(run).lower(medium, sources).compile()
    ready = time.perf_counter()
    recorded = np.asarray(compiled(medium, sources))
    done = time.perf_counter()
    return Answer(task.phasors(recorded.reshape(task.steps, -1)), prepared - begin, done - ready)


def places(cells: np.ndarray, width: int) -> tuple[np.ndarray, ...]:
    """Return the indices along each axis of cells (n, 3) of the task."""
    return tuple(cells.T + width)


if __name__ == "__main__":
    serve(simulate)
