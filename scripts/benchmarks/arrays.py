"""Real arrays: discs in free space, their accuracy, and large bodies by tolerance.

A plane has 101 x 101 points, 150 mm in front of 256 transducers. Errors of discs are against Rayleigh's
integral, at random points at least a wavelength from the rim, relative to the field at each point. Bodies
are rigid and tilted, in front of a SonicSurface of discs, and simulated to 2 % by `tolerance` in a process
each. Four foci are in the shadow 0.1 m behind a plate, and beside a cube, which hides half of the array.
True errors are against a finer grid where faces fall as well, extrapolated by the law of errors. Takes about
10 minutes on 2 idle cores, most of it for these.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import torch
from shared.document import Page, percent, printed, table
from shared.scenes import relative_error
from shared.timing import in_new_process, peak_memory, shortest, timed

import autdtorch as at
from autdtorch.propagators.plan import plan
from autdtorch.propagators.simulated import SimulatedPropagator
from autdtorch.scene.boards import TRANSDUCER_RADIUS

DOCUMENT = "performance.md"

AIR, FREQUENCY = at.Medium(1.2, 343.0), 40e3
UP = (0.0, 0.0, 1.0)
TILT = (0.2, 0.3, 0.1)
THICKNESS = 3e-3
SIDES = {"plate": (0.1, 0.2, 0.3, 0.4), "cube": (0.05, 0.1, 0.3)}  # [m]
ASIDE, ABOVE = 10e-3, 40e-3  # least distances of a cube from the array's axis and its plane [m]
TOLERANCE = 0.02
FINER = 0.75
"""Ratio of a reference's cells to those that are judged, about."""
REFERENCE_TOLERANCE = 1e-3
"""Of a reference's steady state."""
SIZES = (0.5, 1.0, 3.3, 6.0, 10.0, 20.0, 40.0)
"""Products k a of the discs that are compared with Rayleigh's integral; 3.3 is a transducer's."""
PLACES = 2000
REPEATS = 3


def main(page: Page) -> None:
    page.write(
        "Field of a drive on a plane of 101 x 101 points, 256 transducers:",
        table(["transducers", "array and scene", "plane"], printed(planes())),
        f"Discs are within {max(map(disc_error, SIZES)):.1e} of Rayleigh's integral from a wavelength off "
        "their rim on, for k a from 0.5 to 40.",
        "Rigid bodies to 2 % by `tolerance`, 256 discs, four foci:",
        table(
            ["body", "spacing", "time", "largest resident set", "claimed", "true error"],
            printed(large_bodies()),
        ),
    )


def planes() -> Iterator[list[str]]:
    for name, radius in (("points", None), ("discs", TRANSDUCER_RADIUS)):
        scene, preparing = shortest(lambda radius=radius: scene_of((), radius), REPEATS)
        points = at.Plane((0.0, 0.0, 0.15), (1.0, 0.0, 0.0), (0.1, 0.1)).points(1e-3)
        drive, propagator = torch.ones(len(scene.array), dtype=torch.complex128), at.make_propagator(scene)
        propagator.field(drive, points[:2, :2])  # loads the kernels
        _, seconds = shortest(lambda: propagator.field(drive, points), REPEATS)  # noqa: B023
        yield [name, f"{1e3 * preparing:.1f} ms", f"{seconds:.3f} s"]


def disc_error(size: float) -> float:
    """Return the largest relative error of a disc of a size k a."""
    scene = scene_of((), None)
    wavelength = 2 * math.pi / scene.wavenumber
    radius = size / scene.wavenumber
    rng = np.random.default_rng(0)
    places = rng.uniform(-1, 1, (PLACES, 3)) * (radius + 3 * wavelength) + (0.0, 0.0, 2 * radius)
    offset = np.hypot(np.hypot(places[:, 0], places[:, 1]) - radius, places[:, 2])
    points = places[offset >= wavelength]
    array = at.TransducerArray([(0.0, 0.0, 0.0)], UP, 1.0, radius)
    field = at.make_propagator(at.Scene(array, AIR, FREQUENCY, points)).transfer_matrix()
    exact = 4 * math.pi * at.analytic.piston_field(points, array.positions, scene.wavenumber, radius, UP)
    return float(((field - exact).abs() / exact.abs()).max())


def large_bodies() -> Iterator[list[str]]:
    for kind, sides in SIDES.items():
        for side in sides:
            matrix, spacing, seconds, memory, claimed = in_new_process(by_tolerance, (kind, side))
            finer, left = in_new_process(on_a_finer_grid, (kind, side, spacing))
            reference = finer + (finer - matrix) * left / (1 - left)
            yield [
                f"{kind} of {side:g} m",
                f"{1e3 * spacing:.2f} mm",
                f"{seconds:.1f} s",
                f"{memory / 1e9:.2f} GB",
                percent(claimed),
                percent(relative_error(matrix, reference)),
            ]


def by_tolerance(case: tuple[str, float]) -> tuple[torch.Tensor, float, float, int, float]:
    """Return matrix, spacing [m], time [s], memory [byte] and claimed error of a body."""
    at.make_propagator(scene_of(body("plate", 0.02)), "box").transfer_matrix()  # loads the kernels
    scene = scene_of(body(*case))

    def work() -> tuple[torch.Tensor, float, float]:
        propagator = at.make_propagator(scene, spacing=None, tolerance=TOLERANCE, cache=False)
        matrix, error = propagator.transfer_matrix(return_error=True)
        return matrix, propagator.spacing, error

    (matrix, spacing, error), seconds = timed(work)
    return matrix, spacing, seconds, peak_memory(), error


def on_a_finer_grid(case: tuple[str, float, float]) -> tuple[torch.Tensor, float]:
    """Return the matrix of a body on a grid finer than a spacing [m], and the ratio of both errors."""
    kind, side, spacing = case
    coarse = plan(scene_of(body(kind, side)), "box", None, TOLERANCE).on_grids
    finer = replace(coarse, tolerance=REFERENCE_TOLERANCE, grids=coarse.grouping).fitted(FINER * spacing)
    ratio = coarse.law.growth(finer.spacing) / coarse.law.growth(spacing)
    return SimulatedPropagator(finer).transfer_matrix(), ratio


def body(kind: str, side: float) -> Sequence[at.Box]:
    """Return a tilted rigid plate, or a cube beside the array's axis, with a side [m]."""
    if kind == "plate":
        return [at.Box((0.0, 0.0, 0.15), (side, side, THICKNESS), rigid=True, rotation=TILT)]
    reach = 0.7 * side  # of the tilted cube along each axis, at most
    return [at.Box((reach + ASIDE, 0.0, reach + ABOVE), (side, side, side), rigid=True, rotation=TILT)]


def scene_of(bodies: Sequence[at.Box], radius: float | None = TRANSDUCER_RADIUS) -> at.Scene:
    """Return the scene of bodies, with transducers of a radius [m]."""
    array = at.TransducerArray.sonicsurface((0.0, 0.0, 0.0), UP, radius=radius)
    foci = at.circle_points((-20e-3, 0.0, 0.25), 20e-3, 4, UP, angle=0.3)
    return at.Scene(array, AIR, FREQUENCY, foci, bodies)
