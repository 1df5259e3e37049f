"""Kernels: the CPU's against the reference, conservation, sums of waves."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from small_scenes import CUBE, NO_RECEIVERS, NO_SOURCES, all_tensors, assembled_parts, small_scene

from autdtorch.analytic.discs import waves_of
from autdtorch.analytic.green import green
from autdtorch.fdtd.kernels.contract import BLOCK, Sources, blocks_of, uniform_state
from autdtorch.fdtd.kernels.cpu import CpuKernel, _cuts
from autdtorch.fdtd.kernels.cpu_sweep import strips_of
from autdtorch.fdtd.kernels.cpu_waves import superposition, wave_matrix
from autdtorch.fdtd.kernels.reference import ReferenceKernel
from autdtorch.fdtd.stepping import assemble, drive_signal
from autdtorch.propagators.plan import region_of
from autdtorch.scene.obstacles import Box
from autdtorch.utils.apertures import Discs
from autdtorch.utils.validation import LENGTH_TOLERANCE

RIGID = Box(center=(15e-3, 4e-3, 9e-3), size=(4e-3, 6e-3, 7e-3), rigid=True)
FAST = Box(center=(14e-3, 20e-3, 14e-3), size=(6e-3, 5e-3, 5e-3), density=3.0, sound_speed=700.0)


PLATE = Box((12e-3, 12e-3, 21.7e-3), (30e-3, 40e-3, 1.7e-3), density=5.0, sound_speed=300.0)
"""Runs through the absorbing layers of x and y."""


@functools.cache  # no kernel changes them
def scene_parts(dtype, absorption=0.0, lossy=False):
    parts = assembled_parts(small_scene((CUBE, RIGID, FAST, PLATE), absorption=absorption), 1e-3, dtype)
    if not lossy:
        return parts
    assembly, *others = parts
    c = assembly.coefficients
    index = c.heterogeneous_index[::3]  # in the layers too
    weight = torch.rand((len(index), 27), generator=torch.Generator().manual_seed(0)).to(dtype) / 100
    return replace(
        assembly, coefficients=replace(c, loss_index=index, loss_weight=weight, loss_ground=weight[:, 0])
    ), *others


def advance(kernel, dtype, steps, lossy=False):
    assembly, sources, receivers = scene_parts(dtype, 40.0, lossy)
    signal = drive_signal(assembly.steps_per_period, 0, steps).to(dtype)
    return kernel.advance(assembly.silence(sources), assembly.coefficients, sources, receivers, signal)


# float64: rounding grows with the steps and the sums of 27 terms; float32: the design's parity figure, 1e-4
# of the peak
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-4)])
@pytest.mark.parametrize(("steps", "lossy"), [(40, False), (41, True)])  # all layers in 30
def test_cpu_kernel_is_the_reference_kernel(dtype, tolerance, steps, lossy):
    state, recorded = advance(CpuKernel(), dtype, steps, lossy)
    expected, expected_recorded = advance(ReferenceKernel(), dtype, steps, lossy)
    for value, reference in zip(
        all_tensors(state, recorded), all_tensors(expected, expected_recorded), strict=True
    ):
        assert (value - reference).abs().max() <= tolerance * max(float(reference.abs().max()), 1e-30)


@pytest.mark.parametrize("kernel", [CpuKernel(), ReferenceKernel()], ids=["cpu", "reference"])
def test_runs_side_by_side_are_those_alone(kernel):
    assembly, sources, receivers = scene_parts(torch.float64, 40.0, True)
    signal, c = drive_signal(assembly.steps_per_period, 0, 5), assembly.coefficients
    turned = sources.force, sources.force.flip(2)
    runs = [replace(sources, force=force) for force in (torch.cat(turned), *turned)]
    together, *alone = (
        all_tensors(*kernel.advance(assembly.silence(sources), c, sources, receivers, signal))
        for sources in runs
    )
    for value, parts in zip(together, zip(*alone, strict=True), strict=True):
        assert torch.equal(value, torch.cat(parts))


def test_forces_on_all_heterogeneous_cells_are_those_on_each():
    """The kernel adds them block by block, unless another cell is driven too."""
    assembly, _, receivers = scene_parts(torch.float64, 40.0, True)
    signal, c = drive_signal(assembly.steps_per_period, 0, 41), assembly.coefficients
    index = c.heterogeneous_index
    force = torch.rand((1, len(index), 2), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    beside = torch.cat([index[:1] - 1, index]), torch.nn.functional.pad(force, (0, 0, 1, 0))
    assert not torch.isin(beside[0][0], index)
    stepped = []
    for sources in (Sources(index, force), Sources(*beside)):
        state = assembly.silence(sources)
        stepped.append(all_tensors(*CpuKernel().advance(state, c, sources, receivers, signal)))
    for value, expected in zip(*stepped, strict=True):  # the order of sums differs, as above
        assert (value - expected).abs().max() <= 1e-12 * expected.abs().max()


@pytest.mark.parametrize(("chunks", "lossy"), [(2, False), (4, False), (4, True)])
def test_chunks_of_planes_are_the_whole(chunks, lossy, monkeypatch):
    """Chunks change the order of sums; the number of threads changes nothing."""
    whole = advance(CpuKernel(), torch.float64, 41, lossy)
    planes = whole[0].now.shape[1] - 2
    monkeypatch.setattr("autdtorch.fdtd.kernels.cpu._CHUNK_CELLS", 1)
    monkeypatch.setattr("autdtorch.fdtd.kernels.cpu._CHUNK_PLANES", planes // chunks)
    assert len(_cuts(whole[0].now.shape[1:])) == chunks + 1
    parts = advance(CpuKernel(), torch.float64, 41, lossy)
    for value, reference in zip(all_tensors(*parts), all_tensors(*whole), strict=True):
        assert (value - reference).abs().max() <= 1e-12 * reference.abs().max()
    for threads in (1, 3):
        monkeypatch.setattr("autdtorch.fdtd.kernels.cpu.thread_count", lambda count=threads: count)
        again = advance(CpuKernel(), torch.float64, 41, lossy)
        assert all(map(torch.equal, all_tensors(*again), all_tensors(*parts)))


@pytest.mark.parametrize("lossy", [False, True])
def test_strips_of_rows_change_no_bit(lossy, monkeypatch):
    whole = advance(CpuKernel(), torch.float32, 41, lossy)
    _, _, ny, nz = whole[0].now.shape
    monkeypatch.setattr("autdtorch.fdtd.kernels.cpu_sweep._STRIP_CELLS", ny * nz // 3)
    assert len(strips_of(whole[0].now.shape[1:], scene_parts(torch.float32)[0].grid.layer_cells)) > 2
    strips = advance(CpuKernel(), torch.float32, 41, lossy)
    assert all(map(torch.equal, all_tensors(*strips), all_tensors(*whole)))


def test_no_cell_reads_those_inside_rigid_bodies(monkeypatch):
    """The kernel skips them: what they hold at the beginning changes nothing."""
    monkeypatch.setattr("autdtorch.fdtd.stepping._FEWEST_IDLE", 1)
    monkeypatch.setattr("autdtorch.fdtd.kernels.cpu._UNROLLED", 1)
    body = Box(center=(12e-3, 11e-3, 13e-3), size=(10e-3, 9e-3, 11e-3), rigid=True)
    parts = assembled_parts(small_scene((body,)), 1e-3, torch.float32)
    assembly, sources, receivers = parts
    c, signal = assembly.coefficients, drive_signal(assembly.steps_per_period, 0, 41).float()
    assert len(c.idle) > 10

    def stepped(coefficients, value):
        state = assembly.silence(sources)
        for first, last in c.idle:
            for part in (state.now, state.before):
                part.view(-1)[first:last] = value
        state, recorded = CpuKernel().advance(state, coefficients, sources, receivers, signal)
        for first, last in c.idle:
            for part in (state.now, state.before):
                part.view(-1)[first:last] = 0
        return all_tensors(state, recorded)

    whole = stepped(replace(c, idle=c.idle[:0]), 0)
    assert all(map(torch.equal, stepped(c, math.nan), whole))
    monkeypatch.setattr("autdtorch.fdtd.kernels.cpu_sweep._STRIP_CELLS", 1)
    assert all(map(torch.equal, stepped(c, math.nan), whole))


@given(st.lists(st.booleans(), max_size=60), st.integers(1, 3), st.integers(0, 100))
def test_each_cell_is_in_one_block_with_its_weights(cells, kinds, seed):
    """Other cells of a block have no weights, and no block reaches beyond the last cell."""
    generator = np.random.default_rng(seed)
    index = 10 + np.flatnonzero(cells)
    rows = generator.random((kinds, 27))[generator.integers(0, kinds, len(index))]
    blocks = blocks_of(index, rows)
    expected = np.zeros((len(blocks.first) * BLOCK, 27))
    expected[blocks.slot] = rows
    assert (blocks.weight[blocks.kind].transpose(0, 2, 1).reshape(-1, 27) == expected).all()
    reached = (blocks.first[:, None] + np.arange(BLOCK)).reshape(-1)
    assert (reached[blocks.slot] == index).all()
    assert (reached <= index.max(initial=0)).all()
    lane, (first, last) = np.arange(BLOCK), blocks.lanes.T[:, :, None]
    assert (np.flatnonzero((lane >= first) & (lane < last)) == blocks.slot).all()


def test_one_worker_steps_where_processors_are_busy(monkeypatch):
    kernel, used = CpuKernel(), []
    shares = iter([1.0, 0.5, 0.8, 0.95, 1.0])

    def share(work, workers):
        used.append(workers)
        work()
        return next(shares)

    monkeypatch.setattr("autdtorch.fdtd.kernels.cpu._share_of_processors", share)
    monkeypatch.setattr("autdtorch.fdtd.kernels.cpu._CHUNK_CELLS", 1)
    monkeypatch.setattr("autdtorch.fdtd.kernels.cpu._CHUNK_PLANES", 15)
    monkeypatch.setattr("autdtorch.fdtd.kernels.cpu.thread_count", lambda: 2)
    for _ in range(5):
        advance(kernel, torch.float64, 1)
    assert used == [2, 2, 1, 1, 2]


def closed_box(dtype):
    """Coefficients of air on a grid without absorption: the ring holds the pressure at zero."""
    c = assemble(region_of(small_scene()), 1e-3, dtype).coefficients
    return replace(c, layer_decay=torch.zeros_like(c.layer_decay), layer_gain=torch.zeros_like(c.layer_gain))


def test_a_mode_of_a_closed_box_keeps_its_frequency_and_amplitude():
    """p = sin(k_x x) sin(k_y y) sin(k_z z) cos(w t) is an exact solution of the scheme, with w from the
    symbol."""
    shape, steps = (24, 26, 28), 400
    c = closed_box(torch.float64)
    wave = [math.pi * n / (size - 1) for n, size in zip((3, 2, 5), shape, strict=True)]
    x, y, z = (
        torch.sin(k * torch.arange(size, dtype=torch.float64)) for k, size in zip(wave, shape, strict=True)
    )
    mode = x[:, None, None] * y[None, :, None] * z[None, None, :]
    cx, cy, cz = (math.cos(k) for k in wave)
    along, beside = c.face * (cx + cy + cz), 2 * c.edge * (cx * cy + cy * cz + cz * cx)
    turn = math.acos(c.center / 2 + along + beside + 4 * c.corner * cx * cy * cz)
    state = uniform_state(shape, c, 0.0)
    state.now.copy_(mode)
    state.before.copy_(mode * math.cos(turn))
    silence = torch.zeros((steps, 2), dtype=torch.float64)
    state, _ = CpuKernel().advance(state, c, NO_SOURCES, NO_RECEIVERS, silence)
    # rounding of 400 steps, each of relative size 1e-16, adds up at worst in proportion to steps^2
    assert (state.now - mode * math.cos(turn * steps)).abs().max() < 1e-10


def places(points, sources):
    generator = torch.Generator().manual_seed(0)
    targets = 0.1 * torch.rand((points, 3), generator=generator, dtype=torch.float64)
    targets[0] = torch.tensor([3.0, -2.0, 1.0], dtype=torch.float64)
    origins = 0.1 + 0.05 * torch.rand((sources, 3), generator=generator, dtype=torch.float64)
    return targets, origins, torch.randn((sources, 3), generator=generator, dtype=torch.complex128)


# Rounding of single waves, 3e-7 and 2e-14 measured; ten times that and more for the order of sums elsewhere.
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 4e-6)])
@pytest.mark.parametrize("wavenumber", [complex(740.0), complex(740.0, 5.0), complex(740.0, 700.0)])
@pytest.mark.parametrize(("points", "sources"), [(40, 5000), (5000, 40), (1, 1), (65, 64), (64, 65)])
def test_the_sum_is_that_of_greens_functions(points, sources, wavenumber, dtype, tolerance):
    targets, origins, amplitude = places(points, sources)
    summed = superposition(targets, origins, amplitude, wavenumber, dtype=dtype)
    exact = 4 * math.pi * green(targets, origins, wavenumber) @ amplitude
    largest = 4 * math.pi * green(targets, origins, wavenumber).abs().max()
    # what has faded below 1e-30 may end in other subnormal numbers
    assert (summed - exact).abs().max() < tolerance * amplitude.norm() * largest + 1e-30


def test_distances_are_cut_off_and_nothing_sums_to_nothing():
    _, origins, amplitude = places(1, 1)
    alone = superposition(origins, origins, amplitude, 740.0)
    assert alone[0, 0].abs() == pytest.approx(float(amplitude[0, 0].abs() / LENGTH_TOLERANCE), rel=1e-12)
    targets, origins, amplitude = places(3, 2)
    assert superposition(targets[:0], origins, amplitude, 740.0).shape == (0, 3)
    assert torch.equal(
        superposition(targets, origins[:0], amplitude[:0], 740.0), torch.zeros((3, 3), dtype=torch.complex128)
    )


def test_the_number_of_threads_changes_no_bit(monkeypatch):
    targets, origins, amplitude = places(3000, 200)
    sums = []
    for threads in (1, 2, 5):
        monkeypatch.setattr("autdtorch.utils.process.thread_count", lambda count=threads: count)
        sums += [superposition(targets, origins, amplitude, 740.0, dtype=torch.float32)]
        sums += [superposition(origins, targets, amplitude[:1].repeat(3000, 1), 740.0)]
    for one, other in (sums[2:4], sums[4:]):
        assert torch.equal(one, sums[0])
        assert torch.equal(other, sums[1])


def drawn_discs(radii, seed):
    """Discs in a cube of 0.1 m, and 70 points around them, many next to one."""
    generator = torch.Generator().manual_seed(seed)
    normals = torch.randn((len(radii), 3), generator=generator, dtype=torch.float64)
    normals /= normals.norm(dim=1, keepdim=True)
    centers = 0.1 * torch.rand((len(radii), 3), generator=generator, dtype=torch.float64)
    apart = torch.rand((70, 1), generator=generator, dtype=torch.float64) ** 3 * 0.2 + 1e-4
    ways = torch.randn((70, 3), generator=generator, dtype=torch.float64)
    return Discs(centers, normals, torch.tensor(radii, dtype=torch.float64)), centers[0] + apart * ways


@given(
    wavenumber=st.sampled_from([200.0, 733.0, complex(733.0, 0.15), complex(1100.0, 5.0)]),
    radii=st.lists(st.sampled_from([0.0, 1e-3, 4.5e-3, 30e-3]), min_size=1, max_size=4),
    seed=st.integers(0, 1000),
)
def test_compiled_sums_of_discs_are_those_of_their_waves(wavenumber, radii, seed):
    """The rule along the rim is one, and the series end at most 1e-8 apart.

    Single precision adds its rounding, of 1e-7, for each of about k a waves of the size of their sum.
    """
    discs, points = drawn_discs(radii, seed)
    exact = waves_of(points, discs, complex(wavenumber))
    amplitude = torch.eye(len(radii), dtype=torch.complex128)
    largest = exact.abs().max(dim=0).values
    errors = (superposition(points, discs, amplitude, wavenumber) - exact).abs() / largest
    assert errors.max() < 2e-8
    single = superposition(points, discs, amplitude, wavenumber, dtype=torch.float32)
    assert ((single - exact).abs() / largest).max() < 2e-6 * (10 + abs(wavenumber) * max(radii))
    one = torch.ones((1, 1), dtype=torch.complex128)
    received = torch.cat([superposition(discs, point[None], one, wavenumber) for point in points], dim=1)
    assert ((received.mT - exact).abs() / largest).max() < 2e-8  # reciprocity
    numbers = torch.arange(1.0, 1.0 + len(radii), dtype=torch.float64) + 0j
    twice = wave_matrix(points, discs, numbers, 1, wavenumber)
    summed = exact @ numbers[:, None]
    assert (twice - summed).abs().max() < 2e-8 * len(radii) ** 2 * largest.max()
