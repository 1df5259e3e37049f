"""Sums of waves, holograms and Bayesian optimisation on a GPU, beside the cores of the same machine.

Fields of a drive come back to the CPU; matrices stay on the device. Holograms are of random matrices in
single precision. The faster of two counts. Takes a minute, with an NVIDIA GPU.
"""

import itertools
from collections.abc import Callable, Iterator
from typing import Any

import torch
from shared.document import printed, table
from shared.scenes import objective_of, paper_scene, relative_error
from shared.timing import shortest

import autdtorch as at

OPTIONS = {"--device": {"default": "cuda", "help": "beside the CPU"}}

REPEATS = 2
UP = (0.0, 0.0, 1.0)
VOLUME = 64
"""Points along each side of a cube; on the CPU their matrix takes 1 GiB."""

PLACES = 80_000
SETS, POINTS, TRANSDUCERS, ITERATIONS = 10_000, 8, 256, 50
TRIALS = 25


def main(device: str) -> None:
    if not torch.cuda.is_available():
        raise SystemExit("cuda_methods: needs an NVIDIA GPU")
    header = ["task", "CPU", "GPU", "ratio", "difference"]
    rows = itertools.chain(fields(device), holograms(device), searches(device))
    print(table(header, printed(rows)))  # each row as it comes


def fields(device: str) -> Iterator[list[str]]:
    """Time the field of a drive in a cube, and the matrix of points on the device."""
    steps = torch.linspace(-0.1, 0.1, VOLUME, dtype=torch.float64)
    cube = torch.cartesian_prod(steps, steps, steps + 0.25)
    for kind, radius in (("points", 0.0), ("discs", 4.5e-3)):
        array = at.TransducerArray.sonicsurface((0.0, 0.0, 0.0), UP, radius=radius)
        scene = at.Scene(array, at.Medium.air(), 40e3, [(0.0, 0.0, 0.2)])
        drive = at.drive_from_phases(at.focus_phases(array.positions, (0.0, 0.0, 0.2), scene.wavenumber))

        def field(on: str) -> torch.Tensor:
            return at.make_propagator(scene, device=on).field(drive, cube[None])  # noqa: B023

        yield compared(f"field, {VOLUME}^3 points, 256 {kind}", device, field)
        places = cube[:PLACES]

        def matrix(on: str) -> torch.Tensor:
            return at.make_propagator(scene).transfer_matrix(places.to(on))  # noqa: B023

        yield compared(f"matrix, {len(places):,} points, 256 {kind}", device, matrix)


def holograms(device: str) -> Iterator[list[str]]:
    """Time drives for sets of points, whose pressures are compared."""
    generator = torch.Generator().manual_seed(0)
    matrix = torch.randn(SETS, POINTS, TRANSDUCERS, dtype=torch.complex64, generator=generator)
    sets = {on: matrix.to(on) for on in ("cpu", device)}
    for algorithm in ("gs_pat", "wgs", "gs"):

        def solve(on: str) -> torch.Tensor:
            drive = at.holography(sets[on], None, algorithm, ITERATIONS)  # noqa: B023
            return (sets[on] @ drive[..., None]).abs()

        yield compared(f"{SETS:,} holograms, {algorithm}", device, solve)


def searches(device: str) -> Iterator[list[str]]:
    """Time Bayesian optimisation of all trials at once; the difference is that of the median scores."""
    objective = objective_of(paper_scene("two_cubes"))
    cases: dict[str, dict[str, Any]] = {
        "one process": {"evaluations": 64},
        "a process per focus": {"evaluations": 48, "initial": 4, "model": "foci", "kernel": "phasor"},
    }
    for name, settings in cases.items():

        def search(on: str) -> torch.Tensor:
            solution = at.bayes_opt(objective, trials=TRIALS, device=on, **settings)  # noqa: B023
            return solution.score.median()[None]

        yield compared(f"BO, {name}, {TRIALS} trials", device, search, repeats=1)


def compared(
    name: str, device: str, work: Callable[[str], torch.Tensor], repeats: int = REPEATS
) -> list[str]:
    """Return a row: times on both, their ratio, and the relative difference of the results."""
    (on_cpu, slow), (on_gpu, fast) = (timed_on(on, work, repeats) for on in ("cpu", device))
    difference = relative_error(on_gpu.cpu(), on_cpu)
    return [name, f"{slow:.4f} s", f"{fast:.4f} s", f"{slow / fast:.1f}", f"{difference:.1e}"]


def timed_on(device: str, work: Callable[[str], torch.Tensor], repeats: int) -> tuple[torch.Tensor, float]:
    """Return a result and the shortest time [s], after one that loads the kernels."""

    def done() -> torch.Tensor:
        result = work(device)
        if device != "cpu":
            torch.cuda.synchronize()
        return result

    if repeats > 1:
        done()
    return shortest(done, repeats)
