"""AUTD3: 249 transducers a board, 256 phases, 255 amplitudes; on the network, not on USB."""

from __future__ import annotations

import cmath
import math
from typing import ClassVar

import numpy as np
import torch

from autdtorch.hardware.devices.device import Device, Firmware
from autdtorch.scene.arrays import AUTD3_TRANSDUCERS
from autdtorch.scene.phase_levels import PhaseLevels
from autdtorch.utils.array_types import COMPLEX


class _Autd3(Device):
    """A frame is the phases of all boards, then the intensities of all."""

    def pack(self, *levels: torch.Tensor) -> bytes:
        return torch.cat(levels).to(torch.uint8).numpy().tobytes()

    def firmware(self, transducers: int) -> Firmware:
        return _Autd3Firmware(transducers)


class _Autd3Firmware:
    """Boards behind their software kit, which receives a frame as one pattern.

    The packets between kit and boards are the kit's own; `autd3_emulator` checks the levels in them.
    """

    baud: ClassVar[int | None] = None

    def __init__(self, transducers: int) -> None:
        """Switch boards of so many `transducers` on; they are silent until the first pattern."""
        self._playing = bytes(2 * transducers)

    def receive(self, data: bytes) -> None:
        self._playing = data

    def drive(self) -> torch.Tensor:
        """Return the drive (N,): phase n / 256 of a period, amplitude i / 255."""
        levels = np.frombuffer(self._playing, np.uint8).reshape(2, -1).T.tolist()
        played = [cmath.rect(i / 255, 2 * math.pi * n / 256) for n, i in levels]
        return torch.tensor(played, **COMPLEX)


#: One board. An intensity i is proportional to the amplitude, as the firmware gives it the pulse width
#: 512 asin(i / 255) / pi (AUTD3 manual, "Intensity and Pulse Width"), unless another table was loaded.
AUTD3 = _Autd3(
    name="AUTD3",
    board=AUTD3_TRANSDUCERS,
    phase_levels=PhaseLevels(256, 255),
    columns=("phase", "intensity"),
    most_boards=None,
)
