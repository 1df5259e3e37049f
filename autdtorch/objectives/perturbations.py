"""Real conditions around an objective: noise, few levels, dead transducers, drift. They nest.

What is wrapped first is nearest to the air: ``Quantised(Drift(Dead(objective, [3]), phase=0.1), levels=32)``
rounds the drive, then lets the transducers drift, then silences one; ``Noise`` may come anywhere. All random
choices follow from the seeds. They go on from row to row, however the rows are divided among calls: a trial
that shall not depend on the trials beside it needs an objective of its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
import torch

from autdtorch.objectives.simulated import Objective, SimulatedObjective, require_objective, validate_drives
from autdtorch.scene.drive import drive_from_phases, validate_drive
from autdtorch.scene.phase_levels import PhaseLevels
from autdtorch.scene.scene import Scene
from autdtorch.utils.validation import (
    boolean,
    indices,
    integer_at_least,
    invalid,
    not_negative,
    number_between,
    positive,
)

SNRS = (-1000.0, 1000.0)
"""Range of signal-to-noise ratios [dB]; far beyond it their powers overflow."""

_PER = 1000  # Evaluations over which the rms of a drift is stated.


@runtime_checkable
class Player(Protocol):
    """An objective that knows its device's levels, as a `HardwareObjective` does."""

    def played(self, drive: torch.Tensor) -> torch.Tensor:
        """What the device plays (..., M) when asked for drives (..., M); asked for that, it plays that."""
        ...


class Condition:
    """An objective under a condition, itself an objective; by itself it changes nothing.

    Attributes:
        inner: the objective under the condition.
        scene: its scene.
        evaluations: number of observations so far through this wrapper.
    """

    inner: Objective
    scene: Scene
    evaluations: int

    def __init__(self, objective: Objective) -> None:
        """Wrap an objective.

        Raises:
            ValueError: no objective.
        """
        require_objective(objective)
        self.inner = objective
        self.scene = objective.scene
        self.evaluations = 0

    def __repr__(self) -> str:
        """What is wrapped, from the outside inwards."""
        return f"{type(self).__name__}({self.inner!r}, {self.evaluations} evaluations)"

    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        """Observe drives (B, M) under the condition: pressure magnitudes (B, P) [Pa].

        Raises:
            ValueError: another shape, not finite complex numbers, or an amplitude above 1.
        """
        drive = validate_drives(drive, len(self.scene.array))
        pressure = self._observe(drive)
        self.evaluations += len(drive)
        return pressure

    def played(self, drive: torch.Tensor) -> torch.Tensor:
        """Return the part of `emitted` that is known beforehand, for drives (..., M); a `Solution` holds it.

        Raises:
            ValueError: another shape, not finite complex numbers, or an amplitude above 1.
        """
        return validate_drive(drive, len(self.scene.array))

    def emitted(self, drive: torch.Tensor) -> torch.Tensor:
        """Return what is asked of `inner` now, when drives (B, M) are asked of this.

        Raises:
            ValueError: another shape, not finite complex numbers, or an amplitude above 1.
        """
        return self.played(drive)

    def _observe(self, drive: torch.Tensor) -> torch.Tensor:
        return self.inner(self.emitted(drive))


class Quantised(Condition):
    """A device that plays the nearest of few phases, and perhaps knows no amplitude but on and off.

    This is how any method works on the levels of a device: what it observes is what the device plays, and the
    drive of its `Solution` is on these levels.
    """

    def __init__(self, objective: Objective, levels: int, on_off: bool = False) -> None:
        """Wrap an objective.

        Args:
            objective: what the device plays to.
            levels: number of phases in [0, 2 pi), >= 2; 32 for SonicSurface, 128 for OpenMPD, 256 for AUTD3.
            on_off: amplitudes of 0.5 and more become 1, others 0.

        Raises:
            ValueError: `levels` is not an integer >= 2, or `on_off` no boolean.
        """
        super().__init__(objective)
        self.levels = integer_at_least("levels", levels, 2)
        self.on_off = boolean("on_off", on_off)

    def played(self, drive: torch.Tensor) -> torch.Tensor:
        """Return the nearest drives (..., M) that the device can play.

        Raises:
            ValueError: another shape, not finite complex numbers, or an amplitude above 1.
        """
        levels = PhaseLevels(self.levels, 1 if self.on_off else None)
        return levels.drive(*levels.nearest(super().played(drive)))


class Dead(Condition):
    """Transducers that are silent, whatever they are asked for."""

    def __init__(self, objective: Objective, transducers: Sequence[int]) -> None:
        """Wrap an objective.

        Args:
            objective: what the others play to.
            transducers: indices of the silent ones, at least one, each once.

        Raises:
            ValueError: `transducers` is none of the above.
        """
        super().__init__(objective)
        count = len(self.scene.array)
        self._alive = torch.ones(count, dtype=torch.float64, device="cpu")
        self._alive[indices("transducers", transducers, count)] = 0

    def emitted(self, drive: torch.Tensor) -> torch.Tensor:
        """Return `drive` (B, M) without the silent transducers.

        Raises:
            ValueError: another shape, not finite complex numbers, or an amplitude above 1.
        """
        return super().emitted(drive) * self._alive


class Drift(Condition):
    """Transducers and sensor that change slowly: random walks, a step for every evaluation.

    Every transducer has a phase w that walks and a loss e^{-|v|} with v walking, the sensor a gain e^u, the
    same for all control points. All start at w = v = u = 0.
    """

    def __init__(
        self, objective: Objective, phase: float = 0.0, loss: float = 0.0, sensor: float = 0.0, seed: int = 0
    ) -> None:
        """Wrap an objective.

        Args:
            objective: what drifts.
            phase: rms of a transducer's w after 1000 evaluations [rad], >= 0.
            loss: rms of its v after 1000 evaluations, >= 0; 0.1 loses about 8 % of the amplitude.
            sensor: rms of u after 1000 evaluations, >= 0.
            seed: of the walks, >= 0.

        Raises:
            ValueError: an argument out of range.
        """
        super().__init__(objective)
        rms = (
            not_negative("phase", phase, "rad"),
            not_negative("loss", loss),
            not_negative("sensor", sensor),
        )
        transducers = len(self.scene.array)
        steps = np.repeat(rms, (transducers, transducers, 1)) / math.sqrt(_PER)
        self._generator = _generator(seed, "Drift")
        self._steps = torch.from_numpy(steps)
        self._walk = torch.zeros_like(self._steps)

    def emitted(self, drive: torch.Tensor) -> torch.Tensor:
        """Return `drive` (B, M) as the transducers turn it after the evaluations so far.

        Raises:
            ValueError: another shape, not finite complex numbers, or an amplitude above 1.
        """
        return super().emitted(drive) * self._factors(self._walk)[0]

    def _observe(self, drive: torch.Tensor) -> torch.Tensor:
        size = (len(drive), len(self._steps))
        steps = self._steps * torch.from_numpy(self._generator.standard_normal(size))
        walk = self._walk + steps.cumsum(dim=0)
        transducers, sensor = self._factors(walk)
        self._walk = walk[-1]
        return self.inner(drive * transducers) * sensor

    def _factors(self, walk: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Factors of the drives (..., M), and of the observed pressures (..., 1)."""
        transducers = len(self.scene.array)
        phase, loss, sensor = torch.split(walk, [transducers, transducers, 1], dim=-1)
        return drive_from_phases(phase, (-loss.abs()).exp()), sensor.exp()


class Noise(Condition):
    """Complex circular Gaussian noise of fixed level on the phasor at every control point.

    A reading is |p + n|. Since all phases of n are equally likely, that has the distribution of ||p| + n|,
    which needs no phase of p: any objective can be wrapped. Its mean is above |p|, by about sigma^2 / (4 |p|)
    where |p| is well above sigma, and by more below (Rice).
    """

    def __init__(
        self, objective: Objective, snr: float, reads: int = 1, seed: int = 0, reference: float | None = None
    ) -> None:
        """Wrap an objective.

        Args:
            objective: what is observed.
            snr: 20 log10(reference / sigma) [dB], with sigma^2 = E |n|^2; -1000 to 1000.
            reads: readings of each drive, >= 1, of which the mean is observed. Each reading is an
                evaluation, here and of `objective`, and drifts go on meanwhile; a `Solution` counts drives.
            seed: of the noise, >= 0.
            reference: [Pa], > 0; by default the rms pressure over control points and random phases, all
                transducers fully on: sqrt(mean_p sum_m |G_pm|^2) of the innermost objective, which must be
                simulated from a transfer matrix.

        Raises:
            ValueError: an argument out of range, or no `reference` where there is no transfer matrix.
        """
        super().__init__(objective)
        level = number_between("snr", snr, *SNRS, "dB")
        self.reads = integer_at_least("reads", reads, 1)
        reference = _innermost_rms(objective) if reference is None else positive("reference", reference, "Pa")
        self.sigma = reference * 10 ** (-level / 20)
        self._generator = _generator(seed, "Noise")

    def _observe(self, drive: torch.Tensor) -> torch.Tensor:
        pressure = self.inner(drive.repeat_interleave(self.reads, dim=0))
        parts = torch.from_numpy(self._generator.standard_normal((*pressure.shape, 2)))
        noise = torch.view_as_complex(self.sigma / math.sqrt(2) * parts)
        self.evaluations += (self.reads - 1) * len(drive)
        return (pressure + noise).abs().reshape(len(drive), self.reads, -1).mean(dim=1)


def true_pressure(objective: Objective, drive: torch.Tensor) -> torch.Tensor:
    """Pressure (B, P) [Pa] that the array now really makes when asked for drives (B, M).

    What the device does to the drive remains: levels, dead transducers, the drift so far. What only the
    sensor does, noise and its drift, is gone. Only the innermost objective counts these as evaluations.

    Raises:
        ValueError: another shape, not finite complex numbers, or an amplitude above 1.
    """
    require_objective(objective)
    drive = validate_drives(drive, len(objective.scene.array))
    while isinstance(objective, Condition):
        drive = objective.emitted(drive)
        objective = objective.inner
    return objective(drive)


def playable(objective: Objective, drive: torch.Tensor) -> torch.Tensor:
    """The drives (..., M) that the device is known to play when asked for `drive`: on its levels."""
    while isinstance(objective, Condition):
        drive = objective.played(drive)
        objective = objective.inner
    return objective.played(drive) if isinstance(objective, Player) else drive


def random_rms(matrix: torch.Tensor) -> float:
    """Rms pressure [Pa] over control points and random phases, all transducers on, of a matrix (P, M)."""
    return math.sqrt(float(matrix.abs().square().sum(dim=1).mean()))


def _innermost_rms(objective: Objective) -> float:
    while isinstance(objective, Condition):
        objective = objective.inner
    matrix = objective.transfer_matrix if isinstance(objective, SimulatedObjective) else None
    if matrix is None:
        raise invalid("reference", None, "must be given where the objective has no transfer matrix", "Pa")
    return random_rms(matrix)


def _generator(seed: int, kind: str) -> np.random.Generator:
    # NumPy's, since one large draw is there the same as many small ones. The kind keeps noise and drift of
    # one seed apart.
    return np.random.default_rng([integer_at_least("seed", seed, 0), *kind.encode()])
