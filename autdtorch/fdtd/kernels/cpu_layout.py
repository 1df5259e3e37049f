"""Memory layout of the boundary layers in the kernel for CPUs: flat, in the order of `cpu_sweep.py`.

The contract counts both layers of an axis inwards. Here the upper layers of y and z have the order of the
axis, which changes the sign of psi, and ends of rows are stored in lanes.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from autdtorch.fdtd.kernels.contract import Coefficients, Memory
from autdtorch.utils.array_types import AnyArray

# b and a of the half cells, then b and a of the cells, repeated as `stretch` reads them
Profile = tuple[AnyArray, AnyArray, AnyArray, AnyArray]


def rows_profile(c: Coefficients, row: int) -> Profile:
    """Return the profile of a lower layer, for rows."""
    decay, gain = c.layer_decay.numpy(), c.layer_gain.numpy()
    return decay[0::2].repeat(row), gain[0::2].repeat(row), decay[1::2].repeat(row), gain[1::2].repeat(row)


def plane_profiles(c: Coefficients, shape: torch.Size) -> tuple[AnyArray, ...]:
    """Return the profiles across y, z, and y for the lanes, of both layers each."""
    _, ny, nz = shape
    decay, gain = c.layer_decay.numpy(), c.layer_gain.numpy()
    across_z = []
    for values in (decay, gain):
        half, cell, none = values[0::2], values[1::2], np.zeros(1, values.dtype)
        halves = np.concatenate((half, none, half[::-1], none))
        cells = np.concatenate((cell, none, none, cell[::-1], none, none))
        across_z.append((np.tile(halves, ny), np.tile(cells, ny)))
    (b_half, b_cell), (a_half, a_cell) = across_z
    lanes = 2 * (c.layer_cells + 2)
    return *_both_rows(c, nz), b_half, a_half, b_cell, a_cell, *_both_rows(c, lanes)


def _both_rows(c: Coefficients, row: int) -> Profile:
    """Return the profiles of a lower and an upper layer of rows, with a row of zeros after their cells."""
    low = rows_profile(c, row)
    none = np.zeros(row, low[0].dtype)
    high = [part.reshape(-1, row)[::-1].ravel() for part in low]
    b_half, a_half = (np.concatenate((low[part], high[part])) for part in (0, 1))
    b_cell, a_cell = (np.concatenate((low[part], none, high[part], none)) for part in (2, 3))
    return b_half, a_half, b_cell, a_cell


class FlatMemory:
    """Memory of the layers, copied from a state: psi and zeta of x, y, ends of rows, and y for these."""

    def __init__(self, memory: Memory) -> None:
        """Copy the memory of a state, except the x layers, which are used in place."""
        self._layers = [[part.numpy() for part in layer] for layer in memory[:4]]
        x, (psi_y, zeta_y), (psi_z, _), (psi_yz, zeta_yz) = self._layers
        nx, ny, layer_cells = len(psi_z[0]), psi_z.shape[2], psi_z.shape[3] - 1
        lanes = 2 * (layer_cells + 2)
        of_yz = ((*part.shape[:3], lanes) for part in (psi_yz, zeta_yz))
        sizes = (psi_y.shape, zeta_y.shape, *2 * ((nx, ny, lanes),), *of_yz)
        self.arrays = (*x, *(np.zeros(size, psi_y.dtype) for size in sizes))
        for here, there, sign in self._pairs():
            here[...] = sign * there

    def give_back(self) -> None:
        """Copy back to the state."""
        for here, there, sign in self._pairs():
            there[...] = sign * here

    def _pairs(self) -> Iterator[tuple[AnyArray, AnyArray, int]]:
        """Yield views of the arrays and of the state; psi of upper layers changes its sign."""
        for half, number in ((True, 2), (False, 3)):
            y, z, yz = self.arrays[number], self.arrays[number + 2], self.arrays[number + 4]
            _, of_y, of_z, of_yz = (layer[not half] for layer in self._layers)
            reach = z.shape[-1] // 2
            cells = reach - 2
            upper = -1 if half else 1
            first, last = (0, reach - 1) if half else (1, reach - 1)
            low, high = slice(first, last), slice(reach + first, reach + last)
            yield z[..., low], of_z[0], 1
            yield z[..., high][..., ::-1], of_z[1], upper
            for side, sign, order in ((0, 1, slice(None)), (1, upper, slice(None, None, -1))):
                yield y[side][:, order], of_y[side], sign
                yield yz[side][:, order, 1 : cells + 1], of_yz[side][..., :cells], sign
                yield yz[side][:, order, reach + 1 : -1][..., ::-1], of_yz[side][..., cells:], sign
