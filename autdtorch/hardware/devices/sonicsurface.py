"""SonicSurface: 16 x 16 transducers, pitch 10.5 mm, 32 phases, no amplitude; a serial line."""

from __future__ import annotations

import cmath
import math
from functools import cache
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from autdtorch.hardware.devices.device import Device, Firmware
from autdtorch.hardware.transport.serial_chips import ft232r
from autdtorch.scene.drive import PhaseLevels
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.validation import ArrayLike

_BOARD, _BAUD = 256, 230_400
_START, _COMMIT = 0xFE, 0xFD
_OFF = 32  # phase level that switches a transducer off


class _SonicSurface(Device):
    """A frame is 0xFE, a phase level for each FPGA channel, and 0xFD, which starts the pattern."""

    def levels(self, drive: ArrayLike) -> tuple[torch.Tensor, ...]:
        phase, on = super().levels(drive)
        return (torch.where(on > 0, phase, _OFF),)

    def drive(self, *levels: ArrayLike) -> torch.Tensor:
        (level,) = self._checked(levels, (_OFF,))
        return self.phase_levels.drive(level % _OFF, level != _OFF)

    def pack(self, *levels: torch.Tensor) -> bytes:
        frames = np.empty((levels[0].numel() // _BOARD, 1 + _BOARD + 1), np.uint8)
        frames[:, 0], frames[:, -1] = _START, _COMMIT
        frames[:, 1 + sonicsurface_channels()] = levels[0].reshape(-1, _BOARD).numpy()
        return frames.tobytes()

    def firmware(self, transducers: int) -> Firmware:
        return _SonicSurfaceFirmware()


class _SonicSurfaceFirmware:
    """The primary FPGA (Distribute.vhd, PhaseLine.vhd), without phase corrections.

    It starts with all transducers on, at phase 0. A channel has a phase that it emits and one that waits; the
    commit swaps them.
    """

    baud: ClassVar[int | None] = 230_400

    _START, _COMMIT, _ENABLE, _DISABLE, _OFF = 254, 253, 192, 193, 32

    def __init__(self) -> None:
        self._playing = [0] * 256
        self._waiting = [0] * 256
        self._channel = 0
        self._enabled = True

    def receive(self, data: bytes) -> None:
        for byte in data:
            if byte == self._START and self._enabled:
                self._channel = 0
            elif byte == self._COMMIT:
                self._playing, self._waiting = self._waiting, self._playing
                self._channel = 0
            elif byte in (self._ENABLE, self._DISABLE):
                self._enabled = byte == self._ENABLE
            elif self._enabled:
                self._waiting[self._channel % 256] = byte if byte == self._OFF else byte & 31
                self._channel += 1

    def drive(self) -> torch.Tensor:
        """Return the drive (256,): the pulse of phase n begins n / 32 of a period late."""
        played = [0j if n == self._OFF else cmath.exp(2j * math.pi * n / 32) for n in self._playing]
        by_channel = torch.tensor(played, **COMPLEX)
        return by_channel[torch.from_numpy(sonicsurface_channels())]


@cache
def sonicsurface_channels() -> NDArray[np.intp]:
    """Return the FPGA channel (256,) of each transducer, row by row.

    A channel block of 64 drives four columns, and in it a block of eight drives two rows. Source: the table
    in upnalab/SonicSurface, ControlSoftware/Python/SonicSurface.py, which this rule reproduces.
    """
    row, column = np.indices((16, 16))
    in_block = np.array([[0, 7, 1, 2], [4, 3, 6, 5]])
    channels: NDArray[np.intp] = 64 * (column // 4) + 8 * (row // 2) + in_block[row % 2, column % 4]
    return channels.ravel()


#: One device, row by row. A drive below 1/2 is off, anything else is full.
SONICSURFACE = _SonicSurface(
    name="SonicSurface",
    board=_BOARD,
    phase_levels=PhaseLevels(32, 1),
    columns=("phase",),
    adapters=(ft232r(_BAUD),),
    baud=_BAUD,
)
