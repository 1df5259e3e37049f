"""The kernel for NVIDIA GPUs, in Triton.

Fields, memory and coefficients stay on the device between calls: returned states and records are tensors on
it. With TRITON_INTERPRET=1 Triton interprets the steps, slowly, on the CPU.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
import triton
from torch import Tensor

from autdtorch.fdtd.kernels import cuda_steps, cuda_sweep
from autdtorch.fdtd.kernels.contract import (
    Coefficients,
    Columns,
    Kernel,
    Layer,
    Memory,
    Receivers,
    Sources,
    WaveState,
)
from autdtorch.utils.validation import invalid, no_cuda

_GRAPH_STEPS = 16  # Most steps of a captured graph; even, so that both fields return to their places
# Steps of a run that are launched one by one, at some 100 us each from Python; to capture its graphs takes
# as long as 500 to 1000 of these
_LAUNCHED = 512
# Most cells of runs whose steps are captured. Beyond, a step takes longer than its three launches from
# Python: with absorbing layers, 7 million cells take 90 us on an H200.
_MOST_CAPTURED = 2**23
_MOST_CACHED = 2**22  # Most cells whose two fields, in single precision, stay in 50 MB of cache
_FEWEST_PROGRAMS = 1400  # That occupy a GPU of 132 multiprocessors
_MOST_RUNS, _MOST_CELLS = 256, 2**27  # Of a launch; more take their time one after the other
# Memory [bytes], in double precision, of a cell with its layers on a grid of 60^3, and of a receiver, mostly
# its record
_FIELD_BYTES, _RECORD_BYTES = 48, 3200


class BlockSizes(NamedTuple):
    """Sizes of a program's work, powers of two."""

    x: int = 16  # planes that a tile marches through
    y: int = 2  # rows of a tile
    z: int = 64  # cells of its rows, which are contiguous
    rows: int = 2  # rows that a thread steps
    lanes: int = 16  # columns through an absorbing layer
    registers: int | None = None  # most of a thread of the sweep, in single precision


def blocks_of(shape: Cells, runs: int) -> BlockSizes:
    """Return the blocks for runs on a grid, by timings on an H200."""
    nx, ny, nz = shape
    if runs * nx * ny * nz > _MOST_CACHED:
        return BlockSizes(y=4, rows=4, registers=128)
    blocks = BlockSizes()
    tiles = runs * triton.cdiv(ny, blocks.y) * triton.cdiv(nz, blocks.z)
    # a march takes its time however few programs there are
    while blocks.x > 1 and triton.cdiv(nx, blocks.x) * tiles < _FEWEST_PROGRAMS:
        blocks = blocks._replace(x=blocks.x // 2)
    return blocks


class Ends(NamedTuple):
    """Number of the program after the last of each task of `prepare`, except the receivers."""

    z: int
    y: int
    yz: int
    heterogeneous: int
    crossed: int


class DeviceMedium:
    """A medium on the device, and workspace for some runs."""

    def __init__(
        self, c: Coefficients, shape: Cells, runs: int, blocks: BlockSizes, device: torch.device
    ) -> None:
        """Copy the medium `c` of a grid to a device."""
        self.coefficients, self.shape, self.runs, self.blocks, self.device = c, shape, runs, blocks, device
        self.cells, self.depths = c.layer_cells, triton.next_power_of_2(max(1, c.layer_cells))
        self.dtype = c.layer_decay.dtype
        # whether programs of the next launch may begin, and wait, while those of a launch end
        self.early = device.type == "cuda" and torch.cuda.get_device_capability() >= (9, 0)
        weights = c.center, c.face, c.edge, c.corner, c.keep
        self.weights = torch.tensor(weights, dtype=self.dtype, device=device)
        padding = 0, 2 * self.depths + 1 - len(c.layer_decay)
        profile = (torch.nn.functional.pad(each, padding) for each in (c.layer_decay, c.layer_gain))
        self.profile = Profile(*(each.to(device) for each in profile))
        self.heterogeneous = heterogeneous_table(c, runs, device)
        self.columns = column_table(c.columns, c.crossing, device)
        self.crossed = column_table(c.crossed, c.crossing[:0], device)
        self.settled = settled_table(c, device)
        self.terms = no_terms(shape, runs, c, device)
        nx, ny, nz = shape
        columns = (nx * ny, nx * nz, 2 * self.cells * nx) if self.cells else (0, 0, 0)
        z, y, yz = (2 * triton.cdiv(count, blocks.lanes) for count in columns)
        heterogeneous = triton.cdiv(self.heterogeneous.size, self.depths * blocks.lanes)
        crossed = triton.cdiv(self.crossed.size, blocks.lanes)
        self.ends = Ends(*itertools.accumulate((z, y, yz, heterogeneous, crossed)))
        self.tiles = triton.cdiv(nx - 2, blocks.x) * triton.cdiv(ny, blocks.y) * triton.cdiv(nz, blocks.z)


class DeviceRun:
    """A state with its sources and receivers: the arguments of all launches."""

    def __init__(
        self, medium: DeviceMedium, state: WaveState, sources: Sources, receivers: Receivers, steps: int
    ) -> None:
        """Copy a state to the medium's device, for calls of `steps` each."""
        self.medium, self.state, self.sources, self.receivers = medium, state, sources, receivers
        dtype, device = medium.dtype, medium.device
        self._fields = tuple(field.to(device).contiguous() for field in (state.now, state.before))
        memory = Memory(*(Layer(*(part.to(device).contiguous() for part in each)) for each in state.memory))
        self._memories = memory, Memory(*(Layer(*map(torch.zeros_like, each)) for each in memory))
        self._driven = driven_table(sources, medium.settled, dtype, device)
        self._received = receiver_table(receivers, medium.runs, steps, dtype, device)
        self.signal = torch.zeros((steps, sources.force.shape[2]), dtype=dtype, device=device)
        self._first = torch.zeros((), dtype=torch.int64, device=device)
        self._turn = self._launched = 0
        self._graphs: dict[tuple[int, int], torch.cuda.CUDAGraph] = {}  # by turn and number of steps

    def advance(self, signal: Tensor) -> Tensor:
        """Step once per row of the signal; return the record of the receivers."""
        self.signal.copy_(signal)
        self._first.zero_()
        steps, on_gpu = len(signal), self.medium.device.type == "cuda"
        if on_gpu and self._launched >= _LAUNCHED and self._fields[0].numel() <= _MOST_CAPTURED:
            self._replay(steps)
        else:
            self._launch(self._turn, steps)
            self._launched += steps
        self._turn = (self._turn + steps) % 2
        m, received, block = self.medium, self._received, self.medium.depths * self.medium.blocks.lanes
        grid = (m.runs * triton.cdiv(received.size, block),)
        cuda_steps.read_last[grid](
            self._fields[self._turn], m.shape, received, m.runs, steps - 1, LANES=block
        )  # fmt: skip
        now, before = self._fields[self._turn], self._fields[1 - self._turn]
        self.state = WaveState(now, before, self._memories[self._turn])
        return received.recorded.clone()

    def _replay(self, steps: int) -> None:
        done = 0
        while done < steps:
            part = self._turn, min(_GRAPH_STEPS, steps - done)
            if part not in self._graphs:
                graph = torch.cuda.CUDAGraph()
                with torch.cuda.graph(graph):
                    self._launch(*part)
                self._graphs[part] = graph
            self._graphs[part].replay()
            done += part[1]

    def _launch(self, turn: int, steps: int) -> None:
        for offset in range(steps):
            self._step(turn + offset, offset)
        self._first += steps

    def _step(self, turn: int, offset: int) -> None:
        """Launch the step `offset` rows of the signal after the first one."""
        m, blocks, driven, received = self.medium, self.medium.blocks, self._driven, self._received
        now, old = self._fields[turn % 2], self._memories[turn % 2]
        other, new = self._fields[(turn + 1) % 2], self._memories[(turn + 1) % 2]
        lanes = m.depths * blocks.lanes
        early = {"EARLY": m.early, "launch_pdl": m.early}
        sizes = {"CELLS": m.cells, "DEPTHS": m.depths, "LANES": blocks.lanes, **early}
        cuda_steps.prepare[(m.runs * (m.ends.crossed + triton.cdiv(received.size, lanes)),)](
            now, other, m.shape, m.weights, m.profile, old, new, m.terms, m.heterogeneous, m.crossed,
            received, m.ends, m.runs, self._first, offset, LOSSY=len(m.heterogeneous.loss) > 0,
            CROSSED_WIDTH=len(m.crossed.weight), **sizes,
        )  # fmt: skip
        cuda_sweep.sweep[(m.runs * (m.tiles + triton.cdiv(m.columns.size, blocks.lanes)),)](
            now, other, m.shape, m.weights, m.profile, old, new, m.terms, m.columns, m.crossed, m.tiles,
            m.runs, COLUMNS_WIDTH=len(m.columns.weight), X=blocks.x, Y=blocks.y, Z=blocks.z,
            ROWS=blocks.rows, num_warps=max(1, blocks.y * blocks.z // (32 * blocks.rows)),
            maxnreg=blocks.registers if m.dtype == torch.float32 else None, **sizes,
        )  # fmt: skip
        cuda_steps.settle[(m.runs * triton.cdiv(driven.size, lanes),)](
            other, m.shape, m.heterogeneous, m.settled, driven, m.terms, m.columns, self.signal, m.runs,
            self._first, offset, SHARES=len(m.settled.share), SIGNALS=driven.force.shape[1], CELLS=m.cells,
            LANES=lanes, **early,
        )  # fmt: skip


class CudaKernel(Kernel):
    """Kernel on the current CUDA device, which keeps states, the medium and the last run; see `Kernel`.

    One thread makes its calls, and waits for the device.
    """

    def __init__(self, blocks: BlockSizes | None = None) -> None:
        """Find the device; Triton may interpret without one. By default, `blocks` fit the grid."""
        interpreted = triton.knobs.runtime.interpret
        if not interpreted and not torch.cuda.is_available():
            raise invalid("kernel", "cuda", no_cuda())
        self.device = torch.device("cpu" if interpreted else "cuda")
        self._blocks = blocks
        self._medium: DeviceMedium | None = None
        self._run: DeviceRun | None = None

    def together(self, shape: tuple[int, int, int], receivers: int) -> int:
        """Return as many as fit half of the free memory, at most enough to occupy the device."""
        cells = math.prod(shape)
        most = max(1, min(_MOST_RUNS, _MOST_CELLS // cells))
        if self.device.type == "cpu":
            return most
        size = _FIELD_BYTES * cells + _RECORD_BYTES * receivers
        free, _ = torch.cuda.mem_get_info()
        # PyTorch keeps what runs before have freed
        unused = torch.cuda.memory_reserved() - torch.cuda.memory_allocated()
        return max(1, min(most, int((free + unused) / 2 / size)))

    @torch.no_grad()
    def advance(
        self, state: WaveState, c: Coefficients, sources: Sources, receivers: Receivers, signal: Tensor
    ) -> tuple[WaveState, Tensor]:
        """See `Kernel.advance`; the record stays on the device."""
        (runs, *cells), medium, run = state.now.shape, self._medium, self._run
        shape = Cells(*cells)
        if medium is None or medium.coefficients is not c or (medium.shape, medium.runs) != (shape, runs):
            self._run = run = None
            blocks = self._blocks or blocks_of(shape, runs)
            self._medium = medium = DeviceMedium(c, shape, runs, blocks, self.device)
        if (
            run is None or run.state is not state or run.sources is not sources
            or run.receivers is not receivers or len(run.signal) != len(signal)
        ):  # fmt: skip
            self._run = run = None  # frees its memory first
            self._run = run = DeviceRun(medium, state, sources, receivers, len(signal))
        recorded = run.advance(signal)
        return run.state, recorded


class Cells(NamedTuple):
    """Number of cells along x, y and z."""

    nx: int
    ny: int
    nz: int


class Profile(NamedTuple):
    """Recursion coefficients of the layers, zero-padded to the depth of a block of lanes."""

    decay: Tensor
    gain: Tensor


class Terms(NamedTuple):
    """Terms that layers add to the sums across them in R runs, low layer first, both counted inwards."""

    y: Tensor  # E_y p (R, nx, 2 L, nz)
    z: Tensor  # E_z p (R, nx, ny, 2 L)
    yz: Tensor  # E_y E_z p (R, nx, 2 L, 2 L)
    columns: Tensor  # added to the pressure (R, L m + 1), with a zero at the end
    crossed: Tensor  # likewise, added to the columns


class Heterogeneous(NamedTuple):
    """n heterogeneous cells."""

    size: int
    cell: Tensor  # flat index (n,)
    weight: Tensor  # stencil rows (27, n)
    scale: Tensor  # of the layers' term, 0 outside of them (n,)
    settled: Tensor  # workspace: new pressure less `scale` times the result of the sweep (R, n)
    loss: Tensor  # rows on the change of a step, and ground (28, n); none (0, n) without losses


class ColumnTable(NamedTuple):
    """m columns."""

    size: int
    cell: Tensor  # flat index (L + 2, m)
    offset: Tensor  # (w, m)
    weight: Tensor  # (w, m)
    crossing: Tensor  # place of the terms that cross them (L + 2, m)


class Settled(NamedTuple):
    """k cells that a sweep leaves wrong, ascending."""

    cell: Tensor  # flat index (k,)
    heterogeneous: Tensor  # place among the heterogeneous cells, -1 for others (k,)
    share: Tensor  # places among the columns' terms, including the zero at their end (w, k)
    sound_hard: Tensor  # 1 where sound-hard (k,)


class Driven(NamedTuple):
    """n cells to correct: the k of `Settled`, then those that are only driven."""

    settled: int  # k
    size: int  # n
    cell: Tensor  # flat index (n,)
    force: Tensor  # by each of the S signals (R, S, n)


class ReceiverTable(NamedTuple):
    """q receivers of w cells each."""

    size: int  # q
    width: int  # w
    steps: int  # of the record
    cell: Tensor  # flat index (w, q)
    weight: Tensor  # (w, q)
    recorded: Tensor  # record (R, steps, q)


def heterogeneous_table(c: Coefficients, runs: int, device: torch.device) -> Heterogeneous:
    """Return the heterogeneous cells, with the scale of the layers' term in those in layers."""
    index, count = c.heterogeneous_index.to(device), len(c.heterogeneous_index)
    scale = torch.zeros(count, dtype=c.heterogeneous_weight.dtype, device=device)
    scale[torch.searchsorted(index, c.layer_index.to(device))] = c.layer_scale.to(device)
    weight = c.heterogeneous_weight.to(device).T.contiguous()
    loss = weight.new_zeros((28 if len(c.loss_index) else 0, count))
    place = torch.searchsorted(index, c.loss_index.to(device).contiguous())
    loss[:, place] = torch.cat((c.loss_weight.T, c.loss_ground[None])).to(weight)[: len(loss)]
    settled = scale.new_zeros((runs, count))
    return Heterogeneous(count, index.contiguous(), weight, scale, settled, loss)


def column_table(columns: Columns, crossing: Tensor, device: torch.device) -> ColumnTable:
    """Return columns, with the places (m, L + 2) of the terms to add to each cell's sum."""
    index, offset, weight, crossing = (
        each.to(device).T.contiguous() for each in (columns.index, columns.offset, columns.weight, crossing)
    )
    count = index.shape[1]
    return ColumnTable(count, index, offset, weight if count else weight[:0], crossing)


def settled_table(c: Coefficients, device: torch.device) -> Settled:
    """Return heterogeneous cells, sound-hard cells and those of columns, each once."""
    inside = c.columns.index.to(device).T[1:-1].reshape(-1)
    heterogeneous, sound_hard = c.heterogeneous_index.to(device), c.sound_hard_index.to(device)
    cell = torch.unique(torch.cat((heterogeneous, sound_hard, inside)))
    place = torch.full_like(cell, -1)
    place[torch.searchsorted(cell, heterogeneous)] = torch.arange(len(heterogeneous), device=device)
    hard = torch.zeros(len(cell), dtype=torch.int8, device=device)
    hard[torch.searchsorted(cell, sound_hard)] = 1
    # the n-th of the terms that come to a cell is in row n
    taker, order = torch.sort(torch.searchsorted(cell, inside), stable=True)
    count = torch.bincount(taker, minlength=len(cell))
    nth = torch.arange(len(inside), device=device) - (count.cumsum(0) - count)[taker]
    width = int(count.max()) if len(inside) else 0
    share = torch.full((width, len(cell)), len(inside), dtype=torch.int64, device=device)
    share[nth, taker] = order
    return Settled(cell, place, share, hard)


def driven_table(sources: Sources, settled: Settled, dtype: torch.dtype, device: torch.device) -> Driven:
    """Return the settled cells and the driven ones, each once."""
    index = sources.index.to(device)
    listed = torch.isin(index, settled.cell)
    cell = torch.cat((settled.cell, index[~listed]))
    place = torch.searchsorted(settled.cell, index)
    place[~listed] = torch.arange(len(settled.cell), len(cell), device=device)
    of_sources = sources.force.detach().to(device, dtype)
    runs, _, signals = of_sources.shape
    force = torch.zeros((runs, signals, len(cell)), dtype=dtype, device=device)
    force[..., place] = of_sources.mT
    return Driven(len(settled.cell), len(cell), cell, force)


def receiver_table(
    receivers: Receivers, runs: int, steps: int, dtype: torch.dtype, device: torch.device
) -> ReceiverTable:
    """Return the receivers, for calls of `steps`."""
    index, weight = receivers.index.to(device).T.contiguous(), receivers.weight.to(device).T.contiguous()
    recorded = torch.zeros((runs, steps, index.shape[1]), dtype=dtype, device=device)
    return ReceiverTable(index.shape[1], len(index), steps, index, weight.to(dtype), recorded)


def no_terms(shape: Cells, runs: int, c: Coefficients, device: torch.device) -> Terms:
    """Return workspace for the layers' terms."""
    cells, (nx, ny, nz) = c.layer_cells, shape
    columns, crossed = ((cells * len(each.index) + 1,) for each in (c.columns, c.crossed))
    sizes = ((nx, 2 * cells, nz), (nx, ny, 2 * cells), (nx, 2 * cells, 2 * cells), columns, crossed)
    return Terms(*(torch.zeros((runs, *size), dtype=c.layer_decay.dtype, device=device) for size in sizes))
