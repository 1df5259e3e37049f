"""k-wave-python: k-space pseudospectral, the NumPy backend in single precision."""

from __future__ import annotations

import time
import urllib.request

import numpy as np
from task import Answer, Task, serve


def no_download(_url: str, path: str, *_: object) -> None:
    """Write an empty file instead of the C++ binaries, which are fetched at import but not needed."""
    with open(path, "wb"):
        pass


urllib.request.urlretrieve = no_download

from kwave.kgrid import kWaveGrid  # noqa: E402
from kwave.kmedium import kWaveMedium  # noqa: E402
from kwave.ksensor import kSensor  # noqa: E402
from kwave.ksource import kSource  # noqa: E402
from kwave.kspaceFirstOrder import kspaceFirstOrder  # noqa: E402


def simulate(task: Task) -> Answer:
    begin = time.perf_counter()
    width = task.layer_cells
    density = np.pad(task.density, width, mode="edge")
    grid = kWaveGrid(list(density.shape), [task.spacing] * 3)
    grid.setTime(task.steps, task.time_step)

    source = kSource()
    source.p_mask, order = mask(density.shape, task.source_cells + width)
    # a recorded sample is half a step later than the source sample with its index
    source.p = task.source_weights[order, None] * task.drive(-0.5)[None]
    source.p_mode = "additive"
    where, order = mask(density.shape, task.receiver_cells + width)
    outputs = kspaceFirstOrder(
        grid,
        kWaveMedium(sound_speed=task.sound_speed, density=density),
        source,
        kSensor(mask=where, record=["p"]),
        pml_size=width,
        pml_inside=True,
        backend="python",
        dtype=np.float32,
        quiet=True,
    )
    recorded = np.empty((task.steps, len(order)), np.float32)
    recorded[:, order] = outputs["p"].T
    return Answer(task.phasors(recorded), 0.0, time.perf_counter() - begin)


def mask(shape: tuple[int, ...], cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return cells (n, 3) as a mask, and their order in it."""
    marked = np.zeros(shape, bool)
    marked[tuple(cells.T)] = True
    return marked, np.ravel_multi_index(tuple(cells.T), shape).argsort()


if __name__ == "__main__":
    serve(simulate)
