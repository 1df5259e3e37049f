"""Autograd through the reference kernel, against which the adjoint is tested."""

from __future__ import annotations

import torch

from autdtorch.fdtd.kernels.contract import Coefficients, Columns, Receivers, Sources, uniform_state
from autdtorch.fdtd.kernels.reference import ReferenceKernel

SHAPE = (7, 8, 9)
CELL = 3 * 72 + 4 * 9 + 4


def pressure(force: torch.Tensor, weight: torch.Tensor, steps: int) -> torch.Tensor:
    """Return the record of two receivers on a tiny grid with two heterogeneous cells and layers of two."""
    heterogeneous = torch.tensor([CELL, CELL + 1])
    profile = torch.tensor([2.0, 1.5, 1.0, 0.5, 0.1], dtype=torch.float64)
    decay = torch.exp(-profile - 0.1)
    gain = profile / (profile + 0.1) * (decay - 1)
    columns = Columns(
        torch.tensor([[CELL - 4, CELL - 3, CELL - 2, CELL - 1]]),
        torch.tensor([[-81, -72, -63, -9, 0, 9, 63, 72, 81]]),
        weight[:1, :9],
    )
    scaled = torch.tensor([CELL]), torch.tensor([1.3], dtype=torch.float64)
    crossed = Columns(columns.index, columns.offset[:, 3:6], weight[1:, 9:12])
    coefficients = Coefficients(
        0.19, 0.12, 0.06, 0.045, 0.99, heterogeneous, weight, torch.tensor([CELL + 3]), decay, gain, *scaled,
        columns, crossed, torch.tensor([[2, 2, 0, 1]]),
    )  # fmt: skip
    receivers = Receivers(torch.tensor([[CELL + 9], [CELL - 72]]), torch.ones((2, 1), dtype=torch.float64))
    signal = torch.stack(
        (torch.cos(torch.arange(steps) * 0.6), torch.sin(torch.arange(steps) * 0.6)), 1
    ).double()
    state = uniform_state(SHAPE, coefficients, 0.0)
    sources = Sources(torch.tensor([CELL - 1, CELL + 9]), force)
    _, recorded = ReferenceKernel().advance(state, coefficients, sources, receivers, signal)
    return recorded


def test_gradients_by_source_and_medium() -> None:
    generator = torch.Generator().manual_seed(0)
    force = torch.randn((2, 2), generator=generator, dtype=torch.float64).requires_grad_()
    weight = (0.05 * torch.rand((2, 27), generator=generator, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda f, w: pressure(f, w, steps=5), (force, weight))
