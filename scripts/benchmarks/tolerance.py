"""Error and time of matrices that were asked for by tolerance.

Fills in a block of benchmarks.md. Each scene is simulated for each tolerance with `spacing=None`, and on ten
grids. Required: true errors within the tolerance in 95 % of the cases, estimates within a factor of three of
the true errors in 90 %, and a time of at most three times that of the coarsest grid that would have done.

    python scripts/benchmark.py tolerance           about 40 minutes on 2 idle cores
    python scripts/benchmark.py tolerance --every 4
"""

from __future__ import annotations

import argparse
import math
import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pyvista
import torch
from shared.document import fill_in, measured, percent, table
from shared.scenes import relative_error, uncached

import autdtorch as at
from autdtorch import analytic
from autdtorch.propagators import OperatorPropagator, SimulatedPropagator
from autdtorch.propagators.moved_boxes import forget_assemblies

DOCUMENT = "benchmarks.md"

TOLERANCES = (0.05, 0.02, 0.01, 0.005)
SPACINGS = (2.4, 2.0, 1.65, 1.35, 1.1, 0.9, 0.75, 0.6, 0.5, 0.4)  # [mm]
REFERENCE = 0.3  # [mm], where there is no exact solution
SHOWN = ((0.02, "tolerance 2 %"), (0.005, "tolerance 0.5 %"), (1.1, "spacing 1.1 mm"), (0.5, "0.5 mm"))
"""Tolerances and spacings [mm] of the table by kinds of scenes."""

FACTOR = 3.0
"""Largest ratio of an estimate and the true error, and of a time and that of the coarsest grid that does."""

AIR = at.Medium(1.2, 343.0)
ARRAY = at.TransducerArray.grid((4, 4), 10.5e-3, (0, 0, -40e-3), (0, 0, 1))
POINTS = np.array([[0, 0, 30], [12, 0, 30], [-10, 8, 25], [4, -14, 35]]) * 1e-3

MATERIALS: Mapping[str, Mapping[str, object]] = {
    "rigid": {"rigid": True},
    "ratio 77": {"density": 77 * AIR.density, "sound_speed": 900.0},
    "ratio 77, sound speed of air": {"density": 77 * AIR.density, "sound_speed": AIR.sound_speed},
    "ratio 8": {"density": 8 * AIR.density, "sound_speed": 1.5 * AIR.sound_speed},
    "ratio 3": {"density": 3 * AIR.density, "sound_speed": 1.5 * AIR.sound_speed},
    "helium": {"density": 0.14 * AIR.density, "sound_speed": 2.7 * AIR.sound_speed},
}


@dataclass(frozen=True)
class Case:
    """A scene, the kind of scenes it belongs to, and its exact matrix (P, M) [Pa] if there is a solution."""

    kind: str
    name: str
    scene: at.Scene
    exact: torch.Tensor | None = None


def scene(*obstacles: at.Obstacle) -> at.Scene:
    """Return obstacles between 16 transducers and four points."""
    return at.Scene(ARRAY, AIR, 40e3, POINTS, obstacles, domain=((-0.1,) * 3, (0.1,) * 3))


def sphere_case(material: str, radius: float) -> Case:
    """Return a sphere off the middle, with the exact series."""
    given, center = MATERIALS[material], (0.7e-3, -0.4e-3, 0.3e-3)
    found = scene(at.Sphere(center, radius, **given))
    where = (found.control_points, ARRAY.positions, found.wavenumber, center, radius)
    if "rigid" in given:
        field = analytic.rigid_sphere(*where)
    else:
        ratios = float(given["density"]) / AIR.density, float(given["sound_speed"]) / AIR.sound_speed
        field = analytic.fluid_sphere(*where, *ratios)
    name = f"sphere of {1e3 * radius:g} mm, {material}"
    return Case("spheres", name, found, 4 * math.pi * ARRAY.source_strength * field)


def slab_case(thickness: float, density: float, speed: float) -> Case:
    """Return a point source before a slab, with points on both sides."""
    face = 20.3e-3
    slab = at.Box(
        (face + thickness / 2, 20e-3, 20e-3), (thickness, 1.0, 1.0),
        density=density * AIR.density, sound_speed=speed * AIR.sound_speed,
    )  # fmt: skip
    array = at.TransducerArray([(8.3e-3, 19.1e-3, 20.7e-3)], (1, 0, 0))
    points = torch.tensor(
        [(x, y, z) for x in (14.1e-3, 34.6e-3) for y in (9.4e-3, 21e-3) for z in (11.7e-3, 32.2e-3)],
        dtype=torch.float64,
    )
    found = at.Scene(array, AIR, 40e3, points, (slab,), domain=((0, 0, 0), (40e-3,) * 3))
    where = (points, array.positions, found.wavenumber, (face, 0, 0), (-1, 0, 0), thickness, density, speed)
    exact = 4 * math.pi * array.source_strength * analytic.fluid_slab(*where)
    return Case("slabs", f"slab of {1e3 * thickness:g} mm, ratio {density:g}", found, exact)


def cases() -> list[Case]:
    """Return the scenes of all kinds."""
    random = np.random.default_rng(19)
    found = [sphere_case(name, radius) for name in MATERIALS for radius in (3.3e-3, 4.6e-3, 6.5e-3, 8e-3)]
    found += [slab_case(*each) for each in ((5e-3, 3.0, 1.5), (3.2e-3, 77.0, 2.6), (4.1e-3, 8.0, 1.5))]
    names = list(MATERIALS)
    for number in range(18):
        name, size = names[number % 6], random.uniform(5e-3, 16e-3, 3).tolist()
        center = random.uniform(-3e-3, 3e-3, 3).tolist()
        found.append(
            Case("cuboids", f"cuboid {number}, {name}", scene(at.Box(center, size, **MATERIALS[name])))
        )
    for number in range(14):
        name, size = names[number % 6], random.uniform(5e-3, 14e-3, 3).tolist()
        turn = random.uniform(-0.8, 0.8, 3).tolist()
        box = at.Box(random.uniform(-3e-3, 3e-3, 3).tolist(), size, turn, **MATERIALS[name])
        found.append(Case("turned cuboids", f"turned cuboid {number}, {name}", scene(box)))
    for number in range(8):
        pair = [names[number % 6], names[(number + 1) % 6]]
        places = ((-8e-3, 1e-3, -2e-3), (7e-3, -1e-3, 3e-3))
        spheres = [
            at.Sphere(place, random.uniform(3e-3, 6e-3), **MATERIALS[name])
            for place, name in zip(places, pair, strict=True)
        ]
        found.append(Case("two spheres", f"two spheres {number}, {' and '.join(pair)}", scene(*spheres)))
    for number in range(6):
        boxes = [
            at.Box(place, (8e-3,) * 3, random.uniform(-0.7, 0.7, 3).tolist(), rigid=True)
            for place in ((-8e-3, 1e-3, -2e-3), (8e-3, -1e-3, 3e-3))
        ]
        found.append(Case("two turned cubes", f"two turned cubes {number}, rigid", scene(*boxes)))
    for number in range(4):
        boxes = [
            at.Box(random.uniform(-12e-3, 12e-3, 3).tolist(), (6e-3,) * 3, **MATERIALS[names[number]])
            for _ in range(3)
        ]
        found.append(Case("three cubes", f"three cubes {number}, {names[number]}", scene(*boxes)))
    return found + [ellipsoid_case(name, number) for number, name in enumerate(names)]


def ellipsoid_case(material: str, number: int) -> Case:
    """Return an ellipsoid as a mesh of 5120 triangles."""
    ball = pyvista.Icosphere(radius=1.0, nsub=4).scale((7.0, 5.0, 4.0))
    turn = 0.2 * number, 0.3, 0.1 * number
    mesh = at.Mesh.from_surface(ball, scale=1e-3, rotation=turn, **MATERIALS[material])
    return Case("ellipsoids (meshes)", f"ellipsoid, {material}", scene(mesh))


@dataclass(frozen=True)
class Result:
    """The error and the time of a matrix of a case.

    Attributes:
        kind: of the case.
        asked: spacing [mm] or tolerance.
        error: true relative error.
        claimed: estimated error; None where none was asked for.
        seconds: run time.
        spacing: [mm].
    """

    kind: str
    asked: float
    error: float
    claimed: float | None
    seconds: float
    spacing: float


def on_grids(case: Case) -> tuple[list[Result], torch.Tensor]:
    """Return the results by spacing that the scene allows, and the reference."""
    matrices: dict[float, tuple[torch.Tensor, float]] = {}
    for spacing in (*SPACINGS, *(() if case.exact is not None else (REFERENCE,))):
        begin = time.perf_counter()
        try:
            matrix = uncached(case.scene, simulating(case.scene), spacing).transfer_matrix()
        except ValueError as error:  # too coarse for a slow medium
            print(f"{case.name}: {error}", flush=True)
            continue
        matrices[spacing] = matrix, time.perf_counter() - begin
    reference = matrices.pop(REFERENCE)[0] if case.exact is None else case.exact
    found = [
        Result(case.kind, h, relative_error(matrix, reference), None, seconds, h)
        for h, (matrix, seconds) in matrices.items()
    ]
    return found, reference


def simulating(scene: at.Scene) -> str:
    """Return the method that simulates a scene; "auto" would take the closed form of a sphere."""
    known = isinstance(at.make_propagator(scene, cache=False), OperatorPropagator)
    return "box" if known else "auto"


def by_tolerance(case: Case, tolerance: float, reference: torch.Tensor) -> Result:
    """Return the result of a tolerance; its time includes the choice of the spacing."""
    forget_assemblies()
    begin = time.perf_counter()
    method = simulating(case.scene)
    propagator = at.make_propagator(case.scene, method, spacing=None, tolerance=tolerance, cache=False)
    assert isinstance(propagator, SimulatedPropagator)
    matrix, claimed = propagator.transfer_matrix(return_error=True)
    seconds, error = time.perf_counter() - begin, relative_error(matrix, reference)
    return Result(case.kind, tolerance, error, claimed, seconds, 1e3 * propagator.spacing)


def summary(found: list[Result], ratios: list[float]) -> list[str]:
    """Return a row of shares over the results of a tolerance."""
    met = np.mean([one.error <= one.asked for one in found])
    claims = np.array([one.claimed / one.error for one in found])
    near = np.mean((claims <= FACTOR) & (claims >= 1 / FACTOR))
    quick = np.mean(np.array(ratios) <= FACTOR)
    spacing, error = (np.median([getattr(one, name) for one in found]) for name in ("spacing", "error"))
    return [
        percent(found[0].asked), str(len(found)), f"{met:.0%}", f"{near:.0%}", f"{np.median(claims):.2g}",
        f"{quick:.0%}", f"{np.median(ratios):.2g}", f"{spacing:.2g} mm", percent(float(error)),
    ]  # fmt: skip


def by_kind(found: list[Result], columns: tuple[tuple[float, str], ...]) -> str:
    """Return a table with the median error (and the largest), and the median time, of each kind of scene."""
    lines = []
    for kind in dict.fromkeys(one.kind for one in found):
        cells = []
        for asked, _ in columns:
            own = [one for one in found if (one.kind, one.asked) == (kind, asked)]
            errors = [100 * one.error for one in own]
            seconds = float(np.median([one.seconds for one in own]))
            cells.append(f"{np.median(errors):.3g} ({max(errors):.3g}) %, {seconds:.2g} s")
        lines.append([kind, *cells])
    return table(["scenes", *(shown for _, shown in columns)], lines)


OPTIONS = {"--every": {"type": int, "default": 1, "help": "measure each n-th scene"}}


def main(given: argparse.Namespace) -> None:
    """Measure the cases and write the tables."""
    warnings.simplefilter("ignore", at.SteadyStateWarning)
    grids: list[Result] = []
    asked: dict[float, list[Result]] = {tolerance: [] for tolerance in TOLERANCES}
    ratios: dict[float, list[float]] = {tolerance: [] for tolerance in TOLERANCES}
    uncached(cases()[0].scene, simulating(cases()[0].scene), 2.0).transfer_matrix()  # compiles the kernel
    for case in cases()[:: given.every]:
        own, reference = on_grids(case)
        grids += own
        for tolerance in TOLERANCES:
            found = by_tolerance(case, tolerance, reference)
            asked[tolerance].append(found)
            enough = [one for one in own if one.error <= tolerance]
            if enough:
                ratios[tolerance].append(found.seconds / max(enough, key=lambda one: one.spacing).seconds)
            print(f"{case.name}, {tolerance:g}: {found}", flush=True)
    header = ["tolerance", "scenes", "met", "estimate within 3", "estimate / error", "time within 3"]
    header += ["time ratio", "spacing", "error"]
    rows = [summary(asked[tolerance], ratios[tolerance]) for tolerance in TOLERANCES]
    caption = (
        "Shares of the scenes whose true error is within the tolerance, whose estimate is within a factor of"
        " three of it, and whose time is within that of the coarsest sufficient one of ten grids; medians."
    )
    every = [one for found in asked.values() for one in found] + grids
    parts = [
        measured(), caption, table(header, rows), "Median error (the largest), and median time:",
        by_kind(every, SHOWN),
    ]  # fmt: skip
    fill_in(DOCUMENT, "benchmark.py tolerance", parts, given.output)
