"""Rates and run times on a GPU, beside those of the CPU kernel on the same machine.

A cell of uniform air in float32 needs 12 bytes a step; the bandwidth is measured by a copy within the GPU's
memory. Each matrix has a new propagator, preparing included; the faster of two counts. Takes about a
minute, with an NVIDIA GPU.
"""

from collections.abc import Iterator

import torch
from benchmarks.kernels import assemblies, cell_rate, fastest, uniform
from shared.document import Page, percent, printed, table
from shared.scenes import autd3_array, paper_scene, relative_error, uncached
from shared.timing import shortest

import autdtorch as at
from autdtorch.fdtd.kernels.cuda import CudaKernel

DOCUMENT = "performance.md"
OPTIONS = {"--seconds": {"type": float, "default": 0.2, "help": "of each repeat"}}

CELL_BYTES = 12
COPIED = 2**28
"""Numbers of the copy, 1 GiB."""
SIDE = 256
REPEATS = 2
PHONE = at.Box((40e-3, 50e-3, 50e-3), (8e-3, 70e-3, 140e-3), rotation=(0.1, 0.2, 0.3), rigid=True)


def main(page: Page, seconds: float) -> None:
    """Measure, and write the block."""
    if not torch.cuda.is_available():
        raise SystemExit("cuda: needs an NVIDIA GPU")
    copied = bandwidth(seconds)
    page.write(
        f"{torch.cuda.get_device_name()}, whose memory copies {copied / 1e12:.2f} TB/s:",
        table(["grid", "Gcell/s", "of the bandwidth"], printed(rates(copied, seconds))),
        "Transfer matrices, preparing on the CPU included, and the difference of the two:",
        table(["scene", "CPU", "GPU", "ratio", "difference"], printed(matrices())),
    )


def bandwidth(seconds: float) -> float:
    """Return the bandwidth of a copy, bytes read and written [byte/s]."""
    source = torch.ones(COPIED, device="cuda")
    target = torch.empty_like(source)

    def copy(times: int) -> None:
        for _ in range(times):
            target.copy_(source)
        torch.cuda.synchronize()

    return fastest(copy, 8.0 * COPIED, seconds)


def rates(copied: float, seconds: float) -> Iterator[list[str]]:
    """Measure the kernel on uniform air and on the paper's scenes."""
    scenes = assemblies()
    air = uniform(scenes["free space"])
    cases = [(f"uniform air, {SIDE}^3, no layers", (SIDE,) * 3, air)]
    for name, assembly in scenes.items():
        shape = assembly.grid.shape
        cases.append((f"{name}, {' x '.join(map(str, shape))}", shape, assembly.coefficients))
    for name, shape, coefficients in cases:
        rate = cell_rate(CudaKernel(), shape, coefficients, seconds, torch.cuda.synchronize)
        share = percent(CELL_BYTES * rate / copied)
        yield [name, f"{rate / 1e9:.1f}", share]


def phone_scene(points: int) -> at.Scene:
    """Return a tilted phone before an AUTD3 of points, with control points behind it."""
    middle, spread = torch.tensor([0.09, 0.05, 0.05]), torch.tensor([0.02, 0.1, 0.15])
    places = middle + spread * (torch.rand(points, 3, generator=torch.Generator().manual_seed(0)) - 0.5)
    domain = ((-5e-3, -0.1, -0.1), (0.12, 0.2, 0.2))
    return at.Scene(autd3_array(), at.Medium.air(), 40e3, places, [PHONE], domain=domain)


def matrices() -> Iterator[list[str]]:
    """Time transfer matrices on the CPU and on the GPU."""
    cases = [(f"three cubes, {spacing:g} mm", paper_scene("three_cubes"), spacing) for spacing in (1.0, 0.5)]
    cases += [(f"phone, AUTD3, {points} points, 1 mm", phone_scene(points), 1.0) for points in (4, 64)]
    for name, scene, spacing in cases:
        (on_cpu, slow), (on_gpu, fast) = (
            shortest(
                lambda s=scene, h=spacing, d=d: uncached(s, "box", h, device=d).transfer_matrix(), REPEATS
            )
            for d in ("cpu", "cuda")
        )
        difference = f"{relative_error(on_gpu.cpu(), on_cpu):.1e}"
        yield [name, f"{slow:.2f} s", f"{fast:.2f} s", f"{slow / fast:.1f}", difference]
