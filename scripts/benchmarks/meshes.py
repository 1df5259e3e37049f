"""Run times of scenes that users bring: a hand as a mesh, transducers as discs, moved obstacles, steel.

The hand has a palm, four fingers and a thumb of ellipsoids, 40,000 triangles in all. Each matrix has four
foci. Each time is the shortest of three, with the kernels compiled. Nearby poses are drawn: moves of 0.1 to
3 mm, turns of 0.1 to 5 degrees. Takes four minutes on 2 idle cores.
"""

import dataclasses
import functools
from collections.abc import Iterator, Sequence

import numpy as np
import pyvista
from shared.document import printed
from shared.scenes import relative_error, uncached
from shared.timing import shortest, timed

import autdtorch as at

AIR = at.Medium(1.2, 343.0)
UP, PLACE = (0.0, 0.0, 1.0), (0.0, 0.0, 0.09)
FOCI = [(-20e-3, 10e-3, 0.13), (30e-3, 0.0, 0.14), (60e-3, 20e-3, 0.15), (0.0, -70e-3, 0.13)]
DOMAIN = ((-0.15, -0.15, -0.01), (0.15, 0.15, 0.2))
FINGERS = ((-32, 45, 7.5), (-11, 58, 8), (10, 55, 8), (31, 42, 7))
"""Middle across the hand, half the length and radius [mm]."""
REPEATS = 3
Pose = tuple[tuple[float, float, float], tuple[float, float, float]]
POSE: Pose = (0.6e-3, -0.5e-3, 0.6e-3), (1.2, -1.0, 1.2)


def main() -> None:
    """Measure and print."""
    printed(rows())


def hand() -> at.Mesh:
    """Return a rigid hand, its parts merged."""
    palm = pyvista.Icosphere(radius=1.0, nsub=5).scale((50.0, 42.0, 14.0)).translate((-35.0, 0.0, 0.0))
    finger = pyvista.Icosphere(radius=1.0, nsub=4)
    parts = [finger.scale((length, r, r)).translate((30.0, y, 0.0)) for y, length, r in FINGERS]
    thumb = finger.scale((40.0, 9.0, 9.0)).rotate_z(-53.0).translate((-30.0, -45.0, 0.0))
    return at.Mesh.from_surface(
        pyvista.merge([palm, *parts, thumb], merge_points=False), 1e-3, PLACE, rigid=True
    )


def seconds(obstacle: at.Obstacle, array: at.TransducerArray, spacing: float, moved: bool = False) -> float:
    """Return the time of a transfer matrix, from the scene on; a moved obstacle was simulated before."""

    def work() -> None:
        scene = at.Scene(array, AIR, 40e3, FOCI, [obstacle], domain=DOMAIN)
        if moved:
            at.make_propagator(scene, "box", 1e-3 * spacing, cache=False).transfer_matrix()
        else:
            uncached(scene, "box", spacing, 2e-3).transfer_matrix()

    return shortest(work, REPEATS)[1]


def of_poses(obstacle: at.Obstacle, array: at.TransducerArray, poses: Sequence[Pose]) -> str:
    """Return the shortest time of nearby poses, after that at the start, and their errors."""
    scene = at.Scene(array, AIR, 40e3, FOCI, [obstacle], domain=DOMAIN)
    nearby = at.NearbyPoses(uncached(scene, "box", 1.0, 2e-3))
    nearby.transfer_matrix()
    times, errors, claims = [], [], []
    for offset, degrees in poses:
        work = functools.partial(nearby.transfer_matrix, offset, rotation_degrees=degrees, return_error=True)
        (matrix, told), spent = timed(work)
        moved = scene.moved(offset, rotation_degrees=degrees)
        errors.append(relative_error(matrix, uncached(moved, "box", 1.0, 2e-3).transfer_matrix()))
        times.append(spent)
        claims.append(told)
    listed = (" ".join(f"{100 * each:.2f}" for each in part) for part in (errors, claims))
    return "{:.2f} s, {} % from new simulations, {} % told".format(min(times), *listed)


def drawn(count: int) -> list[Pose]:
    """Draw moves [m] and turns [degrees]."""
    random = np.random.default_rng(1)

    def vector(least: float, most: float) -> tuple[float, float, float]:
        direction = random.normal(size=3)
        x, y, z = direction / np.linalg.norm(direction) * np.exp(random.uniform(*np.log([least, most])))
        return x, y, z

    return [(vector(0.1e-3, 3e-3), vector(0.1, 5.0)) for _ in range(count)]


def rows() -> Iterator[list[str]]:
    """Measure all cases."""
    discs = at.TransducerArray.autd3((0.0, 0.0, 0.0), UP)
    points = at.TransducerArray.autd3((0.0, 0.0, 0.0), UP, radius=None)
    few = at.TransducerArray.grid((4, 4), 10e-3, (0.0, 0.0, 0.0), UP)
    mesh, rigid = hand(), at.Sphere(PLACE, 8e-3, rigid=True)
    seconds(rigid, discs, 2.0)  # loads the kernels
    moved = dataclasses.replace(mesh, offset=tuple(np.add(PLACE, (5e-3, 0.0, 0.0)).tolist()))
    steel = at.Sphere(PLACE, 8e-3, density=7800.0, sound_speed=5900.0)
    yield ["hand, discs, `NearbyPoses`: 1 mm and 2 degrees", of_poses(mesh, discs, [POSE])]
    phone = at.Box(PLACE, (0.15, 0.075, 0.008), rigid=True, rotation=(0.1, 0.2, 0.3))
    for name, body in (("hand", mesh), ("phone", phone), ("cube", at.Box(PLACE, (0.03,) * 3, rigid=True))):
        yield [f"{name}, discs, `NearbyPoses`: drawn moves", of_poses(body, discs, drawn(4))]
    for name, *case in (
        ("hand, AUTD3 of discs, 1 mm", mesh, discs, 1.0),
        ("the same, moved by 5 mm", moved, discs, 1.0, True),
        ("hand, AUTD3 of points, 1 mm", mesh, points, 1.0),
        ("steel sphere, 16 points, 0.5 mm", steel, few, 0.5),
        ("rigid sphere, 16 points, 0.5 mm", rigid, few, 0.5),
    ):
        yield [name, f"{seconds(*case):.2f} s"]
