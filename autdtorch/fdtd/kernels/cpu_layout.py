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


def plane_profiles(c: Coefficients, shape: torch.Size, planes: int) -> tuple[Profile, Profile, Profile]:
    """Return the profiles across y, z, and y for the lanes, of both layers each, for some planes."""
    _, ny, nz = shape
    decay, gain = c.layer_decay.numpy(), c.layer_gain.numpy()
    lanes, none = 2 * (c.layer_cells + 2), np.zeros(1, decay.dtype)
    halves = [np.concatenate((half, none, half[::-1], none)) for half in (decay[0::2], gain[0::2])]
    cells = [np.concatenate((cell, none, none, cell[::-1], none, none)) for cell in (decay[1::2], gain[1::2])]

    def profile(row: int, times: int) -> Profile:
        b_half, a_half, b_cell, a_cell = (np.tile(part.repeat(row), times) for part in (*halves, *cells))
        return b_half, a_half, b_cell, a_cell

    return profile(nz, planes), profile(1, planes * ny), profile(lanes, planes)


class FlatMemory:
    """Memory of the layers, copied from a state: psi and zeta of x, y, ends of rows, and y for these."""

    def __init__(self, memory: Memory) -> None:
        """Copy the memory of a state, except the x layers, which are used in place."""
        self._layers = [[part.numpy() for part in layer] for layer in memory[:4]]
        x, (psi_y, _), (psi_z, _), _ = self._layers
        _, nx, ny, cells = psi_z.shape
        nz, lanes = psi_y.shape[-1], 2 * (cells + 1)
        sizes = ((nx, lanes, nz), (nx, ny, lanes), (nx, lanes, lanes))
        self.arrays = (*x, *(np.zeros(size, psi_y.dtype) for size in sizes for _ in range(2)))
        for here, there, sign in self._pairs():
            here[...] = sign * there

    def give_back(self) -> None:
        """Copy back to the state."""
        for here, there, sign in self._pairs():
            there[...] = sign * here

    def _pairs(self) -> Iterator[tuple[AnyArray, AnyArray, int]]:
        """Yield views of the arrays and of the state; psi of upper layers changes its sign."""
        for part in (0, 1):
            y, z, yz = self.arrays[2 + part :: 2]
            _, of_y, of_z, of_yz = (layer[part] for layer in self._layers)
            reach = z.shape[-1] // 2
            upper = 1 if part else -1
            low, high = slice(part, reach - 1), slice(reach + part, 2 * reach - 1)
            inner, outer = slice(1, reach - 1), slice(reach + 1, 2 * reach - 1)
            for side, along, sign, order in ((0, low, 1, 1), (1, high, upper, -1)):
                yield y[:, along][:, ::order], of_y[side], sign
                yield z[..., along][..., ::order], of_z[side], sign
                yield yz[:, along, inner][:, ::order], of_yz[side][..., : reach - 2], sign
                yield yz[:, along, outer][:, ::order, ::-1], of_yz[side][..., reach - 2 :], sign
