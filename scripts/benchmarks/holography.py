"""Drives a second by the algorithms of holography, beside those of AcousTools on the same matrices.

Needs `pip install 'autdtorch[crosscheck]'`. Matrices are random, in single precision, with a row for each
point and the 249 transducers of an AUTD3. Each time is the shortest of five. The share of the bound is over
sets of random foci, with the paper's two cubes before them. Takes about two minutes on 2 idle cores.
"""

import functools
import time
from collections.abc import Callable, Iterator

import torch
from acoustools.Solvers import gspat_solver, iterative_backpropagation, naive_solver_batched, wgs_solver_batch
from shared.document import Page, printed, quartiles, table
from shared.scenes import cube_shadow, weakest
from shared.timing import shortest

import autdtorch as at

DOCUMENT = "performance.md"

SETS, TRANSDUCERS, ITERATIONS, REPEATS = 2048, 249, 50, 5
POINTS = 32
MORE = 8  # starts
SETTLED = 0.3  # [s]
ALGORITHMS = ("naive", "gs", "wgs", "gs_pat")


def main(page: Page) -> None:
    page.write(
        f"Sets of {POINTS} points a second, {ITERATIONS} iterations, {TRANSDUCERS} transducers, "
        "amplitudes 1:",
        table(["algorithm", "autdtorch", "AcousTools", "ratio"], printed(rates())),
        "Share of the bound on the weakest focus [%], 200 iterations, behind two cubes (quartiles): "
        "the bound is within 0.3 % for 4 foci, and a relaxation for more:",
        table(["foci", *ALGORITHMS, "diff_pat", f"wgs, {MORE} starts"], printed(shares())),
    )


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
    solve()
    time.sleep(SETTLED)  # until threads of the solver before no longer spin
    return SETS / shortest(solve, REPEATS)[1]


def rates() -> Iterator[list[str]]:
    generator = torch.Generator().manual_seed(POINTS)
    matrix = torch.randn(SETS, POINTS, TRANSDUCERS, dtype=torch.complex64, generator=generator)
    others = theirs(matrix)
    for algorithm in ALGORITHMS:
        ours = rate(functools.partial(at.holography, matrix, None, algorithm, ITERATIONS))
        other = rate(others[algorithm])
        yield [algorithm, f"{ours:,.0f}", f"{other:,.0f}", f"{ours / other:.1f}"]


def shares() -> Iterator[list[str]]:
    """Yield the share of the bound that each algorithm reaches: quartiles over sets of foci."""
    whole, generator = cube_shadow(80), torch.Generator().manual_seed(0)
    for points, count in ((4, 30), (8, 30), (16, 15), (32, 15)):
        sets = torch.stack([whole[torch.randperm(80, generator=generator)[:points]] for _ in range(count)])
        bounds = torch.tensor([at.focus_bound(matrix) for matrix in sets])
        row = [str(points)]
        for algorithm, starts in (*((name, 1) for name in (*ALGORITHMS, "diff_pat")), ("wgs", MORE)):
            wanted = None if algorithm != "diff_pat" else bounds[:, None].expand(-1, points)
            drive = at.holography(sets, wanted, algorithm, starts=starts)
            row.append(quartiles(100 * weakest(sets, drive) / bounds, ".0f"))
        yield row
