"""Rates and run times on a GPU, beside those of the CPU kernel on the same machine.

Fills in a block of performance.md. A cell of uniform air in float32 needs 12 bytes a step; the bandwidth is
that of a copy within the GPU's memory. Matrices come from propagators of their own, preparing included, the
faster of two. Holograms are of random matrices of 256 transducers and 8 points.

    python scripts/benchmark.py cuda              about a minute, with an NVIDIA GPU
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator

import torch
from benchmarks.kernels import assemblies, fastest, uniform
from shared.document import fill_in, measured, percent, table
from shared.scenes import autd3_array, paper_scene, relative_error

import autdtorch as at
from autdtorch.fdtd.kernels.contract import Coefficients, Receivers, Sources, uniform_state
from autdtorch.fdtd.kernels.cuda import CudaKernel
from autdtorch.propagators.moved_boxes import forget_assemblies

DOCUMENT = "performance.md"

CELL_BYTES = 12
COPIED = 2**28
"""Numbers of the copy, 1 GiB."""
SIDES = (112, 256)
REPEATS = 2
SETS, POINTS, TRANSDUCERS, ITERATIONS = 4096, 8, 256, 100
PHONE = at.Box((40e-3, 50e-3, 50e-3), (8e-3, 70e-3, 140e-3), rotation=(0.1, 0.2, 0.3), rigid=True)


def bandwidth(seconds: float) -> float:
    """Return the bandwidth of a copy, bytes read and written [byte/s]."""
    source = torch.ones(COPIED, device="cuda")
    target = torch.empty_like(source)

    def copy(times: int) -> None:
        for _ in range(times):
            target.copy_(source)
        torch.cuda.synchronize()

    return fastest(copy, 8.0 * COPIED, seconds)


def cell_rate(shape: tuple[int, int, int], coefficients: Coefficients, seconds: float) -> float:
    """Return the cells stepped per second, without sources and receivers."""
    kernel, state = CudaKernel(), uniform_state(shape, coefficients, 1e-20)
    sources = Sources(torch.zeros(0, dtype=torch.int64), torch.zeros((0, 2)))
    receivers = Receivers(torch.zeros((0, 1), dtype=torch.int64), torch.zeros((0, 1)))

    def step(times: int) -> None:
        nonlocal state
        state, _ = kernel.advance(state, coefficients, sources, receivers, torch.zeros((times, 2)))
        torch.cuda.synchronize()

    return fastest(step, float(math.prod(shape)), seconds)


def rates(copied: float, seconds: float) -> Iterator[list[str]]:
    """Measure the kernel on uniform air and on the paper's scenes."""
    found = assemblies()
    air = uniform(found["free space"])
    cases = [(f"uniform air, {side}^3, no layers", (side,) * 3, air) for side in SIDES]
    for name, each in found.items():
        shape = each.grid.shape
        cases.append((f"{name}, {' x '.join(map(str, shape))}", shape, each.coefficients))
    for name, shape, coefficients in cases:
        rate = cell_rate(shape, coefficients, seconds)
        share = percent(CELL_BYTES * rate / copied)
        yield [name, f"{1e6 * math.prod(shape) / rate:.1f} us", f"{rate / 1e9:.1f}", share]


def matrix(scene: at.Scene, spacing: float, device: str) -> tuple[torch.Tensor, float]:
    """Return the transfer matrix and its shortest time [s]."""
    spent = []
    for _ in range(REPEATS):
        forget_assemblies()
        begin = time.perf_counter()
        propagator = at.make_propagator(scene, "box", spacing, tolerance=1e-3, cache=False, device=device)
        found = propagator.transfer_matrix()
        spent.append(time.perf_counter() - begin)
    return found, min(spent)


def phone_scene(points: int) -> at.Scene:
    """Return a tilted phone before an AUTD3 of points, with control points behind it."""
    middle, spread = torch.tensor([0.09, 0.05, 0.05]), torch.tensor([0.02, 0.1, 0.15])
    places = middle + spread * (torch.rand(points, 3, generator=torch.Generator().manual_seed(0)) - 0.5)
    domain = ((-5e-3, -0.1, -0.1), (0.12, 0.2, 0.2))
    return at.Scene(autd3_array(), at.Medium.air(), 40e3, places, [PHONE], domain=domain)


def matrices() -> Iterator[list[str]]:
    """Time transfer matrices on the CPU and on the GPU."""
    cases = [
        (f"{name.replace('_', ' ')}, {1e3 * spacing:g} mm", paper_scene(name), spacing)
        for name in ("three_cubes", "two_cubes")
        for spacing in (1e-3, 0.5e-3)
    ]
    cases += [(f"phone, AUTD3, {points} points, 1 mm", phone_scene(points), 1e-3) for points in (4, 64)]
    for name, scene, spacing in cases:
        (on_cpu, slow), (on_gpu, fast) = (matrix(scene, spacing, device) for device in ("cpu", "cuda"))
        difference = f"{relative_error(on_gpu.cpu(), on_cpu):.1e}"
        yield [name, f"{slow:.2f} s", f"{fast:.2f} s", f"{slow / fast:.1f}", difference]


def holograms() -> Iterator[list[str]]:
    """Measure the holograms a second of each algorithm."""
    generator = torch.Generator().manual_seed(0)
    sets = torch.randn(SETS, POINTS, TRANSDUCERS, dtype=torch.complex64, generator=generator).cuda()
    for algorithm in ("naive", "gs", "wgs", "gs_pat"):

        def solve(times: int, algorithm: str = algorithm) -> None:
            for _ in range(times):
                at.holography(sets, None, algorithm, ITERATIONS)
            torch.cuda.synchronize()

        yield [algorithm, f"{fastest(solve, SETS, 0.1):,.0f}"]


def printed(rows: Iterator[list[str]]) -> list[list[str]]:
    """Return all rows, printed as they come."""
    found = []
    for row in rows:
        print(row, flush=True)
        found.append(row)
    return found


OPTIONS: dict[str, dict[str, object]] = {
    "--seconds": {"type": float, "default": 0.2, "help": "of each repeat"}
}


def main(given: argparse.Namespace) -> None:
    """Measure, and write the block."""
    if not torch.cuda.is_available():
        raise SystemExit("cuda: needs an NVIDIA GPU")
    copied = bandwidth(given.seconds)
    parts = (
        measured(),
        f"{torch.cuda.get_device_name()}, whose memory copies {copied / 1e12:.2f} TB/s. A step:",
        table(["grid", "time", "Gcell/s", "of the bandwidth"], printed(rates(copied, given.seconds))),
        "Transfer matrices, preparing on the CPU included, and the difference of the two:",
        table(["scene", "CPU", "GPU", "ratio", "difference"], printed(matrices())),
        f"Holograms a second, {TRANSDUCERS} transducers, {POINTS} points, {ITERATIONS} iterations:",
        table(["algorithm", "a second"], printed(holograms())),
    )
    fill_in(DOCUMENT, "benchmark.py cuda", parts, given.output)
