"""Ultraino Mega-64: 64 transducers a board, 10 phases, 5 amplitudes; boards in a row on a serial line."""

from __future__ import annotations

import cmath
import itertools
import math
from functools import cache
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray

from autdtorch.hardware.devices.device import Device, Firmware
from autdtorch.hardware.transport.serial_chips import arduino_mega
from autdtorch.scene.drive import PhaseLevels

_BOARD, _BAUD = 64, 115_200
_TENTHS, _PORTS = 10, 10  # of a period; of 8 pins
# The end of a frame: emit the first pattern for 1 period, the second for 0, which ends the cycle (each in
# four bytes of two bits), commit that, and switch to the new pattern.
_END = bytes([0x30, 0x30, 0x30, 0x70, 0x30, 0x30, 0x30, 0x30, 0x10, 0x00])


class _Ultraino(Device):
    """A frame is a pattern for each board, and the commands that start it.

    A pattern is a byte for each port in each tenth of a period. A byte goes out as its upper, then its lower
    half, each above the number of the board, from 1.
    """

    keys = ("boards",)

    def pack(self, *levels: torch.Tensor) -> bytes:
        phase, duty = (level.reshape(-1, self.boards, 1, _BOARD) for level in levels)
        tenth = torch.arange(_TENTHS, device="cpu")[:, None]
        pins = np.zeros((len(phase), self.boards, _TENTHS, 8 * _PORTS), np.uint8)
        pins[..., ultraino_pins()] = ((tenth - phase) % _TENTHS < duty).numpy()
        halves = np.packbits(pins, axis=-1, bitorder="little")[..., None] << np.array([0, 4], np.uint8) & 0xF0
        numbers = np.arange(1, self.boards + 1, dtype=np.uint8)[:, None, None, None]
        patterns = (halves | numbers).reshape(len(phase), -1)
        ends = np.tile(np.frombuffer(_END, np.uint8), (len(phase), 1))
        return np.hstack([patterns, ends]).tobytes()

    def firmware(self, transducers: int) -> Firmware:
        return _UltrainoFirmware(transducers // _BOARD)


class _UltrainoFirmware:
    """Boards in a row (DriverMEGA.ino).

    A board starts with all pins high in the first half of the period. It takes bytes whose low half is 1, and
    passes others on, less 1; commands are passed on unchanged. Of two buffers of 32 patterns, one is emitted,
    each pattern for its duration in periods, and the other is written. Only the switch of the buffers moves
    writing back to the start.
    """

    baud: ClassVar[int | None] = 115_200

    _PORTS, _TENTHS, _PATTERNS = 10, 10, 32
    _SWITCH, _COMMIT_DURATIONS, _DURATION, _DURATION_MASK = 0x00, 0x10, 0x30, 0x3F

    def __init__(self, boards: int = 1) -> None:
        size = self._PATTERNS * self._TENTHS * self._PORTS
        self._playing, self._waiting = bytearray(size), bytearray(size)
        self._playing[: self._PORTS * self._TENTHS // 2] = b"\xff" * (self._PORTS * self._TENTHS // 2)
        self._durations = self._waiting_durations = [1] + [0] * (self._PATTERNS - 1)
        self._written = self._durations_written = 0
        self._next = _UltrainoFirmware(boards - 1) if boards > 1 else None

    def receive(self, data: bytes) -> None:
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
        """Return the drive (64 n,): the fundamental; 1 for a pulse of the period's first half."""
        durations = self._durations[:1] + list(itertools.takewhile(bool, self._durations[1:]))
        size = self._TENTHS * self._PORTS
        cycle = [
            duration * self._fundamentals(self._playing[size * number :][:size])
            for number, duration in enumerate(durations)
        ]
        drive = torch.stack(cycle).sum(dim=0) / sum(durations)
        return drive if self._next is None else torch.cat([drive, self._next.drive()])

    def _fundamentals(self, pattern: bytearray) -> torch.Tensor:
        bits = np.unpackbits(np.frombuffer(pattern, np.uint8), bitorder="little")
        high = bits.reshape(self._TENTHS, -1)[:, ultraino_pins()]
        turn = 2j * math.pi / self._TENTHS
        played = np.stack([on * cmath.exp(turn * (tenth - 2)) for tenth, on in enumerate(high)]).sum(axis=0)
        return torch.from_numpy(math.sin(math.pi / self._TENTHS) * played)


@cache
def ultraino_pins() -> NDArray[np.intp]:
    """Return the pin (64,) of the Arduino's ports of each transducer: 8 times the port, plus the bit.

    The ports are A, C, L, B, K, F, H, D, G, J. Source: the wiring of the board, PORT_MAPPING in
    asiermarzo/Ultraino, ArduinoMEGA64.java. Its phase compensation is zero everywhere.
    """
    blocks = [
        *(range(51, 55), range(28, 32), range(47, 39, -1), range(56, 60), (48, 49, 72, 69)),
        *(range(39, 31, -1), (21, 23, 65, 63), range(9, 16, 2), (20, 22, 64, 66), range(8, 15, 2)),
        *(range(24, 28), range(16, 20), range(7, -1, -1)),
    ]
    return np.concatenate(blocks)


#: One board; the first is on USB, and each passes on the bytes of the next, numbered from 1 in four bits.
#: The program of Ultraino stops at 14 boards. It makes the duty proportional to the amplitude, and lets the
#: centre of a pulse move with its duty.
ULTRAINO = _Ultraino(
    name="Ultraino",
    board=_BOARD,
    phase_levels=PhaseLevels(_TENTHS, _TENTHS // 2, pulses=True),
    columns=("phase", "duty"),
    adapters=(arduino_mega(_BAUD),),
    baud=_BAUD,
    boot_time=2.0,  # opening its port resets the Arduino, whose boot loader waits for a program
    most_boards=14,
)


def ultraino_boards(boards: int = 1) -> Device:
    """Return 1 to 14 boards Mega-64 of Ultraino in a row, 64 transducers each; else `ValueError`."""
    return ULTRAINO.with_boards(boards)
