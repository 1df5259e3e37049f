"""What devices do with the bytes they are sent, for the emulator.

Written from the firmwares alone, not from `frames`, so that the one checks the other.
"""

from __future__ import annotations

import cmath
import itertools
import math
from typing import ClassVar, Protocol

import torch

from autdtorch.hardware.devices.order import sonicsurface_channels, ultraino_pins


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
        return torch.tensor(played, dtype=torch.complex128, device="cpu")[
            torch.from_numpy(sonicsurface_channels())
        ]

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
        return torch.tensor(
            [_fundamental(phase, duty) for phase, duty in pulses], dtype=torch.complex128, device="cpu"
        )


class UltrainoFirmware:
    """Boards Mega-64 of Ultraino in a row (DriverMEGA.ino).

    A board starts with all pins high in the first half of the period. Bytes whose lower half is 1 are for it;
    others it passes on, less 1, and commands as they are. There are two buffers of 32 patterns: one plays,
    pattern after pattern for their durations in periods, the other is written to. Where it is written goes
    back to the start by the switch alone.
    """

    baud: ClassVar[int | None] = 115_200

    _PORTS, _TENTHS, _PATTERNS = 10, 10, 32
    _SWITCH, _COMMIT_DURATIONS, _DURATION, _DURATION_MASK = 0x00, 0x10, 0x30, 0x3F

    def __init__(self, boards: int = 1) -> None:
        """Switch `boards` boards on."""
        size = self._PATTERNS * self._TENTHS * self._PORTS
        self._playing, self._waiting = bytearray(size), bytearray(size)
        self._playing[: self._PORTS * self._TENTHS // 2] = b"\xff" * (self._PORTS * self._TENTHS // 2)
        self._durations = self._waiting_durations = [1] + [0] * (self._PATTERNS - 1)
        self._written = self._durations_written = 0
        self._next = UltrainoFirmware(boards - 1) if boards > 1 else None

    def receive(self, data: bytes) -> None:
        """Take bytes, in pieces of any length."""
        for byte in data:
            self._take(byte)

    def _take(self, byte: int) -> None:
        passed_on = byte
        if byte == self._SWITCH:
            self._playing, self._waiting = self._waiting, self._playing
            self._written = self._durations_written = 0
        elif byte & 0x0F == 1:
            place, lower = divmod(self._written, 2)
            old = self._waiting[place] if lower else 0
            self._waiting[place] = old | (byte >> 4 if lower else byte & 0xF0)
            self._written += 1
            return
        elif byte & self._DURATION_MASK == self._DURATION:
            place, part = divmod(self._durations_written, 4)
            durations = list(self._waiting_durations)
            durations[place] = (durations[place] if part else 0) | (byte & 0xC0) >> 2 * part
            self._waiting_durations = durations
            self._durations_written += 1
        elif byte == self._COMMIT_DURATIONS:
            self._durations = self._waiting_durations
            self._durations_written = 0
        else:
            passed_on = byte - 1
        if self._next is not None:
            self._next._take(passed_on)

    def drive(self) -> torch.Tensor:
        """What the transducers play (64 n,): the fundamental; 1 for a pulse of the period's first half."""
        durations = self._durations[:1] + list(itertools.takewhile(bool, self._durations[1:]))
        size = self._TENTHS * self._PORTS
        cycle = [
            duration * self._fundamentals(self._playing[size * number :][:size])
            for number, duration in enumerate(durations)
        ]
        own = torch.stack(cycle).sum(dim=0) / sum(durations)
        return own if self._next is None else torch.cat([own, self._next.drive()])

    def _fundamentals(self, pattern: bytearray) -> torch.Tensor:
        turn = 2j * math.pi / self._TENTHS
        played = [0j] * 64
        for transducer, pin in enumerate(ultraino_pins()):
            port, bit = divmod(int(pin), 8)
            high = [pattern[self._PORTS * tenth + port] >> bit & 1 for tenth in range(self._TENTHS)]
            sum_ = sum(on * cmath.exp(turn * (tenth - 2)) for tenth, on in enumerate(high))
            played[transducer] = math.sin(math.pi / self._TENTHS) * sum_
        return torch.tensor(played, dtype=torch.complex128, device="cpu")


class Autd3Firmware:
    """Boards of AUTD3 behind their kit, which hands over the phases of all, then the intensities of all.

    What the kit sends in between is its own; its emulator (`autd3_emulator`) is the check of the levels.
    """

    baud: ClassVar[int | None] = None

    def __init__(self, transducers: int) -> None:
        """Switch boards of so many `transducers` on: they are silent until they are sent a pattern."""
        self._playing = bytes(2 * transducers)

    def receive(self, data: bytes) -> None:
        """Take a pattern."""
        self._playing = data

    def drive(self) -> torch.Tensor:
        """What the transducers play (N,): phase n / 256 of a period, amplitude i / 255."""
        half = len(self._playing) // 2
        levels = zip(self._playing[:half], self._playing[half:], strict=True)
        played = [cmath.rect(intensity / 255, 2 * math.pi * phase / 256) for phase, intensity in levels]
        return torch.tensor(played, dtype=torch.complex128, device="cpu")


def _fundamental(phase: int, duty: int) -> complex:
    middle = phase + (duty - 64) / 2
    return cmath.rect(math.sin(math.pi * duty / 128), 2 * math.pi * middle / 128)
