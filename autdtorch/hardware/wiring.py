"""Which of a device's transducers play the drives of a scene."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from autdtorch.drive import validate_drive
from autdtorch.hardware.devices import Device
from autdtorch.validation import integer_at_least, invalid


class Wiring:
    """A device some of whose transducers are a scene's; the others stay off.

    Attributes:
        device: plays the drives.
        transducers: for each transducer of the scene, which of the device's it is (M,), int64.
    """

    def __init__(self, device: Device, transducers: Sequence[int] | torch.Tensor | None = None) -> None:
        """Wire a device.

        Args:
            device: plays the drives.
            transducers: for each transducer of the scene, which of the device's it is (M,); by default all
                in order.

        Raises:
            ValueError: `transducers` that the device does not have, or one twice.
        """
        self.device = device
        self.transducers = places(transducers, device.transducers)

    def frame(self, drive: torch.Tensor) -> bytes:
        """Bytes for a drive (M,), |q| <= 1, on the nearest levels.

        Raises:
            ValueError: another shape, not finite complex numbers, or an amplitude above 1.
        """
        everyone = torch.zeros(self.device.transducers, dtype=torch.complex128)
        everyone[self.transducers] = single_drive(drive, len(self.transducers))
        return self.device.frame(everyone)

    def played(self, drive: torch.Tensor) -> torch.Tensor:
        """What the device plays (M,) when asked for a drive (M,): the nearest on its levels.

        Raises:
            ValueError: another shape, not finite complex numbers, or an amplitude above 1.
        """
        return self.device.played(self.frame(drive))[self.transducers]


def single_drive(drive: torch.Tensor, transducers: int) -> torch.Tensor:
    """`drive` (M,) as complex128, after checking that an array of M `transducers` can play it.

    Raises:
        ValueError: another shape, not finite complex numbers, or an amplitude above 1.
    """
    checked = validate_drive(drive, transducers)
    if checked.ndim != 1:
        raise ValueError(f"drive: shape {tuple(checked.shape)}; must be ({transducers},), one drive")
    return checked


def places(transducers: Sequence[int] | torch.Tensor | None, count: int) -> torch.Tensor:
    """Which of a device's `count` transducers play a scene's (M,), int64.

    Raises:
        ValueError: transducers that the device does not have, or one twice.
    """
    if transducers is None:
        return torch.arange(count)
    if isinstance(transducers, torch.Tensor):  # its elements are no Integral
        transducers = transducers.tolist()
    chosen = [integer_at_least(f"transducers[{place}]", one, 0) for place, one in enumerate(transducers)]
    if not chosen or len(set(chosen)) < len(chosen) or max(chosen) >= count:
        raise invalid("transducers", chosen, f"must be indices from 0 to {count - 1}, each once")
    return torch.tensor(chosen)
