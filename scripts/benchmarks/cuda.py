"""Rates and run times on a GPU, beside those of the CPU kernel on the same machine.

A cell of uniform air in float32 needs 12 bytes a step; the bandwidth is measured by a copy within the GPU's
memory. Each matrix has a new propagator, preparing included; the faster of two counts. Takes about two
minutes, with an NVIDIA GPU.
"""

import functools
import math
import statistics
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from benchmarks.arrays import body, scene_of
from benchmarks.kernels import assemblies, cell_rate, fastest, uniform
from benchmarks.meshes import AIR, DOMAIN, FOCI, UP, hand
from shared.document import Page, percent, printed, table
from shared.scenes import autd3_array, paper_scene, relative_error, uncached
from shared.timing import shortest

import autdtorch as at
from autdtorch.fdtd.kernels.cpu import CpuKernel
from autdtorch.fdtd.kernels.cuda import CudaKernel

DOCUMENT = "performance.md"
OPTIONS = {"--seconds": {"type": float, "default": 0.2, "help": "of each repeat"}}

CELL_BYTES = 12
COPIED = 2**28
"""Numbers of the copy, 1 GiB."""
SIDE, SIDE_OF_PLATE = 256, 0.4
REPEATS = 2
PHONE = at.Box((40e-3, 50e-3, 50e-3), (8e-3, 70e-3, 140e-3), rotation=(0.1, 0.2, 0.3), rigid=True)


def main(page: Page, seconds: float) -> None:
    if not torch.cuda.is_available():
        raise SystemExit("cuda: needs an NVIDIA GPU")
    copied = bandwidth(seconds)
    page.write(
        f"{torch.cuda.get_device_name()}, whose memory copies {copied / 1e12:.2f} TB/s:",
        table(
            ["grid", "runs", "step [us]", "Gcell/s", "of the bandwidth", "2 CPU cores, Gcell/s", "ratio"],
            printed(rates(copied, seconds)),
        ),
        "Transfer matrices, preparing on the CPU included, the time of a run, and the difference of the two:",
        table(["scene", "CPU", "GPU", "a run", "ratio", "difference"], printed(matrices())),
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
    """Measure the kernel on uniform air and on the paper's scenes, beside the CPU kernel on two threads."""
    scenes = assemblies()
    cases = [(f"uniform air, {SIDE}^3, no layers", (SIDE,) * 3, uniform(scenes["free space"]), 1)]
    for name, assembly in scenes.items():
        shape, runs = assembly.grid.shape, (1, 4, 64) if "box" in name else (1,)
        cases += [
            (f"{name}, {' x '.join(map(str, shape))}", shape, assembly.coefficients, each) for each in runs
        ]
    slow = 0.0
    for name, shape, coefficients, runs in cases:
        if runs == 1:
            with threads(2):
                slow = cell_rate(CpuKernel(), shape, coefficients, seconds)
        rate = cell_rate(CudaKernel(), shape, coefficients, seconds, torch.cuda.synchronize, runs)
        step = runs * math.prod(shape) / rate
        yield [
            name, str(runs), f"{1e6 * step:.1f}", f"{rate / 1e9:.1f}", percent(CELL_BYTES * rate / copied),
            f"{slow / 1e9:.2f}", f"{rate / slow:.0f}",
        ]  # fmt: skip


@contextmanager
def threads(most: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(most)
    yield
    torch.set_num_threads(before)


def phone_scene(points: int) -> at.Scene:
    """Return a tilted phone before an AUTD3 of points, with control points behind it."""
    middle, spread = torch.tensor([0.09, 0.05, 0.05]), torch.tensor([0.02, 0.1, 0.15])
    places = middle + spread * (torch.rand(points, 3, generator=torch.Generator().manual_seed(0)) - 0.5)
    domain = ((-5e-3, -0.1, -0.1), (0.12, 0.2, 0.2))
    return at.Scene(autd3_array(), at.Medium.air(), 40e3, places, [PHONE], domain=domain)


def matrices() -> Iterator[list[str]]:
    cubes, discs = paper_scene("three_cubes"), at.TransducerArray.autd3((0.0, 0.0, 0.0), UP)
    hand_scene = at.Scene(discs, AIR, 40e3, FOCI, [hand()], domain=DOMAIN)
    cases: list[tuple[str, at.Scene, str, float, float]] = [
        ("three cubes, 1 mm", cubes, "box", 1.0, 1e-3),
        ("three cubes, 0.5 mm", cubes, "box", 0.5, 1e-3),
        ("three cubes, whole domain, 1 mm", cubes, "full", 1.0, 1e-3),
        ("phone, AUTD3, 4 points, 1 mm", phone_scene(4), "box", 1.0, 1e-3),
        ("phone, AUTD3, 64 points, 1 mm", phone_scene(64), "box", 1.0, 1e-3),
        ("hand, AUTD3 of discs, 4 points, 1 mm", hand_scene, "box", 1.0, 2e-3),
        (
            f"plate of {SIDE_OF_PLATE:g} m, 256 discs, 4 points, 1 mm",
            scene_of(body("plate", SIDE_OF_PLATE)),
            "box",
            1.0,
            2e-3,
        ),
    ]
    for name, scene, method, spacing, tolerance in cases:
        timed_on = {}
        for device in ("cpu", "cuda"):
            work = functools.partial(simulated, scene, method, spacing, tolerance, device)
            timed_on[device] = shortest(work, REPEATS)
        (on_cpu, _), slow = timed_on["cpu"]
        (on_gpu, stepping), fast = timed_on["cuda"]
        difference = f"{relative_error(on_gpu.cpu(), on_cpu):.1e}"
        yield [
            name, f"{slow:.2f} s", f"{fast:.2f} s", f"{1e3 * stepping:.0f} ms", f"{slow / fast:.1f}",
            difference,
        ]  # fmt: skip


def simulated(
    scene: at.Scene, method: str, spacing: float, tolerance: float, device: str
) -> tuple[torch.Tensor, float]:
    """Return the transfer matrix, and the time of a run [s]."""
    propagator = uncached(scene, method, spacing, tolerance, device=device)
    matrix = propagator.transfer_matrix()
    return matrix, statistics.mean(run.seconds for run in propagator.runs)
