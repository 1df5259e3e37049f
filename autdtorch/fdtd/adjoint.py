"""Gradients of what receivers record, by an adjoint run of any kernel.

Times the masses of its cells the scheme is symmetric, the boundary layers included: what a force on cell j
makes of cell i some steps later is m_j / m_i times what one on i makes of j. So the derivatives lambda of a
loss by the forces on all cells come from a run of the same kernel: driven in the receivers' cells by the
loss's derivatives by what they recorded, last step first, over the masses, and read times the masses. Then

    dL / d force_is  = sum_t lambda_i(t) signal_s(t)
    dL / d weight_ij = sum_t lambda_i(t) (p_j(t) - p_i(t)).

For the second the run itself is needed in reverse. Its state is kept at the beginning of segments, and each
segment is stepped again, with the heterogeneous cells and their neighbours as receivers. What it costs is in
`docs/decisions/gradients.md`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import torch
from torch.autograd.function import once_differentiable

from autdtorch.fdtd.interpolation import Interpolation
from autdtorch.fdtd.kernels.contract import Kernel, Layer, Receivers, Sources, State
from autdtorch.fdtd.stencil import flat_offsets
from autdtorch.fdtd.stepping import Assembly
from autdtorch.utils.threads import spread

_SEGMENT_BYTES = 128 * 2**20
"""Of what is recorded in a segment at once; longer ones only where the states kept would take more."""

_CELLS_AT_ONCE = 1000
"""Cells whose derivatives are a piece of work."""

_ROUNDING = 4
"""Roundings of the largest singular value below which others are nothing else."""


def recorded(
    kernel: Kernel, assembly: Assembly, sources: Sources, receivers: Receivers, signal: torch.Tensor
) -> torch.Tensor:
    """Step from silence, once per row of `signal` (steps, S), and record (steps, R); see `Kernel.advance`.

    Differentiable, once, by `sources.force` and by `assembly.coefficients.heterogeneous_weight`. Stencil rows
    in the boundary layers count as constant: their derivatives are zero.

    Raises:
        ValueError: a source or a receiver is in the boundary layers, where reciprocity does not hold.
    """
    for name, index in (("sources", sources.index), ("receivers", receivers.index)):
        if not assembly.grid.inside(index.numpy()).all():
            raise ValueError(f"{name}: cells in the boundary layers; must be inside of them")
    weight = assembly.coefficients.heterogeneous_weight
    coefficients = replace(assembly.coefficients, heterogeneous_weight=weight.detach())
    run = _Run(kernel, replace(assembly, coefficients=coefficients), sources.index, receivers, signal)
    result: torch.Tensor = _Recorded.apply(sources.force, weight, run)  # type: ignore[no-untyped-call]
    return result


@dataclass(frozen=True)
class _Run:
    """What is constant in a run."""

    kernel: Kernel
    assembly: Assembly
    driven: torch.Tensor
    receivers: Receivers
    signal: torch.Tensor

    def advance(
        self, state: State, sources: Sources, receivers: Receivers, signal: torch.Tensor
    ) -> tuple[State, torch.Tensor]:
        """Step a copy of the state."""
        state, heard = self.kernel.advance(
            _copy(state), self.assembly.coefficients, sources, receivers, signal
        )
        return state, heard.cpu()

    def single(self, cells: torch.Tensor) -> Receivers:
        """Cells (k,) as receivers."""
        return Receivers(cells[:, None], torch.ones((len(cells), 1), dtype=self.assembly.dtype, device="cpu"))

    def fields(
        self, state: State, sources: Sources, cells: torch.Tensor, signal: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Pressure in cells (k,) before the first of some steps (1, k), and after each (steps, k)."""
        first = state.now.reshape(1, -1)[:, cells.to(state.now.device)].cpu()
        return first, self.advance(state, sources, self.single(cells), signal)[1]

    def mass(self, cells: torch.Tensor) -> torch.Tensor:
        """Of cells (k,), no two alike."""
        return torch.from_numpy(self.assembly.heterogeneous.mass_of(cells.numpy())).to(self.assembly.dtype)

    def adjoint_sources(self, slope: torch.Tensor) -> tuple[Sources, torch.Tensor]:
        """What drives the adjoint run, and by which signals (steps, S), last step first.

        Derivatives (steps, R) of few independent signals, such as those of phasors, are brought down to
        these: S is their rank.
        """
        loud = slope.any(dim=1)
        left, size, right = torch.linalg.svd(slope[loud], full_matrices=False)
        rank = int((size > _ROUNDING * torch.finfo(slope.dtype).eps * size[:1]).sum())
        signal = torch.zeros((len(slope), rank), dtype=slope.dtype, device="cpu")
        signal[loud] = left[:, :rank]
        amplitude = (size[:rank, None] * right[:rank]).T
        cells, place = torch.unique(self.receivers.index, return_inverse=True)
        force = torch.zeros((len(cells), rank), dtype=slope.dtype, device="cpu")
        for point, weight, own in zip(place, self.receivers.weight, amplitude, strict=True):
            force.index_add_(0, point, weight[:, None] * own)
        return Sources(cells, force / self.mass(cells)[:, None]), signal.flip(0)


@dataclass(frozen=True)
class _Neighbourhood:
    """The heterogeneous cells outside the layers, and the cells whose field their derivatives need.

    Attributes:
        own: which of the heterogeneous cells they are (n,).
        index: their flat indices.
        cells: these, their neighbours' and those of the receivers (k,), ascending.
        offsets: to the neighbours (27,).
        points: the receivers.
    """

    own: torch.Tensor
    index: torch.Tensor
    cells: torch.Tensor
    offsets: torch.Tensor
    points: Interpolation

    @classmethod
    def of(cls, run: _Run) -> _Neighbourhood:
        grid, heterogeneous = run.assembly.grid, run.assembly.coefficients.heterogeneous_index
        own = torch.from_numpy(grid.inside(heterogeneous.numpy()))
        index, offsets = heterogeneous[own], torch.from_numpy(flat_offsets(grid.shape))
        used = torch.zeros(math.prod(grid.shape), dtype=torch.bool, device="cpu")
        used[run.receivers.index] = True
        for offset in offsets:
            used[index + offset] = True
        points = Interpolation(run.receivers.index.numpy(), run.receivers.weight.numpy())
        return cls(own, index, used.nonzero().reshape(-1), offsets, points)

    def heard(self, field: torch.Tensor) -> torch.Tensor:
        """What the receivers hear (steps, R) of the field in the cells (steps, k)."""
        return torch.from_numpy((self.points.matrix(self.cells.numpy()) @ field.numpy().T).T)

    def correlate(
        self, adjoint: torch.Tensor, first: torch.Tensor, after: torch.Tensor, total: torch.Tensor
    ) -> None:
        """Add to `total` (n, 27) the sums of lambda_i (p_j - p_i), of lambda (steps, n) and `_Run.fields`."""
        from autdtorch.fdtd.kernels.cpu_correlation import correlate  # with numba, which takes its time

        field = torch.empty(after.shape[::-1], dtype=after.dtype, device="cpu")
        field[:, 0], field[:, 1:] = first[0], after[:-1].T
        place = torch.zeros(int(self.cells[-1]) + 1, dtype=torch.int32, device="cpu")
        place[self.cells] = torch.arange(len(self.cells), dtype=torch.int32, device="cpu")
        tensors = adjoint.T.contiguous(), field, self.index, self.offsets, place, total
        arrays = [tensor.numpy() for tensor in tensors]
        ends = pairwise([*range(0, len(self.index), _CELLS_AT_ONCE), len(self.index)])
        spread(lambda rows: correlate(*rows, *arrays), ends)


class _Recorded(torch.autograd.Function):
    """Forwards the run, backwards the adjoint run beside its segments."""

    @staticmethod
    def forward(ctx: Any, force: torch.Tensor, weight: torch.Tensor, run: _Run) -> torch.Tensor:
        """Record, and keep the states at the cuts where derivatives by the weights are wanted."""
        sources, steps = Sources(run.driven, force.detach()), len(run.signal)
        state = run.assembly.silence(sources)
        ctx.run, ctx.sources, ctx.around, ctx.cuts = run, sources, None, [0, steps]
        if not ctx.needs_input_grad[1]:
            return run.advance(state, sources, run.receivers, run.signal)[1]
        ctx.around = around = _Neighbourhood.of(run)
        ctx.cuts, ctx.states = _cuts(steps, state, len(around.cells)), []
        recorded = []
        for start, end in pairwise(ctx.cuts):
            ctx.states.append(state)
            part = run.signal[start:end]
            if end < steps:
                state, heard = run.advance(state, sources, run.receivers, part)
            else:  # where the backward pass begins
                ctx.last = run.fields(state, sources, around.cells, part)
                heard = around.heard(ctx.last[1])
            recorded.append(heard)
        return torch.cat(recorded)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None, None]:
        """Step the adjoint run, and again the segments that go with it."""
        run, around, steps, driven = ctx.run, ctx.around, len(slope), len(ctx.run.driven)
        by_force = torch.zeros_like(ctx.sources.force)
        by_row = torch.zeros(
            (0 if around is None else len(around.index), 27), dtype=by_force.dtype, device="cpu"
        )
        if slope.any():
            cells = [run.driven] if around is None else [run.driven, around.index]
            mass, read = torch.cat([run.mass(group) for group in cells]), run.single(torch.cat(cells))
            sources, signal = run.adjoint_sources(slope)
            state = run.assembly.silence(sources)
            for number in reversed(range(len(ctx.cuts) - 1)):
                start, end = ctx.cuts[number : number + 2]
                part = run.signal[start:end]
                state, heard = run.advance(state, sources, read, signal[steps - end : steps - start])
                adjoint = mass * heard.flip(0)
                by_force += adjoint[:, :driven].double().T @ part.double()  # as in `drive_dft`
                if around is not None:
                    fields = ctx.last
                    if end < steps:
                        fields = run.fields(ctx.states[number], ctx.sources, around.cells, part)
                    around.correlate(adjoint[:, driven:], *fields, by_row)
        if around is None:
            return by_force, None, None
        by_weight = torch.zeros_like(run.assembly.coefficients.heterogeneous_weight)
        by_weight[around.own] = by_row
        return by_force, by_weight, None


def _copy(state: State) -> State:
    def copied(layer: Layer) -> Layer:
        return layer[0].clone(), layer[1].clone()

    layers = tuple(map(copied, state.layers))
    return State(
        state.now.clone(), state.before.clone(), layers, copied(state.columns), copied(state.crossed)
    )


def _cuts(steps: int, state: State, cells: int) -> list[int]:
    """Where segments begin and end: with the states kept, they hold least at the root of these lengths."""
    memory = (*state.layers, state.columns, state.crossed)
    numbers = 2 * state.now.numel() + sum(part.numel() for layer in memory for part in layer)
    longest = max(
        _SEGMENT_BYTES / (cells * state.now.element_size()), math.sqrt(steps * numbers / (2 * cells))
    )
    count = math.ceil(steps / longest)
    return [steps * number // count for number in range(count + 1)]
