"""The transducers of a device that play the drives of a scene."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from autdtorch.hardware.devices.device import Device
from autdtorch.scene.drive import validate_single_drive
from autdtorch.utils.validation import indices, require_kind


class Wiring:
    """A device, and its transducer for each of a scene's (M,), int64; other transducers stay off."""

    def __init__(self, device: Device, transducers: Sequence[int] | torch.Tensor | None = None) -> None:
        """Wire a device; by default all its transducers in order."""
        require_kind("device", device, Device)
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
        everyone = torch.zeros(self.device.transducers, dtype=torch.complex128, device="cpu")
        everyone[self.transducers] = validate_single_drive(drive, len(self.transducers))
        return everyone
