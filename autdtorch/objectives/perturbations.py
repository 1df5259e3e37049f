"""Perturbations around an objective: quantisation, failed transducers, drift and noise. They nest.

The innermost perturbation acts last on the drive: ``Quantised(Drift(FailedTransducers(objective, [3]),
phase=0.1), levels=32)`` rounds the drive, then lets the transducers drift, then switches one off. `Noise` may
come anywhere. All random choices follow from the seeds, and go on from row to row, however the rows are
divided among calls. A trial that must not depend on others therefore needs a separate objective.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch

from autdtorch.objectives.objective import Objective, observe_drives, require_objective, validate_drives
from autdtorch.objectives.readings import deviation_by_square
from autdtorch.scene.drive import PhaseLevels, drive_from_phases, validate_drive
from autdtorch.utils.array_types import REAL, device_of
from autdtorch.utils.text import counted
from autdtorch.utils.validation import (
    boolean,
    indices,
    integer_at_least,
    invalid,
    not_negative,
    number_between,
    positive,
    real_tensor,
)

SNRS = (-1000.0, 1000.0)
"""Range of signal-to-noise ratios [dB]; far beyond it their powers overflow."""

_PER = 1000  # Evaluations over which the rms of a drift is stated.


class Perturbation:
    """Base of the perturbations: an objective around another, which it leaves unchanged.

    Attributes:
        inner: the wrapped objective.
        scene: its scene.
        evaluations: number of observations so far through this wrapper.
    """

    def __init__(self, objective: Objective) -> None:
        """Wrap an objective."""
        require_objective(objective)
        self.inner = objective
        self.scene = objective.scene
        self.evaluations = 0

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.inner!r}, {counted(self.evaluations, 'evaluation')})"

    def __call__(self, drive: torch.Tensor) -> torch.Tensor:
        """Observe drives (..., M), perturbed: pressure magnitudes (..., P) [Pa]."""
        pressure = observe_drives(self._observe, drive, len(self.scene.array))
        self.evaluations += math.prod(pressure.shape[:-1])
        return pressure

    def quantised(self, drive: torch.Tensor) -> torch.Tensor:
        """Return drives (..., M) perturbed as far as is known beforehand; a `Solution` holds them."""
        return validate_drive(drive, len(self.scene.array))

    def emitted(self, drive: torch.Tensor) -> torch.Tensor:
        """Return the drives (..., M) that `inner` gets for drives (..., M), at present."""
        return self.quantised(drive)

    def _observe(self, drive: torch.Tensor) -> torch.Tensor:
        return self.inner(self.emitted(drive))


class Quantised(Perturbation):
    """A device with few phase levels, and perhaps no amplitude between off and full.

    With it any method works on the levels of a device: it observes the quantised drives, and its `Solution`
    holds them.
    """

    def __init__(self, objective: Objective, levels: int, on_off: bool = False) -> None:
        """Wrap an objective.

        Args:
            objective: is wrapped.
            levels: number of phases in [0, 2 pi), >= 2; 32 for SonicSurface, 128 for OpenMPD, 256 for AUTD3.
            on_off: amplitudes of 0.5 and more become 1, others 0.
        """
        super().__init__(objective)
        self.levels = integer_at_least("levels", levels, 2)
        self.on_off = boolean("on_off", on_off)

    def quantised(self, drive: torch.Tensor) -> torch.Tensor:
        """Return the nearest drives (..., M) that the device can play."""
        levels = PhaseLevels(self.levels, 1 if self.on_off else None)
        return levels.drive(*levels.nearest(super().quantised(drive)))


class FailedTransducers(Perturbation):
    """Transducers that never emit."""

    def __init__(self, objective: Objective, transducers: Sequence[int]) -> None:
        """Wrap an objective.

        Args:
            objective: is wrapped.
            transducers: indices of those that failed, at least one, each once.
        """
        super().__init__(objective)
        count = len(self.scene.array)
        self._working = torch.ones(count, **REAL)
        self._working[indices("transducers", transducers, count)] = 0

    def emitted(self, drive: torch.Tensor) -> torch.Tensor:
        """Return `drive` (..., M) without the failed transducers."""
        return super().emitted(drive) * self._working.to(drive.device)


class Drift(Perturbation):
    """Transducers and sensor that drift: random walks with a step for every evaluation.

    Every transducer has a phase w and a loss e^{-|v|}, the sensor a gain e^u for all control points. The
    walks w, v and u start at 0.
    """

    def __init__(
        self, objective: Objective, phase: float = 0.0, loss: float = 0.0, sensor: float = 0.0, seed: int = 0
    ) -> None:
        """Wrap an objective.

        Args:
            objective: is wrapped.
            phase: rms of a transducer's w after 1000 evaluations [rad], >= 0.
            loss: rms of its v after 1000 evaluations, >= 0; 0.1 loses about 8 % of the amplitude.
            sensor: rms of u after 1000 evaluations, >= 0.
            seed: of the walks, >= 0.
        """
        super().__init__(objective)
        rms = not_negative("phase", phase, "rad"), not_negative("loss", loss), not_negative("sensor", sensor)
        transducers = len(self.scene.array)
        steps = np.repeat(rms, (transducers, transducers, 1)) / math.sqrt(_PER)
        self._generator = _generator(seed, "Drift")
        self._steps = torch.from_numpy(steps)
        self._walk = torch.zeros_like(self._steps)

    def emitted(self, drive: torch.Tensor) -> torch.Tensor:
        """Return `drive` (..., M) with the drift after the evaluations so far."""
        return super().emitted(drive) * self._factors(self._walk)[0].to(drive.device)

    def _observe(self, drive: torch.Tensor) -> torch.Tensor:
        size = (len(drive), len(self._steps))
        steps = self._steps * torch.from_numpy(self._generator.standard_normal(size))
        walk = self._walk + steps.cumsum(dim=0)
        transducers, sensor = self._factors(walk)
        self._walk = walk[-1]
        return self.inner(drive * transducers) * sensor

    def _factors(self, walk: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the factors of the drives (..., M) and of the observed pressures (..., 1)."""
        transducers = len(self.scene.array)
        phase, loss, sensor = torch.split(walk, [transducers, transducers, 1], dim=-1)
        return drive_from_phases(phase, (-loss.abs()).exp()), sensor.exp()


class Noise(Perturbation):
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
            objective: is wrapped.
            snr: 20 log10(reference / sigma) [dB], with sigma^2 = E |n|^2; -1000 to 1000.
            reads: number of readings of each drive, >= 1; their mean is observed. Each reading is an
                evaluation, here and of `objective`, and drifts go on; a `Solution` counts drives.
            seed: of the noise, >= 0.
            reference: [Pa], > 0; by default the rms pressure over control points and random phases, all
                transducers fully on: sqrt(mean_p sum_m |G_pm|^2) of the innermost objective, which must have
                a transfer matrix G.
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


class CameraNoise(Perturbation):
    """Noise of a thermal camera, which sees |p|^2: a relative part, and a floor where it is dark.

    A reading is sqrt(max(0, |p|^2 + n)) with Gaussian n.
    """

    def __init__(
        self, objective: Objective, relative: float = 0.025, floor: float = 0.0, seed: int = 0
    ) -> None:
        """Wrap an objective.

        Args:
            objective: is wrapped.
            relative: standard deviation of a high pressure, relative to it, 1e-6 to 1.
            floor: [Pa], >= 0; its square is the standard deviation of |p|^2 in the dark.
            seed: of the noise, >= 0.
        """
        super().__init__(objective)
        self.relative = number_between("relative", relative, 1e-6, 1.0)
        self.floor = not_negative("floor", floor, "Pa")
        self._generator = _generator(seed, "CameraNoise")

    def deviation(self, pressure: torch.Tensor) -> torch.Tensor:
        """Return the deviations (..., P) [Pa] of readings (..., P) [Pa], as `Readings.deviation`."""
        pressure = real_tensor("pressure", pressure, "Pa")
        return deviation_by_square(pressure, self._of_square(pressure.square()))

    def _observe(self, drive: torch.Tensor) -> torch.Tensor:
        square = self.inner(drive).square()
        noise = torch.from_numpy(self._generator.standard_normal(square.shape))
        return (square + self._of_square(square) * noise).clamp_min(0).sqrt()

    def _of_square(self, square: torch.Tensor) -> torch.Tensor:
        """Return the deviations [Pa^2] of squares of pressures."""
        return torch.hypot(2 * self.relative * square, torch.full_like(square, self.floor**2))


def true_pressure(objective: Objective, drive: torch.Tensor) -> torch.Tensor:
    """Return the pressures (..., P) [Pa] that the array at present makes for drives (..., M).

    Perturbations of the drive remain: quantisation, failed transducers, the drift so far. Those of the sensor
    are left out: noise and its drift. Only the innermost objective counts the evaluations.
    """
    require_objective(objective)
    device, drive = device_of(drive), validate_drives(drive, len(objective.scene.array))
    while isinstance(objective, Perturbation):
        drive = objective.emitted(drive)
        objective = objective.inner
    return observe_drives(objective, drive, drive.shape[-1]).to(device)


def quantised(objective: Objective, drive: torch.Tensor) -> torch.Tensor:
    """Return the drives (..., M) that the device of an objective is known to play for drives (..., M)."""
    while isinstance(objective, Perturbation):
        drive = objective.quantised(drive)
        objective = objective.inner
    known = getattr(objective, "quantised", None)  # of a `HardwareObjective`
    return drive if known is None else known(drive)


def continued(objective: Objective, number: int) -> contextlib.AbstractContextManager[object]:
    """Return a block in which an objective with a log takes evaluations from it, from drive `number` on.

    Such are `HardwareObjective` and `Scenarios` of them, whose logs count every reading of `Noise`. Others
    observe in the block as they do outside.
    """
    while isinstance(objective, Perturbation):
        if isinstance(objective, Noise):
            number *= objective.reads
        objective = objective.inner
    return getattr(objective, "continued", contextlib.nullcontext)(number)


def deviation_of(objective: Objective) -> Callable[[torch.Tensor], torch.Tensor] | None:
    """Return the function of an objective that gives the deviations of its readings (..., P) [Pa], if any."""
    known = getattr(objective, "deviation", None)
    while known is None and isinstance(objective, Perturbation):
        objective = objective.inner
        known = getattr(objective, "deviation", None)
    return known


def simulated_matrix(objective: Objective) -> torch.Tensor | None:
    """Return the transfer matrix (P, M) [Pa] of the innermost objective, or None where it has none."""
    return getattr(innermost(objective), "transfer_matrix", None)


def innermost(objective: Objective) -> Objective:
    """Return the objective that perturbations wrap."""
    while isinstance(objective, Perturbation):
        objective = objective.inner
    return objective


def random_rms(matrix: torch.Tensor) -> float:
    """Return the rms pressure [Pa] over the points of a matrix (P, M) and random phases at full drive."""
    return math.sqrt(float(matrix.abs().square().sum(dim=1).mean()))


def _innermost_rms(objective: Objective) -> float:
    matrix = simulated_matrix(objective)
    if matrix is None:
        raise invalid("reference", None, "must be given where the objective has no transfer matrix", "Pa")
    return random_rms(matrix)


def _generator(seed: int, kind: str) -> np.random.Generator:
    # NumPy's generator: one large draw equals many small ones. The kind separates noise and drift of a seed.
    return np.random.default_rng([integer_at_least("seed", seed, 0), *kind.encode()])
