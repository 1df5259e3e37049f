"""The scale of a trial's drives: |q| = 1 is the largest amplitude that the limit allows."""

from __future__ import annotations

import torch

from autdtorch.hardware.wiring import Wiring
from autdtorch.scene.drive import AMPLITUDE_TOLERANCE, validate_drive, validate_single_drive
from autdtorch.utils.validation import invalid, number_between, positive

_FINEST = 2.0**-14  # of the amplitudes to choose from; two levels of a device here are further apart


class AmplitudeScale:
    """Drives of a trial, from their scale to the device's and back.

    Each transducer has levels of its own where a device is calibrated: none is asked for more than the
    highest of its levels within the limit, so that rounding takes none above it.

    Attributes:
        largest: the amplitude of the device that is 1 in the trial: the highest level within the limit.
    """

    def __init__(self, wiring: Wiring, amplitude: float) -> None:
        """Find the levels within a limit.

        Args:
            wiring: plays the drives.
            amplitude: the most that a transducer is driven at, above 0 up to 1.

        Raises:
            ValueError: `amplitude` out of range, or the device has none up to it but 0.
        """
        self._wiring = wiring
        limit = number_between("amplitude", positive("amplitude", amplitude), 0.0, 1.0)
        self._most = self._amplitudes(self._highest(limit))
        self.largest = float(self._most.max())
        if self.largest == 0:
            above = self._amplitudes((self._highest(0.0) + 2 * _FINEST).clamp(max=1))
            least = torch.where(above > 0, above, torch.inf).min()
            raise invalid(
                "amplitude", limit, f"must be >= {least:.3g}, the least that {wiring.device.name} plays"
            )

    def asked(self, drive: torch.Tensor) -> torch.Tensor:
        """What to ask of the device, in its own scale, for a trial's drive (M,).

        Raises:
            ValueError: another shape, not finite complex numbers, or an amplitude above 1.
        """
        wanted = self.largest * validate_single_drive(drive, len(self._most))
        return torch.polar(wanted.abs().minimum(self._most), wanted.angle())

    def played(self, drive: torch.Tensor) -> torch.Tensor:
        """What the device plays (..., M), in the trial's scale, when asked for drives (..., M) in it.

        Raises:
            ValueError: another shape, not finite complex numbers, or an amplitude above 1.
        """
        drive = validate_drive(drive, len(self._most))
        # One by one, as the link plays them: no rounding may depend on the rows beside.
        rows = [self._wiring.played(self.asked(row)) for row in drive.reshape(-1, drive.shape[-1])]
        return torch.stack(rows).reshape(drive.shape) / self.largest

    def _highest(self, limit: float) -> torch.Tensor:
        """What to ask each transducer for (M,), to have it play the highest of its levels up to `limit`."""
        asked = torch.zeros(len(self._wiring.transducers), dtype=torch.float64, device="cpu")
        step = 1.0
        while step >= _FINEST:
            more = (asked + step).clamp(max=1)
            asked = torch.where(self._amplitudes(more) <= limit + AMPLITUDE_TOLERANCE, more, asked)
            step /= 2
        return asked

    def _amplitudes(self, asked: torch.Tensor) -> torch.Tensor:
        """Amplitudes (M,) that are played for others (M,)."""
        return self._wiring.played(asked.to(torch.complex128)).abs()
