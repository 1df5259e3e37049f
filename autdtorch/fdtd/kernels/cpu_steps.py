"""The tasks of time steps on CPUs, compiled: chunks of planes, phase by phase, claimed by workers."""

from __future__ import annotations

import numpy as np
from numba import njit

from autdtorch.fdtd.kernels.contract import BLOCK
from autdtorch.fdtd.kernels.cpu_intrinsics import (
    add_to_counter,
    give_way,
    losses_around,
    read_counter,
)
from autdtorch.fdtd.kernels.cpu_layers import stretch
from autdtorch.fdtd.kernels.cpu_sweep import sweep_planes
from autdtorch.utils.compiled import INNER, NO_ARRAYS, entry

COUNTERS = 32  # Numbers that hold the two counters, 0 at first
_CLAIMED, _FINISHED = 0, 16  # Their places, on separate cache lines
# Polls of the counter before a waiting worker yields: a few microseconds, less than waking costs
_LOOKS = 2000


@njit(**INNER)
def _wait_for(counters, tasks):  # type: ignore[no-untyped-def]
    looks = 0
    while read_counter(counters, _FINISHED) < tasks:
        looks += 1
        if looks > _LOOKS:
            give_way()


@njit(**INNER)
def _record(p, receivers, first, last, out):  # type: ignore[no-untyped-def]
    index, weight = receivers  # a row for each cell of a receiver
    for m in range(len(index)):
        cell, share = index[m], weight[m]
        for r in range(first, last):
            value = share[r] * p[cell[r]]
            out[r] = out[r] + value if m else value


@njit(**INNER)
def _sweep_chunk(c, p, q, medium, layers, cells, room):  # type: ignore[no-untyped-def]
    cuts, starts = medium[0], medium[1]
    group, y, e_y, z, e_z, yz, e_yz, a, b, across, outermost = room
    terms = (y[c], e_y[c]), (z[c], e_z[c]), (yz[c], e_yz[c])
    room_of_chunk = across[c], outermost[c], terms, (a[c], b[c]), group
    psi_x, zeta_x, psi_y, zeta_y, psi_z, zeta_z, psi_yz, zeta_yz = layers
    memory = (psi_y, zeta_y), (psi_z, zeta_z), (psi_yz, zeta_yz)
    first, last = np.uint64(cuts[c]), np.uint64(cuts[c + 1])
    shape, weights, profile, profiles = medium[4:7], medium[7:12], medium[12:14], medium[14:17]
    idle, strips = medium[17:19], medium[19]
    sweep_planes(
        p, q, first, last, strips, shape, weights, (psi_x, zeta_x), profile, memory, profiles, cells, starts,
        idle, room_of_chunk,
    )  # fmt: skip


@njit(**INNER)
def _damp_chunk(c, p, q, keep, losses, offset):  # type: ignore[no-untyped-def]
    """Compute the losses in the cells of chunk c, before the sweep overwrites the pressures `q` before."""
    cell, _, place_of, weight, total, ground, starts, change = losses
    size = np.uint64(BLOCK)
    for b in range(np.uint64(starts[c]), np.uint64(starts[c + 1])):
        at, place = cell[b], b * size
        losses_around(p, q, at, keep, offset, weight, place_of[b], change, place)
        for k in range(size):
            here, n = p[at + k], place + k
            change[n] += total[n] * (here - q[at + k]) - ground[n] * here


@njit(**INNER)
def _finish_chunk(c, q, medium, cells, losses, outermost, sources, row, sound_hard):  # type: ignore[no-untyped-def]
    """Add the terms of the neighbours to the outermost planes of chunk c; then set its single cells."""
    cuts, starts, driven_starts, hard_starts = medium[:4]
    ny, nz = int(medium[5]), int(medium[6])
    plane = ny * nz
    for end in range(2):
        other = c + 2 * end - 1
        if 0 <= other < len(cuts) - 1:
            at = cuts[c + 1] - 1 if end else cuts[c]
            for j in range(1, ny - 1):
                for k in range(j * nz + 1, j * nz + nz - 1):
                    q[at * plane + k] += outermost[other, (1 - end) * plane + k]
    cell, lanes, _, _, _, in_layer, scale, _, new, swept = cells
    driven, force, push = sources
    first, last, size = np.uint64(starts[cuts[c]]), np.uint64(starts[cuts[c + 1]]), np.uint64(BLOCK)
    for s in range(len(push)):
        for n in range(first * size, last * size):
            new[n] += push[s, n] * row[s]
    for b in range(first, last):
        at, place = cell[b], b * size
        if in_layer[b]:
            for k in range(lanes[b, 0], lanes[b, 1]):
                new[place + k] += scale[place + k] * (q[at + k] - swept[place + k])
        for k in range(lanes[b, 0], lanes[b, 1]):
            q[at + k] = new[place + k]
    lossy, loss_lanes, _, _, _, _, loss_starts, change = losses
    for b in range(loss_starts[c], loss_starts[c + 1]):
        for k in range(loss_lanes[b, 0], loss_lanes[b, 1]):
            q[lossy[b] + k] += change[np.uint64(b) * size + k]
    for n in range(driven_starts[c], driven_starts[c + 1]):
        pressure = q[driven[n]]
        for s in range(len(row)):
            pressure += force[s, n] * row[s]
        q[driven[n]] = pressure
    for n in range(hard_starts[c], hard_starts[c + 1]):
        q[sound_hard[n]] = 0


@njit(**INNER)
def _stretch_columns(p, columns, beside, place, memory):  # type: ignore[no-untyped-def]
    """Advance the columns' memory and set their terms, with summands from `beside` at `place`."""
    index, offset, weight, u, terms, b_half, a_half, b_cell, a_cell = columns
    psi, zeta = memory
    count, depths = index.shape
    for n in range(count):
        for depth in range(1, depths):
            total = p[0] - p[0]
            for m in range(weight.shape[1]):
                total += weight[n, m] * p[index[n, depth] + offset[n, m]]
            if place[n, depth] < len(beside):
                total += beside[place[n, depth]]
            u[depth * count + n] = total
    zero, profile = np.uint64(0), (b_half, a_half, b_cell, a_cell)
    stretch(
        u, zero, np.uint64(count), psi, zero, zeta, zero, terms, zero, np.uint64(len(terms)), profile, zero
    )


@njit(**INNER)
def _finish_columns(p, q, columns, memory):  # type: ignore[no-untyped-def]
    """Add the terms of interfaces through the layers."""
    (cut, crossed, crossing, nothing, nowhere), (cut_memory, crossed_memory) = columns, memory
    _stretch_columns(p, crossed, nothing, nowhere, crossed_memory)
    _stretch_columns(p, cut, crossed[4], crossing, cut_memory)
    index, terms = cut[0], cut[4]
    count = len(index)
    for n in range(count):
        for depth in range(index.shape[1] - 2):
            q[index[n, depth + 1]] += terms[depth * count + n]


@entry(**NO_ARRAYS)
def advance(  # type: ignore[no-untyped-def]
    p, q, medium, layers, cells, losses, room, columns, memory, sound_hard, sources, receivers, signal,
    recorded, counters,
):  # fmt: skip
    """Do tasks until none is left; each worker calls this with the same arguments.

    A step has two phases with a task for each chunk, sweep it and finish it. One is before these if cells are
    lossy, and one after if interfaces pass through the absorbing layers. The first records the step before.
    Chunks at both ends, whose planes are in the absorbing layers, are done first: they take longest.
    """
    chunks, steps, read = len(medium[0]) - 1, len(signal), recorded.shape[1]
    swept = 1 if len(losses[0]) else 0  # the phase of the sweep
    kinds = swept + (3 if len(columns[0][0]) else 2)
    for _ in range((kinds * steps + 1) * chunks):
        task = add_to_counter(counters, _CLAIMED, 1)
        phase, place = task // chunks, task % chunks
        c = chunks - 1 - place // 2 if place % 2 else place // 2
        if phase > kinds * steps:
            break
        _wait_for(counters, phase * chunks)
        step, kind = phase // kinds, phase % kinds
        now, new = (p, q) if step % 2 == 0 else (q, p)
        if kind == 0:
            if step > 0:
                first, last = np.uint64(c * read // chunks), np.uint64((c + 1) * read // chunks)
                _record(now, receivers, first, last, recorded[step - 1])
            if swept and step < steps:
                _damp_chunk(c, now, new, medium[11], losses, cells[4])
        if kind == swept and step < steps:
            _sweep_chunk(c, now, new, medium, layers, cells, room)
        elif kind == swept + 1:
            _finish_chunk(c, new, medium, cells, losses, room[-1], sources, signal[step], sound_hard)
        elif kind == swept + 2 and c == 0:
            _finish_columns(now, new, columns, memory)
            for n in range(len(sound_hard)):
                new[sound_hard[n]] = 0
        add_to_counter(counters, _FINISHED, 1)
