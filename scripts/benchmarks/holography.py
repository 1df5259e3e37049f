"""Drives a second by the algorithms of holography, beside those of AcousTools on the same matrices.

Needs `pip install 'autdtorch[crosscheck]'`. Fills in a block of performance.md. Matrices are random, in
single precision, with a row for each point and the 249 transducers of an AUTD3. Each time is the shortest of
five. The share of the bound is the median over sets of random foci, with the paper's two cubes before them.
Paths are closed circles of 200 frames behind these cubes or around them.

    python scripts/benchmark.py holography        about a minute on 2 idle cores
"""

from __future__ import annotations

import argparse
import functools
import math
import time
from collections.abc import Callable

import torch
from acoustools.Solvers import (
    gspat_solver,
    iterative_backpropagation,
    naive_solver_batched,
    wgs_solver_batch,
)
from shared.document import fill_in, measured, table
from shared.scenes import autd3_array, paper_scene, with_array

import autdtorch as at

DOCUMENT = "performance.md"

SETS, TRANSDUCERS, ITERATIONS, REPEATS = 2048, 249, 50, 5
POINTS = (1, 2, 8, 32)
SETTLED = 0.3  # [s]
ALGORITHMS = ("naive", "gs", "wgs", "gs_pat")
FRAMES, PHASE_STEP = 200, math.pi / 4
PATHS = {  # centre [m], radius [m], normal, foci on the circle
    "30 mm, behind": ((80e-3, 50e-3, 50e-3), 30e-3, (1, 0, 0), 1),
    "15 mm, behind": ((80e-3, 50e-3, 50e-3), 15e-3, (1, 0, 0), 2),
    "20 mm, behind": ((80e-3, 50e-3, 50e-3), 20e-3, (1, 0, 0), 4),
    "40 mm, around": ((41e-3, 50e-3, 50e-3), 40e-3, (0, 0, 1), 1),
    "40 mm, around, two foci": ((41e-3, 50e-3, 50e-3), 40e-3, (0, 0, 1), 2),
}


def theirs(matrix: torch.Tensor) -> dict[str, Callable[[], object]]:
    """Return AcousTools' solvers, on matrices (B, P, M)."""
    places, ones = torch.zeros(len(matrix), 3, matrix.shape[1]), torch.ones_like(matrix[0, :, :1])

    def at_points() -> object:
        back = matrix.conj().mT
        return gspat_solver(matrix @ back, matrix, back, ones, ITERATIONS)

    return {
        "naive": lambda: naive_solver_batched(places, A=matrix),
        "gs": lambda: iterative_backpropagation(places, iterations=ITERATIONS, A=matrix),
        "wgs": lambda: wgs_solver_batch(matrix, ones, ITERATIONS),
        "gs_pat": at_points,
    }


def rate(solve: Callable[[], object]) -> float:
    """Return the sets a second."""
    solve()
    time.sleep(SETTLED)  # until threads of the solver before no longer spin
    spent = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        solve()
        spent.append(time.perf_counter() - begin)
    return SETS / min(spent)


def rates(points: int) -> list[list[str]]:
    """Return rows for sets of so many points."""
    generator, rows = torch.Generator().manual_seed(points), []
    matrix = torch.randn(SETS, points, TRANSDUCERS, dtype=torch.complex64, generator=generator)
    others = theirs(matrix)
    for algorithm in ALGORITHMS:
        ours = rate(functools.partial(at.holography, matrix, None, algorithm, ITERATIONS))
        other = rate(others[algorithm])
        rows.append([str(points), algorithm, f"{ours:,.0f}", f"{other:,.0f}", f"{ours / other:.1f}"])
        print(rows[-1], flush=True)
    return rows


def shares() -> list[list[str]]:
    """Return the median share of the bound that each algorithm reaches, 4 and 8 foci behind two cubes."""
    scene, rows = with_array(paper_scene("two_cubes"), autd3_array()), []
    generator = torch.Generator().manual_seed(0)
    lower, upper = torch.tensor([[0.07, 0.03, 0.03], [0.09, 0.07, 0.07]], dtype=torch.float64)
    places = lower + (upper - lower) * torch.rand(80, 3, dtype=torch.float64, generator=generator)
    whole = at.make_propagator(scene, "box", 1e-3, cache=False).transfer_matrix(places).to(torch.complex128)
    for points in (4, 8):
        sets = torch.stack([whole[torch.randperm(80, generator=generator)[:points]] for _ in range(30)])
        bounds = torch.tensor([at.focus_bound(matrix) for matrix in sets])
        row = [str(points)]
        for algorithm in (*ALGORITHMS, "diff_pat"):
            wanted = None if algorithm != "diff_pat" else bounds[:, None].expand(-1, points)
            drive = at.holography(sets, wanted, algorithm)
            weakest = (sets @ drive[..., None])[..., 0].abs().amin(dim=1)
            row.append(f"{100 * float((weakest / bounds).median()):.0f} %")
        rows.append(row)
        print(row, flush=True)
    return rows


def paths() -> list[list[str]]:
    """Return rows for paths: frames a second, phase steps, and how even the frames are."""
    scene, rows = with_array(paper_scene("two_cubes"), autd3_array()), []
    propagator = at.make_propagator(scene, "box", 1e-3, cache=False)
    for name, (center, radius, normal, foci) in PATHS.items():
        circle = at.circle_points(center, radius, FRAMES, normal)
        places = torch.stack([circle.roll(-focus * FRAMES // foci, 0) for focus in range(foci)], dim=1)
        matrix = propagator.transfer_matrix(places.flatten(0, 1)).reshape(FRAMES, foci, -1)
        spent = []
        for _ in range(REPEATS):
            begin = time.perf_counter()
            drives = at.drive_sequence(matrix, None, PHASE_STEP, closed=True)
            spent.append(time.perf_counter() - begin)
        free = at.drive_sequence(matrix, even=False)
        steps = (drives * drives.roll(1, 0).conj()).angle().abs()
        even, uneven, alone = (
            (matrix @ drive[..., None])[..., 0].abs().amin(dim=1)
            for drive in (drives, at.drive_sequence(matrix, None, PHASE_STEP, True, even=False), free)
        )
        cells = [
            f"{FRAMES / min(spent):,.0f}",
            f"{float(steps.max()):.3f}",
            *(f"{100 * float(one.min() / one.mean()):.1f}" for one in (even, uneven)),
            f"{100 * float(even.min() / alone.min()):.0f}",
        ]
        rows.append([name, str(foci), *cells])
        print(rows[-1], flush=True)
    return rows


def main(given: argparse.Namespace) -> None:
    """Measure, and write the block."""
    found = [row for points in POINTS for row in rates(points)]
    parts = (
        measured(),
        f"Sets a second, {ITERATIONS} iterations, {TRANSDUCERS} transducers, amplitudes 1:",
        table(["points", "algorithm", "autdtorch", "AcousTools", "ratio"], found),
        "Share of the bound on the weakest focus, 200 iterations (median of 30 sets behind two cubes):",
        table(["foci", *ALGORITHMS, "diff_pat"], shares()),
        f"Closed paths of {FRAMES} frames, phase steps up to {PHASE_STEP:.3f} rad. Levels of the weakest\n"
        "frame are shares of the mean of all, with amplitudes lowered to one level and without, and of the\n"
        "weakest frame without a limit:",
        table(
            [
                "circle",
                "foci",
                "frames/s",
                "largest step [rad]",
                "even [%]",
                "amplitudes 1 [%]",
                "no limit [%]",
            ],
            paths(),
        ),
    )
    fill_in(DOCUMENT, "benchmark.py holography", parts, given.output)
