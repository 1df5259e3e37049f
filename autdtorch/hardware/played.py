"""The drives that a device plays for a scene: its transducers, its levels, and the scale of a trial."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from autdtorch.hardware.devices import require_device
from autdtorch.hardware.devices.device import Device
from autdtorch.objectives.objective import Objective
from autdtorch.objectives.perturbations import Perturbation
from autdtorch.scene.drive import AMPLITUDE_TOLERANCE, validate_drive, validate_single_drive
from autdtorch.utils.array_types import COMPLEX, REAL
from autdtorch.utils.validation import indices, invalid, number_between, positive

_FINEST = 2.0**-14  # resolution of the search; two levels of a device here are further apart


class Wiring:
    """A device, and its transducer for each of a scene's (M,), int64; other transducers stay off."""

    def __init__(self, device: Device, transducers: Sequence[int] | torch.Tensor | None = None) -> None:
        """Wire a device; by default all its transducers in order."""
        require_device(device)
        self.device = device
        chosen = range(device.transducers) if transducers is None else transducers
        places = indices("transducers", chosen, device.transducers)
        self.transducers = torch.tensor(places, dtype=torch.int64, device="cpu")

    def frame(self, drive: torch.Tensor) -> bytes:
        """Return the bytes for a drive (M,), |q| <= 1, on the nearest levels."""
        return self.device.frame(self._of_device(drive))

    def quantised(self, drive: torch.Tensor) -> torch.Tensor:
        """Return the device's nearest drive (M,) to a `drive` (M,)."""
        return self.device.quantised(self._of_device(drive))[self.transducers]

    def _of_device(self, drive: torch.Tensor) -> torch.Tensor:
        everyone = torch.zeros(self.device.transducers, **COMPLEX)
        everyone[self.transducers] = validate_single_drive(drive, len(self.transducers))
        return everyone


class AmplitudeScale:
    """The scale between a trial's drives and the device's, whose amplitude `largest` is 1 in the trial.

    Transducers of a calibrated device differ in their levels. None is driven above the highest of its levels
    within the limit, so that rounding exceeds the limit nowhere.
    """

    def __init__(self, wiring: Wiring, amplitude: float) -> None:
        """Find the levels within a limit, above 0 up to 1; `ValueError` if that leaves only 0."""
        self._wiring = wiring
        limit = number_between("amplitude", positive("amplitude", amplitude), 0.0, 1.0)
        self._most = self._amplitudes(self._highest(limit))
        self.largest = float(self._most.max())
        if self.largest == 0:
            above = self._amplitudes((self._highest(0.0) + 2 * _FINEST).clamp(max=1))
            least = torch.where(above > 0, above, torch.inf).min()
            accepted = f"must be >= {least:.3g}, the lowest level of {wiring.device.name}"
            raise invalid("amplitude", limit, accepted)

    def asked(self, drive: torch.Tensor) -> torch.Tensor:
        """Return the drive to ask of the device, in the device's scale, for a trial's `drive` (M,)."""
        wanted = self.largest * validate_single_drive(drive, len(self._most))
        return torch.polar(wanted.abs().minimum(self._most), wanted.angle())

    def quantised(self, drive: torch.Tensor) -> torch.Tensor:
        """Return the device's nearest drives to drives (..., M), both in the trial's scale."""
        drive = validate_drive(drive, len(self._most))
        # One by one, as the link plays them: no rounding may depend on the rows beside.
        rows = [self._wiring.quantised(self.asked(row)) for row in drive.reshape(-1, drive.shape[-1])]
        return torch.stack(rows).reshape(drive.shape) / self.largest

    def _highest(self, limit: float) -> torch.Tensor:
        """Return the amplitude to ask of each transducer (M,) for the highest of its levels up to `limit`."""
        asked = torch.zeros(len(self._wiring.transducers), **REAL)
        step = 1.0
        while step >= _FINEST:
            more = (asked + step).clamp(max=1)
            asked = torch.where(self._amplitudes(more) <= limit + AMPLITUDE_TOLERANCE, more, asked)
            step /= 2
        return asked

    def _amplitudes(self, asked: torch.Tensor) -> torch.Tensor:
        """Return the device's nearest amplitudes (M,) to others (M,)."""
        return self._wiring.quantised(asked.to(torch.complex128)).abs()


class Played(Perturbation):
    """A device that plays the nearest of its levels, as it is calibrated, within the limit of a trial.

    With ``Played(SimulatedObjective(...), device)`` a method finds the same drive as with a
    `HardwareObjective` without noise. The pressures differ by a factor: |q| = 1 in the trial is the amplitude
    `largest` of the device, its highest level within the limit.
    """

    def __init__(
        self,
        objective: Objective,
        device: Device,
        transducers: Sequence[int] | torch.Tensor | None = None,
        amplitude: float = 1.0,
    ) -> None:
        """Wrap an objective.

        Args:
            objective: simulates the pressure of the device's drives.
            device: the device whose levels are used.
            transducers: the device's transducer for each of the scene's (M,); by default all in order.
            amplitude: amplitude limit of the trial, as in `Limits`.

        `ValueError` for `transducers` that the device does not have, one twice, or not as many as the scene
        has; or an `amplitude` out of range or below the device's lowest level.
        """
        super().__init__(objective)
        wiring = Wiring(device, transducers)
        count = len(self.scene.array)
        if len(wiring.transducers) != count:
            accepted = f"must be {count}, as many as the scene has"
            raise invalid("transducers", len(wiring.transducers), accepted)
        self._scale = AmplitudeScale(wiring, amplitude)
        self.largest = self._scale.largest

    def quantised(self, drive: torch.Tensor) -> torch.Tensor:
        """Return the device's nearest drives to drives (..., M), both in the trial's scale."""
        return self._scale.quantised(drive)
