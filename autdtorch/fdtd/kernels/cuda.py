"""The kernel for NVIDIA GPUs, in Triton.

Fields, memory and coefficients stay on the device between calls: returned states and records are tensors on
it. With TRITON_INTERPRET=1 Triton interprets the steps, slowly, on the CPU.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import torch
import triton
from torch import Tensor

from autdtorch.fdtd.kernels import cuda_steps
from autdtorch.fdtd.kernels import cuda_tables as tables
from autdtorch.fdtd.kernels.contract import Coefficients, Layer, Memory, Receivers, Sources, WaveState
from autdtorch.utils.validation import invalid, no_cuda

_GRAPH_STEPS = 16  # Steps of a captured graph; even, so that both fields return to their places
# Most cells of a grid whose steps are captured. Beyond, a step takes longer than its three launches from
# Python, some 100 us: 17 million cells take 112 us on an H100.
_MOST_CAPTURED = 2**25
_MOST_CACHED = 2**22  # Most cells whose two fields, in single precision, stay in 50 MB of cache
_FEWEST_PROGRAMS = 1000  # That occupy a GPU of 132 multiprocessors


class BlockSizes(NamedTuple):
    """Sizes of a program's work, powers of two."""

    x: int = 16  # planes that a tile marches through
    y: int = 4  # rows of a tile
    z: int = 32  # cells of its rows, which are contiguous
    lanes: int = 16  # columns through a boundary layer


def blocks_of(shape: tables.Cells) -> BlockSizes:
    """Return the blocks for a grid, by timings on an H100; `docs/decisions/kernels.md` has them."""
    nx, ny, nz = shape
    if nx * ny * nz > _MOST_CACHED:
        return BlockSizes(32, 1, 256)
    blocks = BlockSizes()
    tiles = triton.cdiv(ny, blocks.y) * triton.cdiv(nz, blocks.z)
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
    """A medium on the device, and workspace."""

    def __init__(
        self, c: Coefficients, shape: tables.Cells, blocks: BlockSizes, device: torch.device
    ) -> None:
        """Copy the medium `c` of a grid to a device."""
        self.coefficients, self.shape, self.blocks, self.device = c, shape, blocks, device
        self.cells, self.depths = c.layer_cells, triton.next_power_of_2(max(1, c.layer_cells))
        self.dtype = c.layer_decay.dtype
        weights = c.center, c.face, c.edge, c.corner, c.keep
        self.weights = torch.tensor(weights, dtype=self.dtype, device=device)
        padding = 0, 2 * self.depths + 1 - len(c.layer_decay)
        profile = (torch.nn.functional.pad(each, padding) for each in (c.layer_decay, c.layer_gain))
        self.profile = tables.Profile(*(each.to(device) for each in profile))
        self.heterogeneous = tables.heterogeneous_table(c, device)
        self.columns = tables.column_table(c.columns, c.crossing, device)
        self.crossed = tables.column_table(c.crossed, c.crossing[:0], device)
        self.settled = tables.settled_table(c, device)
        self.terms = tables.no_terms(shape, c, device)
        nx, ny, nz = shape
        z, y, yz = (2 * triton.cdiv(rows, blocks.lanes) for rows in (nx * ny, nx * nz, 2 * self.cells * nx))
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
        self._driven = tables.driven_table(sources, medium.settled, dtype, device)
        self._received = tables.receiver_table(receivers, steps, dtype, device)
        self.signal = torch.zeros((steps, sources.force.shape[1]), dtype=dtype, device=device)
        self._first = torch.zeros((), dtype=torch.int64, device=device)
        self._turn = 0
        self._graphs: dict[int, torch.cuda.CUDAGraph] = {}

    def advance(self, signal: Tensor) -> Tensor:
        """Step once per row of the signal; return the record of the receivers."""
        self.signal.copy_(signal)
        self._first.zero_()
        steps, small = len(signal), self._fields[0].numel() <= _MOST_CAPTURED
        captured = self.medium.device.type == "cuda" and steps > _GRAPH_STEPS and small
        done = self._replay(steps) if captured else 0
        for offset in range(steps - done):
            self._step(self._turn + offset, offset)
        self._turn = (self._turn + steps) % 2
        received, block = self._received, self.medium.depths * self.medium.blocks.lanes
        grid = (triton.cdiv(received.size, block),)
        cuda_steps.read_last[grid](self._fields[self._turn], received, steps - 1, LANES=block)
        now, before = self._fields[self._turn], self._fields[1 - self._turn]
        self.state = WaveState(now, before, self._memories[self._turn])
        return received.recorded.clone()

    def _replay(self, steps: int) -> int:
        """Step by replays of a captured graph; return the number of steps done."""
        done = 0
        if self._turn not in self._graphs:
            # two steps first: nothing may be compiled while a graph is captured
            for done in (1, 2):
                self._step(self._turn + done - 1, done - 1)
            self._first += done
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph):
                for offset in range(_GRAPH_STEPS):
                    self._step(self._turn + offset, offset)
                self._first += _GRAPH_STEPS
            self._graphs[self._turn] = graph
        while steps - done >= _GRAPH_STEPS:
            self._graphs[self._turn].replay()
            done += _GRAPH_STEPS
        return done

    def _step(self, turn: int, offset: int) -> None:
        """Launch the step `offset` rows of the signal after the first one."""
        m, blocks, driven, received = self.medium, self.medium.blocks, self._driven, self._received
        now, old = self._fields[turn % 2], self._memories[turn % 2]
        other, new = self._fields[(turn + 1) % 2], self._memories[(turn + 1) % 2]
        lanes = m.depths * blocks.lanes
        sizes = {"CELLS": m.cells, "DEPTHS": m.depths, "LANES": blocks.lanes}
        cuda_steps.prepare[(m.ends.crossed + triton.cdiv(received.size, lanes),)](
            now, other, m.shape, m.weights, m.profile, old, new, m.terms, m.heterogeneous, m.crossed,
            received, m.ends, self._first, offset, LOSSY=len(m.heterogeneous.loss) > 0,
            CROSSED_WIDTH=len(m.crossed.weight), **sizes,
        )  # fmt: skip
        cuda_steps.sweep[(m.tiles + triton.cdiv(m.columns.size, blocks.lanes),)](
            now, other, m.shape, m.weights, m.profile, old, new, m.terms, m.columns, m.tiles,
            COLUMNS_WIDTH=len(m.columns.weight), X=blocks.x, Y=blocks.y, Z=blocks.z,
            num_warps=blocks.y * blocks.z // 32, **sizes,
        )  # fmt: skip
        cuda_steps.settle[(triton.cdiv(driven.size, lanes),)](
            other, m.heterogeneous, m.settled, driven, m.terms.columns, self.signal, self._first, offset,
            SHARES=len(m.settled.share), SIGNALS=len(driven.force), LANES=lanes,
        )  # fmt: skip


class CudaKernel:
    """Kernel on the current CUDA device, which keeps states, the medium and the last run; see `Kernel`."""

    def __init__(self, blocks: BlockSizes | None = None) -> None:
        """Find the device; Triton may interpret without one. By default, `blocks` fit the grid."""
        interpreted = triton.knobs.runtime.interpret
        if not interpreted and not torch.cuda.is_available():
            raise invalid("kernel", "cuda", no_cuda())
        self._device = torch.device("cpu" if interpreted else "cuda")
        self._blocks = blocks
        self._medium: DeviceMedium | None = None
        self._run: DeviceRun | None = None

    def at_once(self, shape: tuple[int, int, int]) -> int:
        """Return 1: the device holds the last run."""
        return 1

    @torch.no_grad()
    def advance(
        self, state: WaveState, c: Coefficients, sources: Sources, receivers: Receivers, signal: Tensor
    ) -> tuple[WaveState, Tensor]:
        """See `Kernel.advance`; the record stays on the device."""
        shape = tables.Cells(*state.now.shape)
        medium, run = self._medium, self._run
        if medium is None or medium.coefficients is not c or medium.shape != shape:
            self._run = run = None
            self._medium = medium = DeviceMedium(c, shape, self._blocks or blocks_of(shape), self._device)
        if (
            run is None or run.state is not state or run.sources is not sources
            or run.receivers is not receivers or len(run.signal) != len(signal)
        ):  # fmt: skip
            self._run = run = None  # frees its memory first
            self._run = run = DeviceRun(medium, state, sources, receivers, len(signal))
        recorded = run.advance(signal)
        return run.state, recorded
