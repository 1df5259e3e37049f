"""Public readings of a SonicSurface by one microphone: Fushimi et al., Commun. Eng. 3 (2024), from a clone.

The repository DigitalNatureGroup/insitu_optimization is for research only: nothing of it is stored here.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

import autdtorch as at
from autdtorch.hardware.devices.sonicsurface import SONICSURFACE, sonicsurface_channels
from autdtorch.utils.process import cached_property

KINDS = "i", "ii", "iii"
"""Kinds of targets: a phase, an amplitude, both."""
TARGETS, TRIES = 20, 3

LEVELS = SONICSURFACE.phase_levels
assert LEVELS is not None

MARKS = ("numerical_simulated_results", "experiment_data")
"""Folders of a clone."""

MICROPHONE, SOUND_SPEED, DENSITY = (0.0, 0.0, 40e-3), 346.0, 1.18
AUTHORS_RADIUS = 5e-3
"""Radius of a transducer in the authors' simulation [m]."""


def scene(radius: float) -> at.Scene:
    """Return the scene: array in z = 0, microphone on its axis."""
    array = at.TransducerArray.sonicsurface((0, 0, 0), normal=(0, 0, 1), radius=radius)
    return at.Scene(array, at.Medium(DENSITY, SOUND_SPEED), 40e3, [MICROPHONE], name="SonicSurface")


def matrix(radius: float) -> torch.Tensor:
    """Return the simulated transfer matrix (1, M) [Pa]."""
    return at.make_propagator(scene(radius)).transfer_matrix()


@dataclass(frozen=True)
class Holograms:
    """A clone of the repository.

    Step 3 has the drives of a simulation, each played three times. Step 4 has the drives to which the
    authors' in-situ optimisation came. The order is tries, kinds, targets.
    """

    folder: Path

    @cached_property
    def step3(self) -> at.Readings:
        """The readings (180, 1) of the simulation's drives, with phases up to a constant."""
        names = (f"step2_target_A{kind}_N_{n}_phase_export.csv" for kind, n in _targets())
        simulated = np.array([self._phases(0, name) for name in names])
        phase_name = "step3_compare_A{}_numerical2experiment_pha_{}_try.csv"
        return self._readings(3, np.concatenate([simulated] * TRIES), phase_name)

    @cached_property
    def step4(self) -> at.Readings:
        """The readings (180, 1) of the optimised drives, with phases up to a constant."""
        names = [
            f"step4_optimize_match_target_A{kind}_N_{n}_pat_phase_record_{attempt}_try.csv"
            for attempt in range(TRIES)
            for kind, n in _targets()
        ]
        optimised = np.array([self._phases(1, name) for name in names])
        return self._readings(4, optimised, "step4_target_A{}_optimized_final_phase_{}_try.csv")

    @cached_property
    def targets(self) -> torch.Tensor:
        """Wanted pressures (60,); those of a phase alone have amplitude 1, those of an amplitude phase 0."""
        amplitude, phase = (self._table(0, f"step_2_target_{name}_list.csv") for name in ("amp", "pha"))
        phasor = np.exp(1j * phase)
        return torch.from_numpy(np.concatenate([phasor, amplitude + 0j, amplitude * phasor]))

    @cached_property
    def authors_simulation(self) -> torch.Tensor:
        """The magnitudes (60,) [Pa] that the authors' simulation gave for the drives of step 3."""
        names = [f"step_2_target_A{kind}_performance_amp.csv" for kind in KINDS]
        return torch.from_numpy(np.concatenate([self._table(0, name) for name in names]))

    def _readings(self, step: int, phases: np.ndarray, phase_name: str) -> at.Readings:
        """Return the readings of phases (180, M) as the device rounds them."""
        drives = LEVELS.drive(*LEVELS.nearest(torch.from_numpy(np.exp(1j * phases))))
        levels, read = [], []
        for attempt in range(TRIES):
            for kind in KINDS:
                read.append(self._table(1, phase_name.format(kind, attempt)))
                names = (
                    f"step{step}_optimize_match_target_A{kind}_N_{n}_fft_data_record_{attempt}_try.csv"
                    for n in range(TARGETS)
                )
                levels += [np.abs(self._table(1, name, complex)[1:]).max() for name in names]
        return at.Readings(drives, levels, phase=np.concatenate(read))

    def _phases(self, folder: int, name: str) -> np.ndarray:
        """Return phases (M,) [rad] of a file, which has them by channel, in the order of the array."""
        return self._table(folder, name, delimiter=",").ravel()[sonicsurface_channels()]

    def _table(self, folder: int, name: str, dtype: type = float, delimiter: str | None = None) -> np.ndarray:
        return np.loadtxt(self.folder / MARKS[folder] / name, dtype, delimiter=delimiter, ndmin=1)


def _targets() -> Iterator[tuple[str, int]]:
    return ((kind, n) for kind in KINDS for n in range(TARGETS))
