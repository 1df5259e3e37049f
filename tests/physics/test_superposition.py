"""Sums of spherical waves against Green's function."""

import math

import pytest
import torch

from autdtorch.analytic.green import green
from autdtorch.fdtd.kernels.cpu_waves import superposition


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
        monkeypatch.setattr("autdtorch.utils.threads.thread_count", lambda count=threads: count)
        sums += [superposition(targets, origins, amplitude, 740.0, dtype=torch.float32)]
        sums += [superposition(origins, targets, amplitude[:1].repeat(3000, 1), 740.0)]
    for one, other in (sums[2:4], sums[4:]):
        assert torch.equal(one, sums[0])
        assert torch.equal(other, sums[1])
