"""Estimates of `at.estimate` against measured memory and time.

Each scene has a process of its own, which first simulates a small scene to load the kernels. The memory is
the peak during the simulation over the memory before (Linux with glibc).

    python scripts/check.py estimate            a minute or two; the machine should be idle otherwise
"""

from __future__ import annotations

import argparse
import ctypes
import logging
import math
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull
from shared.processes import in_new_process
from shared.scenes import paper_scene

import autdtorch as at
from autdtorch.propagators.moved_boxes import forget_assemblies
from autdtorch.utils.spatial import doubled_normals


class Cost(NamedTuple):
    """Estimated and measured memory [byte], time [s] and number of runs."""

    estimated_memory: int
    memory: int
    estimated_seconds: float
    seconds: float
    estimated_runs: int
    runs: int


def behind(
    *obstacles: at.Obstacle, array: at.TransducerArray | None = None, points: object = None
) -> Callable[[], at.Scene]:
    """Return a scene like the paper's with other obstacles, array or control points."""

    def made() -> at.Scene:
        own = paper_scene("two_cubes")
        domain = None if array else ((0, 0, 0), (0.1, 0.1, 0.1))
        chosen = own.control_points if points is None else points
        return at.Scene(
            array or own.array, own.medium, 40e3, chosen, obstacles or own.obstacles, domain=domain
        )

    return made


def head() -> at.Mesh:
    """Return an ellipsoid as a mesh of 4800 triangles."""
    number = np.arange(2402)
    height = 1 - (2 * number + 1) / 2402
    turn = number * math.pi * (3 - 5**0.5)
    flat = np.sqrt(1 - height**2)
    vertices = np.column_stack((12 * flat * np.cos(turn), 9 * flat * np.sin(turn), 15 * height))
    faces = ConvexHull(vertices).simplices
    corners = vertices[faces]
    inward = (doubled_normals(corners) * corners[:, 0]).sum(axis=1) < 0
    faces[inward] = faces[inward, ::-1]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "head.obj"
        lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in faces + 1]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return at.Mesh(path, scale=1e-3, offset=(41e-3, 50e-3, 50e-3), rigid=True)


def grid_of_points() -> list[tuple[float, float, float]]:
    """Return twelve points behind the obstacles, none the image of another."""
    return [(75e-3 + 1.3e-3 * n, 20e-3 + 5.1e-3 * n, 80e-3 - 4.3e-3 * n) for n in range(12)]


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

Case = tuple[Callable[[], at.Scene], str, float, str]
"""A scene, the method, the spacing [m] and the precision of the fields."""


def case(make: Callable[[], at.Scene] | str, method: str, spacing: float, dtype: str = "float32") -> Case:
    """Return a case of a scene, or of one of the paper's by name; `spacing` in [mm]."""
    return partial(paper_scene, make) if isinstance(make, str) else make, method, 1e-3 * spacing, dtype


CASES: dict[str, Case] = {
    "empty domain": case("homogeneous", "full", 1.0),
    "empty domain, fine": case("homogeneous", "full", 0.7),
    "two cubes": case("two_cubes", "box", 1.0),
    "two cubes, fine": case("two_cubes", "box", 0.5),
    "two cubes, domain": case("two_cubes", "full", 1.0),
    "two cubes, float64": case("two_cubes", "full", 1.0, "float64"),
    "three cubes": case("three_cubes", "box", 0.7),
    "three cubes, domain": case("three_cubes", "full", 1.2),
    "sphere of the paper": case("sphere", "box", 0.8),
    "rigid sphere": case(behind(BALL), "box", 0.8),
    "helium": case(behind(HELIUM), "box", 1.0),
    "tilted cube": case(behind(TILTED), "box", 0.8),
    "plate": case(behind(PLATE), "box", 1.0),
    "wall": case(behind(WALL), "full", 1.5),
    "spheres apart": case(behind(*APART), "box", 0.7),
    "rod": case(behind(ROD), "full", 1.2),
    "AUTD3 with discs": case(behind(array=AUTD3), "box", 1.0),
    "twelve points": case(behind(points=grid_of_points()), "box", 0.8),
    "mesh": case(lambda: behind(head())(), "box", 1.0),
    "voxels": case(behind(VOXELS), "box", 1.0),
}


def held(entry: str) -> int:
    """Return an entry of the memory status of this process [byte], on Linux."""
    lines = Path("/proc/self/status").read_text("utf-8").splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(entry))


def measure(name: str) -> Cost:
    """Return estimate and measurement of a case, in a process of its own."""
    logging.disable()
    scene, method, spacing, dtype = CASES[name]
    built = scene()
    for kind in ("box", "full"):
        at.make_propagator(paper_scene("two_cubes"), kind, 2.5e-3, dtype=dtype, cache=False).transfer_matrix()
    estimate = at.estimate(built, spacing, method=method, dtype=dtype)
    ctypes.CDLL("libc.so.6").malloc_trim(0)  # memory that is free already does not count
    Path("/proc/self/clear_refs").write_text("5", "ascii")  # resets the peak
    forget_assemblies()
    before, begin = held("VmRSS"), time.perf_counter()
    propagator = at.make_propagator(built, method, spacing, dtype=dtype, cache=False)
    propagator.transfer_matrix()
    seconds, memory = time.perf_counter() - begin, held("VmHWM") - before
    return Cost(estimate.memory, memory, estimate.seconds, seconds, estimate.runs, propagator.planned_runs)


OPTIONS = {"--scenes": {"nargs": "+", "choices": CASES, "default": list(CASES), "help": "checked scenes"}}


def main(given: argparse.Namespace) -> None:
    """Print estimates, measurements and their ratios."""
    form = "{:22s}{:>10s}{:>10s}{:>7s}{:>10s}{:>10s}{:>7s}{:>8s}"
    print(form.format("scene", "memory", "measured", "ratio", "time", "measured", "ratio", "runs"))
    ratios = []
    for name in given.scenes:
        cost = in_new_process(measure, name)
        ratios.append((cost.estimated_memory / cost.memory, cost.estimated_seconds / cost.seconds))
        memory = [f"{one / 1e6:.0f} MB" for one in (cost.estimated_memory, cost.memory)]
        seconds = [f"{one:.2f} s" for one in (cost.estimated_seconds, cost.seconds)]
        both = [f"{ratio:.2f}" for ratio in ratios[-1]]
        runs = f"{cost.estimated_runs}/{cost.runs}"
        print(form.format(name, *memory, both[0], *seconds, both[1], runs), flush=True)
    for what, own in zip(("memory", "time"), zip(*ratios, strict=True), strict=True):
        print(f"{what}: within a factor of {max(max(one, 1 / one) for one in own):.2f}")
