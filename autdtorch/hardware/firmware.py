"""What devices do with the bytes they are sent, for the emulator.

Written from the firmwares alone, not from `frames`, so that the one checks the other.
"""

from __future__ import annotations

import cmath
import math
from typing import ClassVar, Protocol

import torch

from autdtorch.hardware.order import sonicsurface_channels


class Firmware(Protocol):
    """A device behind its USB chip.

    Attributes:
        baud: rate at which it listens [bits/s]; None for a FIFO.
    """

    baud: ClassVar[int | None]

    def receive(self, data: bytes) -> None:
        """Take bytes, in pieces of any length."""
        ...

    def drive(self) -> torch.Tensor:
        """What the transducers now play, row by row (N,), complex128."""
        ...


class SonicSurfaceFirmware:
    """The primary FPGA of a SonicSurface (Distribute.vhd, PhaseLine.vhd), without phase corrections.

    It starts with all transducers on, at phase 0. A channel has the phase that it plays and one that waits;
    the commit swaps them.
    """

    baud: ClassVar[int | None] = 230_400

    _START, _COMMIT, _ENABLE, _DISABLE, _OFF = 254, 253, 192, 193, 32

    def __init__(self) -> None:
        """Switch the device on."""
        self._playing = [0] * 256
        self._waiting = [0] * 256
        self._channel = 0
        self._enabled = True

    def receive(self, data: bytes) -> None:
        """Take bytes, in pieces of any length."""
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
        """What the transducers play (256,): the pulse of phase n begins n / 32 of a period late."""
        played = [self._played(phase) for phase in self._playing]
        return torch.tensor(played, dtype=torch.complex128)[torch.from_numpy(sonicsurface_channels())]

    def _played(self, phase: int) -> complex:
        return 0j if phase == self._OFF else cmath.exp(2j * math.pi * phase / 32)


class OpenMPDFirmware:
    """A board of OpenMPD: it plays pulses that begin at a phase and last for a duty, both in 1/128 period.

    Bit 7 begins a message where one is due; the later bytes' bits 7, which set lamp and rate, are ignored.
    """

    baud: ClassVar[int | None] = None

    def __init__(self) -> None:
        """Switch the device on."""
        self._message = bytearray()
        self._playing = bytes(512)

    def receive(self, data: bytes) -> None:
        """Take bytes, in pieces of any length."""
        for byte in data:
            if self._message or byte & 128:
                self._message.append(byte & 127)
            if len(self._message) == 512:
                self._playing = bytes(self._message)
                self._message.clear()

    def drive(self) -> torch.Tensor:
        """What the transducers play (256,): the fundamental of the pulses; 1 for phase 0 and duty 64."""
        pulses = zip(self._playing[:256], self._playing[256:], strict=True)
        return torch.tensor([_fundamental(phase, duty) for phase, duty in pulses], dtype=torch.complex128)


def _fundamental(phase: int, duty: int) -> complex:
    middle = phase + (duty - 64) / 2
    return cmath.rect(math.sin(math.pi * duty / 128), 2 * math.pi * middle / 128)
