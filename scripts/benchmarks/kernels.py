"""Rates of the kernels, against the bandwidth of the memory.

A cell of uniform air in float32 needs 12 bytes a step: two fields read, one written. The bandwidth comes from
a triad, c = a + b / 2, on arrays larger than all caches and on arrays as large as a field. Takes about a
minute on 2 idle cores.
"""

from collections.abc import Callable, Iterator

import numpy as np
import torch
from numba import njit, prange
from shared.document import printed
from shared.scenes import paper_scene
from shared.timing import shortest, timed

from autdtorch.fdtd.grid import make_box
from autdtorch.fdtd.kernels.contract import Coefficients, Columns, Kernel, Receivers, Sources, uniform_state
from autdtorch.fdtd.kernels.cpu import CpuKernel
from autdtorch.fdtd.kernels.reference import ReferenceKernel
from autdtorch.fdtd.stepping import Assembly, assemble, assemble_on
from autdtorch.propagators.plan import region_of
from autdtorch.utils.process import spread

OPTIONS = {"--seconds": {"type": float, "default": 0.4, "help": "of each repeat"}}

SIDE = 112
LARGE = 100_000_000
"""Numbers of an array larger than all caches."""
REPEATS = 5
"""Repeats of each measurement; the fastest counts."""


def main(seconds: float) -> None:
    for numbers, where in ((LARGE, "beyond the caches"), (SIDE**3, f"at {SIDE}^3")):
        print(f"memory (triad) allows {bandwidth(numbers, seconds) / 12e9:.2f} Gcell/s {where}")
    printed(rates(seconds))


def rates(seconds: float) -> Iterator[list[str]]:
    """Measure the kernels on uniform air and on the paper's scenes."""
    scenes, cpu = assemblies(), CpuKernel()
    rate = cell_rate(cpu, (SIDE,) * 3, uniform(scenes["free space"]), seconds)
    yield ["cpu", f"uniform air, {SIDE}^3, no layers", f"{rate / 1e9:.3f}"]
    cases = [("cpu", cpu, name) for name in scenes]
    for kernel_name, kernel, name in [*cases, ("reference", ReferenceKernel(), "free space")]:
        shape = scenes[name].grid.shape
        rate = cell_rate(kernel, shape, scenes[name].coefficients, seconds)
        yield [kernel_name, f"{name}, {' x '.join(map(str, shape))}", f"{rate / 1e9:.3f}"]


@njit(parallel=True, cache=True)
def triad(a, b, c):  # type: ignore[no-untyped-def]
    """Read two numbers, write one."""
    for k in prange(len(a)):
        c[k] = a[k] + np.float32(0.5) * b[k]


def fastest(step: Callable[[int], object], work: float, seconds: float) -> float:
    """Return the work per second of `step(times)`, with about `seconds` for each repeat."""
    for times in (2, 3):
        step(times)
    _, three = timed(lambda: step(3))
    times = max(3, int(3 * seconds / three))
    return work * times / shortest(lambda: step(times), REPEATS)[1]


def bandwidth(numbers: int, seconds: float) -> float:
    """Return the bandwidth of a triad [byte/s]."""
    a, b, c = (np.ones(numbers, np.float32) for _ in range(3))
    return fastest(lambda times: [triad(a, b, c) for _ in range(times)], 12 * numbers, seconds)


def uniform(assembly: Assembly) -> Coefficients:
    """Return the coefficients of air without absorbing layers."""
    c, nothing = assembly.coefficients, torch.zeros(0, dtype=torch.int64)
    dtype = assembly.dtype
    none, silent = torch.zeros(0, dtype=dtype), torch.zeros(1, dtype=dtype)
    return Coefficients(
        c.center, c.face, c.edge, c.corner, c.keep, nothing, torch.zeros((0, 27), dtype=dtype), nothing,
        silent, silent, nothing, none, Columns.none(0, dtype), Columns.none(0, dtype, width=3),
        torch.zeros((0, 2), dtype=torch.int64),
    )  # fmt: skip


def cell_rate(
    kernel: Kernel,
    shape: tuple[int, int, int],
    coefficients: Coefficients,
    seconds: float,
    wait: Callable[[], None] = lambda: None,
    together: int = 1,
) -> float:
    """Return the cells stepped per second, without sources and receivers; small grids side by side.

    `wait` returns when the steps are done. A call steps runs `together`.
    """
    calls = kernel.at_once(shape)
    states = [uniform_state(shape, coefficients, 1e-20, together) for _ in range(calls)]
    dtype = coefficients.layer_decay.dtype
    sources = Sources(torch.zeros(0, dtype=torch.int64), torch.zeros((together, 0, 2)))
    receivers = Receivers(torch.zeros((0, 1), dtype=torch.int64), torch.zeros((0, 1), dtype=dtype))

    def step(times: int) -> None:
        nonlocal states
        signal = torch.zeros((times, 2), dtype=dtype)
        states = spread(
            lambda state: kernel.advance(state, coefficients, sources, receivers, signal)[0], states, calls
        )
        wait()

    return fastest(step, float(calls * together * np.prod(shape)), seconds)


def assemblies() -> dict[str, Assembly]:
    """Assemble the scenes at 1 mm, on the whole domain and in the box."""
    air, cubes = (region_of(paper_scene(name)) for name in ("homogeneous", "three_cubes"))
    return {
        "free space": assemble(air, 1e-3),
        "three cubes, full": assemble(cubes, 1e-3),
        "three cubes, box": assemble_on(make_box(cubes, 1e-3), cubes, torch.float32, None),
    }
