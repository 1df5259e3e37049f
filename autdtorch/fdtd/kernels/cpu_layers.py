"""The absorbing layers of a chunk of planes on one core.

The layers stretch the sums of neighbours along an axis: T_y p becomes T_y p + E_y p, and T_y T_z p becomes
(T_y + E_y)(T_z + E_z) p. A plane's memory across y is stored as L + 2 rows from the ring inwards, then as
many outwards. Its memory across z is stored as lanes, the ends of all rows, in the same order. The memory of
E_y E_z has rows of lanes. Several planes are computed at a time, because starting a loop costs as much as a
few hundred cells.

The contract counts both layers of an axis inwards. Here the upper layers of y and z have the order of the
axis, which changes the sign of psi.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from numba import njit

from autdtorch.fdtd.kernels.contract import Coefficients, Memory
from autdtorch.fdtd.kernels.cpu_intrinsics import add_four
from autdtorch.utils.array_types import AnyArray
from autdtorch.utils.compiled import INNER

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
    """Memory of the layers of a run, from a state: psi and zeta of x, y, ends of rows, and y for these."""

    def __init__(self, memory: Memory) -> None:
        """Copy the memory of the state of one run, except the x layers, which are used in place."""
        self._layers = [[part[0].numpy() for part in layer] for layer in memory[:4]]
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


_U = np.uint64


@njit(**INNER)
def stretch(u, at, step, psi, psi_at, zeta, zeta_at, term, term_at, cells, profile, profile_at):  # type: ignore[no-untyped-def]
    """Advance the memory of a layer and write its terms.

    Along its axis cells are `step` apart. There is a half cell between each cell of u from `at` on and the
    next. The `cells` and the terms begin with the second cell; the profile has a value for each.
    """
    b_half, a_half, b_cell, a_cell = profile
    for k in range(cells + step):
        decayed = b_half[profile_at + k] * psi[psi_at + k]
        psi[psi_at + k] = decayed + a_half[profile_at + k] * (u[at + step + k] - u[at + k])
    here, ahead = at + step, at + step + step
    for k in range(cells):
        slope = psi[psi_at + step + k] - psi[psi_at + k]
        second = (u[ahead + k] - u[here + k]) - (u[here + k] - u[at + k])
        moved = b_cell[profile_at + k] * zeta[zeta_at + k] + a_cell[profile_at + k] * (second + slope)
        zeta[zeta_at + k] = moved
        term[term_at + k] = slope + moved


@njit(**INNER)
def _copy_rows(u, first, planes, ny, row, reach, out):  # type: ignore[no-untyped-def]
    """Copy the rows of the layers across y, from planes of ny rows."""
    to = _U(0)
    for plane in range(first, first + planes):
        for side in range(_U(2)):
            start = (plane * ny + (ny - reach) * side) * row
            for k in range(reach * row):
                out[to + k] = u[start + k]
            to += reach * row


@njit(**INNER)
def _copy_ends(p, first, rows, nz, reach, out):  # type: ignore[no-untyped-def]
    to = _U(0)
    for row in range(first, first + rows):
        low, high = row * nz, (row + _U(1)) * nz - reach
        for k in range(reach):
            out[to + k] = p[low + k]
            out[to + reach + k] = p[high + k]
        to += reach + reach


@njit(**INNER)
def stretch_planes(p, i, planes, shape, cells, memory, terms, place, profiles):  # type: ignore[no-untyped-def]
    """Compute E_y p, E_z p and E_y E_z p of some planes from i on, in the layers; write from `place` on."""
    _, ny, nz = shape
    (psi_y, zeta_y), (psi_z, zeta_z), (psi_yz, zeta_yz) = memory
    (y, e_y), (z, e_z), (yz, e_yz) = terms
    across_y, across_z, across_yz = profiles
    one, two, zero = _U(1), _U(2), _U(0)
    reach = cells + two
    lanes = two * reach
    _copy_rows(p, i, planes, ny, nz, reach, y)
    first, out, size = i * lanes * nz, place * lanes * nz + nz, planes * lanes * nz - two * nz
    stretch(y, zero, nz, psi_y, first, zeta_y, first + nz, e_y, out, size, across_y, zero)
    _copy_ends(p, i * ny, planes * ny, nz, reach, z)
    first, out, size = i * ny * lanes, place * ny * lanes + one, planes * ny * lanes - two
    stretch(z, zero, one, psi_z, first, zeta_z, first + one, e_z, out, size, across_z, zero)
    _copy_rows(e_z, place, planes, ny, lanes, reach, yz)
    first, size = i * lanes * lanes, planes * lanes * lanes - two * lanes
    out = (place * lanes + one) * lanes
    stretch(yz, zero, lanes, psi_yz, first, zeta_yz, first + lanes, e_yz, out, size, across_yz, zero)


@njit(**INNER)
def _add_to_ends(u, at, rows, shape, cells, ends):  # type: ignore[no-untyped-def]
    """Add the cells of lanes to some rows of the plane of u that begins at `at`."""
    _, ny, nz = shape
    first, last = rows
    one, reach, fours = _U(1), cells + _U(2), cells - cells % _U(4)
    for j in range(max(first, one), min(last, ny - one)):
        low, high = at + j * nz + one, at + (j + one) * nz - reach + one
        lane = j * (reach + reach) + one
        for k in range(_U(0), fours, _U(4)):
            add_four(u, low + k, ends, lane + k)
            add_four(u, high + k, ends, lane + reach + k)
        for k in range(fours, cells):
            u[low + k] += ends[lane + k]
            u[high + k] += ends[lane + reach + k]


@njit(**INNER)
def add_terms(q, at, across, here, place, rows, shape, cells, terms, ends, weights):  # type: ignore[no-untyped-def]
    """Add the terms of rows of a plane to its A, in `across` from `here` on, and to its B, in q from `at` on.

    The `rows` from the first to one past the last contain a layer across y as a whole or not at all.
    """
    _, ny, nz = shape
    (_, e_y), (_, e_z), (_, e_yz) = terms
    a, b = ends
    _, face, edge, corner, _ = weights
    one, two = _U(1), _U(2)
    reach = cells + two
    lanes = two * reach
    first_side, sides = _U(0) if rows[0] == 0 else one, two if rows[1] == ny else one
    for side in range(first_side, sides):
        e = (place * lanes + side * reach) * nz
        o = (ny - reach) * side * nz
        for k in range(nz, (cells + one) * nz):
            middle, beside = e_y[e + k], e_y[e + k - one] + e_y[e + k + one]
            across[here + o + k] += edge * middle + corner * beside
            q[at + o + k] += face * middle + edge * beside
    e = place * ny * lanes
    for k in range(max(rows[0], one) * lanes, min(rows[1], ny - one) * lanes):
        middle, beside = e_z[e + k], e_z[e + k - lanes] + e_z[e + k + lanes]
        a[k] = edge * middle + corner * beside
        b[k] = face * middle + edge * beside
    for side in range(first_side, sides):
        e = (place * lanes + side * reach) * lanes
        o = (ny - reach) * side * lanes
        for k in range(lanes, (cells + one) * lanes):
            a[o + k] += corner * e_yz[e + k]
            b[o + k] += edge * e_yz[e + k]
    _add_to_ends(across, here, rows, shape, cells, a)
    _add_to_ends(q, at, rows, shape, cells, b)


@njit(**INNER)
def _half_cell(psi, at, u, ahead, here, n, decay, gain):  # type: ignore[no-untyped-def]
    for k in range(n):
        psi[at + k] = decay * psi[at + k] + gain * (u[ahead + k] - u[here + k])


@njit(**INNER)
def absorb_x(q, i, rows, shape, memory, u, profile):  # type: ignore[no-untyped-def]
    """Add the term of the layer across x to rows of plane i; `u` holds A of the planes around."""
    nx, ny, nz = shape
    psi, zeta = memory
    decay, gain = profile
    one, two, three = _U(1), _U(2), _U(3)
    cells, plane = _U(len(decay) // 2), ny * nz
    start, n = rows[0] * nz, (rows[1] - rows[0]) * nz
    side = one if two * i > nx else _U(0)
    depth = nx - one - i if side else i
    here, low, high = i % three * plane, (i + two) % three * plane, (i + one) % three * plane
    here, low, high = here + start, low + start, high + start
    outside, inside = (high, low) if side else (low, high)
    outer = (side * (cells + one) + depth - one) * plane + start
    inner, shift, out = outer + plane, (side * cells + depth - one) * plane + start, i * plane + start
    # Each half cell is advanced with the first of its two planes.
    if side and depth == cells:
        _half_cell(psi, inner, u, inside, here, n, decay[two * depth], gain[two * depth])
    if not side and depth == one:
        _half_cell(psi, outer, u, here, outside, n, decay[0], gain[0])
    first, second = (outer, inner) if side else (inner, outer)
    ahead, behind = (here, outside) if side else (inside, here)
    half = two * depth - two if side else two * depth
    b_half, a_half, sign = decay[half], gain[half], decay.dtype.type(-1 if side else 1)
    b, a = decay[two * depth - one], gain[two * depth - one]
    for k in range(n):
        advanced = b_half * psi[first + k] + a_half * (u[ahead + k] - u[behind + k])
        psi[first + k] = advanced
        slope = sign * (advanced - psi[second + k])
        bend = (u[inside + k] - u[here + k]) - (u[here + k] - u[outside + k])
        moved = b * zeta[shift + k] + a * (bend + slope)
        zeta[shift + k] = moved
        q[out + k] += slope + moved
