"""OpenMPD: 16 x 16 transducers a board, pitch 10.5 mm, 128 phases, 64 amplitudes; a FIFO on USB."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch

from autdtorch.hardware.devices.device import Device, Firmware
from autdtorch.hardware.devices.openmpd_board import OpenMPDBoard
from autdtorch.hardware.transport.serial_chips import FT232H
from autdtorch.scene.phase_levels import PhaseLevels
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.validation import ArrayLike, complex_tensor, invalid, members

_BOARD = 256
_FIRST = 0x80  # on the first byte of a message; on later bytes it sets lamp and rate


@dataclass(frozen=True)
class _OpenMPD(Device):
    """A message to a board is 256 phases, the first of them with bit 7, then 256 duties, by pin.

    Without `files`, which describe the boards, transducers are in the order of the pins.
    """

    files: tuple[OpenMPDBoard, ...] = ()

    def levels(self, drive: ArrayLike) -> tuple[torch.Tensor, ...]:
        if self.files:
            parts = zip(self.files, torch.split(complex_tensor("drive", drive), _BOARD, -1), strict=True)
            drive = torch.cat([file.by_pin(file.calibrated(part)) for file, part in parts], dim=-1)
        return super().levels(drive)

    def drive(self, *levels: ArrayLike) -> torch.Tensor:
        sent = super().drive(*levels)
        if not self.files:
            return sent
        ones = torch.ones(_BOARD, **COMPLEX)
        parts = zip(self.files, torch.split(sent, _BOARD, -1), strict=True)
        by_file = torch.cat([part[..., list(file.pins)] for file, part in parts], dim=-1)
        factors = torch.cat([file.calibrated(ones) for file in self.files])
        return torch.where(by_file == 0, by_file, by_file / factors)  # rounding may take it above 1

    def pack(self, *levels: torch.Tensor) -> bytes:
        by_board = torch.cat([level.reshape(-1, _BOARD) for level in levels], dim=1)
        frame = bytearray(by_board.to(torch.uint8).numpy().tobytes())
        for first in range(0, len(frame), 2 * _BOARD):
            frame[first] |= _FIRST
        return bytes(frame)

    def firmware(self, transducers: int) -> Firmware:
        return _OpenMPDFirmware()


class _OpenMPDFirmware:
    """A board that emits pulses, which begin at a phase and last for a duty, both in 1/128 of a period.

    Bit 7 begins a message where one is due; bits 7 of later bytes, which set lamp and rate, are ignored.
    """

    baud: ClassVar[int | None] = None

    def __init__(self) -> None:
        self._message = bytearray()
        self._playing = bytes(512)

    def receive(self, data: bytes) -> None:
        for byte in data:
            if self._message or byte & 128:
                self._message.append(byte & 127)
            if len(self._message) == 512:
                self._playing = bytes(self._message)
                self._message.clear()

    def drive(self) -> torch.Tensor:
        """Return the drive (256,): the fundamental of the pulses; 1 for phase 0 and duty 64."""
        pulses = zip(self._playing[:256], self._playing[256:], strict=True)
        played = [
            cmath.rect(math.sin(math.pi * duty / 128), 2 * math.pi * (phase + (duty - 64) / 2) / 128)
            for phase, duty in pulses
        ]
        return torch.tensor(played, **COMPLEX)


#: One board, by pin. OpenMPD's solver (`discretise`) has the same levels, but truncates where this rounds.
OPENMPD = _OpenMPD(
    name="OpenMPD",
    board=_BOARD,
    phase_levels=PhaseLevels(128, 64, pulses=True),
    columns=("phase", "duty"),
    adapters=(FT232H,),
)


def openmpd_boards(boards: Sequence[OpenMPDBoard]) -> Device:
    """Return `boards` of OpenMPD as their files describe them: in the files' order, calibrated, by pin.

    A board has 256 transducers, and is found by its name as the serial number of its chip. Boards change over
    one after the other, as their messages arrive.

    `ValueError` for no board, one of another number of transducers, or two of the same name.
    """
    boards = members("boards", boards, OpenMPDBoard)
    names = tuple(board.name for board in boards)
    if not boards or len(set(names)) < len(names):
        raise invalid("boards", names, "must be one or more, of different names")
    for board in boards:
        if len(board.pins) != _BOARD:
            raise ValueError(f"boards: {board.name} has {len(board.pins)} transducers; must be {_BOARD}")
    return replace(OPENMPD, boards=len(boards), serials=names, files=boards)
