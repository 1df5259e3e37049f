"""The kernel for CPUs, in numba: in place, on several cores.

The shape of the grid alone determines its chunks of planes (`_cuts`), so that results do not depend on the
number of threads. A step sweeps each chunk once (`cpu_sweep.py`). Then the outermost planes of a chunk
receive the terms of its neighbours, and single cells are corrected. A small grid is one chunk, stepped by one
thread: several runs can be stepped concurrently.

Workers do these tasks, which are numbered phase by phase. A worker claims the next task, waits until all
tasks of earlier phases are finished, and does it. A suspended worker delays the others by one task, and
waiting workers yield to it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray

from autdtorch.fdtd.kernels.blocks import BLOCK, Blocks
from autdtorch.fdtd.kernels.contract import (
    CPU,
    Coefficients,
    Columns,
    Receivers,
    Sources,
    WaveState,
    uniform_state,
)
from autdtorch.fdtd.kernels.cpu_intrinsics import (
    add_to_counter,
    give_way,
    losses_around,
    read_counter,
)
from autdtorch.fdtd.kernels.cpu_layers import FlatMemory, plane_profiles, rows_profile, stretch
from autdtorch.fdtd.kernels.cpu_sweep import planes_at_once, strips_of, sweep_planes, workspace
from autdtorch.fdtd.kernels.cpu_waves import superposition
from autdtorch.fdtd.stencil import OFFSETS, flat_offsets
from autdtorch.utils.array_types import COMPLEX, REAL, AnyArray, Index
from autdtorch.utils.compiled import INNER, entry, meanwhile
from autdtorch.utils.process import spread, thread_count

# Fewest cells and planes of a chunk, for which a second thread and the sums at its ends pay
_CHUNK_CELLS, _CHUNK_PLANES = 200_000, 32
_FLAT_PLANES = 12  # Fewest planes of two chunks of large planes
# Shares of the processors' time that workers got: below the first a single worker continues, above the second
# several again
_CROWDED, _FREE = 0.75, 0.9
_COUNTERS = 32  # Numbers that hold the two counters, 0 at first
_CLAIMED, _FINISHED = 0, 16  # Their places, on separate cache lines
_UNROLLED = 32  # Cells that a compiled loop computes at once: the lanes of four vectors
_TICKS = 10  # Fewest ticks of the thread clock for a meaningful time
# Polls of the counter before a waiting worker yields: a few microseconds, less than waking costs
_LOOKS = 2000


@njit(**INNER)
def _wait_for(counters, tasks):  # type: ignore[no-untyped-def]
    """Wait until so many tasks are finished."""
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


@entry()
def _advance(  # type: ignore[no-untyped-def]
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


def _cuts(shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the first planes of the chunks, each thicker than an absorbing layer, and one past the last."""
    planes = shape[0] - 2
    cells = math.prod(shape)
    of_cells = cells // _CHUNK_CELLS
    most = max(min(of_cells, planes // _CHUNK_PLANES), min(of_cells, planes // _FLAT_PLANES, 2))
    chunks = 1 << max(0, most.bit_length() - 1)  # a power of two, which most numbers of cores divide
    return np.linspace(1, 1 + planes, chunks + 1).astype(np.int64)


def _idle(runs: AnyArray, shape: torch.Size) -> tuple[AnyArray, AnyArray]:
    """Return idle runs (g, 2), by cells of their planes, and the number of the first run of each plane.

    They begin a little later, so that loops over the cells between them have no remainder.
    """
    plane, row = shape[1] * shape[2], shape[2]
    starts, (first, last) = np.searchsorted(runs[:, 0], plane * np.arange(shape[0] + 1)), runs.T % plane
    before = np.roll(last, 1)
    before[starts[:-1][np.diff(starts) > 0]] = row + 1
    first = before + _UNROLLED * -((before - first) // _UNROLLED)
    return np.stack((np.minimum(first, last), last), axis=1).astype(np.uint64), starts


def _columns(c: Coefficients) -> tuple[Any, ...]:
    """Return columns, crossed ones, places of these ones' terms, and for these no terms at no places."""
    none = torch.zeros_like(c.crossed.index).numpy()
    return *(_filed(c, each) for each in (c.columns, c.crossed)), c.crossing.numpy(), _zeros(c, 0), none


def _filed(c: Coefficients, columns: Columns) -> tuple[AnyArray, ...]:
    """Return cells, offsets, weights, workspace for sums across and for terms, and profile of columns."""
    parts = columns.index, columns.offset, columns.weight
    count, cells = len(columns.index), c.layer_cells
    work = _zeros(c, (cells + 2) * count), _zeros(c, cells * count)
    return *(part.contiguous().numpy() for part in parts), *work, *rows_profile(c, count)


def _zeros(c: Coefficients, count: int) -> AnyArray:
    return c.layer_decay.new_zeros(count).numpy()


def _heterogeneous_cells(c: Coefficients, shape: torch.Size) -> tuple[AnyArray, ...]:
    """Return blocks, their weights, offsets, which are in layers, layer scale, air's weights, workspace."""
    blocks = c.heterogeneous
    air = np.array((c.center, c.face, c.edge, c.corner), blocks.weight.dtype)[np.abs(OFFSETS).sum(axis=1)]
    index = c.heterogeneous_index.numpy()
    scale = np.zeros_like(blocks.weight, shape=len(index))
    scale[np.searchsorted(index, c.layer_index.numpy())] = c.layer_scale.numpy()
    scale = blocks.laid(scale)
    in_layer = (scale.reshape(-1, BLOCK) != 0).any(axis=1)
    work = np.empty_like(scale), np.empty_like(scale)
    offset = np.array(flat_offsets(shape)[::3])
    return *_flat(blocks), offset, in_layer, scale, air.repeat(BLOCK), *work


def _losses(c: Coefficients, plane: int, cuts: NDArray[np.int64]) -> tuple[AnyArray, ...]:
    """Return the lossy cells: blocks, their weights, sums of these, ground, first of a chunk, workspace."""
    blocks = c.lossy
    total = blocks.weight.sum(axis=1)[blocks.kind].reshape(-1)
    ground = blocks.laid(c.loss_ground.numpy().astype(total.dtype, copy=False))
    starts = _first_blocks(blocks, plane * cuts)
    return *_flat(blocks), total, ground, starts, np.empty_like(total)


def _forces(c: Coefficients, sources: Sources) -> tuple[AnyArray, AnyArray, AnyArray]:
    """Return the driven cells (n,) and their forces by signal (S, n), and forces (S, slots) of all blocks.

    Forces on all heterogeneous cells are those of the blocks.
    """
    # numba compiles again for arrays with gaps, and crashed when it loaded that from disk
    force = sources.force[0].mT.contiguous().numpy()
    if not np.array_equal(sources.index.numpy(), c.heterogeneous_index.numpy()):
        return _unsigned(sources.index), force, np.zeros_like(force, shape=(0, 0))
    of_blocks = c.heterogeneous.laid(force)
    return _unsigned(sources.index[:0]), np.zeros_like(force, shape=(len(force), 0)), of_blocks


def _flat(blocks: Blocks) -> tuple[AnyArray, ...]:
    """Return the first cells, lanes, first weights and weights of blocks."""
    first = blocks.first.view(np.uint64)
    return first, blocks.lanes, blocks.kind * np.uint64(27 * BLOCK), blocks.weight.reshape(-1)


def _first_blocks(blocks: Blocks, cells: Index) -> Index:
    """Return the number of the first block behind each of the flat indices `cells`, ascending."""
    return np.searchsorted(blocks.first + blocks.lanes[:, 0], cells)


def _share_of_processors(work: Callable[[], object], workers: int) -> float:
    """Run `work` on several workers; return the share of the time in which they had a processor, 0 to 1."""

    def timed(_: int) -> float:
        begin = time.thread_time()
        work()
        return time.thread_time() - begin

    begin = time.perf_counter()
    spent, took = sum(spread(timed, range(workers), workers)), time.perf_counter() - begin
    if took < _TICKS * time.get_clock_info("thread_time").resolution:  # 16 ms on Windows
        return 1.0
    return spent / (workers * took)


def _unsigned(index: torch.Tensor) -> AnyArray:
    return index.contiguous().numpy().view(np.uint64)


class CpuKernel:
    """Kernel on the CPU, which updates the state in place; see `kernels.contract`."""

    device = CPU

    def __init__(self) -> None:
        """Assume free processors at first."""
        self._crowded = False

    def at_once(self, shape: tuple[int, int, int]) -> int:
        """Return as many as threads allow with one for each chunk, of grids of more than two chunks 1."""
        chunks = len(_cuts(shape)) - 1
        return max(1, thread_count() // chunks) if chunks <= 2 else 1

    def together(self, shape: tuple[int, int, int], receivers: int) -> int:
        """Return 1: the fields of several runs would share the caches."""
        return 1

    def advance(
        self, state: WaveState, c: Coefficients, sources: Sources, receivers: Receivers, signal: torch.Tensor
    ) -> tuple[WaveState, torch.Tensor]:
        """See `Kernel.advance`."""
        runs = [slice(run, run + 1) for run in range(len(state.now))]
        # in large pages, unlike PyTorch's
        recorded = np.empty((len(runs), len(signal), len(receivers.index)), state.now.numpy().dtype)
        for run, record in zip(runs, recorded, strict=True):
            driven = Sources(sources.index, sources.force[run])
            self._step(state.chosen(run), c, driven, receivers, signal, record)
        now, before = (state.now, state.before) if len(signal) % 2 == 0 else (state.before, state.now)
        return WaveState(now, before, state.memory), torch.from_numpy(recorded)

    def _step(
        self,
        state: WaveState,
        c: Coefficients,
        sources: Sources,
        receivers: Receivers,
        signal: torch.Tensor,
        recorded: AnyArray,
    ) -> None:
        """Step a single run, and set its record (steps, q)."""
        shape, cuts = state.now.shape[1:], _cuts(state.now.shape[1:])
        plane = shape[1] * shape[2]
        dtype = c.heterogeneous_weight.numpy().dtype.type
        forces = _forces(c, sources)
        medium = (
            cuts,
            _first_blocks(c.heterogeneous, plane * np.arange(shape[0] + 1)),
            np.searchsorted(forces[0], plane * cuts),
            np.searchsorted(c.sound_hard_index.numpy(), plane * cuts),
            *(np.uint64(cells) for cells in shape),
            *(dtype(weight) for weight in (c.center, c.face, c.edge, c.corner, c.keep)),
            c.layer_decay.numpy(),
            c.layer_gain.numpy(),
            *plane_profiles(c, shape, planes_at_once(shape, c.layer_cells)),
            *_idle(c.idle.numpy(), shape),
            strips_of(shape, c.layer_cells),
        )
        memory = FlatMemory(state.memory)
        arguments = (
            state.now.numpy().reshape(-1),
            state.before.numpy().reshape(-1),
            medium,
            tuple(part.reshape(-1) for part in memory.arrays),
            _heterogeneous_cells(c, shape),
            _losses(c, plane, cuts),
            workspace(cuts, shape, c.layer_cells, dtype),
            _columns(c),
            tuple((psi.reshape(-1).numpy(), zeta.reshape(-1).numpy()) for psi, zeta in state.memory[4:]),
            _unsigned(c.sound_hard_index),
            forces,
            (_unsigned(receivers.index.mT), receivers.weight.mT.contiguous().numpy()),
            signal.contiguous().numpy(),
            recorded,
            np.zeros(_COUNTERS, np.int64),
        )
        self._work(lambda: _advance(*arguments), len(cuts) - 1)
        memory.give_back()

    def compiled_ahead(self, dtype: torch.dtype) -> AbstractContextManager[None]:
        """Compile `advance` in another process while the sums of waves are compiled here."""
        none = torch.zeros((0, 1), dtype=torch.int64, device="cpu")
        silent = torch.zeros((0, 1), dtype=dtype, device="cpu")

        def step() -> None:
            c = Coefficients.of_air(dtype)
            state = uniform_state((3, 3, 3), c, 0.0)  # no steps: of any shape
            self.advance(state, c, Sources(none[:, 0], silent[None]), Receivers(none, silent), silent)

        def add() -> None:
            places = torch.eye(3, **REAL)
            superposition(places[:1], places[1:], torch.ones((2, 1), **COMPLEX), 1.0, dtype=silent.dtype)

        return meanwhile(_advance, step, add)

    def _work(self, advance: Callable[[], object], chunks: int) -> None:
        """Step on as many threads as chunks and free processors; workers that wait are slower than one."""
        workers = 1 if self._crowded else min(thread_count(), chunks)
        share = _share_of_processors(advance, workers)
        if chunks > 1:
            self._crowded = share < (_FREE if self._crowded else _CROWDED)


@entry(fastmath={"reassoc", "nsz"})  # vectorises sums of products; nothing that could be inlined is called
def correlate(first, last, adjoint, field, index, offsets, place, total):  # type: ignore[no-untyped-def]
    """Add sums of lambda_i (p_j - p_i) over the steps to rows `first` to `last` of `total` (n, 27).

    `adjoint` is lambda (n, steps) in the cells `index` (n,), `field` is p (k, steps) in these and their
    neighbours at `offsets` (27,). `place` is the row of a cell in `field`.
    """
    for i in range(first, last):
        here = place[index[i]]
        for j in range(len(offsets)):
            other, product = place[index[i] + offsets[j]], total[i, j]
            for t in range(adjoint.shape[1]):
                product += adjoint[i, t] * (field[other, t] - field[here, t])
            total[i, j] = product
