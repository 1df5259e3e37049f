"""One step of a chunk of planes on one core.

A step goes through the planes once. T_a is the sum of the two neighbours along axis a. Plane i of the
pressure gives two planes, A and B, and the new pressure is

    A = face p + edge (T_y + T_z) p + corner T_y T_z p,    B = center p + face (T_y + T_z) p + edge T_y T_z p,
    new_i = B_i + A_(i-1) + A_(i+1) - keep before_i.

The last A is added when plane i + 2 reads it. Large planes are cut in strips of rows, each of which is swept
through all planes, so that the cache holds A and what plane i + 2 completes. The absorbing layers across y
and z stretch T_y and T_z: `cpu_layers.py` adds the resulting terms to A and B, and the terms of the layers
across x to new_i.

Cells inside rigid bodies are skipped. A is anything there: it counts in cells of the planes beside that are
inside or at the surface, whose pressure nobody reads or is set to zero.

All arrays are flat with unsigned indices: array views cost numba more than a short row, and possibly negative
indices a test. Loops run over whole planes, or all rows of a layer, as if they were one row. The values that
this mixes into the ring at both ends of each row are set to zero at the end.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray

from autdtorch.fdtd.kernels.contract import BLOCK
from autdtorch.fdtd.kernels.cpu_intrinsics import step_around
from autdtorch.fdtd.kernels.cpu_layers import absorb_x, add_terms, stretch_planes
from autdtorch.utils.array_types import Index
from autdtorch.utils.compiled import INNER

_GROUP_CELLS = 3000  # Cells of the layers across an axis that are computed at once
_STRIP_CELLS = 50_000  # Cells of a strip of a plane of at least twice as many, for the cache
_U = np.uint64


@njit(**INNER)
def _sweep(p, at, n, row, q, old, back, across, here, behind, weights):  # type: ignore[no-untyped-def]
    """Set A of a plane and q = B + A behind - keep q; add A behind to the plane before that, old."""
    center, face, edge, corner, keep = weights
    one = _U(1)
    up, down = at - row, at + row
    for k in range(n):
        beside = (p[up + k] + p[down + k]) + (p[at + k - one] + p[at + k + one])
        diagonal = (p[up + k - one] + p[up + k + one]) + (p[down + k - one] + p[down + k + one])
        middle, a = p[at + k], across[behind + k]
        old[back + k] += a
        q[at + k] = (center * middle + face * beside + edge * diagonal) + a - keep * q[at + k]
        across[here + k] = face * middle + edge * beside + corner * diagonal


@njit(**INNER)
def _heterogeneous(p, q, cells, first, last, keep):  # type: ignore[no-untyped-def]
    """Compute new pressures of blocks of cells; in layers also the result of the sweep in them."""
    cell, _, place_of, weight, offset, in_layer, _, air, new, swept = cells
    for b in range(_U(first), _U(last)):
        at, place = cell[b], b * _U(BLOCK)
        step_around(p, q, at, keep, offset, weight, place_of[b], new, place)
        if in_layer[b]:
            step_around(p, q, at, keep, offset, air, _U(0), swept, place)


@njit(**INNER)
def _silence_row_ends(u, base, rows, shape):  # type: ignore[no-untyped-def]
    _, _, nz = shape
    for j in range(rows[0], rows[1]):
        u[base + j * nz] = 0
        u[base + (j + _U(1)) * nz - _U(1)] = 0


@njit(**INNER)
def _sweep_strip(  # type: ignore[no-untyped-def]
    p, q, first, last, rows, shape, weights, x_layer, x_profile, layers, profiles, cells, starts, idle, room
):
    """Step some rows of planes; those of the first strip also compute what all strips need."""
    nx, ny, nz = shape
    across, outermost, terms, ends, group = room
    one, two, three = _U(1), _U(2), _U(3)
    depth, plane = _U(len(x_profile[0]) // 2), ny * nz
    stored = _U(len(terms[0][1])) // (two * (depth + two) * nz)
    start, stop = rows[0] * nz, rows[1] * nz
    low, high = max(start, nz + one), min(stop, plane - nz - one)
    for k in range(start, stop):
        across[(first + two) % three * plane + k] = 0
        outermost[k] = outermost[plane + k] = 0
    for i in range(first, last + one):
        here, behind = i % three * plane, (i + two) % three * plane
        old, back = (q, (i - two) * plane) if i > first + one else (outermost, _U(0))
        if i < last:
            if rows[0] == 0:
                _heterogeneous(p, q, cells, starts[i], starts[i + one], weights[4])
            at = low
            for run in range(idle[1][i], idle[1][i + one] + 1):  # one more: the cells behind the last run
                end, ahead = high, high
                if run < idle[1][i + one]:
                    end = min(max(idle[0][run, 0], at), high)
                    ahead = min(max(idle[0][run, 1], at), high)
                _sweep(
                    p, i * plane + at, end - at, nz, q, old, back + at, across, here + at, behind + at,
                    weights,
                )  # fmt: skip
                at = ahead
        else:
            for k in range(start, stop):
                old[back + k] += across[behind + k]
                outermost[plane + k] = across[behind + k]
                across[here + k] = 0
        if i < last and depth:
            place = (i - first) % stored
            if rows[0] == 0 and (i - first) % group == 0:
                planes = min(group, last - i)
                stretch_planes(p, i, planes, shape, depth, layers, terms, place, profiles)
            add_terms(q, i * plane, across, here, place, rows, shape, depth, terms, ends, weights)
        if i <= depth + one or i + depth + two >= nx:
            _silence_row_ends(across, here, rows, shape)
            if i > first and (i <= depth + one or i + depth >= nx):
                absorb_x(q, i - one, rows, shape, x_layer, across, x_profile)
        if i > first + one:
            _silence_row_ends(q, (i - two) * plane, rows, shape)
    _silence_row_ends(q, (last - one) * plane, rows, shape)


@njit(**INNER)
def sweep_planes(  # type: ignore[no-untyped-def]
    p, q, first, last, strips, shape, weights, x_layer, x_profile, layers, profiles, cells, starts, idle, room
):
    """Step planes first .. last - 1 as if others were zero; `room` then holds A for the neighbours."""
    for strip in range(len(strips) - 1):
        rows = strips[strip], strips[strip + 1]
        _sweep_strip(
            p, q, first, last, rows, shape, weights, x_layer, x_profile, layers, profiles, cells, starts,
            idle, room,
        )  # fmt: skip


def planes_at_once(shape: torch.Size, layer_cells: int) -> int:
    """Return the number of planes whose layers are computed at once: as many as the cache holds."""
    _, ny, nz = shape
    return max(1, _GROUP_CELLS // (2 * (layer_cells + 2) * max(ny, nz)))


def strips_of(shape: torch.Size, layer_cells: int) -> NDArray[np.uint64]:
    """Return the first rows of the strips of a plane, each wider than a layer, and one past the last."""
    _, ny, nz = shape
    count = max(1, min(ny * nz // _STRIP_CELLS, ny // (2 * layer_cells + 4)))
    return np.linspace(0, ny, count + 1).astype(np.uint64)


def workspace(cuts: Index, shape: torch.Size, layer_cells: int, dtype: type) -> tuple[Any, ...]:
    """Return planes whose layers are computed at once, and the workspace of the chunks."""
    _, ny, nz = shape
    lanes, group = 2 * (layer_cells + 2), planes_at_once(shape, layer_cells)
    stored = group if len(strips_of(shape, layer_cells)) == 2 else int(np.diff(cuts).max())
    sizes = (lanes * nz, ny * lanes, lanes * lanes)
    terms = (planes * size for size in sizes for planes in (group, stored))
    parts = (*terms, ny * lanes, ny * lanes, 3 * ny * nz, 2 * ny * nz)
    return np.uint64(group), *(np.zeros((len(cuts) - 1, size), dtype) for size in parts)
