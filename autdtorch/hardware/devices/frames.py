"""Bytes on the wire to and from the levels of a device, `levels`."""

from __future__ import annotations

import numpy as np
import torch

from autdtorch.hardware.devices.levels import ULTRAINO_PHASES, Levels
from autdtorch.hardware.devices.order import sonicsurface_channels, ultraino_pins

#: Transducers of a board of SonicSurface or OpenMPD, and of Ultraino.
BOARD, ULTRAINO_BOARD = 256, 64

_START, _COMMIT = 0xFE, 0xFD
_FIRST = 0x80  # on the first byte of a message to OpenMPD

_ULTRAINO_PORTS = 10  # of 8 pins
_ULTRAINO_BYTES = ULTRAINO_PHASES * _ULTRAINO_PORTS
# What ends a frame: play the first pattern for 1 period, the second for 0, which ends the cycle (each in four
# bytes, two bits in each), commit that, and switch to the new pattern.
_ULTRAINO_END = bytes([0x30, 0x30, 0x30, 0x70, 0x30, 0x30, 0x30, 0x30, 0x10, 0x00])


def sonicsurface_frame(levels: torch.Tensor) -> bytes:
    """A frame for a SonicSurface: 0xFE, a level for each FPGA channel, 0xFD to play them.

    Args:
        levels: (256,), from `sonicsurface_levels`, row by row.

    Raises:
        ValueError: another shape.
    """
    _require_board("levels", levels)
    bytes_by_channel = np.empty(BOARD, np.uint8)
    bytes_by_channel[sonicsurface_channels()] = levels.numpy()
    return bytes([_START, *bytes_by_channel, _COMMIT])


def levels_of_sonicsurface_frame(frame: bytes) -> torch.Tensor:
    """Levels (256,), int64, row by row, of a frame; inverse of `sonicsurface_frame`.

    Raises:
        ValueError: bytes that are not such a frame.
    """
    if len(frame) != BOARD + 2 or frame[0] != _START or frame[-1] != _COMMIT:
        raise ValueError(f"frame: {_shown(frame)}; must be 0xfe, {BOARD} bytes, 0xfd")
    return torch.from_numpy(np.frombuffer(frame, np.uint8)[1:-1][sonicsurface_channels()].astype(np.int64))


def openmpd_frame(levels: Levels) -> bytes:
    """A message for a board of OpenMPD: 256 phases, of which the first carries bit 7, then 256 duties.

    Args:
        levels: (256,), from `openmpd_levels`, in the order of the board's pins.

    Raises:
        ValueError: another shape.
    """
    for name, values in levels._asdict().items():
        _require_board(f"levels.{name}", values)
    message = bytearray(torch.cat([levels.phase, levels.amplitude]).to(torch.uint8).numpy().tobytes())
    message[0] |= _FIRST
    return bytes(message)


def levels_of_openmpd_frame(frame: bytes) -> Levels:
    """Levels (256,), in the order of the pins, of a message; inverse of `openmpd_frame`.

    Raises:
        ValueError: bytes that are not such a message.
    """
    if len(frame) != 2 * BOARD or not frame[0] & _FIRST:
        raise ValueError(f"frame: {_shown(frame)}; must be {2 * BOARD} bytes, the first above 127")
    # Bit 7 of later bytes is for the lamp and the rate.
    levels = torch.from_numpy(np.frombuffer(frame, np.uint8).astype(np.int64) & ~_FIRST)
    return Levels(levels[:BOARD], levels[BOARD:])


def ultraino_frame(levels: Levels) -> bytes:
    """A frame for boards of Ultraino, Mega-64: what each pin does in a period, and the command to play it.

    A pattern is a byte for each port in each tenth of a period; a byte goes out as its upper, then its lower
    half, each above the number of the board, from 1.

    Args:
        levels: (64 n,) of n boards, from `ultraino_levels`.

    Raises:
        ValueError: another shape.
    """
    for name, values in levels._asdict().items():
        if values.ndim != 1 or len(values) % ULTRAINO_BOARD or not len(values):
            shape = tuple(values.shape)
            raise ValueError(f"levels.{name}: shape {shape}; must be ({ULTRAINO_BOARD} n,) of n boards")
    tenth = torch.arange(ULTRAINO_PHASES, device="cpu")[:, None]
    high = (tenth - levels.phase) % ULTRAINO_PHASES < levels.amplitude
    frame = bytearray()
    for board in range(high.shape[1] // ULTRAINO_BOARD):
        pins = np.zeros((ULTRAINO_PHASES, 8 * _ULTRAINO_PORTS), np.uint8)
        pins[:, ultraino_pins()] = high[:, ULTRAINO_BOARD * board :][:, :ULTRAINO_BOARD].numpy()
        halves = np.packbits(pins, bitorder="little")[:, None] << np.array([0, 4], np.uint8) & 0xF0
        frame += (halves | board + 1).tobytes()
    return bytes(frame) + _ULTRAINO_END


def levels_of_ultraino_frame(frame: bytes) -> Levels:
    """Levels (64 n,), int64, of a frame; inverse of `ultraino_frame`.

    Raises:
        ValueError: bytes that are not such a frame.
    """
    boards, rest = divmod(len(frame) - len(_ULTRAINO_END), 2 * _ULTRAINO_BYTES)
    data = np.frombuffer(frame, np.uint8)[: len(frame) - len(_ULTRAINO_END)]
    numbers = np.repeat(np.arange(1, boards + 1), 2 * _ULTRAINO_BYTES)
    if boards < 1 or rest or not frame.endswith(_ULTRAINO_END) or (data & 0x0F != numbers).any():
        raise ValueError(
            f"frame: {_shown(frame)}; must be {2 * _ULTRAINO_BYTES} bytes a board, numbered from 1 in their "
            f"lower half, then {_ULTRAINO_END.hex(' ')}"
        )
    halves = (data & 0xF0).astype(np.uint8).reshape(boards, ULTRAINO_PHASES, _ULTRAINO_PORTS, 2)
    pins = np.unpackbits(halves[..., 0] | halves[..., 1] >> np.uint8(4), axis=-1, bitorder="little")
    high = pins[..., ultraino_pins()].astype(np.int64)
    begins = (high > np.roll(high, 1, axis=1)).argmax(axis=1)
    return Levels(torch.from_numpy(begins.ravel()), torch.from_numpy(high.sum(axis=1).ravel()))


def _require_board(name: str, values: torch.Tensor) -> None:
    if values.shape != (BOARD,):
        raise ValueError(f"{name}: shape {tuple(values.shape)}; must be ({BOARD},)")


def _shown(frame: bytes) -> str:
    return f"{len(frame)} bytes, {frame[:2].hex(' ')} ... {frame[-1:].hex()}"
