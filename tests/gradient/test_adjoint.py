"""Gradients of records: the adjoint run of the CPU kernel, and autograd through the reference kernel."""

from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from small_scenes import assembled_parts, small_scene

from autdtorch.fdtd import adjoint
from autdtorch.fdtd.adjoint import recorded
from autdtorch.fdtd.grid import make_grid
from autdtorch.fdtd.kernels.contract import (
    Coefficients,
    Columns,
    Receivers,
    Sources,
    WaveState,
    uniform_state,
)
from autdtorch.fdtd.kernels.cpu import CpuKernel
from autdtorch.fdtd.kernels.reference import ReferenceKernel
from autdtorch.fdtd.material_gradients import cells_of_obstacles
from autdtorch.propagators.plan import region_of
from autdtorch.scene.obstacles import Box, Sphere

HEAVY = Sphere((4.7e-3, 4.2e-3, 4.6e-3), 1.7e-3, density=20.0, sound_speed=300.0)
RIGID = Box((3.2e-3, 7e-3, 7e-3), (3e-3, 2.3e-3, 2.3e-3), rigid=True)
WALL = Box((4e-3, 4e-3, 7.4e-3), (40e-3, 40e-3, 1e-3), density=5.0, sound_speed=340.0)
"""Continues through the absorbing layers of x and y."""

STEPS = 24


LOSSY = (
    Sphere((4.7e-3, 4.2e-3, 4.6e-3), 1.7e-3, density=20 + 1j, sound_speed=300 - 20j),
    Sphere((3.2e-3, 7e-3, 7e-3), 1.2e-3, impedance=2 - 1j),
)


def parts(dtype, *obstacles):
    """Return a 2 x 2 array in absorbing air, three receivers, and a random signal."""
    signal = torch.randn((STEPS, 2), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    scene = small_scene(obstacles, extent=9e-3, absorption=40.0)
    return *assembled_parts(scene, 1.4e-3, dtype), signal.to(dtype)


def differentiable(assembly, sources):
    names = "heterogeneous_weight", "loss_weight", "loss_ground"
    rows = {name: getattr(assembly.coefficients, name).clone().requires_grad_() for name in names}
    coefficients = replace(assembly.coefficients, **rows)
    force = sources.force.clone().requires_grad_()
    return replace(assembly, coefficients=coefficients), replace(sources, force=force)


def gradients(case, kernel):
    """Return the record and the derivatives of a random loss, by plain autograd without a kernel."""
    assembly, sources, receivers, signal = case
    assembly, sources = differentiable(assembly, sources)
    if kernel is None:
        state, c = assembly.silence(sources), assembly.coefficients
        record = ReferenceKernel().advance(state, c, sources, receivers, signal)[1][0]
    else:
        record = recorded(kernel, assembly, sources, receivers, signal)
    slope = torch.randn(record.shape, generator=torch.Generator().manual_seed(0), dtype=record.dtype)
    (slope * record).sum().backward()
    c = assembly.coefficients
    rows = [c.heterogeneous_weight, *([c.loss_weight, c.loss_ground] if len(c.loss_index) else [])]
    return record.detach(), sources.force.grad, *(row.grad for row in rows)


# float64: rounding over the steps; float32: the design's parity figure, of which rounding takes a tenth
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-4)])
@pytest.mark.parametrize("obstacles", [(HEAVY, RIGID), LOSSY], ids=["loss-free", "lossy"])
def test_gradients_are_those_of_the_reference_kernel(dtype, tolerance, obstacles):
    case = parts(dtype, *obstacles)
    for value, oracle in zip(gradients(case, CpuKernel()), gradients(case, None), strict=True):
        assert (value - oracle).abs().max() <= tolerance * oracle.abs().max()


def test_walls_through_the_layers_keep_the_gradients_exact():
    """Derivatives by rows in the layers are zero; all others are those of autograd."""
    case = parts(torch.float64, HEAVY, WALL)
    inside = torch.from_numpy(case[0].grid.inside(case[0].heterogeneous.index))
    assert 0 < inside.sum() < len(inside)
    (_, force, weight), (_, by_force, by_weight) = (gradients(case, each) for each in (CpuKernel(), None))
    assert not weight[~inside].any()
    # rows within 1e-9 of air's are taken for air's, which leaves that much asymmetry
    assert (force - by_force).abs().max() <= 1e-10 * by_force.abs().max()
    assert (weight - by_weight)[inside].abs().max() <= 1e-10 * by_weight[inside].abs().max()


def test_segments_do_not_change_the_gradients(monkeypatch):
    case = parts(torch.float64, HEAVY, RIGID)
    whole = gradients(case, CpuKernel())
    monkeypatch.setattr(adjoint, "_cuts", lambda *_: [0, 9, 10, STEPS])
    for part, one in zip(gradients(case, CpuKernel()), whole, strict=True):
        # sums in another order
        assert (part - one).abs().max() <= 1e-13 * one.abs().max()


def test_cuts_bound_the_memory():
    """At 100^3 heterogeneous cells the stored states and the record of a segment stay below 1 GiB."""
    state = WaveState(torch.zeros((1, *(118,) * 3)), torch.zeros(0), ())
    cells = 102**3
    for steps in (10, 1000, 10_000):
        cuts = adjoint._cuts(steps, state, cells)
        longest = max(end - start for start, end in pairwise(cuts))
        assert (cuts[0], cuts[-1]) == (0, steps)
        stored = (len(cuts) - 1) * 2 * state.now.numel() + 2 * longest * cells
        # the minimum is 2 sqrt(steps x state x row); the record of short runs is 128 MiB, twice
        assert 4 * stored <= max(2.1 * 4 * (steps * 4 * state.now.numel() * cells) ** 0.5, 600 * 2**20)


@pytest.mark.parametrize("kernel", [CpuKernel(), ReferenceKernel()], ids=["cpu", "reference"])
@pytest.mark.parametrize("obstacles", [(HEAVY, RIGID), LOSSY], ids=["loss-free", "lossy"])
def test_adjoint_dot_product(kernel, obstacles):
    """<c, J f> = <J^T c, f> for forces f and weights c of the record."""
    assembly, sources, receivers, signal = parts(torch.float64, *obstacles)
    generator = torch.Generator().manual_seed(3)
    force = torch.randn(sources.force.shape, generator=generator, dtype=torch.float64).requires_grad_()
    record = recorded(kernel, assembly, Sources(sources.index, force), receivers, signal)
    slope = torch.randn(record.shape, generator=generator, dtype=torch.float64)
    (back,) = torch.autograd.grad(record, force, slope)
    # rounding over the steps
    assert float(back.flatten() @ force.detach().flatten()) == pytest.approx(
        float(slope.flatten() @ record.detach().flatten()), rel=1e-12
    )


def test_a_constant_loss_has_no_gradient():
    assembly, sources = differentiable(*parts(torch.float64, HEAVY)[:2])
    record = recorded(CpuKernel(), assembly, sources, *parts(torch.float64, HEAVY)[2:])
    (0 * record).sum().backward()
    assert not sources.force.grad.any()
    assert not assembly.coefficients.heterogeneous_weight.grad.any()


SHAPE = (7, 8, 9)
CELL = 3 * 72 + 4 * 9 + 4


def pressure(force, weight, steps):
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
    sources = Sources(torch.tensor([CELL - 1, CELL + 9]), force[None])
    _, recorded = ReferenceKernel().advance(state, coefficients, sources, receivers, signal)
    return recorded


def test_gradients_by_source_and_medium():
    generator = torch.Generator().manual_seed(0)
    force = torch.randn((2, 2), generator=generator, dtype=torch.float64).requires_grad_()
    weight = (0.05 * torch.rand((2, 27), generator=generator, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda f, w: pressure(f, w, steps=5), (force, weight))


def test_gradients_by_the_materials_of_a_lossy_body():
    """The adjoint run against central differences of whole runs, at one time step."""
    scene = small_scene(LOSSY, extent=9e-3)
    region, generator = region_of(scene), torch.Generator().manual_seed(0)
    grid = make_grid(region, 1.4e-3)
    start = torch.tensor([[20.0, 1.0], [300.0, 340.0]], dtype=torch.float64)
    slope = torch.randn((STEPS, 3), generator=generator, dtype=torch.float64)

    def loss(values):
        cells = cells_of_obstacles(region, grid, *values)
        assembly = cells.assembly(grid, region, torch.float64, 1.5e-6)
        strength = torch.tensor([1.0, 1j, -0.4, 0.3 - 0.7j], dtype=torch.complex128)
        sources = cells.driven(assembly.sources(scene.array.positions, strength), assembly)
        signal = torch.cos(0.6 * torch.arange(2 * STEPS, dtype=torch.float64)).reshape(STEPS, 2)
        receivers = assembly.receivers(scene.control_points)
        return (slope * recorded(CpuKernel(), assembly, sources, receivers, signal)).sum()

    values = start.clone().requires_grad_()
    loss(values).backward()
    for row in range(2):
        step = torch.zeros_like(start)
        step[row, 0] = 1e-4 * start[row, 0]
        change = float(loss(start + step) - loss(start - step)) / float(2 * step[row, 0])
        # truncation; one step for both, as transfers of mass between cells have kinks
        assert float(values.grad[row, 0]) == pytest.approx(change, rel=1e-4)
