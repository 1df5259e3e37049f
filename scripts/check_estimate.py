"""Compare what `at.estimate` tells with what transfer matrices take: memory and time over twenty scenes.

    python scripts/check_estimate.py            a minute or two; the machine should have nothing else to do

Each scene has a process of its own, which first simulates a small one so that the kernels are loaded. Memory
is the most that the process held during the simulation, over what it held before (Linux with glibc).
"""

from __future__ import annotations

import argparse
import ctypes
import json
import logging
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import autdtorch as at

ROOT = Path(__file__).parents[1]
SCENES = ROOT / "configs" / "scene"

Case = tuple[Callable[[], at.Scene], str, float, str]
"""A scene, the method, the spacing [m] and the precision of the fields."""


def paper(name: str) -> Callable[[], at.Scene]:
    """Return one of the paper's scenes."""
    return lambda: at.load_scene(SCENES / f"{name}.yaml")


def behind(
    *obstacles: at.Obstacle, array: at.TransducerArray | None = None, points: object = None
) -> Callable[[], at.Scene]:
    """Return a scene like the paper's with other obstacles, array or control points."""

    def made() -> at.Scene:
        own = paper("two_cubes")()
        domain = None if array else ((0, 0, 0), (0.1, 0.1, 0.1))
        chosen = own.control_points if points is None else points
        return at.Scene(
            array or own.array, own.medium, 40e3, chosen, obstacles or own.obstacles, domain=domain
        )

    return made


def head() -> at.Mesh:
    """Return an ellipsoid as a mesh of 4800 triangles."""
    turns, heights = np.arange(60) * 2 * np.pi / 60, np.linspace(0, np.pi, 42)[1:-1]
    rings = [
        (12 * np.sin(h) * np.cos(t), 9 * np.sin(h) * np.sin(t), 15 * np.cos(h))
        for h in heights
        for t in turns
    ]
    vertices = [*rings, (0, 0, 15), (0, 0, -15)]
    top, bottom, last = len(rings) + 1, len(rings) + 2, len(rings) - 60
    faces = []
    for k in range(60):
        after = (k + 1) % 60
        faces += [(top, k + 1, after + 1), (bottom, last + after + 1, last + k + 1)]
        for below in range(0, last, 60):
            a, b, c, d = below + k + 1, below + after + 1, below + 60 + k + 1, below + 60 + after + 1
            faces += [(a, c, b), (b, c, d)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "head.obj"
        lines = [f"v {x} {y} {z}" for x, y, z in vertices] + [f"f {a} {b} {c}" for a, b, c in faces]
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
ROD = at.Cylinder((50e-3, 50e-3, 50e-3), 6e-3, 60e-3, axis=(0, 1, 1), rigid=True)
AUTD3 = at.TransducerArray.autd3(center=(0, 50e-3, 50e-3), normal=(1, 0, 0))

CASES: dict[str, Callable[[], Case]] = {
    "empty domain": lambda: (paper("homogeneous"), "full", 1e-3, "float32"),
    "empty domain, fine": lambda: (paper("homogeneous"), "full", 0.7e-3, "float32"),
    "two cubes": lambda: (paper("two_cubes"), "box", 1e-3, "float32"),
    "two cubes, fine": lambda: (paper("two_cubes"), "box", 0.5e-3, "float32"),
    "two cubes, domain": lambda: (paper("two_cubes"), "full", 1e-3, "float32"),
    "two cubes, float64": lambda: (paper("two_cubes"), "full", 1e-3, "float64"),
    "three cubes": lambda: (paper("three_cubes"), "box", 0.7e-3, "float32"),
    "three cubes, domain": lambda: (paper("three_cubes"), "full", 1.2e-3, "float32"),
    "sphere of the paper": lambda: (paper("sphere"), "box", 0.8e-3, "float32"),
    "rigid sphere": lambda: (behind(BALL), "box", 0.8e-3, "float32"),
    "helium": lambda: (behind(HELIUM), "box", 1e-3, "float32"),
    "tilted cube": lambda: (behind(TILTED), "box", 0.8e-3, "float32"),
    "plate": lambda: (behind(PLATE), "box", 1e-3, "float32"),
    "wall": lambda: (behind(WALL), "full", 1.5e-3, "float32"),
    "spheres apart": lambda: (behind(*APART), "box", 0.7e-3, "float32"),
    "rod": lambda: (behind(ROD), "full", 1.2e-3, "float32"),
    "AUTD3 with discs": lambda: (behind(array=AUTD3), "box", 1e-3, "float32"),
    "twelve points": lambda: (behind(points=grid_of_points()), "box", 0.8e-3, "float32"),
    "mesh": lambda: (behind(head()), "box", 1e-3, "float32"),
    "voxels": lambda: (
        behind(at.VoxelMask(np.ones((6, 8, 8), bool), 2e-3, origin=(35e-3, 42e-3, 42e-3), rigid=True)),
        "box", 1e-3, "float32",
    ),
}  # fmt: skip


def held(entry: str) -> int:
    """Return what the process holds of an entry of Linux's status [bytes]."""
    lines = Path("/proc/self/status").read_text("utf-8").splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(entry))


def measured(name: str) -> None:
    """Print what one scene takes and what was told, in a process of its own."""
    logging.disable()
    scene, method, spacing, dtype = CASES[name]()
    scene = scene()
    small = at.load_scene(SCENES / "two_cubes.yaml")
    for kind in ("box", "full"):
        at.make_propagator(small, kind, 2.5e-3, dtype=dtype, cache=False).transfer_matrix()
    told = at.estimate(scene, spacing, method=method, dtype=dtype)
    ctypes.CDLL("libc.so.6").malloc_trim(0)  # what is free already is not what the simulation takes
    Path("/proc/self/clear_refs").write_text("5", "ascii")  # sets the peak back
    before, begin = held("VmRSS"), time.perf_counter()
    propagator = at.make_propagator(scene, method, spacing, dtype=dtype, cache=False)
    propagator.transfer_matrix()
    seconds, memory = time.perf_counter() - begin, held("VmHWM") - before
    print(json.dumps([told.memory, memory, told.seconds, seconds, told.runs, propagator.planned_runs]))


def main() -> None:
    """Measure all scenes."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scene", choices=CASES, help="this one alone, in this process")
    if (name := parser.parse_args().scene) is not None:
        measured(name)
        return
    print(
        f"{'scene':24s}{'memory':>14s}{'measured':>10s}{'ratio':>7s}{'time':>10s}{'measured':>10s}{'ratio':>7s}{'runs':>8s}"
    )
    ratios = []
    for name in CASES:
        command = [sys.executable, __file__, "--scene", name]
        said = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT).stdout
        told_memory, memory, told_seconds, seconds, told_runs, runs = json.loads(said)
        ratios.append((told_memory / memory, told_seconds / seconds))
        print(
            f"{name:24s}{told_memory / 1e6:11.0f} MB{memory / 1e6:7.0f} MB{ratios[-1][0]:7.2f}"
            f"{told_seconds:8.2f} s{seconds:8.2f} s{ratios[-1][1]:7.2f}{told_runs:5d}/{runs}", flush=True,
        )  # fmt: skip
    for what, own in zip(("memory", "time"), zip(*ratios, strict=True), strict=True):
        print(f"{what}: within a factor of {max(max(one, 1 / one) for one in own):.2f}")


if __name__ == "__main__":
    main()
