"""One step of a chunk of planes on one core.

A step goes through the planes once. With T_a the sum of the two neighbours along axis a, stretched in the
boundary layers, plane i of the pressure gives two planes,

    A = face p + edge (T_y + T_z) p + corner T_y T_z p,    B = center p + face (T_y + T_z) p + edge T_y T_z p,

and new_i = B_i + A_(i-1) + A_(i+1) + E_x A_i - keep before_i, where E_x is what the layers across x add. What
those across y and z add, E_y p, E_z p and E_y E_z p, is computed in their own cells.

All arrays are flat with unsigned indices: array views cost numba more than a short row, and possibly negative
indices a test. Loops run over whole planes, or all rows of a layer, as if they were one row. The values that
this mixes into the ring at both ends of each row are set to zero at the end.

The ends of the rows, with the layers across z, are stored in lanes: for each row L + 2 cells of the low end,
from the ring inwards, then as many of the high end, outwards.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from autdtorch.fdtd.kernels.compiled import INNER
from autdtorch.fdtd.kernels.cpu_rows import sum_of_rows

_U = np.uint64


@njit(**INNER)
def _sweep(p, at, n, row, old, old_at, total, across, weights):  # type: ignore[no-untyped-def]
    """Finish the plane before: old = total + A - keep old; then total = B + A before, across = A."""
    center, face, edge, corner, keep = weights
    one = _U(1)
    up, down, first = at - row, at + row, row + one
    for k in range(n):
        beside = (p[up + k] + p[down + k]) + (p[at + k - one] + p[at + k + one])
        diagonal = (p[up + k - one] + p[up + k + one]) + (p[down + k - one] + p[down + k + one])
        own = p[at + k]
        a = face * own + edge * beside + corner * diagonal
        old[old_at + k] = total[first + k] + a - keep * old[old_at + k]
        total[first + k] = center * own + face * beside + edge * diagonal + across[first + k]
        across[first + k] = a


@njit(**INNER)
def _heterogeneous(p, q, cells, first, last, keep):  # type: ignore[no-untyped-def]
    """Compute new pressures of heterogeneous cells; in layers also the result of the sweep in them."""
    index, weight, offset, scale, air, new, swept = cells
    for n in range(first, last):
        cell = index[n]
        own, old = p[cell], q[cell]
        new[n] = own + keep * (own - old) + sum_of_rows(p, cell, offset, weight, n * len(air))
        if scale[n] != 0:
            swept[n] = own + keep * (own - old) + sum_of_rows(p, cell, offset, air, 0)


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
def _stretch_plane(p, i, shape, cells, memory, terms, ends, profiles):  # type: ignore[no-untyped-def]
    """Compute the layers' terms E_y p, E_z p and E_y E_z p of plane i."""
    _, ny, nz = shape
    (psi_y, zeta_y), (psi_z, zeta_z), (psi_yz, zeta_yz) = memory
    e_y, e_z, e_yz = terms
    across_y, across_z, across_yz = profiles
    one, two, zero = _U(1), _U(2), _U(0)
    reach = cells + two
    lanes, base, slot = two * reach, i * ny * nz, i % _U(3)
    for j in range(ny):
        low, high = base + j * nz, base + (j + one) * nz - reach
        for depth in range(reach):
            ends[j * lanes + depth] = p[low + depth]
            ends[j * lanes + reach + depth] = p[high + depth]
    first = i * ny * lanes
    stretch(
        ends, zero, one, psi_z, first, zeta_z, first + one, e_z, slot * ny * lanes + one, ny * lanes - two,
        across_z, zero,
    )  # fmt: skip
    for side in range(two):
        layer, out = side * shape[0] + i, two * slot + side
        row = (ny - reach) * side
        stretch(
            p, base + row * nz, nz, psi_y, layer * (cells + one) * nz, zeta_y, layer * cells * nz,
            e_y, out * cells * nz, cells * nz, across_y, side * (cells + one) * nz,
        )  # fmt: skip
        stretch(
            e_z, (slot * ny + row) * lanes, lanes, psi_yz, layer * (cells + one) * lanes, zeta_yz,
            layer * cells * lanes, e_yz, out * cells * lanes, cells * lanes, across_yz,
            side * (cells + one) * lanes,
        )  # fmt: skip


@njit(**INNER)
def _add_ends(q, base, shape, cells, ends):  # type: ignore[no-untyped-def]
    """Add the layers' cells of lanes to a plane that begins at `base`."""
    _, ny, nz = shape
    one, reach = _U(1), cells + _U(2)
    for j in range(one, ny - one):
        low, high = base + j * nz + one, base + (j + one) * nz - reach + one
        at = j * (reach + reach) + one
        for depth in range(cells):
            q[low + depth] += ends[at + depth]
            q[high + depth] += ends[at + reach + depth]


@njit(**INNER)
def _absorb_plane(q, i, shape, cells, terms, ends, weights):  # type: ignore[no-untyped-def]
    """Add the terms of the layers across y and z to plane i, smoothed over x and the other axis."""
    _, ny, nz = shape
    e_y, e_z, e_yz = terms
    _, face, edge, corner, _ = weights
    one, two, three = _U(1), _U(2), _U(3)
    reach = cells + two
    lanes, base = two * reach, i * ny * nz
    here, before, after = i % three, (i + two) % three, (i + one) % three
    o, b, a = here * ny * lanes, before * ny * lanes, after * ny * lanes
    for k in range(lanes, (ny - one) * lanes):
        beside = (e_z[o + k - lanes] + e_z[o + k + lanes]) + (e_z[b + k] + e_z[a + k])
        diagonal = (e_z[b + k - lanes] + e_z[b + k + lanes]) + (e_z[a + k - lanes] + e_z[a + k + lanes])
        ends[k] = face * e_z[o + k] + edge * beside + corner * diagonal
    for side in range(two):
        row = (ny - reach) * side + one
        size = cells * lanes
        o, b, a = (two * here + side) * size, (two * before + side) * size, (two * after + side) * size
        for k in range(size):
            ends[row * lanes + k] += edge * e_yz[o + k] + corner * (e_yz[b + k] + e_yz[a + k])
        size = cells * nz
        o, b, a = (two * here + side) * size, (two * before + side) * size, (two * after + side) * size
        out = base + row * nz
        for k in range(one, size - one):
            beside = (e_y[o + k - one] + e_y[o + k + one]) + (e_y[b + k] + e_y[a + k])
            diagonal = (e_y[b + k - one] + e_y[b + k + one]) + (e_y[a + k - one] + e_y[a + k + one])
            q[out + k] += face * e_y[o + k] + edge * beside + corner * diagonal
    _add_ends(q, base, shape, cells, ends)


@njit(**INNER)
def _stretched_across(across, out, base, i, shape, cells, terms, ends, weights):  # type: ignore[no-untyped-def]
    """Write A of plane i, with the terms of the layers across y and z, to `out` from `base` on."""
    _, ny, nz = shape
    e_y, e_z, e_yz = terms
    _, _, edge, corner, _ = weights
    one, two = _U(1), _U(2)
    reach, slot = cells + two, i % _U(3)
    lanes, plane = two * reach, ny * nz
    for k in range(plane):
        out[base + k] = across[k]
    e = slot * ny * lanes
    for k in range(lanes, (ny - one) * lanes):
        ends[k] = edge * e_z[e + k] + corner * (e_z[e + k - lanes] + e_z[e + k + lanes])
    for side in range(two):
        row = (ny - reach) * side + one
        e = (two * slot + side) * cells * lanes
        for k in range(cells * lanes):
            ends[row * lanes + k] += corner * e_yz[e + k]
        e = (two * slot + side) * cells * nz
        for k in range(one, cells * nz - one):
            out[base + row * nz + k] += edge * e_y[e + k] + corner * (e_y[e + k - one] + e_y[e + k + one])
    _add_ends(out, base, shape, cells, ends)
    for j in range(ny):
        out[base + j * nz] = 0
        out[base + (j + one) * nz - one] = 0


@njit(**INNER)
def _half_cell(psi, at, u, ahead, here, n, decay, gain):  # type: ignore[no-untyped-def]
    for k in range(n):
        psi[at + k] = decay * psi[at + k] + gain * (u[ahead + k] - u[here + k])


@njit(**INNER)
def _absorb_x(q, i, shape, memory, u, profile):  # type: ignore[no-untyped-def]
    """Add the term of the layer across x to plane i; `u` holds A of the planes around."""
    nx, ny, nz = shape
    psi, zeta = memory
    decay, gain = profile
    one, two, three = _U(1), _U(2), _U(3)
    cells, plane = _U(len(decay) // 2), ny * nz
    side = one if two * i > nx else _U(0)
    depth = nx - one - i if side else i
    here, low, high = i % three * plane, (i + two) % three * plane, (i + one) % three * plane
    outside, inside = (high, low) if side else (low, high)
    outer = (side * (cells + one) + depth - one) * plane
    inner, shift, out = outer + plane, (side * cells + depth - one) * plane, i * plane
    # Each half cell is advanced with the first of its two planes.
    if side or depth == one:
        _half_cell(psi, outer, u, here, outside, plane, decay[two * depth - two], gain[two * depth - two])
    if not side or depth == cells:
        _half_cell(psi, inner, u, inside, here, plane, decay[two * depth], gain[two * depth])
    b, a = decay[two * depth - one], gain[two * depth - one]
    for k in range(plane):
        slope = psi[inner + k] - psi[outer + k]
        second = (u[inside + k] - u[here + k]) - (u[here + k] - u[outside + k])
        moved = b * zeta[shift + k] + a * (second + slope)
        zeta[shift + k] = moved
        q[out + k] += slope + moved


@njit(**INNER)
def sweep_planes(  # type: ignore[no-untyped-def]
    p, q, first, last, shape, weights, layer, layers, profile, profiles, cells, starts, room
):
    """Step planes first .. last - 1 as if others were zero; `room` then has A for the neighbours."""
    nx, ny, nz = shape
    terms, ends, total, across, u, outermost = room
    one, two, three = _U(1), _U(2), _U(3)
    depth, plane = _U(len(profile[0]) // 2), ny * nz
    for silent in (total, across, *terms):
        silent[:] = 0
    if first <= depth or last + depth >= nx:
        u[:] = 0
    n, keep = plane - nz - nz - two, weights[4]
    for i in range(first, last + one):
        done = i - one
        if i < last:
            _heterogeneous(p, q, cells, starts[i], starts[i + one], keep)
            if depth:
                _stretch_plane(p, i, shape, depth, layers, terms, ends, profiles)
            # the result before the first plane is stored where A of that plane will be
            old, at = (outermost, _U(0)) if i == first else (q, done * plane + nz + one)
            _sweep(p, i * plane + nz + one, n, nz, old, at, total, across, weights)
        else:
            for k in range(nz, plane - nz):
                q[done * plane + k] = total[k] - keep * q[done * plane + k]
            across[:] = 0
            for term in terms:
                size = _U(len(term)) // three
                for k in range(size):
                    term[i % three * size + k] = 0
        if i <= depth + one or i + depth + two >= nx:
            _stretched_across(across, u, i % three * plane, i, shape, depth, terms, ends, weights)
        elif i == first:
            _stretched_across(across, outermost, _U(0), i, shape, depth, terms, ends, weights)
        elif i + one == last:
            _stretched_across(across, outermost, plane, i, shape, depth, terms, ends, weights)
        if i > first:
            if depth:
                _absorb_plane(q, done, shape, depth, terms, ends, weights)
            if done <= depth or done + depth + one >= nx:
                _absorb_x(q, done, shape, layer, u, profile)
            for j in range(one, ny - one):
                q[done * plane + j * nz] = 0
                q[done * plane + (j + one) * nz - one] = 0
