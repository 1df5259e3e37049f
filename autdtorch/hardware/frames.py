"""Bytes on the wire to and from the levels of a device, `levels`, of one board of 256 transducers."""

from __future__ import annotations

import numpy as np
import torch

from autdtorch.hardware.levels import Levels
from autdtorch.hardware.order import sonicsurface_channels

BOARD = 256

_START, _COMMIT = 0xFE, 0xFD
_FIRST = 0x80  # on the first byte of a message to OpenMPD


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


def _require_board(name: str, values: torch.Tensor) -> None:
    if values.shape != (BOARD,):
        raise ValueError(f"{name}: shape {tuple(values.shape)}; must be ({BOARD},)")


def _shown(frame: bytes) -> str:
    return f"{len(frame)} bytes, {frame[:2].hex(' ')} ... {frame[-1:].hex()}"
