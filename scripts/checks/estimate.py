"""Estimates of `at.estimate` against measured memory and time.

Each scene has a new process, which first simulates a small scene to load the kernels. The memory is the peak
during the simulation over the memory before (Linux with glibc). Takes a minute or two; the machine should be
idle otherwise.
"""

import ctypes
import logging
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyvista
from shared.document import printed, table
from shared.scenes import paper_scene, uncached
from shared.timing import in_new_process, timed

import autdtorch as at


def behind(
    *obstacles: at.Obstacle, array: at.TransducerArray | None = None, points: object = None
) -> at.Scene:
    """Return a scene like the paper's with other obstacles, array or control points."""
    paper = paper_scene("two_cubes")
    domain = None if array else ((0, 0, 0), (0.1, 0.1, 0.1))
    points = paper.control_points if points is None else points
    bodies = obstacles or paper.obstacles
    return at.Scene(array or paper.array, paper.medium, 40e3, points, bodies, domain=domain)


def head() -> at.Scene:
    """Return a scene of an ellipsoid as a mesh of 5120 triangles."""
    ball = pyvista.Icosphere(radius=1.0, nsub=4).scale((12.0, 9.0, 15.0))
    return behind(at.Mesh.from_surface(ball, scale=1e-3, offset=MIDDLE, rigid=True))


MIDDLE = (41e-3, 50e-3, 50e-3)
BALL = at.Sphere(MIDDLE, 12e-3, rigid=True)
HELIUM = at.Sphere(MIDDLE, 10e-3, density=0.17, sound_speed=1000.0)
TILTED = at.Box(MIDDLE, (15e-3, 15e-3, 15e-3), rotation=(0.3, 0.2, 0.5), rigid=True)
PLATE = at.Box(MIDDLE, (2e-3, 40e-3, 40e-3), density=100.0, sound_speed=340.0)
WALL = at.Box((60e-3, 50e-3, 90e-3), (1.0, 1.0, 10e-3), rigid=True)
APART = (
    at.Sphere((41e-3, 25e-3, 25e-3), 6e-3, rigid=True),
    at.Sphere((41e-3, 75e-3, 75e-3), 6e-3, density=50.0, sound_speed=500.0),
)
VOXELS = at.VoxelMask(np.ones((6, 8, 8), bool), 2e-3, origin=(35e-3, 42e-3, 42e-3), rigid=True)
ROD = at.Cylinder((50e-3, 50e-3, 50e-3), 6e-3, 60e-3, axis=(0, 1, 1), rigid=True)
AUTD3 = at.TransducerArray.autd3(center=(0, 50e-3, 50e-3), normal=(1, 0, 0))
TWELVE = [(75e-3 + 1.3e-3 * n, 20e-3 + 5.1e-3 * n, 80e-3 - 4.3e-3 * n) for n in range(12)]
"""Points behind the obstacles, none the image of another [m]."""

CASES: dict[str, Any] = {
    "empty domain": ("homogeneous", "full", 1.0),
    "empty domain, fine": ("homogeneous", "full", 0.7),
    "two cubes": ("two_cubes", "box", 1.0),
    "two cubes, fine": ("two_cubes", "box", 0.5),
    "two cubes, domain": ("two_cubes", "full", 1.0),
    "two cubes, float64": ("two_cubes", "full", 1.0, "float64"),
    "three cubes": ("three_cubes", "box", 0.7),
    "three cubes, domain": ("three_cubes", "full", 1.2),
    "sphere of the paper": ("sphere", "box", 0.8),
    "rigid sphere": (partial(behind, BALL), "box", 0.8),
    "helium": (partial(behind, HELIUM), "box", 1.0),
    "tilted cube": (partial(behind, TILTED), "box", 0.8),
    "plate": (partial(behind, PLATE), "box", 1.0),
    "wall": (partial(behind, WALL), "full", 1.5),
    "spheres apart": (partial(behind, *APART), "box", 0.7),
    "rod": (partial(behind, ROD), "full", 1.2),
    "AUTD3 with discs": (partial(behind, array=AUTD3), "box", 1.0),
    "twelve points": (partial(behind, points=TWELVE), "box", 0.8),
    "mesh": (head, "box", 1.0),
    "voxels": (partial(behind, VOXELS), "box", 1.0),
}
"""Maker of a scene or name of the paper's, method, spacing [mm], and precision if not float32."""
OPTIONS = {"--scenes": {"nargs": "+", "choices": CASES, "default": list(CASES), "help": "checked scenes"}}


def main(scenes: list[str]) -> None:
    rows = printed(in_new_process(row, name) for name in scenes)
    header = ["scene", *["memory", "measured", "ratio"], *["time", "measured", "ratio"], "runs"]
    print("", table(header, rows), sep="\n")
    for what, column in (("memory", 3), ("time", 6)):
        ratios = [float(cells[column]) for cells in rows]
        print(f"{what}: within a factor of {max(max(ratio, 1 / ratio) for ratio in ratios):.2f}")


def memory_of(entry: str) -> int:
    """Return an entry of the memory status of this process [byte], on Linux."""
    lines = Path("/proc/self/status").read_text("utf-8").splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(entry))


def row(name: str) -> list[str]:
    """Return estimates, measurements and ratios of a case, in a process that has done nothing else."""
    logging.disable()
    maker, method, spacing, *other = CASES[name]
    scene = paper_scene(maker) if isinstance(maker, str) else maker()
    (dtype,) = other or ["float32"]
    for kind in ("box", "full"):
        uncached(paper_scene("two_cubes"), kind, 2.5, 2e-3, dtype=dtype).transfer_matrix()
    estimate = at.estimate(scene, 1e-3 * spacing, method=method, dtype=dtype)
    ctypes.CDLL("libc.so.6").malloc_trim(0)  # memory that is free already does not count
    Path("/proc/self/clear_refs").write_text("5", "ascii")  # resets the peak
    before = memory_of("VmRSS")
    propagator, making = timed(lambda: uncached(scene, method, spacing, 2e-3, dtype=dtype))
    _, seconds = timed(propagator.transfer_matrix)
    cells = [name]
    for claim, true, unit in (
        (1e-6 * estimate.memory, 1e-6 * (memory_of("VmHWM") - before), "MB"),
        (estimate.seconds, making + seconds, "s"),
    ):
        cells += [f"{claim:.3g} {unit}", f"{true:.3g} {unit}", f"{claim / true:.2f}"]
    return [*cells, f"{estimate.runs}/{propagator.planned_runs}"]
