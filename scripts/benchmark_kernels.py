"""How fast the kernels step, against the memory's bandwidth in the same run; writes docs/performance.md.

    python scripts/benchmark_kernels.py           about a minute on 2 idle cores

A cell of uniform air in float32 needs 12 bytes a step: two fields read, one written. Bandwidth is that of a
copy, 8 bytes a number, and of a triad, 12, of arrays that no cache holds and of arrays as large as a field.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from generated_block import fill_in, measured, table
from numba import njit, prange

import autdtorch as at
from autdtorch.fdtd.grid import make_box
from autdtorch.fdtd.kernels.contract import Coefficients, Columns, Kernel, Receivers, Sources, uniform_state
from autdtorch.fdtd.kernels.cpu import CpuKernel
from autdtorch.fdtd.kernels.reference import ReferenceKernel
from autdtorch.fdtd.stepping import Assembly, assemble, assemble_on
from autdtorch.propagators.scene_region import region_of
from autdtorch.utils.threads import thread_count

ROOT = Path(__file__).parents[1]
SCENES, DOCS = ROOT / "configs" / "scene", ROOT / "docs"
SIDE = 112
LARGE = 100_000_000
"""Numbers of an array that no cache holds."""
REPEATS = 5
SECONDS = 0.4
"""Of each repeat, about; the fastest counts."""


@njit(parallel=True, cache=True)
def copy(a, b):  # type: ignore[no-untyped-def]
    """Read one number, write one."""
    for k in prange(len(a)):
        b[k] = a[k]


@njit(parallel=True, cache=True)
def triad(a, b, c):  # type: ignore[no-untyped-def]
    """Read two numbers, write one."""
    for k in prange(len(a)):
        c[k] = a[k] + np.float32(0.5) * b[k]


def fastest(step: Callable[[int], object], work: float) -> float:
    """Work a second of `step(times)`, in the fastest of some repeats."""
    step(2)
    begin = time.perf_counter()
    step(3)
    times = max(3, int(3 * SECONDS / (time.perf_counter() - begin)))
    spent = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        step(times)
        spent.append(time.perf_counter() - begin)
    return work * times / min(spent)


def bandwidths(numbers: int) -> tuple[float, float]:
    """Bytes a second of copy and triad."""
    a, b, c = (np.ones(numbers, np.float32) for _ in range(3))
    return (
        fastest(lambda times: [copy(a, b) for _ in range(times)], 8 * numbers),
        fastest(lambda times: [triad(a, b, c) for _ in range(times)], 12 * numbers),
    )


def uniform(assembly: Assembly) -> Coefficients:
    """Air alone, without boundary layers."""
    c, nothing = assembly.coefficients, torch.zeros(0, dtype=torch.int64)
    dtype = assembly.dtype
    none, silent = torch.zeros(0, dtype=dtype), torch.zeros(1, dtype=dtype)
    return Coefficients(
        c.center, c.face, c.edge, c.corner, c.keep, nothing, torch.zeros((0, 27), dtype=dtype), nothing,
        silent, silent, nothing, none, Columns.none(0, dtype), Columns.none(0, dtype, width=3),
        torch.zeros((0, 2), dtype=torch.int64),
    )  # fmt: skip


def cell_rate(kernel: Kernel, shape: tuple[int, int, int], coefficients: Coefficients) -> float:
    """Cells stepped a second, all of the array counted, without sources and receivers."""
    state = uniform_state(shape, coefficients, 1e-20)
    dtype = coefficients.layer_decay.dtype
    nobody = Sources(torch.zeros(0, dtype=torch.int64), torch.zeros((0, 2)))
    deaf = Receivers(torch.zeros((0, 1), dtype=torch.int64), torch.zeros((0, 1), dtype=dtype))

    def step(times: int) -> None:
        nonlocal state
        state, _ = kernel.advance(state, coefficients, nobody, deaf, torch.zeros((times, 2), dtype=dtype))

    return fastest(step, float(np.prod(shape)))


def kernels() -> dict[str, Kernel]:
    """Those there are on this machine, by the names `make_propagator` calls them."""
    found: dict[str, Kernel] = {"cpu": CpuKernel(), "reference": ReferenceKernel()}
    return found


def scenes() -> dict[str, Assembly]:
    """Assembled at 1 mm: the whole domain and the box."""
    found = {"free space": assemble(region_of(at.load_scene(SCENES / "homogeneous.yaml")), 1e-3)}
    for name in ("three_cubes", "two_cubes"):
        scene = at.load_scene(SCENES / f"{name}.yaml")
        found[f"{name.replace('_', ' ')}, full"] = assemble(region_of(scene), 1e-3)
        found[f"{name.replace('_', ' ')}, box"] = assemble_on(
            make_box(region_of(scene), 1e-3), region_of(scene), torch.float32, None
        )
    return found


def main() -> None:
    """Measure, and write the block."""
    lines = []
    for name, numbers in (("beyond the caches", LARGE), (f"of {SIDE}^3", SIDE**3)):
        for how, rate in zip(("copy", "triad"), bandwidths(numbers), strict=True):
            lines.append([f"{how}, arrays {name}", f"{rate / 1e9:.1f} GB/s", f"{rate / 12e9:.2f} Gcell/s"])
    memory = table(["bandwidth", "measured", "at 12 bytes a cell"], lines)
    assemblies = scenes()
    rows = []
    uniform_rate = cell_rate(CpuKernel(), (SIDE,) * 3, uniform(assemblies["free space"]))
    rows.append(["cpu", f"uniform air, {SIDE}^3, no layers", f"{uniform_rate / 1e9:.3f}", "1"])
    for name, kernel in kernels().items():
        for scene, assembly in assemblies.items():
            rate = cell_rate(kernel, assembly.grid.shape, assembly.coefficients)
            shape = " x ".join(map(str, assembly.grid.shape))
            rows.append([name, f"{scene}, {shape}", f"{rate / 1e9:.3f}", f"{rate / uniform_rate:.2f}"])
            print(rows[-1], flush=True)
    rates = table(["kernel", "grid", "Gcell/s", "of the uniform rate"], rows)
    stated = measured("python scripts/benchmark_kernels.py") + f"\n\nThreads: {thread_count()}."
    print(stated, memory, rates, sep="\n\n")
    fill_in(DOCS / "performance.md", "benchmark_kernels", (stated, memory, rates), DOCS)


if __name__ == "__main__":
    main()
