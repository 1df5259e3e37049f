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
