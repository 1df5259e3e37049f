"""Gradients of receiver records, by an adjoint run of any kernel (`docs/decisions/gradients.md`).

The derivatives lambda of a loss by all forces come from an adjoint run of the same kernel, last step first.
It is driven in the receivers' cells by the derivatives of the loss by their record, divided by the masses,
and its pressures are multiplied by the masses:

    dL / d force_is  = sum_t lambda_i(t) signal_s(t).
    dL / d weight_ij = sum_t lambda_i(t) (p_j(t) - p_i(t)).
    dL / d loss_ij   = sum_t lambda_i(t) (p_j(t) - p_j(t - 1)).
    dL / d ground_i  = -sum_t lambda_i(t) p_i(t).

All but the first sum need the run itself in reverse. Its state is stored at the beginning of segments, which
are stepped again with the heterogeneous cells and their neighbours as receivers.
"""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from autdtorch.fdtd.interpolation import Interpolation
from autdtorch.fdtd.kernels.contract import Kernel, Receivers, Sources, WaveState
from autdtorch.fdtd.stencil import flat_offsets
from autdtorch.fdtd.stepping import Assembly
from autdtorch.utils.process import spread

# Memory [bytes] of the record of a segment; larger only where the stored states would take more
_SEGMENT_BYTES = 128 * 2**20
_CHUNK = 1000  # Cells whose derivatives are summed at a time
_ROUNDING = 4  # Singular values below this many roundings of the largest are zero


def recorded(
    kernel: Kernel, assembly: Assembly, sources: Sources, receivers: Receivers, signal: Tensor
) -> Tensor:
    """Step one run from silence, once per row of `signal` (steps, S), and return the record (steps, q).

    Differentiable, once, by `sources.force`, `heterogeneous_weight`, `loss_weight` and `loss_ground`;
    derivatives by rows in the absorbing layers are zero. Sources and receivers, as those of `assembly`, must
    be outside of the layers, where reciprocity does not hold.
    """
    names = "heterogeneous_weight", "loss_weight", "loss_ground"
    rows = {name: getattr(assembly.coefficients, name) for name in names}
    constant = {name: row.detach() for name, row in rows.items()}
    coefficients = replace(assembly.coefficients, **constant)
    run = _Run(kernel, replace(assembly, coefficients=coefficients), sources.index, receivers, signal)
    result: Tensor = _Recorded.apply(sources.force, *rows.values(), run)  # type: ignore[no-untyped-call]
    return result


@dataclass(frozen=True)
class _Run:
    """The constants of a run."""

    kernel: Kernel
    assembly: Assembly
    driven: Tensor
    receivers: Receivers
    signal: Tensor

    def advance(
        self, state: WaveState, sources: Sources, receivers: Receivers, signal: Tensor
    ) -> tuple[WaveState, Tensor]:
        """Step a copy of the state of one run; return its record (steps, q)."""
        c = self.assembly.coefficients
        state, record = self.kernel.advance(deepcopy(state), c, sources, receivers, signal)
        return state, record[0].cpu()

    def fields(
        self, state: WaveState, sources: Sources, cells: Tensor, signal: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the two pressures in cells (k,) before the first step (2, k), and after each (steps, k)."""
        both = torch.stack((state.before.reshape(-1), state.now.reshape(-1)))
        first = both[:, cells.to(state.now.device)].cpu()
        return first, self.advance(state, sources, Receivers.at(cells, self.assembly.dtype), signal)[1]

    def mass(self, cells: Tensor) -> Tensor:
        """Return the mass of distinct cells (k,)."""
        return torch.from_numpy(self.assembly.heterogeneous.mass_of(cells.numpy())).to(self.assembly.dtype)

    def adjoint_sources(self, slope: Tensor) -> tuple[Sources, Tensor]:
        """Return sources and signals (steps, S) of the adjoint run, last step first; S is a rank."""
        loud = slope.any(dim=1)
        left, size, right = torch.linalg.svd(slope[loud], full_matrices=False)
        rank = int((size > _ROUNDING * torch.finfo(slope.dtype).eps * size[:1]).sum())
        signal = torch.zeros((len(slope), rank), dtype=slope.dtype, device="cpu")
        signal[loud] = left[:, :rank]
        amplitude = (size[:rank, None] * right[:rank]).T
        cells, place = torch.unique(self.receivers.index, return_inverse=True)
        force = torch.zeros((len(cells), rank), dtype=slope.dtype, device="cpu")
        for point, weight, size_of in zip(place, self.receivers.weight, amplitude, strict=True):
            force.index_add_(0, point, weight[:, None] * size_of)
        return Sources(cells, (force / self.mass(cells)[:, None])[None]), signal.flip(0)


@dataclass(frozen=True)
class _Neighbourhood:
    """The heterogeneous cells outside the layers, and the cells whose field their derivatives need."""

    mask: Tensor  # of these among the heterogeneous cells
    lossy_mask: Tensor  # of these among the lossy cells
    lossy: Tensor  # places of the lossy ones among these (l,)
    index: Tensor  # their flat indices (n,)
    cells: Tensor  # flat indices of these, of their neighbours and of the receivers (k,), ascending
    offsets: Tensor  # flat offsets to the neighbours (27,)
    points: Interpolation

    @classmethod
    def of(cls, run: _Run) -> _Neighbourhood:
        grid, heterogeneous = run.assembly.grid, run.assembly.coefficients.heterogeneous_index
        mask = torch.from_numpy(grid.inside(heterogeneous.numpy()))
        index, offsets = heterogeneous[mask], torch.from_numpy(flat_offsets(grid.shape))
        losses = run.assembly.coefficients.loss_index
        lossy_mask = torch.from_numpy(grid.inside(losses.numpy()))
        lossy = torch.searchsorted(index, losses[lossy_mask])
        used = torch.zeros(math.prod(grid.shape), dtype=torch.bool, device="cpu")
        used[run.receivers.index] = True
        for offset in offsets:
            used[index + offset] = True
        points = Interpolation(run.receivers.index.numpy(), run.receivers.weight.numpy())
        return cls(mask, lossy_mask, lossy, index, used.nonzero().reshape(-1), offsets, points)

    def received(self, field: Tensor) -> Tensor:
        """Return the record of the receivers (steps, R) from the field in the cells (steps, k)."""
        return torch.from_numpy((self.points.matrix(self.cells.numpy()) @ field.numpy().T).T)

    def correlate(self, adjoint: Tensor, first: Tensor, after: Tensor, totals: _Totals) -> None:
        """Add the sums over steps to `totals`, of lambda (steps, n) and `_Run.fields`."""
        field = torch.cat((first, after)).T  # before, at and after each step
        now = field[:, 1:-1].contiguous()
        self._correlate(adjoint, now, self.index, totals.weight)
        if len(self.lossy):
            lossy, change = self.index[self.lossy], now - field[:, :-2]
            here = torch.searchsorted(self.cells, lossy)
            adjoint = adjoint[:, self.lossy]
            self._correlate(adjoint, change, lossy, totals.loss)
            totals.loss.add_((adjoint.T * change[here]).sum(dim=1, keepdim=True))
            totals.ground.sub_((adjoint.T * now[here]).sum(dim=1))

    def _correlate(self, adjoint: Tensor, field: Tensor, index: Tensor, total: Tensor) -> None:
        """Add sums of lambda_i (f_j - f_i) to `total` (n, 27), of lambda (steps, n) in cells `index` (n,)."""
        from autdtorch.fdtd.kernels.cpu import correlate  # loads numba

        place = torch.zeros(int(self.cells[-1]) + 1, dtype=torch.int32, device="cpu")
        place[self.cells] = torch.arange(len(self.cells), dtype=torch.int32, device="cpu")
        tensors = adjoint.T.contiguous(), field, index, self.offsets, place, total
        arrays = [tensor.numpy() for tensor in tensors]
        ends = pairwise([*range(0, len(index), _CHUNK), len(index)])
        spread(lambda rows: correlate(*rows, *arrays), ends)


class _Totals(NamedTuple):
    """Derivatives by the rows of cells outside the layers."""

    weight: Tensor  # (n, 27)
    loss: Tensor  # (l, 27)
    ground: Tensor  # (l,)


class _Recorded(torch.autograd.Function):
    """The run forwards; the adjoint run and the segments it needs backwards."""

    @staticmethod
    def forward(ctx: Any, force: Tensor, weight: Tensor, loss: Tensor, ground: Tensor, run: _Run) -> Tensor:
        """Record, and store the states at the cuts where derivatives by the rows are needed."""
        sources, steps = Sources(run.driven, force.detach()), len(run.signal)
        state = run.assembly.silence(sources)
        ctx.run, ctx.sources, ctx.around, ctx.cuts = run, sources, None, [0, steps]
        if not any(ctx.needs_input_grad[1:4]):
            return run.advance(state, sources, run.receivers, run.signal)[1]
        ctx.around = around = _Neighbourhood.of(run)
        ctx.cuts, ctx.states = _cuts(steps, state, len(around.cells)), []
        records = []
        for start, end in pairwise(ctx.cuts):
            ctx.states.append(state)
            part = run.signal[start:end]
            if end < steps:
                state, record = run.advance(state, sources, run.receivers, part)
            else:  # where the backward pass begins
                ctx.last = run.fields(state, sources, around.cells, part)
                record = around.received(ctx.last[1])
            records.append(record)
        return torch.cat(records)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        """Step the adjoint run, and again the segments."""
        run, around, steps, driven = ctx.run, ctx.around, len(slope), len(ctx.run.driven)
        by_force = torch.zeros_like(ctx.sources.force)
        rows, lossy = (0, 0) if around is None else (len(around.index), len(around.lossy))
        totals = _Totals(*(by_force.new_zeros(size) for size in ((rows, 27), (lossy, 27), (lossy,))))
        if slope.any():
            cells = [run.driven] if around is None else [run.driven, around.index]
            mass = torch.cat([run.mass(group) for group in cells])
            read = Receivers.at(torch.cat(cells), run.assembly.dtype)
            sources, signal = run.adjoint_sources(slope)
            state = run.assembly.silence(sources)
            for number in reversed(range(len(ctx.cuts) - 1)):
                start, end = ctx.cuts[number : number + 2]
                part = run.signal[start:end]
                state, record = run.advance(state, sources, read, signal[steps - end : steps - start])
                adjoint = mass * record.flip(0)
                by_force[0] += adjoint[:, :driven].double().T @ part.double()  # double: as in `drive_dft`
                if around is not None:
                    fields = ctx.last
                    if end < steps:
                        fields = run.fields(ctx.states[number], ctx.sources, around.cells, part)
                    around.correlate(adjoint[:, driven:], *fields, totals)
        if around is None:
            return by_force, None, None, None, None
        c, masks = run.assembly.coefficients, (around.mask, around.lossy_mask, around.lossy_mask)
        by_rows = [torch.zeros_like(each) for each in (c.heterogeneous_weight, c.loss_weight, c.loss_ground)]
        for each, mask, total in zip(by_rows, masks, totals, strict=True):
            each[mask] = total
        return by_force, *by_rows, None


def _cuts(steps: int, state: WaveState, cells: int) -> list[int]:
    """Return the ends of segments, with least memory for the record of one and the stored states."""
    numbers = 2 * state.now.numel() + sum(part.numel() for layer in state.memory for part in layer)
    fitting = _SEGMENT_BYTES / (cells * state.now.element_size())
    least = math.sqrt(steps * numbers / (2 * cells))
    count = math.ceil(steps / max(fitting, least))
    return [steps * number // count for number in range(count + 1)]
