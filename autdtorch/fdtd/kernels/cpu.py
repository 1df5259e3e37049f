"""The kernel for CPUs, in numba: the same contract as the reference, in place, on all cores.

The planes of the grid are split into chunks, one for each core that has enough to do (`_cuts`); a step goes
through each of them once (`cpu_sweep.py`). Then the outermost planes of a chunk get what its neighbours owe
them, and single cells what concerns them. A small grid is one chunk, stepped without waking another thread:
several of its runs can go side by side.

numba's threads do not survive a fork: start processes that use this module by spawn.
"""

from __future__ import annotations

import math
import os

# What an idle OpenMP thread does while it waits for the next loop is decided when numba starts its threads.
# If it sleeps at once it is not there when it is needed, on a busy machine least of all; it spins for a few
# milliseconds here, which was best on an idle machine and on a busy one (docs/decisions/cpu-kernel.md).
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("GOMP_SPINCOUNT", "1000000")

import numpy as np
import torch
from numba import get_num_threads, njit, prange
from numpy.typing import NDArray

from autdtorch.fdtd.kernels.contract import Coefficients, Columns, Receivers, Sources, State
from autdtorch.fdtd.kernels.cpu_layout import Memory, plane_profiles, rows_profile
from autdtorch.fdtd.kernels.cpu_sweep import INNER, stretch, sweep_planes

Array = NDArray[np.generic]

_CHUNK_CELLS = 200_000
"""Cells of a chunk at least: what a second thread needs to be woken for."""


@njit(**INNER)
def _record(p, receivers, first, last, out):  # type: ignore[no-untyped-def]
    heard, hearing = receivers
    for r in range(first, last):
        total = p[0] - p[0]
        for m in range(heard.shape[1]):
            total += hearing[r, m] * p[heard[r, m]]
        out[r] = total


@njit(**INNER)
def _sweep_chunk(c, p, q, medium, layers, cells, room):  # type: ignore[no-untyped-def]
    cuts, starts = medium[0], medium[1]
    e_y, e_z, e_yz, ends, total, across, u, outermost = room
    own = (e_y[c], e_z[c], e_yz[c]), ends[c], total[c], across[c], u[c], outermost[c]
    psi_x, zeta_x, psi_y, zeta_y, psi_z, zeta_z, psi_yz, zeta_yz = layers
    memory = (psi_y, zeta_y), (psi_z, zeta_z), (psi_yz, zeta_yz)
    first, last = np.uint64(cuts[c]), np.uint64(cuts[c + 1])
    shape, weights, profile = medium[3:6], medium[6:11], medium[11:13]
    profiles = medium[13:17], medium[17:21], medium[21:25]
    sweep_planes(
        p,
        q,
        first,
        last,
        shape,
        weights,
        (psi_x, zeta_x),
        memory,
        profile,
        profiles,
        cells,
        starts,
        own,
    )


@njit(**INNER)
def _finish_chunk(c, q, medium, cells, outermost, sources, row):  # type: ignore[no-untyped-def]
    """Add what the neighbours owe to the outermost planes of chunk c; then set its single cells."""
    cuts, starts, driven_starts = medium[:3]
    ny, nz = int(medium[4]), int(medium[5])
    plane = ny * nz
    for end in range(2):
        other = c + 2 * end - 1
        if 0 <= other < len(cuts) - 1:
            at = cuts[c + 1] - 1 if end else cuts[c]
            for j in range(1, ny - 1):
                for k in range(j * nz + 1, j * nz + nz - 1):
                    q[at * plane + k] += outermost[other, (1 - end) * plane + k]
    index, _, _, scale, _, new, swept = cells
    for n in range(starts[cuts[c]], starts[cuts[c + 1]]):
        absorbed = scale[n] * (q[index[n]] - swept[n]) if scale[n] != 0 else scale[n]
        q[index[n]] = new[n] + absorbed
    driven, force = sources
    for n in range(driven_starts[c], driven_starts[c + 1]):
        for s in range(len(row)):
            q[driven[n]] += force[n, s] * row[s]


@njit(**INNER)
def _stretch_columns(p, columns, beside, place, memory, terms):  # type: ignore[no-untyped-def]
    """Advance the columns' memory and write their terms (L, m); `beside` has more to sum, by `place`."""
    index, offset, weight, b_half, a_half, b_cell, a_cell = columns
    psi, zeta = memory
    count, depths = index.shape
    more = beside.ravel()
    u = np.zeros(depths * count, p.dtype)
    for n in range(count):
        for depth in range(1, depths):
            total = p[0] - p[0]
            for m in range(weight.shape[1]):
                total += weight[n, m] * p[index[n, depth] + offset[n, m]]
            if place[n, depth] < len(more):
                total += more[place[n, depth]]
            u[depth * count + n] = total
    zero, profile = np.uint64(0), (b_half, a_half, b_cell, a_cell)
    stretch(
        u, zero, np.uint64(count), psi.ravel(), zero, zeta.ravel(), zero, terms.ravel(), zero,
        np.uint64((depths - 2) * count), profile, zero,
    )  # fmt: skip


@njit(**INNER)
def _finish_step(p, q, columns, memory, closed):  # type: ignore[no-untyped-def]
    """Add what surfaces through the layers differ by, and silence the closed cells."""
    (cut, crossed, crossing), (cut_memory, crossed_memory) = columns, memory
    if len(cut[0]):
        shares, beside = np.zeros_like(cut_memory[1]), np.zeros_like(crossed_memory[1])
        alone, nothing = np.zeros_like(crossed[0]), np.zeros((0, 0), p.dtype)
        _stretch_columns(p, crossed, nothing, alone, crossed_memory, beside)
        _stretch_columns(p, cut, beside, crossing, cut_memory, shares)
        for n in range(len(cut[0])):
            for depth in range(len(shares)):
                q[cut[0][n, depth + 1]] += shares[depth, n]
    for n in range(len(closed)):
        q[closed[n]] = 0


@njit(cache=True, nogil=True)
def _advance_alone(  # type: ignore[no-untyped-def]
    p, q, medium, layers, cells, room, columns, memory, closed, sources, receivers, signal, recorded
):
    for step in range(len(signal)):
        _sweep_chunk(0, p, q, medium, layers, cells, room)
        _finish_chunk(0, q, medium, cells, room[-1], sources, signal[step])
        _finish_step(p, q, columns, memory, closed)
        _record(q, receivers, 0, recorded.shape[1], recorded[step])
        p, q = q, p


@njit(parallel=True, cache=True, nogil=True)
def _advance_together(  # type: ignore[no-untyped-def]
    p, q, medium, layers, cells, room, columns, memory, closed, sources, receivers, signal, recorded
):
    chunks, heard = len(medium[0]) - 1, recorded.shape[1]
    for step in range(len(signal)):
        for c in prange(chunks):
            if step:
                _record(p, receivers, c * heard // chunks, (c + 1) * heard // chunks, recorded[step - 1])
            _sweep_chunk(c, p, q, medium, layers, cells, room)
        for c in prange(chunks):
            _finish_chunk(c, q, medium, cells, room[-1], sources, signal[step])
        _finish_step(p, q, columns, memory, closed)
        p, q = q, p
    _record(p, receivers, 0, heard, recorded[-1])


def _chunks(cells: int) -> int:
    return max(1, min(get_num_threads(), cells // _CHUNK_CELLS))


def _cuts(shape: torch.Size, layer_cells: int) -> NDArray[np.int64]:
    """First planes of the chunks, and one past the last: the layers across x are not cut."""
    planes = shape[0] - 2
    chunks = max(1, min(_chunks(shape.numel()), planes // (layer_cells + 2)))
    return np.linspace(1, 1 + planes, chunks + 1).astype(np.int64)


def _room(chunks: int, shape: torch.Size, layer_cells: int, dtype: type) -> tuple[Array, ...]:
    """What a chunk keeps during a step, see `sweep_planes`."""
    _, ny, nz = shape
    lanes = 2 * (layer_cells + 2)
    terms = (2 * layer_cells * nz, ny * lanes, 2 * layer_cells * lanes)
    sizes = (*(3 * size for size in terms), ny * lanes, *(planes * ny * nz for planes in (1, 1, 3, 2)))
    return tuple(np.zeros((chunks, size), dtype) for size in sizes)


def _columns(c: Coefficients, columns: Columns) -> tuple[Array, ...]:
    count = len(columns.index)
    return columns.index.numpy(), columns.offset.numpy(), columns.weight.numpy(), *rows_profile(c, count)


def _varying_cells(c: Coefficients, strides: NDArray[np.int64]) -> tuple[Array, ...]:
    """Their indices, weights, the offsets of these, and what the layers need to know about them."""
    offsets = np.indices((3, 3, 3)).reshape(3, -1).T - 1
    air = np.array((c.center, c.face, c.edge, c.corner))[np.abs(offsets).sum(axis=1)]
    index, weight = c.varying_index.numpy(), c.varying_weight.numpy()
    scale = np.zeros_like(weight, shape=len(index))
    scale[np.searchsorted(index, c.layer_index.numpy())] = c.layer_scale.numpy()
    new, swept = np.empty_like(scale), np.empty_like(scale)
    return index, weight.ravel(), offsets @ strides, scale, air.astype(scale.dtype), new, swept


class CpuKernel:
    """See `kernels.contract`; updates the state in place."""

    def at_once(self, shape: tuple[int, int, int]) -> int:
        """One for each core, if the grid is one chunk."""
        return get_num_threads() if _chunks(math.prod(shape)) == 1 else 1

    def advance(
        self,
        state: State,
        coefficients: Coefficients,
        sources: Sources,
        receivers: Receivers,
        signal: torch.Tensor,
    ) -> tuple[State, torch.Tensor]:
        """See `Kernel.advance`."""
        c = coefficients
        shape, cuts = state.now.shape, _cuts(state.now.shape, c.layer_cells)
        plane = shape[1] * shape[2]
        dtype = c.varying_weight.numpy().dtype.type
        recorded = torch.empty((len(signal), len(receivers.index)), dtype=signal.dtype)
        medium = (
            cuts,
            np.searchsorted(c.varying_index.numpy(), plane * np.arange(shape[0] + 1)),
            np.searchsorted(sources.index.numpy(), plane * cuts),
            *(np.uint64(cells) for cells in shape),
            *(dtype(weight) for weight in (c.center, c.face, c.edge, c.corner, c.keep)),
            c.layer_decay.numpy(),
            c.layer_gain.numpy(),
            *plane_profiles(c, shape),
        )
        memory = Memory(state.layers)
        advance = _advance_alone if len(cuts) == 2 else _advance_together
        advance(
            state.now.numpy().reshape(-1),
            state.before.numpy().reshape(-1),
            medium,
            tuple(part.reshape(-1) for part in memory.arrays),
            _varying_cells(c, np.array(state.now.stride())),
            _room(len(cuts) - 1, shape, c.layer_cells, dtype),
            (_columns(c, c.columns), _columns(c, c.crossed), c.crossing.numpy()),
            tuple((psi.numpy(), zeta.numpy()) for psi, zeta in (state.columns, state.crossed)),
            c.closed_index.numpy(),
            # contiguous: for arrays with gaps numba compiles anew, and crashed when it loaded that from disk
            (sources.index.contiguous().numpy(), sources.force.contiguous().numpy()),
            (receivers.index.contiguous().numpy(), receivers.weight.contiguous().numpy()),
            signal.contiguous().numpy(),
            recorded.numpy(),
        )
        memory.give_back()
        now, before = (state.now, state.before) if len(signal) % 2 == 0 else (state.before, state.now)
        return State(now, before, state.layers, state.columns, state.crossed), recorded
