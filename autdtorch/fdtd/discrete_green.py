"""The discrete Green's function: the field on the grid, in air, of a source that lies on one cell.

It solves sum_j g_j (u_j - u) + L u = -4 pi L' / (2 k h) at the cell of the source, and 0 at all others, with
the stencil's symbol L and its slope L' at k h (`stencil.py`). At one and two cells it differs from e^{ikr} /
r by 1 %; from five cells on, only by the dispersion of the grid. So a cube of cells suffices. At its faces
u - e^{ikh} u_before is taken from the exact field, which leaves no resonance. By symmetry, the cells
x >= y >= z >= 0 are the unknowns.
"""

from __future__ import annotations

import itertools
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fftn, ifftn, next_fast_len  # scipy.signal loads slowly

from autdtorch.fdtd.interpolation import GridShape, Interpolation
from autdtorch.fdtd.stencil import OFFSETS, Stencil, places_of
from autdtorch.utils.array_types import ComplexArray, Index

_REACH = 12
"""Cells from the source to the faces of the cube. With 18, the field at 8 cells changes by less than 1e-4
from 6 cells per wavelength on."""

_BESIDE = 7  # Cells around a source, 9 from a point at least, where the grid gives its field


@lru_cache(maxsize=64)
def discrete_green(stencil: Stencil) -> ComplexArray:
    """Return the field [1 / h] at cells (x, y, z) from the source, each of 0 to `_REACH`."""
    axis = range(_REACH + 1)
    cells = np.array([(x, y, z) for x, y, z in itertools.product(axis, repeat=3) if x >= y >= z])
    number = np.zeros((_REACH + 1,) * 3, np.int64)
    for order in itertools.permutations(range(3)):
        number[tuple(cells[:, order].T)] = np.arange(len(cells))
    wavenumber = complex(stencil.kappa, stencil.eta)
    on_face = cells[:, 0] == _REACH
    inner, face, before = np.flatnonzero(~on_face), np.flatnonzero(on_face), cells[on_face] - (1, 0, 0)
    turn = np.exp(1j * wavenumber)
    system, field = np.zeros((len(cells), len(cells)), np.complex128), np.zeros(len(cells), np.complex128)
    for offset, weight in zip(OFFSETS, stencil.weights, strict=True):
        np.add.at(system, (inner, number[tuple(abs(cells[inner] + offset).T)]), weight)
    system[inner, inner] += complex(stencil.symbol, stencil.loss) - stencil.total
    field[0] = -2 * np.pi * stencil.slope / wavenumber
    system[face, face] = 1
    system[face, number[tuple(before.T)]] -= turn
    field[face] = _exact(stencil, cells[face]) - turn * _exact(stencil, before)
    return np.asarray(np.linalg.solve(system, field)[number], np.complex128)


def field_of_kernels(
    kernels: Interpolation, cells: Index, shape: GridShape, stencil: Stencil
) -> tuple[NDArray[np.bool_], ComplexArray]:
    """Return the mask (n,) of the cells (n, 3) near a source between cells, and its field [1 / h] there (m,).

    The source is spread over the cells of some kernels; without any weight it has no field.
    """
    loud = kernels.weight != 0
    places, weight = places_of(kernels.index[loud], shape), kernels.weight[loud]
    if not len(weight):
        return np.ones(len(cells), bool), np.zeros(len(cells), np.complex128)
    low, high = places.min(axis=0), places.max(axis=0)
    density = np.zeros(high - low + 1)
    np.add.at(density, tuple((places - low).T), weight)
    near = np.asarray(((cells >= low - _BESIDE) & (cells <= high + _BESIDE)).all(axis=1))
    field = _green_around(stencil, *(high - low + _BESIDE).tolist())
    lengths = [next_fast_len(length) for length in field.shape]
    wave = ifftn(fftn(field, lengths) * fftn(density, lengths))  # not wrapped from the density's size on
    return near, np.asarray(wave[tuple((cells[near] - low + _BESIDE + density.shape - 1).T)])


@lru_cache(maxsize=8)
def _green_around(stencil: Stencil, *reach: int) -> ComplexArray:
    """Return the field [1 / h] at cells up to `reach` from the source on both sides, exact far from it."""
    offsets = np.abs(np.moveaxis(np.indices([2 * each + 1 for each in reach]), 0, -1) - np.array(reach))
    beside = (offsets <= _REACH).all(axis=-1)
    field = np.empty(beside.shape, np.complex128)
    field[beside] = discrete_green(stencil)[tuple(offsets[beside].T)]
    field[~beside] = _exact(stencil, offsets[~beside])
    return field


def _exact(stencil: Stencil, cells: Index) -> ComplexArray:
    """Return e^{ikr} / r [1 / h] at cells (n, 3) from the source."""
    distance = np.linalg.norm(cells, axis=1)
    wave: ComplexArray = np.exp(1j * complex(stencil.kappa, stencil.eta) * distance) / distance
    return wave
