"""Deepwave: staggered differences of order 2 to 8, leapfrog in time, CPML."""

from __future__ import annotations

import time

import deepwave
import numpy as np
import torch
from task import Answer, Task, serve


def simulate(task: Task) -> Answer:
    begin = time.perf_counter()
    # a source sample acts half a step after the pressure of the same index is recorded
    signal = task.source_weights[:, None] * task.drive(0.5)[None]
    density = torch.from_numpy(task.density)
    outputs = deepwave.acoustic(
        torch.full_like(density, task.sound_speed),
        density,
        grid_spacing=task.spacing,
        dt=task.time_step,
        sources={
            "volume_rate": (
                torch.from_numpy(signal.astype(np.float32))[None],
                torch.from_numpy(task.source_cells)[None],
            )
        },
        receivers={"p": torch.from_numpy(task.receiver_cells)[None]},
        accuracy=task.order,
        pml_width=task.layer_cells,
        pml_freq=task.frequency,
        courant_number=deepwave.discretisation.critical_courant_number(task.order, propagator="acoustic"),
        location_interpolation="none",
    )
    if outputs.info.step_ratio != 1:
        raise ValueError(
            f"time_step: {task.time_step:.4g} s; must be at most {outputs.info.internal_dt:.4g} s"
        )
    recorded = outputs.receiver_amplitudes_p[0].numpy().T
    return Answer(task.phasors(recorded), 0.0, time.perf_counter() - begin)


if __name__ == "__main__":
    serve(simulate)
