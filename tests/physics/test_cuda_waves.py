"""The waves of the CUDA kernel against those of PyTorch: on a GPU, or interpreted by Triton on the CPU."""

import pytest
import torch

pytest.importorskip("triton", reason="the CUDA kernel needs Triton: install autdtorch[cuda]")

from autdtorch.analytic.discs import waves_of
from autdtorch.fdtd.kernels import cuda_waves
from autdtorch.fdtd.kernels.cuda_waves import waves_on_gpu
from autdtorch.fdtd.kernels.waves import superposition
from autdtorch.utils.apertures import Discs
from autdtorch.utils.validation import LENGTH_TOLERANCE

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def drawn(count, seed, size=0.1):
    generator = torch.Generator().manual_seed(seed)
    return size * torch.rand((count, 3), generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("sizes", [(1, 1), (9, 70)])
@pytest.mark.parametrize(
    ("radii", "wavenumber"),
    [
        ([], complex(740.0)),
        ([], complex(740.0, 5.0)),
        ([4.5e-3], complex(740.0, 5.0)),
        ([0.0, 4.5e-3, 30e-3], complex(740.0)),
    ],
)
def test_waves_are_those_of_pytorch(wavenumber, radii, sizes):
    points, centers = drawn(sizes[0], 0), drawn(sizes[1], 1)
    points[0] = centers[0] + torch.tensor([1e-3, 0.0, 1e-4])  # next to a disc
    sources = centers
    if radii:
        normals = torch.nn.functional.normalize(drawn(sizes[1], 2, 2.0) - 1)
        sources = Discs(centers, normals, torch.tensor(radii * sizes[1]).double()[: sizes[1]])
    exact = waves_of(points, sources, wavenumber)
    waves = waves_on_gpu(points.to(DEVICE), sources, wavenumber).cpu()
    # the series of discs end at most 1e-8 apart; of points, rounding of the phase
    assert ((waves - exact).abs() <= (5e-8 if radii else 1e-12) * exact.abs()).all()


def test_sums_of_them_are_those_of_the_cpu():
    points, centers = drawn(40, 0), drawn(90, 1) + 0.15
    discs = Discs(
        centers, torch.eye(3, dtype=torch.float64)[2].expand(90, 3), torch.full((90,), 4.5e-3).double()
    )
    amplitude = torch.randn((90, 3), dtype=torch.complex128, generator=torch.Generator().manual_seed(2))
    for sources in (centers, discs):
        summed = waves_on_gpu(points.to(DEVICE), sources, complex(740.0)).cpu() @ amplitude
        compiled = superposition(points, sources, amplitude, 740.0)
        assert (summed - compiled).norm() < 1e-7 * compiled.norm()
    alone = waves_on_gpu(centers[:1].to(DEVICE), centers[:1], complex(740.0))
    assert alone.abs().item() == pytest.approx(1 / LENGTH_TOLERANCE, rel=1e-12)


def test_a_launch_has_room_for_millions_of_sources(monkeypatch):
    """On a GPU, only the first axis of a grid of programs may be longer than 65535."""
    grids = []

    class Launch:
        def __getitem__(self, grid):
            grids.append(grid)
            return lambda *arguments, **sizes: None

    monkeypatch.setattr(cuda_waves, "_write_waves", Launch())
    waves_on_gpu(drawn(5, 0), torch.zeros(64 * 65536, 3, dtype=torch.float64), complex(740.0))
    (grid,) = grids
    assert grid[0] == 2 * 65536  # two rows of tiles
    assert all(size <= 65535 for size in grid[1:])
