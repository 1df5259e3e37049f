"""The perfectly matched layer around a grid, its absorbing layer: thickness, and profile at one frequency.

Along its axis a layer replaces the second difference d2 by g d(g d), with
g = 1 / (1 + sigma / (alpha - i w)). In time this takes two memory variables (CPML of second order: Komatitsch
& Martin 2007, Pasalic & McGarry 2010):

    psi  <- b psi  + a (u[l+1] - u[l])                      between the cells.
    zeta <- b zeta + a (u[l+1] - 2 u[l] + u[l-1] + psi[l+1/2] - psi[l-1/2])        at the cells.
    d2 u <- d2 u + psi[l+1/2] - psi[l-1/2] + zeta.

E_a u is the term that the layer adds to d2 u. In the 27-point sum, T_a + E_a replaces every sum T_a of the
two neighbours along axis a, in products too. This is the exact complex stretching of the *discrete* equation,
edges and corners of the grid included (`docs/numerics.md`).

A layer repeats the cells that it touches, so the stencil row of a cell is constant along the layer's normal.
The kernels stretch rows as in air, scaled to the sum of the cell's weights: exact inside an obstacle. At an
interface the difference of a row from that is stretched here, by column, with a separate memory. Where two
layers meet, the difference has a part in the product of both stretchings: columns of one layer cross columns
of the other and add to their sums. Without it, waves along interfaces grow.
"""

from __future__ import annotations

import itertools
import math
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares

from autdtorch.fdtd.kernels.contract import Columns
from autdtorch.fdtd.stencil import OFFSETS, Stencil, flat_strides, places_of
from autdtorch.utils.array_types import Array, Index

# Angles of incidence at which the profile is fitted [rad]
TUNED_ANGLES = np.radians((0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 55.0, 60.0, 65.0, 70.0, 75.0, 80.0))
# Strength and order of the power-law profiles that the fit starts from; the one better after so many
# evaluations goes on. Both to the end take 1.7 times as long, for as little reflection.
_STARTS = ((10.0, 1.5), (20.0, 2.5))
_FIRST_EVALUATIONS, _MOST_EVALUATIONS = 8, 60
# Frequency shift alpha over w next to the interior and at the outer end, linear in between (Komatitsch &
# Martin 2007). At frequencies above alpha a layer gives energy to evanescent waves: with a small shift the
# near field of a light obstacle grows. The fit alone would choose 0.01 everywhere, which gives ten times as
# much energy; 0.3 would cost 16 dB of reflection. With 0.1 everywhere, a very light obstacle that pulsates
# far below the drive frequency grows too. The smaller shift at the outer end damps it, and leaves 1 to 3 dB
# less reflection.
_SHIFT, _OUTER_SHIFT = 0.2, 0.05
_DIFFERENCE = 1e-7  # Step of the logarithms of the damping, for numerical derivatives
_BOUNDS = (-14.0, 6.0)  # Range of the logarithms of the damping over w: from none to opaque
_ROUNDING = 1e-6  # Differences from scaled air below this, relative to a face's weight, are rounding
# The absorbing layers: their axis, and 1 for the one at its upper end
_LAYERS = tuple(itertools.product(range(3), (0, 1)))
# Columns of one layer: cells in the ring (m,), step inwards, weights (m, w) and offsets (w,)
_Part = tuple[Index, int, Array, Index]


class Thickness(NamedTuple):
    """Cells of a layer, of fine grids and of those with fewer cells per wavelength than `limit`."""

    fine: int
    coarse: int
    limit: float = 6.0

    def cells(self, kappa: float) -> int:
        """Return the cells at a wavenumber times spacing `kappa` [rad]."""
        return self.fine if kappa <= 2 * math.pi / self.limit else self.coarse


# The layer of a domain. From 6 cells per wavelength on, its reflection to 60 degrees is below -68 dB (-82 dB
# from 8.5 cells per wavelength on); of coarser grids -66 dB at 4.25 cells and -32 dB at 3.
DOMAIN_LAYER = Thickness(6, 8)
# The layers of boxes around bodies with longest sides up to so many wavelengths, and around larger ones. The
# first's reflection of the scattered field is a small part of the error: at 1 mm it raises 0.11 to 0.12 % for
# the paper's three cubes, and leaves 0.45 % for a rigid sphere. In the shadow of a larger body incident and
# scattered field cancel: behind a plate of 0.1 m, 12 wavelengths, the error at 1 mm is 1.1 %, and 0.3 % with
# 6 cells. Coarser boxes have 6 cells: with 8, half of such a grid is layers, and the error of a hand differs
# by less than 0.1 %. Deep in the shadow of still larger bodies 1 to 2 % of the incident field are left:
# behind a plate of 0.4 m, 8 cells leave an error of 8.2 % at 4 cells per wavelength, and 10 cells 3.8 %.
_SMALL, _SMALL_LAYER, _LARGE_LAYER = 4, Thickness(4, 6), Thickness(6, 6)
_DEEP, _DEEP_LAYER = 12, Thickness(8, 10, limit=5.5)


def box_layer(size: float) -> Thickness:
    """Return the thickness around a box of bodies with a longest side [wavelengths]."""
    if size <= _SMALL:
        return _SMALL_LAYER
    return _LARGE_LAYER if size <= _DEEP else _DEEP_LAYER


class LayerProfile(NamedTuple):
    """Recursion coefficients of a layer of n cells, from its outer end inwards."""

    decay: Array  # b at the half cells 0 .. n and at the cells 1 .. n, interleaved (..., 2 n + 1)
    gain: Array  # a, likewise


def reflection(profile: LayerProfile, along: Array, turn: Array) -> NDArray[np.complex128]:
    """Return the complex amplitude (..., n) of the reflected plane wave, exact for the discrete scheme.

    `along` (n,) is the wavenumber along the normal times spacing, `turn` (n,) the frequency times time step
    [rad].
    """
    decay, gain = (np.moveaxis(part, -1, 0)[..., None] for part in profile)
    stretch = 1 + gain / (1 - decay * np.exp(1j * turn))
    half, full = stretch[0::2], stretch[1::2]
    # From the outer end, where the pressure is zero, inwards: waves grow, and rounding does not. The last
    # pressure is that in the first cell of air; in air cell j it is e^{-i along j} + r e^{i along j}.
    drop, rise = (2 - 2 * np.cos(along)) / full, 1 / half
    outer, pressure, flow = np.zeros_like(drop[0]), np.ones_like(drop[0]), half[0]
    for cell in range(len(full)):
        flow = flow - drop[cell] * pressure
        outer, pressure = pressure, pressure + rise[cell + 1] * flow
    ahead = np.exp(1j * along)
    return np.asarray((pressure * ahead - outer) / (outer - pressure / ahead), np.complex128)


@lru_cache(maxsize=64)
def tuned_profile(kappa: float, steps_per_period: float, cells: int) -> LayerProfile:
    """Return the profile of `cells` cells with the least reflection at the drive frequency, at all angles.

    Every value of the damping is free. The complex reflection at `TUNED_ANGLES` is fitted, as its magnitude
    is not smooth; angles up to 60 degrees weigh ten times as much as others.
    """
    frequency = 2 * math.pi / steps_per_period
    along, turn = kappa * np.cos(TUNED_ANGLES), np.full_like(TUNED_ANGLES, frequency)
    weight = np.where(math.radians(62) > TUNED_ANGLES, 10.0, 1.0)
    depth = np.linspace(1, 0.5 / cells, 2 * cells + 1)
    alpha = frequency * (_SHIFT + (_OUTER_SHIFT - _SHIFT) * depth)  # shift per step

    def profile(logarithms: Array) -> LayerProfile:
        sigma = frequency * np.exp(logarithms)  # damping per step
        decay = np.exp(-(sigma + alpha))
        return LayerProfile(decay, sigma / (sigma + alpha) * (decay - 1))

    def residual(logarithms: Array) -> Array:
        amplitude = weight * reflection(profile(logarithms), along, turn)
        return np.concatenate((amplitude.real, amplitude.imag), axis=-1)

    def slopes(logarithms: Array) -> Array:
        moved = logarithms + np.vstack((np.zeros_like(logarithms), _DIFFERENCE * np.eye(len(logarithms))))
        values = residual(moved)
        return np.asarray((values[1:] - values[0]).T / _DIFFERENCE)

    fit = partial(least_squares, residual, jac=slopes, bounds=_BOUNDS)
    starts = [np.log(strength / (kappa * cells) * depth**order) for strength, order in _STARTS]
    begun = [fit(start, max_nfev=_FIRST_EVALUATIONS) for start in starts]
    better = min(begun, key=lambda each: float(each.cost)).x
    return profile(fit(better, max_nfev=_MOST_EVALUATIONS).x)


def layer_columns(
    index: Index,
    rows: Array,
    stencil: Stencil,
    shape: tuple[int, int, int],
    thickness: int,
    factor: float,
    dtype: torch.dtype,
) -> tuple[Columns, Columns, torch.Tensor]:
    """Return the columns, the crossed ones and the places of their terms; see `Coefficients`.

    `rows` (n, 27) are the differences of the cells `index` (n,) in the layers from scaled air, on a grid of a
    `shape` with layers of a `thickness` [cells].
    """
    places = places_of(index, shape)
    strides = flat_strides(shape)
    ahead = np.array(OFFSETS) == 1
    middle, inside = 1 + thickness // 2, np.arange(1, thickness + 2)
    parts, crossed, crossings, count = [], [], [], 0
    for axis, side in _LAYERS:
        used = np.abs(rows[:, ahead[:, axis]]).max(axis=1, initial=0) > _ROUNDING * stencil.face
        here = np.flatnonzero(used & (_depth(places, axis, side, shape) == middle))
        stride = (1 - 2 * side) * strides[axis]
        foot = index[here] - middle * stride
        parts.append(_columns(foot, stride, rows[here], ahead[:, axis], strides))
        crossing = np.full((2, len(here), thickness + 2), -1)
        for other, end in _LAYERS[2 * axis + 2 :]:
            depth, sideways = _depth(places[here], other, end, shape), (1 - 2 * end) * strides[other]
            across = places[here, 3 - axis - other]
            base = np.flatnonzero(depth == middle)
            feet = (foot[base] - middle * sideways)[:, None] + inside * stride
            both = np.repeat(rows[here[base]], len(inside), axis=0)
            crossed.append(_columns(feet.ravel(), sideways, both, ahead[:, axis] & ahead[:, other], strides))
            first = np.full(shape[3 - axis - other], -1)
            first[across[base]] = count + len(inside) * np.arange(len(base))
            met = (depth >= 1) & (depth <= thickness) & (first[across] >= 0)
            crossing[0, met] = depth[met, None] - 1
            crossing[1, met, 1:] = first[across[met], None] + inside - 1
            count += len(inside) * len(base)
        crossings.append(crossing)
    depth, column = np.concatenate(crossings, axis=1)
    crossing = np.where(column < 0, thickness * count, depth * count + column)
    columns, crossing_columns = (_joined(each, factor, thickness, dtype) for each in (parts, crossed))
    return columns, crossing_columns, torch.from_numpy(crossing)


def _depth(places: Index, axis: int, side: int, shape: tuple[int, int, int]) -> Index:
    """Return the number of cells (n,) from the ring at one end of an axis inwards."""
    return np.asarray(shape[axis] - 1 - places[:, axis] if side else places[:, axis])


def _columns(foot: Index, stride: int, rows: Array, ahead: NDArray[np.bool_], strides: Index) -> _Part:
    """Return columns from `foot` (m,) on: the weights `ahead` of `rows` (m, 27), moved beside the cell."""
    offsets = np.array(OFFSETS)[ahead]
    beside = np.where((offsets == 1).all(axis=0), 0, offsets)
    return foot, stride, rows[:, ahead], np.asarray(beside @ strides)


def _joined(parts: list[_Part], factor: float, thickness: int, dtype: torch.dtype) -> Columns:
    depth = np.arange(thickness + 2)
    index = np.concatenate([foot[:, None] + stride * depth for foot, stride, _, _ in parts])
    offset = np.concatenate([np.broadcast_to(offset, weight.shape) for _, _, weight, offset in parts])
    weight = torch.from_numpy(factor * np.concatenate([weight for _, _, weight, _ in parts])).to(dtype)
    return Columns(torch.from_numpy(index), torch.from_numpy(offset), weight)
