"""T-matrices of the paper's cubes: time to build, accuracy after moves, and transfer matrices a second.

Shifts and turns are random, and compared with the box solver at the same spacing and at a fine one. Then
drives for every pose of a cube on a path, all in one call. Takes about ten minutes on 2 idle cores.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from shared.document import Page, percent, printed, table
from shared.scenes import paper_scene, relative_error, weakest
from shared.timing import shortest, timed

import autdtorch as at
from autdtorch.propagators.store import BODIES

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


def main(page: Page, shifts: int, turns: int) -> None:
    head = ["body", "waves", "built [s]", "reciprocity, energy", "from `box`, median and largest [%]"]
    head += ["turned, from `box` at 0.4 mm [%]", "pose [ms]", "pose, discs [ms]", "matrices/s", "plane [s]"]
    page.write(
        f"T-matrices at {1e3 * SPACING:g} mm, {shifts} random shifts up to {1e3 * LARGEST_SHIFT:g} mm\n"
        f"and {turns} random turns: the paper's array and foci. Transfer matrices of four points, and a\n"
        "plane of 10,000, are for 256 transducers; discs are those of an AUTD3.",
        table(head, printed(row(name, shifts, turns) for name in SCENES)),
        on_path(),
    )


def by_box(scene: at.Scene, spacing: float) -> torch.Tensor:
    return at.make_propagator(scene, "box", spacing, cache=False).transfer_matrix()


def build(obstacles: at.Obstacle | tuple[at.Obstacle, ...]) -> tuple[at.TMatrix, float]:
    """Return the T-matrix of obstacles in air, and the time it took [s]."""
    BODIES.forget()
    return timed(lambda: at.TMatrix.of(obstacles, AIR, 40e3, SPACING, cache=False))


def row(name: str, shifts: int, turns: int) -> list[str]:
    scene, generator = paper_scene(name), np.random.default_rng(0)
    body, seconds = build(scene.obstacles)

    def moved(**pose: object) -> torch.Tensor:
        return body.moved(**pose).transfer_matrix(scene.array, scene.control_points)

    def time_of(work: Callable[[], object]) -> float:
        return shortest(work, REPEATS)[1]

    shifted = [{"offset": generator.uniform(-LARGEST_SHIFT, LARGEST_SHIFT, 3)} for _ in range(shifts)]
    turned = [{"rotation": generator.uniform(-math.pi, math.pi, 3)} for _ in range(turns)]
    errors, finer = (
        [relative_error(moved(**pose), by_box(scene.moved(**pose), spacing)) for pose in poses]
        for poses, spacing in ((shifted, SPACING), (turned, FINE))
    )
    aside, discs = body.moved(offset=(1e-3, 0, 0)), autd3_of_discs()
    array = at.TransducerArray.grid((16, 16), 5e-3, (1e-3, 50e-3, 50e-3), (1, 0, 0), radius=0)
    sets = torch.tensor([90e-3, 50e-3, 50e-3]) + 10e-3 * torch.rand(
        1000, 4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    plane = at.Plane(center=(90e-3, 50e-3, 50e-3), normal=(1, 0, 0), size=(100e-3, 100e-3)).points(1e-3)
    cells = [
        f"{len(body.matrix)}",
        f"{seconds:.1f}",
        f"{body.reciprocity:.1e}, {body.energy:.1e}",
        f"{100 * float(np.median(errors)):.2g}, {100 * max(errors):.2g}",
        f"{100 * float(np.median(finer)):.2g}, {100 * max(finer):.2g}",
        f"{1e3 * time_of(lambda: moved(offset=(1e-3, 0, 0))):.1f}",
        f"{1e3 * time_of(lambda: aside.transfer_matrix(discs, scene.control_points)):.1f}",
        f"{1000 / time_of(lambda: body.transfer_matrix(array, sets)):,.0f}",
        f"{time_of(lambda: body.transfer_matrix(array, plane)):.1f}",
    ]
    return [name, *cells]


def autd3_of_discs() -> at.TransducerArray:
    """Return an AUTD3 100 mm behind the paper's array."""
    return at.TransducerArray.autd3((-99e-3, 50e-3, 50e-3), (1, 0, 0))


def on_path() -> str:
    """Find drives for every pose of a cube on a path; return their rate and quality in words."""
    scene = paper_scene("two_cubes")
    body, _ = build(scene.obstacles[0])
    along, aside = torch.linspace(-30e-3, 30e-3, PATH, dtype=torch.float64), torch.zeros(PATH)
    poses = body.moved(torch.stack([aside, along, aside], 1), torch.stack([aside, aside, 25 * along], 1))

    def drives(array: at.TransducerArray) -> torch.Tensor:
        return at.holography(poses.transfer_matrix(array, scene.control_points), starts=STARTS)

    matrix = poses.transfer_matrix(scene.array, scene.control_points)
    best = torch.tensor([float(at.gradient_ascent(each).score[0]) for each in matrix])
    chosen, seconds = shortest(lambda: drives(scene.array), REPEATS)
    _, of_discs = shortest(lambda: drives(autd3_of_discs()), 1)
    share = weakest(matrix, chosen) / best
    return (
        f"A cube on a path of {PATH} poses, 16 transducers: {PATH / seconds:,.0f} poses a second from the\n"
        f"pose to the drive (`holography` with {STARTS} starts), {PATH / of_discs:,.0f} with the 249 discs\n"
        f"of an AUTD3. The weakest focus is at least\n"
        f"{percent(float(share.min()))} of the optimum of its pose (32 gradient ascents), in the median\n"
        f"{percent(float(share.median()))}."
    )
