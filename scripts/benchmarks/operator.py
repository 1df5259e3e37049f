"""Scattering operators of the paper's cubes: time to build, accuracy after moves, and matrices a second.

Fills in blocks of performance.md. Shifts and turns are random, and compared with the box solver at the same
spacing and at a fine one. Then a cube on a path, for which drives are found at every pose, simulated spheres
against their closed form, and a hand that is too large for an operator: its box keeps outgoing fields.

    python scripts/benchmark.py operator        about twelve minutes on 2 idle cores
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator

import numpy as np
import torch
from benchmarks.meshes import DOMAIN, FOCI, UP, hand
from shared.document import fill_in, measured, percent, table
from shared.scenes import paper_scene, relative_error

import autdtorch as at
from autdtorch.propagators import SimulatedPropagator
from autdtorch.propagators.moved_boxes import forget_assemblies

DOCUMENT = "performance.md"

SCENES = ("two_cubes", "three_cubes")
SPACING, FINE = 1e-3, 0.4e-3  # [m]
LARGEST_SHIFT = 4e-3  # [m]
REPEATS = 5
OPTIONS = {
    "--shifts": {"type": int, "default": 50, "help": "random shifts, against the box at the same spacing"},
    "--turns": {"type": int, "default": 20, "help": "random turns, against the box at 0.4 mm"},
}
AIR = at.Medium(density=1.293, sound_speed=340.0)
PATH, STARTS = 200, 8
"""Poses on the path of a cube, and first guesses of the drive at each."""


def shortest(work: Callable[[], object]) -> float:
    """Return the shortest time [s] of some repetitions."""
    spent = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        work()
        spent.append(time.perf_counter() - begin)
    return min(spent)


def by_box(scene: at.Scene, spacing: float) -> torch.Tensor:
    """Return the transfer matrix of the box solver."""
    return at.make_propagator(scene, "box", spacing, cache=False).transfer_matrix()


def built(obstacles: at.Obstacle | tuple[at.Obstacle, ...]) -> tuple[at.ScatteringOperator, float]:
    """Return the operator of obstacles in air, and the time it took [s]."""
    forget_assemblies()
    begin = time.perf_counter()
    operator = at.ScatteringOperator.of(obstacles, AIR, 40e3, SPACING, cache=False)
    return operator, time.perf_counter() - begin


def row(name: str, shifts: int, turns: int) -> list[str]:
    """Return the cells of one scene."""
    scene, generator = paper_scene(name), np.random.default_rng(0)
    operator, seconds = built(scene.obstacles)
    errors, finer = [], []
    for _ in range(shifts):
        shift = generator.uniform(-LARGEST_SHIFT, LARGEST_SHIFT, 3)
        found = operator.moved(shift).transfer_matrix(scene.array, scene.control_points)
        errors.append(relative_error(found, by_box(scene.moved(shift), SPACING)))
    for _ in range(turns):
        turn = generator.uniform(-math.pi, math.pi, 3)
        found = operator.moved(rotation=turn).transfer_matrix(scene.array, scene.control_points)
        finer.append(relative_error(found, by_box(scene.moved(rotation=turn), FINE)))
    pose = shortest(lambda: operator.moved((1e-3, 0, 0)).transfer_matrix(scene.array, scene.control_points))
    array = at.TransducerArray.grid((16, 16), 5e-3, (1e-3, 50e-3, 50e-3), (1, 0, 0), radius=0)
    sets = torch.tensor([90e-3, 50e-3, 50e-3]) + 10e-3 * torch.rand(
        1000, 4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    plane = at.Plane(center=(90e-3, 50e-3, 50e-3), normal=(1, 0, 0), size=(100e-3, 100e-3)).points(1e-3)
    cells = [
        f"{len(operator.matrix)}",
        f"{seconds:.1f}",
        f"{operator.reciprocity:.1e}, {operator.energy:.1e}",
        f"{100 * float(np.median(errors)):.2g}, {100 * max(errors):.2g}",
        f"{100 * float(np.median(finer)):.2g}, {100 * max(finer):.2g}",
        f"{1e3 * pose:.1f}",
        f"{1000 / shortest(lambda: operator.transfer_matrix(array, sets)):,.0f}",
        f"{shortest(lambda: operator.transfer_matrix(array, plane)):.1f}",
    ]
    print(name, *cells, flush=True)
    return [name, *cells]


def on_path() -> str:
    """Find drives for every pose of a cube on a path, and say how fast and how good they are."""
    scene = paper_scene("two_cubes")
    operator, _ = built(scene.obstacles[0])
    way = np.linspace(-30e-3, 30e-3, PATH)

    def matrices() -> torch.Tensor:
        poses = (operator.moved((0, y, 0), (0, 0, 25 * y)) for y in way)
        return torch.stack([pose.transfer_matrix(scene.array, scene.control_points) for pose in poses])

    def weakest(drive: torch.Tensor) -> torch.Tensor:
        return (matrix @ drive[..., None])[..., 0].abs().amin(dim=1)

    matrix = matrices()
    best = torch.stack([own.score[0] for own in map(ascended, matrix)])
    seconds = shortest(lambda: at.holography(matrices(), starts=STARTS))
    share = weakest(at.holography(matrix, starts=STARTS)) / best
    text = (
        f"A cube on a path of {PATH} poses, 16 transducers: {PATH / seconds:,.0f} poses a second from the\n"
        f"pose to the drive (`holography` with {STARTS} starts). The weakest focus is at least\n"
        f"{percent(float(share.min()))} of the optimum of its pose (32 gradient ascents), in the median\n"
        f"{percent(float(share.median()))}."
    )
    print(text, flush=True)
    return text


def ascended(matrix: torch.Tensor) -> at.Solution:
    """Return the best of many gradient ascents on a matrix (P, M)."""
    method = at.GradientAscent()
    state = method.start(at.Problem(matrix.shape[1], len(matrix), transfer_matrix=matrix))
    return method.best(method.tell(state, (method.ask(state) @ matrix.mT).abs()))


def spheres() -> Iterator[list[str]]:
    """Yield the errors of spheres that are simulated, against their closed form."""
    scene = paper_scene("two_cubes")
    for name, radius in (
        ("rigid", 5e-3),
        ("rigid", 8e-3),
        ("density ratio 77", 5e-3),
        ("density ratio 77", 8e-3),
    ):
        material = {"rigid": True} if name == "rigid" else {"density": 77 * AIR.density, "sound_speed": 340.0}
        sphere = at.Sphere((41e-3, 50e-3, 50e-3), radius, **material)
        exact = built(sphere)[0]
        found, seconds = built((sphere, sphere))  # two in one place are simulated
        pair = (one.transfer_matrix(scene.array, scene.control_points) for one in (found, exact))
        error = relative_error(*pair)
        count = min(len(found.matrix), len(exact.matrix))
        entries = relative_error(found.matrix[:count, :count], exact.matrix[:count, :count])
        cells = [f"{name}, {1e3 * radius:g} mm", f"{seconds:.1f}", percent(error), percent(entries)]
        print(*cells, flush=True)
        yield cells


def kept_fields() -> Iterator[list[str]]:
    """Yield the times of sets of four points behind a hand, for an AUTD3."""
    array, points = at.TransducerArray.autd3((0.0, 0.0, 0.0), UP), torch.tensor(FOCI, dtype=torch.float64)

    def timed(what: str, work: Callable[[], object]) -> list[str]:
        before, begin = len(propagator.runs), time.perf_counter()
        work()
        cells = [what, f"{len(propagator.runs) - before}", f"{time.perf_counter() - begin:.2f}"]
        print(*cells, flush=True)
        return cells

    mesh = hand()
    at.make_propagator(at.Scene(array, AIR, 40e3, FOCI, [mesh], domain=DOMAIN), "box", 2e-3).transfer_matrix()
    forget_assemblies()
    scene = at.Scene(array, AIR, 40e3, FOCI, [mesh], domain=DOMAIN)
    propagator = at.make_propagator(scene, "box", SPACING, cache=False)
    assert isinstance(propagator, SimulatedPropagator)
    yield timed("first four points, with assembling", propagator.transfer_matrix)
    yield timed("second four points", lambda: propagator.transfer_matrix(points + 4e-3))
    plane = at.Plane((0, 0, 0.16), UP, (20e-3, 20e-3)).points(1.2e-3).reshape(-1, 3)  # as many as transducers
    yield timed(f"{len(plane)} points", lambda: propagator.transfer_matrix(plane))
    yield timed("four points after them", lambda: propagator.transfer_matrix(points + 2e-3))
    drive = torch.ones(len(array), dtype=torch.complex128)
    picture = at.Plane((0, 0, 0.16), UP, (0.1, 0.1)).points(1e-3)
    yield timed("field of a drive on 10,000 points", lambda: propagator.field(drive, picture))


def main(given: argparse.Namespace) -> None:
    """Measure, and write the block."""
    head = [
        "body",
        "waves",
        "built [s]",
        "reciprocity, energy",
        "from `box`, median and largest [%]",
        "turned, from `box` at 0.4 mm [%]",
        "pose [ms]",
        "matrices/s",
        "plane [s]",
    ]
    parts = (
        measured(),
        f"Operators at {1e3 * SPACING:g} mm, {given.shifts} random shifts up to {1e3 * LARGEST_SHIFT:g} mm\n"
        f"and {given.turns} random turns: the paper's array and foci. Matrices of four points, and a plane\n"
        "of 10,000, are for 256 transducers.",
        table(head, [row(name, given.shifts, given.turns) for name in SCENES]),
        on_path(),
        f"Spheres simulated at {1e3 * SPACING:g} mm, against their closed form:",
        table(["sphere", "built [s]", "transfer matrix", "entries of T"], spheres()),
        f"A hand in front of an AUTD3 at {1e3 * SPACING:g} mm, by `box`, whose outgoing fields are kept:",
        table(["what", "runs", "time [s]"], kept_fields()),
    )
    fill_in(DOCUMENT, "benchmark.py operator", parts, given.output)
