"""The scale of a trial's drives: |q| = 1 is the largest amplitude within the limit."""

from __future__ import annotations

import torch

from autdtorch.hardware.wiring import Wiring
from autdtorch.scene.drive import AMPLITUDE_TOLERANCE, validate_drive, validate_single_drive
from autdtorch.utils.validation import invalid, number_between, positive

_FINEST = 2.0**-14  # resolution of the search; two levels of a device here are further apart


class AmplitudeScale:
    """The scale between a trial's drives and the device's.

    Transducers of a calibrated device have levels of their own. None is driven above the highest of its
    levels within the limit, so that rounding exceeds the limit nowhere. The device's amplitude that is 1 in
    the trial is `largest`.
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
        """Return the drive to ask of the device, in its own scale, for a trial's `drive` (M,)."""
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
        asked = torch.zeros(len(self._wiring.transducers), dtype=torch.float64, device="cpu")
        step = 1.0
        while step >= _FINEST:
            more = (asked + step).clamp(max=1)
            asked = torch.where(self._amplitudes(more) <= limit + AMPLITUDE_TOLERANCE, more, asked)
            step /= 2
        return asked

    def _amplitudes(self, asked: torch.Tensor) -> torch.Tensor:
        """Return the device's nearest amplitudes (M,) to others (M,)."""
        return self._wiring.quantised(asked.to(torch.complex128)).abs()
