"""How right, how stable and how fast the full-domain solver is; prints a Markdown table of figures.

    python scripts/benchmark_solver.py            all but the 0.5 mm runs, about 4 minutes on 2 idle cores
    python scripts/benchmark_solver.py --fine     with them, about 4 minutes more

Each line names what is measured. Timings are wall clock: look at the ratios.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch

import autdtorch as at
from autdtorch.analytic.green import free_space_matrix
from autdtorch.fdtd.kernels.contract import Kernel, Receivers, Sources, uniform_state
from autdtorch.fdtd.kernels.cpu import CpuKernel
from autdtorch.fdtd.kernels.reference import ReferenceKernel
from autdtorch.fdtd.stepping import assemble, drive_signal
from autdtorch.propagators.scene_region import region_of

SCENES = Path(__file__).parents[1] / "configs" / "scene"
OBSTACLE_SCENES = ("three_cubes", "two_cubes")


def load(name: str) -> at.Scene:
    """One of the paper's scenes."""
    return at.load_scene(SCENES / f"{name}.yaml")


def relative_error(value: torch.Tensor, reference: torch.Tensor) -> float:
    """Complex relative L2 error."""
    return float((value - reference).norm() / reference.norm())


def report(what: str, figure: str) -> None:
    """Print a line of the table."""
    print(f"| {what} | {figure} |", flush=True)


def free_space_error() -> None:
    """Transfer matrix of the empty scene against the exact one."""
    scene = load("homogeneous")
    exact = free_space_matrix(scene.control_points, scene.array, scene.wavenumber)
    for spacing in (2e-3, 1e-3):
        simulated = at.make_propagator(scene, "full", spacing, tolerance=1e-4, cache=False).transfer_matrix()
        report(
            f"free space, G at {spacing * 1e3:g} mm against exact",
            f"{100 * relative_error(simulated, exact):.3f} %",
        )


def spacing_difference() -> None:
    """Transfer matrices of the obstacle scenes at two spacings.

    Of one focus: in each scene, and on both grids, the four are mirror images of one another.
    """
    for name in OBSTACLE_SCENES:
        scene = load(name)
        coarse, fine = (
            at.make_propagator(scene, "full", spacing, cache=False).transfer_matrix(scene.control_points[:1])
            for spacing in (1e-3, 0.5e-3)
        )
        report(f"{name}, G at 1 mm against 0.5 mm", f"{100 * relative_error(coarse, fine):.2f} %")


def replay_against_transfer() -> None:
    """A simulation per drive against the transfer matrix."""
    generator = torch.Generator().manual_seed(0)
    drive = at.drive_from_phases(2 * np.pi * torch.rand((3, 16), generator=generator, dtype=torch.float64))
    for name in OBSTACLE_SCENES:
        scene = load(name)
        propagator = at.make_propagator(scene, "full", 1e-3, tolerance=1e-4, cache=False)
        transfer, replay = (
            at.SimulatedObjective(scene, propagator, mode=mode)(drive) for mode in ("transfer", "replay")
        )
        difference = float((transfer - replay).norm() / transfer.norm())
        report(f"{name}, replay against transfer, 3 random drives", f"{difference:.1e}")


def long_run(steps: int = 20_000, block: int = 2_000) -> None:
    """Whether anything grows under a drive that stays on."""
    for name in OBSTACLE_SCENES:
        scene = load(name)
        assembly = assemble(region_of(scene), 1e-3)
        sources = assembly.sources(scene.array.positions, torch.ones(16, dtype=torch.complex128))
        receivers, state, peaks = assembly.receivers(scene.control_points), assembly.silence(sources), []
        for first in range(0, steps, block):
            signal = drive_signal(assembly.steps_per_period, first, block).float()
            state, recorded = CpuKernel().advance(state, assembly.coefficients, sources, receivers, signal)
            peaks.append(float(state.now.abs().max()))
        drift = float(recorded[-block // 2 :].abs().max() / recorded[: block // 2].abs().max()) - 1
        report(
            f"{name}, {steps} driven steps: peak pressure of the grid after each {block}",
            f"{min(peaks):.4g} to {max(peaks):.4g}, foci drift {drift:.1e} in the last {block}",
        )


def kernel_rate(cells: int = 112) -> None:
    """Cell updates per second of both kernels."""
    scene = load("homogeneous")
    coefficients = assemble(region_of(scene), 1e-3).coefficients
    shape = (cells, cells, cells)
    nobody = Sources(torch.zeros(0, dtype=torch.int64), torch.zeros((0, 2)))
    deaf = Receivers(torch.zeros((0, 1), dtype=torch.int64), torch.zeros((0, 1)))

    def rate(kernel: Kernel, steps: int) -> float:
        state = uniform_state(shape, coefficients, 1.0)
        state, _ = kernel.advance(state, coefficients, nobody, deaf, torch.zeros((2, 2)))
        best = np.inf
        for _ in range(5):
            begin = time.perf_counter()
            state, _ = kernel.advance(state, coefficients, nobody, deaf, torch.zeros((steps, 2)))
            best = min(best, time.perf_counter() - begin)
        return cells**3 * steps / best / 1e9

    with torch.no_grad():
        cpu, reference = rate(CpuKernel(), 100), rate(ReferenceKernel(), 5)
    report(f"cpu kernel at {cells}^3, float32, boundary layers and all", f"{cpu:.2f} Gcell/s")
    report(f"torch eager at {cells}^3", f"{reference:.3f} Gcell/s")
    report("ratio", f"{cpu / reference:.0f}")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--fine", action="store_true", help="also the runs at 0.5 mm")
    fine = parser.parse_args().fine
    print("| what | measured |\n| --- | --- |")
    kernel_rate()
    free_space_error()
    replay_against_transfer()
    long_run()
    if fine:
        spacing_difference()


if __name__ == "__main__":
    main()
