"""The devices that a link can drive: what they hang on, and how a drive becomes bytes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch

from autdtorch.hardware.devices.frames import (
    BOARD,
    ULTRAINO_BOARD,
    levels_of_openmpd_frame,
    levels_of_sonicsurface_frame,
    levels_of_ultraino_frame,
    openmpd_frame,
    sonicsurface_frame,
    ultraino_frame,
)
from autdtorch.hardware.devices.levels import (
    openmpd_drive,
    openmpd_levels,
    sonicsurface_drive,
    sonicsurface_levels,
    ultraino_drive,
    ultraino_levels,
)
from autdtorch.hardware.devices.openmpd_board import OpenMPDBoard
from autdtorch.hardware.transport.serial_chips import FT232H, Adapter, arduino_mega, ch340, cp2102, ft232r
from autdtorch.utils.validation import integer_at_least, invalid, members

SONICSURFACE_BAUD = 230_400
ULTRAINO_BAUD = 115_200
#: A board passes frames on to the next, numbered from 1 in four bits; Ultraino's program stops here.
ULTRAINO_MOST_BOARDS = 14

_BITS = 10  # that a byte takes on a serial line: start, 8, stop


@dataclass(frozen=True)
class Device:
    """What a link has to know of a device.

    Attributes:
        name: of the device.
        adapters: USB chips that it may hang on; the first is the usual one.
        transducers: their number N.
        frame: bytes for a drive (N,), |q| <= 1, on the nearest levels. All zeros switch the outputs off.
        played: the drive (N,) that a frame has the device play.
        baud: of its serial line [bits/s]; None if it has none.
        serials: number of the chip of each of its boards, which share the frame evenly; None takes any.
    """

    name: str
    adapters: tuple[Adapter, ...]
    transducers: int
    frame: Callable[[torch.Tensor], bytes]
    played: Callable[[bytes], torch.Tensor]
    baud: int | None = None
    serials: tuple[str | None, ...] = (None,)

    def wire_time(self, frame: bytes) -> float:
        """How long a frame is on the serial line [s]; 0 without one."""
        return 0.0 if self.baud is None else _BITS * len(frame) / self.baud


def _sonicsurface(drive: torch.Tensor) -> bytes:
    return sonicsurface_frame(sonicsurface_levels(drive))


def _sonicsurface_played(frame: bytes) -> torch.Tensor:
    return sonicsurface_drive(levels_of_sonicsurface_frame(frame))


def _openmpd(drive: torch.Tensor) -> bytes:
    return openmpd_frame(openmpd_levels(drive))


def _openmpd_played(frame: bytes) -> torch.Tensor:
    return openmpd_drive(levels_of_openmpd_frame(frame))


def _ultraino(drive: torch.Tensor) -> bytes:
    return ultraino_frame(ultraino_levels(drive))


def _ultraino_played(frame: bytes) -> torch.Tensor:
    return ultraino_drive(levels_of_ultraino_frame(frame))


def openmpd_boards(boards: Sequence[OpenMPDBoard]) -> Device:
    """OpenMPD's boards as their files describe them: in the files' order, calibrated, by pin.

    Each board is found by its name as the serial number of its chip. They play a drive as their messages
    arrive, one after the other.

    Args:
        boards: one after the other, of 256 transducers each.

    Raises:
        ValueError: no board, one that is no `OpenMPDBoard`, one of another number of transducers, or two of
            the same name.
    """
    boards = members("boards", boards, OpenMPDBoard)
    names = tuple(board.name for board in boards)
    if not boards or len(set(names)) < len(names):
        raise invalid("boards", names, "must be one or more, of different names")
    for board in boards:
        if len(board.pins) != BOARD:
            raise ValueError(f"boards: {board.name} has {len(board.pins)} transducers; must be {BOARD}")

    def frame(drive: torch.Tensor) -> bytes:
        parts = zip(boards, drive.reshape(-1, BOARD), strict=True)
        return b"".join(_openmpd(board.by_pin(board.calibrated(part))) for board, part in parts)

    def played(frame: bytes) -> torch.Tensor:
        messages = (frame[start : start + 2 * BOARD] for start in range(0, len(frame), 2 * BOARD))
        return torch.cat([_heard(board, message) for board, message in zip(boards, messages, strict=True)])

    return replace(OPENMPD, transducers=BOARD * len(boards), frame=frame, played=played, serials=names)


def _heard(board: OpenMPDBoard, message: bytes) -> torch.Tensor:
    """The drive (256,) that a calibrated board makes of a message; rounding may take it above 1."""
    sent = _openmpd_played(message)[torch.tensor(board.pins, dtype=torch.int64, device="cpu")]
    return torch.where(
        sent == 0, sent, sent / board.calibrated(torch.ones(BOARD, dtype=sent.dtype, device="cpu"))
    )


def ultraino_boards(boards: int = 1) -> Device:
    """Boards Mega-64 of Ultraino in a row, 64 transducers each: 10 phases, 5 amplitudes.

    Args:
        boards: their number, 1 to 14; the first is on USB, and each passes on what is for the next.

    Raises:
        ValueError: `boards` out of range.
    """
    if integer_at_least("boards", boards, 1) > ULTRAINO_MOST_BOARDS:
        raise invalid("boards", boards, f"must be 1 to {ULTRAINO_MOST_BOARDS}")
    return Device(
        name="Ultraino",
        adapters=(arduino_mega(ULTRAINO_BAUD), ch340(ULTRAINO_BAUD)),
        transducers=ULTRAINO_BOARD * boards,
        frame=_ultraino,
        played=_ultraino_played,
        baud=ULTRAINO_BAUD,
    )


#: 16 x 16, pitch 10.5 mm; 32 phases, no amplitude. An FT232R is the adapter on most cables.
SONICSURFACE = Device(
    name="SonicSurface",
    adapters=(ft232r(SONICSURFACE_BAUD), ch340(SONICSURFACE_BAUD), cp2102(SONICSURFACE_BAUD)),
    transducers=BOARD,
    frame=_sonicsurface,
    played=_sonicsurface_played,
    baud=SONICSURFACE_BAUD,
)

#: 16 x 16, pitch 10.5 mm; 128 phases, 64 amplitudes. Transducers are in the order of the board's pins.
OPENMPD = Device(
    name="OpenMPD",
    adapters=(FT232H,),
    transducers=BOARD,
    frame=_openmpd,
    played=_openmpd_played,
)

#: One board Mega-64: 10 phases, 5 amplitudes.
ULTRAINO = ultraino_boards()
