"""The order in which devices number their transducers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def sonicsurface_channels() -> NDArray[np.intp]:
    """FPGA channel (256,) of each transducer of a SonicSurface, row by row.

    A channel block of 64 drives four columns, and in it a block of eight drives two rows. Source: the table
    in upnalab/SonicSurface, ControlSoftware/Python/SonicSurface.py, which this rule reproduces.
    """
    row, column = np.indices((16, 16))
    in_block = np.array([[0, 7, 1, 2], [4, 3, 6, 5]])
    channels: NDArray[np.intp] = 64 * (column // 4) + 8 * (row // 2) + in_block[row % 2, column % 4]
    return channels.ravel()


def ultraino_pins() -> NDArray[np.intp]:
    """Pin (64,) of the Arduino's ports of each transducer of an Ultraino Mega-64: 8 times the port, plus bit.

    The ports are A, C, L, B, K, F, H, D, G, J. Source: the wiring of the board, PORT_MAPPING in
    asiermarzo/Ultraino, ArduinoMEGA64.java. Its phase compensation is zero everywhere.
    """
    blocks = [
        *(range(51, 55), range(28, 32), range(47, 39, -1), range(56, 60), (48, 49, 72, 69)),
        *(range(39, 31, -1), (21, 23, 65, 63), range(9, 16, 2), (20, 22, 64, 66), range(8, 15, 2)),
        *(range(24, 28), range(16, 20), range(7, -1, -1)),
    ]
    return np.concatenate(blocks)
