"""Run time against error: exact solutions, and the paper's cubes against fine grids of our own.

    python scripts/benchmark_accuracy.py                     2 to 1 mm
    python scripts/benchmark_accuracy.py --fine              with 0.5 mm
    python scripts/benchmark_accuracy.py --make-reference    the cubes' fine grids, once

Writes accuracy.json and accuracy.png and fills in benchmarks.md, in docs/ or `--output`. Errors are complex
relative L2 errors of the transfer matrix, of the total field and of the scattered part alone. A run time is
that of one transfer matrix, assembly included. The paper's domain is cut to what array, obstacles and the
first focus need; the other three foci are mirror images of it. The fine spacings are for the default alone.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import shlex
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import torch
from accuracy_report import Row, write_report
from surface_variants import TREATMENTS, treatment

import autdtorch as at
from autdtorch import analytic
from autdtorch.analytic.green import free_space_matrix
from autdtorch.propagators import SimulatedPropagator
from autdtorch.scene.geometry import plane_basis

ROOT = Path(__file__).parents[1]
SCENES = ROOT / "configs" / "scene"
CUBE_MATRICES = ROOT / "docs" / "reference" / "cubes.json"

TOLERANCE = 1e-3
SPACINGS = (2.0, 1.5, 1.0)  # [mm]
FINE_SPACINGS = (0.5,)

REFERENCE_SPACINGS = (0.5e-3, 1e-3 / 3, 0.25e-3, 0.2e-3)
"""All of them have the cubes' faces between cells, so that their errors are of one family."""

AIR = at.Medium(density=1.293, sound_speed=340.0)

SPHERE_RADIUS, SPHERE_DENSITY_RATIO = 8e-3, 77.3
SPHERES: dict[str, float | None] = {"rigid sphere": None, "sphere": 1.0, "fast sphere": 4.0}
"""Sound speed relative to air, None if rigid."""
SHIFTED_SPHERES = ("rigid sphere", "sphere")
FACE = 22.2e-3
"""Where the slab and the rigid wall begin, along x [m]."""

CUBES = ("three_cubes", "two_cubes")

SPHERE_ORDER = 2.0
CUBE_ORDER = 4 / 3
"""Of smooth surfaces, and of edges: by those of a rigid cube the velocity is singular as r^(-1/3), and the
energy of what a grid of spacing h misses of it goes as h^(4/3) (Grisvard 1985)."""


@dataclass(frozen=True)
class Case:
    """A scene and what is known of it.

    Attributes:
        name: of the case.
        scene: the scene.
        points: where the pressure is compared (P, 3) [m].
        exact: transfer matrix (P, M) [Pa].
        scattered: size of its scattered part, None if there is nothing to scatter.
        order: of the error in the spacing, to extrapolate with.
        method: of the propagator.
    """

    name: str
    scene: at.Scene
    points: torch.Tensor
    exact: torch.Tensor
    scattered: float | None
    order: float
    method: str = "box"


@dataclass(frozen=True)
class Simulation:
    """A transfer matrix (P, M) [Pa], the time [s] it took, and whether every run of it settled."""

    matrix: torch.Tensor
    seconds: float
    settled: bool


def relative_error(value: torch.Tensor, exact: torch.Tensor) -> float:
    """Complex relative L2 error."""
    return float((value - exact).norm() / exact.norm())


def extrapolate(spacings: Sequence[float], matrices: Sequence[torch.Tensor], order: float) -> torch.Tensor:
    """G_0 of the least-squares fit G(h) = G_0 + C h^order; of two spacings, Richardson's extrapolation."""
    powers = np.array(spacings) ** order
    weights = np.linalg.pinv(np.column_stack((np.ones(len(powers)), powers)))[0]
    return sum((w * g for w, g in zip(weights.tolist(), matrices, strict=True)), start=torch.zeros(()))


def observed_order(spacings: Sequence[float], errors: Sequence[float]) -> float:
    """Least-squares slope of log error over log spacing."""
    return float(np.polyfit(np.log(spacings), np.log(errors), 1)[0])


def load(name: str, obstacles: Sequence[at.Obstacle] | None = None) -> at.Scene:
    """One of the paper's scenes with its first focus, with other obstacles if given, in a close domain."""
    scene = at.load_scene(SCENES / f"{name}.yaml")
    obstacles, focus = scene.obstacles if obstacles is None else tuple(obstacles), scene.control_points[:1]
    corners = [torch.tensor([o.lower, o.upper], dtype=torch.float64) for o in obstacles]
    held = torch.cat((scene.array.positions, focus, *corners))
    # on whole millimetres, so that every grid lies as in the paper's domain
    lower, upper = 1e-3 * (1e3 * held.amin(0) - 3).floor(), 1e-3 * (1e3 * held.amax(0) + 3).ceil()
    return dataclasses.replace(
        scene, obstacles=obstacles, control_points=focus, domain=torch.stack((lower, upper)),
        observation_plane=None,
    )  # fmt: skip


def free_space_case() -> Case:
    """The paper's scene without obstacles."""
    scene = load("homogeneous")
    exact = free_space_matrix(scene.control_points, scene.array, scene.wavenumber)
    return Case("free space", scene, scene.control_points, exact, None, SPHERE_ORDER, "full")


def sphere_case(name: str, shift: Sequence[float] = (0.0, 0.0, 0.0)) -> Case:
    """The paper's array and foci with a sphere in between, its centre moved by `shift` (3,) [m]."""
    empty = load("homogeneous")
    center = 41e-3 + shift[0], 50e-3 + shift[1], 50e-3 + shift[2]
    speed_ratio, air = SPHERES[name], empty.medium
    where = (empty.control_points, empty.array.positions, empty.wavenumber, center, SPHERE_RADIUS)
    if speed_ratio is None:
        sphere = at.Sphere(center, SPHERE_RADIUS, rigid=True)
        both = [analytic.rigid_sphere(*where, scattered=scattered) for scattered in (False, True)]
    else:
        density, speed = SPHERE_DENSITY_RATIO * air.density, speed_ratio * air.sound_speed
        sphere = at.Sphere(center, SPHERE_RADIUS, density=density, sound_speed=speed)
        ratios = SPHERE_DENSITY_RATIO, speed_ratio
        both = [analytic.fluid_sphere(*where, *ratios, scattered=scattered) for scattered in (False, True)]
    exact, scattered = (4 * math.pi * empty.array.source_strength * part for part in both)
    scene = load("homogeneous", [sphere])
    return Case(name, scene, scene.control_points, exact, float(scattered.norm()), SPHERE_ORDER)


def cube_case(name: str) -> Case:
    """One of the paper's scenes of cubes."""
    scene = load(name)
    stored = json.loads(CUBE_MATRICES.read_text(encoding="utf-8"))["scenes"][name]
    matrices = [
        torch.complex(*(torch.tensor(m[part], dtype=torch.float64) for part in ("real", "imag")))
        for m in stored
    ]
    exact = extrapolate([m["spacing"] for m in stored], matrices, CUBE_ORDER)
    points = scene.control_points[:1]
    scattered = exact - free_space_matrix(points, scene.array, scene.wavenumber)
    return Case(name, scene, points, exact, float(scattered.norm()), CUBE_ORDER)


def make_reference() -> None:
    """Store the transfer matrices of the cubes on fine grids."""
    scenes: dict[str, list[dict[str, object]]] = {}
    for name in CUBES:
        scene, matrices = load(name), []
        for spacing in REFERENCE_SPACINGS:
            propagator = at.make_propagator(scene, "box", spacing, tolerance=TOLERANCE / 2, cache=False)
            matrices.append(propagator.transfer_matrix(scene.control_points[:1]))
            print(f"{name} at {spacing * 1e3:.4g} mm done", flush=True)
        limit = extrapolate(REFERENCE_SPACINGS, matrices, CUBE_ORDER)
        print(f"{name}: {relative_error(matrices[-1], limit):.1e} from the finest grid", flush=True)
        scenes[name] = [
            {"spacing": h, "real": g.real.tolist(), "imag": g.imag.tolist()}
            for h, g in zip(REFERENCE_SPACINGS, matrices, strict=True)
        ]
    CUBE_MATRICES.parent.mkdir(parents=True, exist_ok=True)
    CUBE_MATRICES.write_text(json.dumps({"command": command(), "scenes": scenes}, indent=1) + "\n", "utf-8")


def simulate(case: Case, spacing: float, tolerance: float = TOLERANCE) -> Simulation:
    """The transfer matrix at `spacing` [mm]."""
    begin = time.perf_counter()
    propagator = at.make_propagator(case.scene, case.method, spacing * 1e-3, tolerance=tolerance, cache=False)
    assert isinstance(propagator, SimulatedPropagator)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", at.SteadyStateWarning)  # the report tells
        matrix = propagator.transfer_matrix(case.points)
    seconds = time.perf_counter() - begin
    return Simulation(matrix, seconds, all(run.reached for run in propagator.runs))


def compare(case: Case, name: str, spacing: float, found: Simulation) -> Row:
    """The errors of a transfer matrix."""
    total = relative_error(found.matrix, case.exact)
    part = None if case.scattered is None else total * float(case.exact.norm()) / case.scattered
    print(f"{case.name}, {name}, {spacing:g} mm: {100 * total:.3f} %, {found.seconds:.1f} s", flush=True)
    return Row(case.name, name, spacing, total, part, found.seconds, found.settled)


def sweep(case: Case, spacings: Sequence[float]) -> list[Row]:
    """Every treatment at every spacing [mm], and the default's extrapolated from each two neighbours."""
    rows = []
    for name in TREATMENTS if case.scene.obstacles else ("default",):
        used = [h for h in spacings if name == "default" or h not in FINE_SPACINGS]
        with treatment(name):
            found = [simulate(case, h) for h in used]
        rows += [compare(case, name, h, one) for h, one in zip(used, found, strict=True)]
    if case.scene.obstacles:  # `found` is of the default, the last of them
        for pair, both in zip(pairwise(spacings), pairwise(found), strict=True):
            limit = extrapolate(pair, [one.matrix for one in both], case.order)
            seconds, settled = sum(one.seconds for one in both), all(one.settled for one in both)
            rows.append(compare(case, "extrapolated", pair[1], Simulation(limit, seconds, settled)))
    return rows


def worst_shift(name: str, spacing: float, count: int) -> Row:
    """The worst (by total error) of `count` random places of a sphere between the cells [mm]."""
    # the same for every sphere and, in cells, for every spacing
    shifts = np.random.default_rng(0).uniform(-0.5, 0.5, (count, 3)) * spacing * 1e-3
    rows = []
    for shift in shifts.tolist():
        case = sphere_case(name, shift)
        rows.append(compare(case, f"worst of {count} shifts", spacing, simulate(case, spacing)))
    return max(rows, key=lambda one: one.total)


def slab_case() -> Case:
    """A point source before a slab, points on both sides of it."""
    thickness, density_ratio, speed_ratio = 5e-3, 3.0, 1.5
    slab = at.Box(
        (FACE + thickness / 2, 20e-3, 20e-3),
        (thickness, 1.0, 1.0),
        density=density_ratio * AIR.density,
        sound_speed=speed_ratio * AIR.sound_speed,
    )
    exact = partial(
        analytic.fluid_slab, thickness=thickness, density_ratio=density_ratio, speed_ratio=speed_ratio
    )
    return layered_case("slab", slab, (14.1e-3, 34.6e-3), exact)


def wall_case() -> Case:
    """A point source and points before a rigid wall."""
    wall = at.Box((FACE + 0.5, 20e-3, 20e-3), (1.0, 1.0, 1.0), rigid=True)
    return layered_case("rigid wall", wall, (14.1e-3,), analytic.rigid_plane)


def layered_case(name: str, box: at.Box, planes: Sequence[float], exact: Callable[..., torch.Tensor]) -> Case:
    """A point source before a box from x = `FACE` that leaves the domain, points in `planes` of x [m]."""
    array = at.TransducerArray([(8.3e-3, 19.1e-3, 20.7e-3)], (1, 0, 0))
    points = torch.tensor(list(product(planes, (9.4e-3, 21e-3), (11.7e-3, 32.2e-3))), dtype=torch.float64)
    scene = at.Scene(array, AIR, 40e3, points, (box,), domain=((0, 0, 0), (40e-3,) * 3))
    where = (points, array.positions, scene.wavenumber, (FACE, 0, 0), (-1, 0, 0))
    strength = 4 * math.pi * array.source_strength
    total, scattered = (strength * exact(*where, scattered=part) for part in (False, True))
    return Case(name, scene, points, total, float(scattered.norm()), SPHERE_ORDER, "full")


def piston_case() -> Case:
    """A tilted disc of radius 5 mm between the cells, points from 0 to 60 degrees off its axis."""
    center = torch.tensor([12.3e-3, 13.1e-3, 13.7e-3], dtype=torch.float64)
    tilt = 2.0, 1.0, 0.6
    array = at.TransducerArray(center[None], tilt, radius=5e-3)
    normal, (across, _) = array.normals[0], plane_basis(tilt)
    angles = torch.deg2rad(torch.arange(0, 61, 5, dtype=torch.float64))[:, None]
    points = center + 20e-3 * (angles.cos() * normal + angles.sin() * across)
    domain = torch.stack((points.amin(0).minimum(center - 6e-3), points.amax(0).maximum(center + 6e-3)))
    scene = at.Scene(array, AIR, 40e3, points, domain=domain)
    field = analytic.piston_field(points, array.positions, scene.wavenumber, 5e-3, tilt)
    return Case(
        "piston", scene, points, 4 * math.pi * array.source_strength * field, None, SPHERE_ORDER, "full"
    )


def worst_point(case: Case, spacing: float = 1.0) -> Row:
    """The worst of the points, each relative to its own pressure."""
    found = simulate(case, spacing)
    worst = float(((found.matrix - case.exact).abs() / case.exact.abs()).max())
    return Row(case.name, "default, worst point", spacing, worst, None, found.seconds, found.settled)


def measure(spacings: Sequence[float], shifts: int) -> list[Row]:
    """All measurements."""
    simulate(sphere_case("sphere"), 2.8)  # compiles the kernel
    cases = [free_space_case(), *map(sphere_case, SPHERES)]
    if CUBE_MATRICES.exists():
        cases += map(cube_case, CUBES)
    else:
        print("the cubes are left out: they need --make-reference once", flush=True)
    rows = [one for case in cases for one in sweep(case, spacings)]
    if shifts:
        rows += [worst_shift(name, h, shifts) for name in SHIFTED_SPHERES for h in spacings]
    for case in (slab_case(), wall_case()):
        rows.append(compare(case, "default", 1.0, simulate(case, 1.0)))
    return [*rows, worst_point(piston_case())]


def orders(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """Observed order of each treatment in each case that has more than one spacing."""
    found: dict[str, dict[str, float]] = {}
    for case, name in dict.fromkeys((one.case, one.treatment) for one in rows):
        mine = [one for one in rows if (one.case, one.treatment) == (case, name)]
        if len(mine) > 1:
            order = observed_order([one.spacing for one in mine], [one.total for one in mine])
            found.setdefault(case, {})[name] = order
    return found


def command() -> str:
    """The command line that this process was started with."""
    return shlex.join(["python", "scripts/benchmark_accuracy.py", *sys.argv[1:]])


def main() -> None:
    """Measure, or make the reference."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--spacings", type=float, nargs="+", default=SPACINGS, metavar="MM")
    parser.add_argument("--fine", action="store_true", help="also 0.5 mm")
    parser.add_argument("--shifts", type=int, default=5, help="places of the sphere between the cells")
    parser.add_argument("--make-reference", action="store_true", help="only that")
    parser.add_argument("--output", type=Path, default=ROOT / "docs")
    given = parser.parse_args()
    if given.make_reference:
        make_reference()
        return
    spacings = sorted({*given.spacings, *(FINE_SPACINGS if given.fine else ())}, reverse=True)
    if len(spacings) < 2:
        parser.error(f"argument --spacings: {given.spacings}; must be at least two different ones")
    rows = measure(spacings, given.shifts)
    write_report(rows, orders(rows), command(), given.output)


if __name__ == "__main__":
    main()
