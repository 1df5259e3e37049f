"""The readable kernel, in torch: the specification of every fast one, and differentiable by autograd."""

from __future__ import annotations

import torch

from autdtorch.fdtd.kernels.contract import Coefficients, Layer, Receivers, Sources, State


def neighbours(field: torch.Tensor, axis: int) -> torch.Tensor:
    """Sum of the two neighbours along an axis; the result is two cells shorter along it."""
    return field.narrow(axis, 0, field.shape[axis] - 2) + field.narrow(axis, 2, field.shape[axis] - 2)


def middle(field: torch.Tensor, axis: int) -> torch.Tensor:
    """The field without its first and last cell along an axis."""
    return field.narrow(axis, 1, field.shape[axis] - 2)


class ReferenceKernel:
    """One torch expression per line of the contract, none in place, so that autograd can go back."""

    def advance(
        self,
        state: State,
        coefficients: Coefficients,
        sources: Sources,
        receivers: Receivers,
        signal: torch.Tensor,
    ) -> tuple[State, torch.Tensor]:
        """See `Kernel.advance`."""
        recorded = []
        for cosine, sine in signal:
            force = cosine * sources.force.real + sine * sources.force.imag
            state = self._step(state, coefficients, sources.index, force)
            recorded.append((state.now.reshape(-1)[receivers.index] * receivers.weight).sum(-1))
        return state, torch.stack(recorded)

    def _step(self, state: State, c: Coefficients, driven: torch.Tensor, force: torch.Tensor) -> State:
        new = torch.nn.functional.pad(_sweep(state.now, c) - c.keep * _core(state.before), (1,) * 6)
        flat_now, flat_before = state.now.reshape(-1), state.before.reshape(-1)
        own, before = flat_now[c.varying_index], flat_before[c.varying_index]
        change = (
            c.varying_weight * (flat_now[c.varying_index[:, None] + _offsets(state.now)] - own[:, None])
        ).sum(-1)
        kept = own + c.keep * (own - before)
        new = new.reshape(-1).index_copy(0, c.varying_index, kept + change)
        new = new.reshape(state.now.shape)
        layers = []
        for axis, (psi, zeta) in enumerate(state.layers):
            low, low_term = _absorb(state.now, (psi[0], zeta[0]), c, axis, mirrored=False)
            high, high_term = _absorb(state.now, (psi[1], zeta[1]), c, axis, mirrored=True)
            layers.append((torch.stack((low[0], high[0])), torch.stack((low[1], high[1]))))
            new = new + low_term + high_term
        return State(new.reshape(-1).index_add(0, driven, force).reshape(new.shape), state.now, tuple(layers))


def _core(field: torch.Tensor) -> torch.Tensor:
    return field[1:-1, 1:-1, 1:-1]


def _offsets(field: torch.Tensor) -> torch.Tensor:
    """Flat offsets of the 27 neighbours, row-major."""
    step = torch.arange(-1, 2)
    strides = field.stride()
    return (
        (step * strides[0])[:, None, None]
        + (step * strides[1])[None, :, None]
        + (step * strides[2])[None, None, :]
    ).reshape(-1)


def _sweep(p: torch.Tensor, c: Coefficients) -> torch.Tensor:
    """Line 1 of the contract, without `before`, in all cells but the ring."""
    along = [neighbours(p, axis) for axis in range(3)]
    faces = sum(middle(middle(along[a], b), d) for a, b, d in ((0, 1, 2), (1, 0, 2), (2, 0, 1)))
    edges = sum(middle(neighbours(along[a], b), d) for a, b, d in ((0, 1, 2), (1, 2, 0), (2, 0, 1)))
    corners = neighbours(neighbours(along[0], 1), 2)
    return c.center * _core(p) + c.face * faces + c.edge * edges + c.corner * corners


def _absorb(
    p: torch.Tensor, layer: Layer, c: Coefficients, axis: int, mirrored: bool
) -> tuple[Layer, torch.Tensor]:
    """Advance one boundary layer's memory; returns it and the term to add to the new pressure."""
    cells = c.layer_cells
    slab = p.narrow(axis, p.shape[axis] - cells - 2 if mirrored else 0, cells + 2)
    slab = torch.flip(slab, (axis,)) if mirrored else slab
    across = [other for other in range(3) if other != axis]
    first, second = across
    smoothed = (
        c.face * middle(middle(slab, first), second)
        + c.edge * (middle(neighbours(slab, first), second) + middle(neighbours(slab, second), first))
        + c.corner * neighbours(neighbours(slab, first), second)
    )
    # The ring at the array's face is silent: nothing is smoothed into it.
    smoothed = torch.cat(
        (torch.zeros_like(smoothed.narrow(axis, 0, 1)), smoothed.narrow(axis, 1, cells + 1)), axis
    )
    shape = [1, 1, 1]
    shape[axis] = -1
    b_half, b_cell = c.layer_decay[0::2].reshape(shape), c.layer_decay[1::2].reshape(shape)
    a_half, a_cell = c.layer_gain[0::2].reshape(shape), c.layer_gain[1::2].reshape(shape)
    psi, zeta = (middle(middle(memory, first), second) for memory in layer)
    difference = torch.diff(smoothed, dim=axis)
    psi = b_half * psi + a_half * difference
    slope = torch.diff(psi, dim=axis)
    zeta = b_cell * zeta + a_cell * (torch.diff(difference, dim=axis) + slope)
    term = slope + zeta
    inner = [0] * 6
    for other in across:
        inner[2 * (2 - other)] = inner[2 * (2 - other) + 1] = 1
    outer = list(inner)
    before, after = 1, p.shape[axis] - cells - 1
    outer[2 * (2 - axis)], outer[2 * (2 - axis) + 1] = (after, before) if mirrored else (before, after)
    term = torch.flip(term, (axis,)) if mirrored else term
    pad = torch.nn.functional.pad
    return (pad(psi, inner), pad(zeta, inner)), pad(term, outer)
