"""Tasks and answers of peers as files, for programs in other environments; needs NumPy only.

A peer runs as `python <name>_peer.py task.npz answer.npz`. Grids exclude the absorbing layers of the peer.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

RAMP_PERIODS = 3
"""Periods over which the drive is switched on."""

DFT_PERIODS = 2
"""Periods over which phasors are computed."""

Array = NDArray[np.float32]
Cells = NDArray[np.int64]


class Stored:
    """A dataclass of arrays and numbers, stored as an .npz file."""

    def save(self, path: Path) -> None:
        np.savez(path, **asdict(self))

    @classmethod
    def load(cls, path: Path) -> Self:
        with np.load(path) as stored:
            values = {name: stored[name] for name in (field.name for field in fields(cls))}
        return cls(**{name: value if value.ndim else value.item() for name, value in values.items()})


@dataclass(frozen=True)
class Task(Stored):
    """A simulation."""

    density: Array  # of the cells (X, Y, Z) [kg/m^3]
    sound_speed: float  # of all cells [m/s]
    spacing: float  # edge of a cell [m]
    frequency: float  # of the drive [Hz]
    time_step: float  # [s]
    steps_per_period: int  # of the drive
    source_cells: Cells  # driven cells (S, 3)
    source_weights: Array  # share of the source in each cell (S,)
    receiver_cells: Cells  # recorded cells (R, 3)
    ends: Cells  # periods (E,), ascending, at which phasors are returned; the last ends the run
    layer_cells: int  # thickness of the absorbing layer
    order: int  # of the differences in space; 0 for spectral

    @property
    def steps(self) -> int:
        return int(self.ends[-1]) * self.steps_per_period

    def drive(self, delay: float = 0.0) -> NDArray[np.float64]:
        """Return a ramped cosine at each step (T,), shifted by `delay` steps."""
        turns = (np.arange(self.steps) + delay) / self.steps_per_period
        ramp = np.clip(turns / RAMP_PERIODS, 0, 1)
        return ramp**2 * (3 - 2 * ramp) * np.cos(2 * np.pi * turns)

    def phasors(self, recorded: Array) -> NDArray[np.complex128]:
        """Return phasors (E, R), time factor e^{-i w t}, of signals (T, R) that begin at step 0."""
        window = DFT_PERIODS * self.steps_per_period
        turn = np.exp(2j * np.pi / self.steps_per_period * np.arange(window)) * 2 / window
        ends = self.ends * self.steps_per_period
        return np.array([turn @ recorded[end - window : end] for end in ends])


@dataclass(frozen=True)
class Answer(Stored):
    """The result of a peer."""

    phasors: NDArray[np.complex128]  # pressure (E, R) at the ends of the task, in any unit
    setup_seconds: float  # before stepping, without imports and compilation
    stepping_seconds: float  # of all steps


def serve(simulate: Callable[[Task], Answer]) -> None:
    """Answer the task named on the command line."""
    task, answer = map(Path, sys.argv[1:])
    simulate(Task.load(task)).save(answer)
