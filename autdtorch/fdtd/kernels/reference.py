"""The reference kernel, in torch: the readable specification, differentiable by autograd."""

from __future__ import annotations

import torch
from torch import Tensor

from autdtorch.fdtd.kernels.contract import (
    CPU,
    Coefficients,
    Columns,
    Kernel,
    Layer,
    Memory,
    Receivers,
    Sources,
    WaveState,
)
from autdtorch.fdtd.stencil import flat_offsets

_X, _Y, _Z = 1, 2, 3  # Axes of fields; axis 0 is the runs


def neighbour_sum(field: Tensor, axis: int) -> Tensor:
    """Return the sum of the two neighbours along an axis, two cells shorter along it."""
    return field.narrow(axis, 0, field.shape[axis] - 2) + field.narrow(axis, 2, field.shape[axis] - 2)


def middle(field: Tensor, axis: int) -> Tensor:
    """Return the field without its first and last cell along an axis."""
    return field.narrow(axis, 1, field.shape[axis] - 2)


class ReferenceKernel(Kernel):
    """One torch expression per line of the contract, none of them in place."""

    device = CPU

    def advance(
        self, state: WaveState, c: Coefficients, sources: Sources, receivers: Receivers, signal: Tensor
    ) -> tuple[WaveState, Tensor]:
        """See `Kernel.advance`."""
        recorded = []
        for row in signal:
            state = self._step(state, c, sources.index, (sources.force * row).sum(-1))
            recorded.append((state.now.flatten(1)[:, receivers.index] * receivers.weight).sum(-1))
        return state, torch.stack(recorded, dim=1)

    def _step(self, state: WaveState, c: Coefficients, driven: Tensor, force: Tensor) -> WaveState:
        shape = state.now.shape
        new = torch.nn.functional.pad(_sweep(state.now, c) - c.keep * _core(state.before), (1,) * 6)
        flat_now, flat_before = state.now.flatten(1), state.before.flatten(1)
        now, before = flat_now[:, c.heterogeneous_index], flat_before[:, c.heterogeneous_index]
        around = c.heterogeneous_index[:, None] + torch.from_numpy(flat_offsets(shape[1:]))
        change = (c.heterogeneous_weight * (flat_now[:, around] - now[..., None])).sum(-1)
        value = now + c.keep * (now - before) + change
        new = new.flatten(1).index_copy(1, c.heterogeneous_index, value).reshape(shape)
        memory, term = _absorb(state.now, state.memory, c)
        term = term.flatten(1)
        term = term.index_copy(1, c.layer_index, c.layer_scale * term[:, c.layer_index]).reshape(shape)
        nothing = torch.zeros(c.crossed.index.T[1:].shape, dtype=flat_now.dtype, device="cpu")
        crossed, beside = _absorb_columns(flat_now, c.crossed, nothing, state.memory.crossed, c)
        beside = torch.nn.functional.pad(beside.flatten(1), (0, 1))[:, c.crossing.T[1:]]
        columns, shares = _absorb_columns(flat_now, c.columns, beside, state.memory.columns, c)
        inside = c.columns.index.T[1:-1].reshape(-1)
        new = (new + term).flatten(1).index_add(1, inside, shares.flatten(1))
        if len(c.loss_index):
            around = c.loss_index[:, None] + torch.from_numpy(flat_offsets(shape[1:]))
            lost = (c.loss_weight * (flat_now - flat_before)[:, around]).sum(-1)
            new = new.index_add(1, c.loss_index, lost - c.loss_ground * flat_now[:, c.loss_index])
        new = new.index_add(1, driven, force).index_fill(1, c.sound_hard_index, 0)
        memory = memory._replace(columns=columns, crossed=crossed)
        return WaveState(new.reshape(shape), state.now, memory)


def _core(field: Tensor) -> Tensor:
    return field[:, 1:-1, 1:-1, 1:-1]


def _sweep(p: Tensor, c: Coefficients) -> Tensor:
    """Return line 1 of the contract, without `before`, in all cells inside the ring."""
    along = {axis: neighbour_sum(p, axis) for axis in (_X, _Y, _Z)}
    others = (_X, _Y, _Z), (_Y, _X, _Z), (_Z, _X, _Y)
    faces = sum(middle(middle(along[a], b), d) for a, b, d in others)
    edges = sum(
        middle(neighbour_sum(along[a], b), d) for a, b, d in ((_X, _Y, _Z), (_Y, _Z, _X), (_Z, _X, _Y))
    )
    corners = neighbour_sum(neighbour_sum(along[_X], _Y), _Z)
    return c.center * _core(p) + c.face * faces + c.edge * edges + c.corner * corners


def _around(field: Tensor, axis: int) -> Tensor:
    """Return the sum of the two neighbours along an axis in every cell; zero beyond the field."""
    return _between(neighbour_sum(field, axis), axis, 1, 1)


def _between(field: Tensor, axis: int, before: int, after: int) -> Tensor:
    """Pad a field with `before` and `after` zeros along an axis."""
    width = [0] * 6
    width[2 * (_Z - axis)], width[2 * (_Z - axis) + 1] = before, after
    return torch.nn.functional.pad(field, width)


def _absorb(p: Tensor, memory: Memory, c: Coefficients) -> tuple[Memory, Tensor]:
    """Advance the layers' memory; return it and the term that replacing all T_a by T_a + E_a adds."""
    x, y, z, yz, *_ = memory
    cells, size = c.layer_cells, p.shape

    def smooth(field: Tensor, first: int, second: int) -> Tensor:
        one, other = _around(field, first), _around(field, second)
        return c.face * field + c.edge * (one + other) + c.corner * _around(one, second)

    def placed(sides: tuple[Tensor, ...], axis: int) -> Tensor:
        low, high = sides
        rest = size[axis] - cells - 1
        return _between(low, axis, 1, rest) + _between(torch.flip(high, (axis,)), axis, rest, 1)

    z, ends = _stretch(p, z, c, _Z)
    y, sides = _stretch(p, y, c, _Y)
    yz, edges = _stretch(torch.cat(ends, _Z), yz, c, _Y)
    e_z, e_y = placed(ends, _Z), placed(sides, _Y)
    e_yz = placed(torch.split(placed(edges, _Y), cells, dim=_Z), _Z)
    across = (
        smooth(p, _Y, _Z) + c.edge * (e_y + e_z) + c.corner * (_around(e_y, _Z) + _around(e_z, _Y) + e_yz)
    )
    # the outermost ring stays zero: nothing is smoothed into it
    x, faces = _stretch(torch.nn.functional.pad(_core(across), (1,) * 6), x, c, _X)
    term = placed(faces, _X) + smooth(e_y, _X, _Z) + smooth(e_z, _X, _Y)
    term = term + c.edge * e_yz + c.corner * _around(e_yz, _X)
    return memory._replace(x=x, y=y, z=z, yz=yz), torch.nn.functional.pad(_core(term), (1,) * 6)


def _absorb_columns(
    flat: Tensor, columns: Columns, beside: Tensor, memory: Layer, c: Coefficients
) -> tuple[Layer, Tensor]:
    """Advance the memory of columns, with summands `beside` (..., L + 1, m); return it and the terms."""
    cells = columns.index.T[1:, :, None] + columns.offset
    across = torch.nn.functional.pad((columns.weight * flat[:, cells]).sum(-1) + beside, (0, 0, 1, 0))
    return _advanced(across, memory, c, 1)


def _stretch(field: Tensor, layer: Layer, c: Coefficients, axis: int) -> tuple[Layer, tuple[Tensor, Tensor]]:
    """Advance the memory of an axis; return it and E_a of the field in the low and the high layer."""
    slabs = (each.narrow(axis, 0, c.layer_cells + 2) for each in (field, torch.flip(field, (axis,))))
    memories = zip(*(part.unbind(1) for part in layer), strict=True)
    sides = [_advanced(slab, Layer(*each), c, axis) for slab, each in zip(slabs, memories, strict=True)]
    (low, low_term), (high, high_term) = sides
    both = (torch.stack(pair, dim=1) for pair in zip(low, high, strict=True))
    return Layer(*both), (low_term, high_term)


def _advanced(across: Tensor, layer: Layer, c: Coefficients, axis: int) -> tuple[Layer, Tensor]:
    """Advance the memory of L cells from the L + 2 `across` them and their neighbours; return it and E_a."""
    shape = [1] * across.ndim
    shape[axis] = -1
    b_half, b_cell = c.layer_decay[0::2].reshape(shape), c.layer_decay[1::2].reshape(shape)
    a_half, a_cell = c.layer_gain[0::2].reshape(shape), c.layer_gain[1::2].reshape(shape)
    difference = torch.diff(across, dim=axis)
    psi = b_half * layer.psi + a_half * difference
    slope = torch.diff(psi, dim=axis)
    zeta = b_cell * layer.zeta + a_cell * (torch.diff(difference, dim=axis) + slope)
    return Layer(psi, zeta), slope + zeta
