"""The kernel for CPUs, in numba: in place, on several cores.

The shape of the grid alone determines its chunks of planes (`_cuts`), so that results do not depend on the
number of threads. A step sweeps each chunk once (`cpu_sweep.py`). Then the outermost planes of a chunk
receive the terms of its neighbours, and single cells are corrected. A small grid is one chunk, stepped by one
thread. Several runs are stepped concurrently, and share the threads.

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
from numpy.typing import NDArray

from autdtorch.fdtd.kernels.contract import (
    BLOCK,
    CPU,
    Blocks,
    Coefficients,
    Columns,
    Kernel,
    Receivers,
    Sources,
    WaveState,
    uniform_state,
)
from autdtorch.fdtd.kernels.cpu_layers import FlatMemory, plane_profiles, rows_profile
from autdtorch.fdtd.kernels.cpu_steps import COUNTERS, advance
from autdtorch.fdtd.kernels.cpu_sweep import planes_at_once, strips_of, workspace
from autdtorch.fdtd.kernels.cpu_waves import superposition
from autdtorch.fdtd.stencil import OFFSETS, flat_offsets
from autdtorch.utils.array_types import COMPLEX, REAL, AnyArray, Index
from autdtorch.utils.compiled import entry, meanwhile
from autdtorch.utils.process import spread, thread_count

# Fewest cells and planes of a chunk, for which a second thread and the sums at its ends pay
_CHUNK_CELLS, _CHUNK_PLANES = 200_000, 32
_FLAT_PLANES = 12  # Fewest planes of two chunks of large planes
# Shares of the processors' time that workers got: below the first a single worker continues, above the second
# several again
_CROWDED, _FREE = 0.75, 0.9
# Most runs of a large grid at once, and most cells of their grids, of 10 bytes each. What a run does beside
# its steps, up to half of its time, takes one thread.
_FEW, _MOST_CELLS = 4, 2**27
_UNROLLED = 32  # Cells that a compiled loop computes at once: the lanes of four vectors
_TICKS = 10  # Fewest ticks of the thread clock for a meaningful time


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


class CpuKernel(Kernel):
    """Kernel on the CPU, which updates the state in place; see `kernels.contract`.

    A call steps one run: the fields of several would share the caches.
    """

    device = CPU

    def __init__(self) -> None:
        """Assume free processors at first."""
        self._crowded = False

    def at_once(self, shape: tuple[int, int, int]) -> int:
        """Return as many as threads allow with one for each chunk, or a few that share the threads evenly."""
        threads, few = thread_count(), min(_FEW, max(1, _MOST_CELLS // math.prod(shape)))
        return max(threads // (len(_cuts(shape)) - 1), threads // math.ceil(threads / few))

    def threads(self, shape: tuple[int, int, int]) -> int:
        """Return a thread for each chunk, as far as there are any."""
        return min(thread_count(), len(_cuts(shape)) - 1)

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
            np.zeros(COUNTERS, np.int64),
        )
        self._work(lambda: advance(*arguments), len(cuts) - 1)
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

        return meanwhile(advance, step, add)

    def _work(self, tasks: Callable[[], object], chunks: int) -> None:
        """Step on as many threads as chunks and free processors; workers that wait are slower than one."""
        workers = 1 if self._crowded else min(thread_count(), chunks)
        share = _share_of_processors(tasks, workers)
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
