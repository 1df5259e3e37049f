"""Nearby poses of obstacles that users bring: a hand as a mesh, a phone and a cube before an AUTD3 of discs.

The hand has a palm, four fingers and a thumb of ellipsoids, 40,000 triangles in all. Each matrix has four
foci. Moves of 0.1 to 3 mm and turns of 0.1 to 5 degrees are drawn; the shortest time counts. Takes four
minutes on 2 idle cores.
"""

import functools
from collections.abc import Iterator, Sequence

import numpy as np
import pyvista
from shared.document import printed
from shared.scenes import relative_error, uncached
from shared.timing import timed

import autdtorch as at

AIR = at.Medium(1.2, 343.0)
UP, PLACE = (0.0, 0.0, 1.0), (0.0, 0.0, 0.09)
FOCI = [(-20e-3, 10e-3, 0.13), (30e-3, 0.0, 0.14), (60e-3, 20e-3, 0.15), (0.0, -70e-3, 0.13)]
DOMAIN = ((-0.15, -0.15, -0.01), (0.15, 0.15, 0.2))
FINGERS = ((-32, 45, 7.5), (-11, 58, 8), (10, 55, 8), (31, 42, 7))
"""Middle across the hand, half the length and radius [mm]."""
Pose = tuple[tuple[float, float, float], tuple[float, float, float]]


def main() -> None:
    printed(rows())


def hand() -> at.Mesh:
    palm = pyvista.Icosphere(radius=1.0, nsub=5).scale((50.0, 42.0, 14.0)).translate((-35.0, 0.0, 0.0))
    finger = pyvista.Icosphere(radius=1.0, nsub=4)
    parts = [finger.scale((length, r, r)).translate((30.0, y, 0.0)) for y, length, r in FINGERS]
    thumb = finger.scale((40.0, 9.0, 9.0)).rotate_z(-53.0).translate((-30.0, -45.0, 0.0))
    return at.Mesh.from_surface(
        pyvista.merge([palm, *parts, thumb], merge_points=False), 1e-3, PLACE, rigid=True
    )


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
    array = at.TransducerArray.autd3((0.0, 0.0, 0.0), UP)
    phone = at.Box(PLACE, (0.15, 0.075, 0.008), rigid=True, rotation=(0.1, 0.2, 0.3))
    cube = at.Box(PLACE, (0.03, 0.03, 0.03), rigid=True)
    for name, body in (("hand", hand()), ("phone", phone), ("cube", cube)):
        yield [name, of_poses(body, array, drawn(4))]
