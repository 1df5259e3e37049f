"""Sums of spherical waves against Green's function."""

import math

import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from autdtorch.analytic.green import green
from autdtorch.fdtd.kernels.cpu_waves import superposition
from autdtorch.scene.arrays import TransducerArray, apertures_of


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


def test_distances_are_cut_off():
    _, origins, amplitude = places(1, 1)
    alone = superposition(origins, origins, amplitude, 740.0, nearest=1e-3)
    assert alone[0, 0].abs() == pytest.approx(float(1e3 * amplitude[0, 0].abs()), rel=1e-12)


def test_without_points_or_sources_nothing_is_summed():
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


@given(
    wavenumber=st.sampled_from([200.0, 733.0, complex(733.0, 0.15), complex(1100.0, 5.0)]),
    normal=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda n: math.hypot(*n) > 0.1),
    distance=st.floats(0.01, 0.5),
    seed=st.integers(0, 1000),
)
def test_a_far_disc_is_the_sum_of_its_nodes(wavenumber, normal, distance, seed):
    array = TransducerArray([(0.01, -0.02, 0.03)], normal, radius=4.5e-3)
    nodes, generator = apertures_of(array), torch.Generator().manual_seed(seed)
    way = torch.randn((70, 3), generator=generator, dtype=torch.float64)
    points = array.positions + distance * way / way.norm(dim=1, keepdim=True)
    assume(nodes.far_from(points[:1], wavenumber).all())
    one = torch.ones((1, 1), dtype=torch.complex128)
    summed = superposition(points, nodes.positions[0], nodes.weights[:, None] + 0j, wavenumber)
    expanded = superposition(points, nodes.discs, one, wavenumber)
    largest = math.exp(-complex(wavenumber).imag * distance) / distance
    assert (expanded - summed).abs().max() < 6e-5 * largest  # measured 2.8e-5, where it begins to be far
    received = torch.cat([superposition(nodes.discs, point[None], one, wavenumber) for point in points])
    assert (received - expanded).abs().max() < 1e-12 * largest  # reciprocity


def test_large_or_near_discs_are_sums_of_nodes():
    nodes = apertures_of(TransducerArray([(0, 0, 0), (0.1, 0, 0)], (0, 0, 1), radius=5e-3))
    points = torch.tensor([[0.0, 0.0, 0.03], [0.0, 0.02, 0.04]], dtype=torch.float64)
    assert nodes.far_from(points, 733.0).tolist() == [False, True]
    assert nodes.far_from(points, 1500.0).tolist() == [False, False]
    assert not apertures_of(TransducerArray([(0, 0, 0)], (0, 0, 1))).far_from(points, 733.0).any()
