"""A rigid sphere and rigid cubes in AcousTools' BEM beside our own (`pip install 'autdtorch[crosscheck]'`).

    python scripts/crosscheck_acoustools.py

Fills in crosschecks.md, in docs/ or `--output`. The sources are points: AcousTools' pistons with radius 0.
Scenes and errors are those of benchmark_accuracy.py, the cubes made rigid. The judge of the sphere is its
exact series, that of the cubes the limit of our own grids.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path

import torch
import vedo
from accuracy_report import percent
from acoustools.BEM import compute_E
from acoustools.Mesh import calculate_features, get_CHIEF_points
from acoustools.Utilities import forward_model_batched
from benchmark_accuracy import (
    CUBE_ORDER,
    SPHERE_RADIUS,
    Case,
    Simulation,
    extrapolate,
    load,
    relative_error,
    simulate,
    sphere_case,
)
from generated_block import fill_in, measured, table

import autdtorch as at
from autdtorch.analytic.green import free_space_matrix
from autdtorch.scene.device_layouts import TRANSDUCER_RADIUS

DOCUMENT = Path(__file__).parents[1] / "docs" / "crosschecks.md"
COMMAND = "python scripts/crosscheck_acoustools.py"
PACKAGES = ("acoustools", "vedo")

SUBDIVISIONS = (2, 3, 4)
SPACINGS = (2.0, 1.0, 0.5)
"""Of our grids [mm]."""
LIMIT_SPACINGS = (0.5, 1 / 3, 0.25)
"""Of those that the cubes' limit comes from [mm]: they all have the faces between cells."""

CHIEF_POINTS, CHIEF_DEPTH = 30, 3e-3
"""About so many points inside, and how deep [m], where the field is asked to be zero."""

REPETITIONS = 3
"""Of short runs, of which the fastest counts: what disturbs a run only lengthens it."""
SHORT = 3.0
"""What is not repeated takes longer than this [s]."""

PLANE_SPACING = 1e-3
"""Of the points behind the obstacles [m]."""

ARC_RADIUS = 0.2
"""At which pistons are compared [m]."""
ANGLES = (0, 20, 40, 60, 80)


@dataclass(frozen=True)
class Row:
    """A measurement: relative errors of the field and of its scattered part, and the run time [s]."""

    scene: str
    program: str
    setting: str
    total: float
    scattered: float
    seconds: float


def cube_scene(count: int) -> at.Scene:
    """The paper's three cubes, rigid, or the middle one."""
    scene = load("three_cubes")
    kept = scene.obstacles if count == 3 else scene.obstacles[1:2]
    return dataclasses.replace(
        scene, obstacles=tuple(at.Box(one.center, one.size, rigid=True) for one in kept)
    )


def cube_case(count: int, spacings: Sequence[float] = LIMIT_SPACINGS) -> Case:
    """Rigid cubes, judged by the limit of our grids [mm]."""
    scene, name = cube_scene(count), "three rigid cubes" if count == 3 else "rigid cube"
    unjudged = Case(name, scene, scene.control_points, torch.zeros(()), None, CUBE_ORDER)
    exact = extrapolate(spacings, [simulate(unjudged, h).matrix for h in spacings], CUBE_ORDER)
    scattered = exact - free_space_matrix(scene.control_points, scene.array, scene.wavenumber)
    return dataclasses.replace(unjudged, exact=exact, scattered=float(scattered.norm()))


def sphere_mesh(scene: at.Scene, subdivisions: int) -> vedo.Mesh:
    """20 * 4^subdivisions triangles with their corners on the sphere."""
    (sphere,) = scene.obstacles
    return featured(vedo.IcoSphere(sphere.center, SPHERE_RADIUS, subdivisions=subdivisions))


def cube_mesh(scene: at.Scene, subdivisions: int) -> vedo.Mesh:
    """12 * 4^subdivisions triangles a cube."""
    cubes = [vedo.Box(one.center, size=one.size).triangulate() for one in scene.obstacles]
    return featured(vedo.merge([cube.subdivide(subdivisions, method=1) for cube in cubes]))


def featured(mesh: vedo.Mesh) -> vedo.Mesh:
    """The mesh with areas and normals, as AcousTools wants it."""
    calculate_features(mesh)
    return mesh


def boundary_elements(case: Case, mesh: vedo.Mesh, chief: bool = True) -> torch.Tensor:
    """AcousTools' transfer matrix (P, M) [Pa], with CHIEF's points inside or without."""
    scene = case.scene
    normals = scene.array.normals.to(torch.complex64)
    inside = get_CHIEF_points(mesh, CHIEF_POINTS, "uniform", scale=CHIEF_DEPTH) if chief else None
    matrix = compute_E(
        mesh,
        case.points.T[None].to(torch.complex64),
        scene.array.positions.float(),
        use_cache_H=False,
        H_method="LU",
        p_ref=scene.array.source_strength,
        norms=normals,
        k=scene.wavenumber,
        transducer_radius=0.0,
        internal_points=inside,
    )
    return matrix[0].to(torch.complex128)


def timed_elements(case: Case, mesh: vedo.Mesh, chief: bool) -> Simulation:
    """The same with its run time, without that of the mesh."""
    begin = time.perf_counter()
    matrix = boundary_elements(case, mesh, chief)
    return Simulation(matrix, time.perf_counter() - begin, True)


def repeated(measure: Callable[[], Simulation]) -> Simulation:
    """A measurement with the shortest run time of several, if it is short."""
    found = [measure()]
    while found[0].seconds < SHORT and len(found) < REPETITIONS:
        found.append(measure())
    return dataclasses.replace(found[0], seconds=min(one.seconds for one in found))


def judged(case: Case, program: str, setting: str, found: Simulation) -> Row:
    """The errors of a transfer matrix."""
    assert case.scattered is not None
    total = relative_error(found.matrix, case.exact)
    row = Row(
        case.name, program, setting, total, total * float(case.exact.norm()) / case.scattered, found.seconds
    )
    print(row, flush=True)
    return row


def sweep(case: Case, meshes: Sequence[vedo.Mesh]) -> list[Row]:
    """AcousTools on every mesh, and ours at every spacing."""
    rows = []
    for mesh in meshes:
        for chief, name in ((False, ""), (True, ", CHIEF")):
            found = repeated(partial(timed_elements, case, mesh, chief))
            rows.append(judged(case, "AcousTools", f"{mesh.ncells} triangles{name}", found))
    simulate(case, SPACINGS[0])  # compiles the kernel
    return rows + [
        judged(case, "autdtorch", f"{h:g} mm", repeated(partial(simulate, case, h))) for h in SPACINGS
    ]


def plane_times(case: Case, mesh: vedo.Mesh, spacing: float) -> str:
    """Run times of the transfer matrix to a plane of points behind the obstacles, ours at `spacing` [mm]."""
    points = at.Plane((80e-3, 50e-3, 50e-3), (1, 0, 0), (60e-3, 60e-3)).points(PLANE_SPACING).reshape(-1, 3)
    wide = dataclasses.replace(case, points=points)
    theirs, ours = timed_elements(wide, mesh, True), simulate(wide, spacing)
    difference = percent(relative_error(ours.matrix, theirs.matrix))
    return (
        f"All {len(case.scene.array)} transducers to {len(points)} points of a plane behind the {case.name}: "
        f"AcousTools with {mesh.ncells} triangles and CHIEF takes {theirs.seconds:.3g} s, autdtorch at "
        f"{spacing:g} mm {ours.seconds:.3g} s. The two matrices differ by {difference}."
    )


def directivities() -> torch.Tensor:
    """Of a piston at `ANGLES`, (3, angles): AcousTools', our disc's at `ARC_RADIUS`, the exact far field."""
    angles = torch.deg2rad(torch.tensor(ANGLES, dtype=torch.float64))
    arc = torch.stack((angles.sin(), torch.zeros_like(angles), angles.cos()), dim=1) * ARC_RADIUS
    k, origin, normal = 2 * math.pi * 40e3 / 340.0, torch.zeros((1, 3)), torch.tensor([[0.0, 0.0, 1.0]])
    theirs = forward_model_batched(
        arc.T[None].to(torch.complex64), origin, p_ref=1.0, norms=normal.to(torch.complex64), k=k,
        transducer_radius=TRANSDUCER_RADIUS,
    )  # fmt: skip
    disc = at.TransducerArray(origin, normal, source_strength=1.0, radius=TRANSDUCER_RADIUS)
    ours = free_space_matrix(arc, disc, k)
    x = k * TRANSDUCER_RADIUS * angles.sin().clamp(min=1e-9)
    return torch.stack(
        (
            ARC_RADIUS * theirs.flatten().abs(),
            ARC_RADIUS * ours.flatten().abs(),
            2 * torch.special.bessel_j1(x) / x,
        )
    )


def report() -> list[str]:
    """The generated part of crosschecks.md."""
    sphere, cube, cubes = sphere_case("rigid sphere"), cube_case(1), cube_case(3)
    spheres = [sphere_mesh(sphere.scene, n) for n in SUBDIVISIONS]
    both = [[cube_mesh(case.scene, n) for n in SUBDIVISIONS] for case in (cube, cubes)]
    rows = [*sweep(sphere, spheres), *sweep(cube, both[0]), *sweep(cubes, both[1])]
    lines = [
        (
            one.scene,
            one.program,
            one.setting,
            percent(one.total),
            percent(one.scattered),
            f"{one.seconds:.3g} s",
        )
        for one in rows
    ]
    pistons = [
        (f"{angle} degrees", *(f"{value:.4f}" for value in values))
        for angle, values in zip(ANGLES, directivities().T.tolist(), strict=True)
    ]
    packages = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    return [
        f"{measured(COMMAND)}\n\n{packages}, threads: {torch.get_num_threads()}.",
        table(("scene", "program", "setting", "total", "scattered", "run time"), lines),
        plane_times(cubes, both[1][1], 1.0),
        table(("angle", "AcousTools", "autdtorch, at 0.2 m", "far field"), pistons),
    ]


def main() -> None:
    """Compare, and fill in the document."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", type=Path, default=DOCUMENT.parent)
    fill_in(DOCUMENT, "crosscheck_acoustools", report(), parser.parse_args().output)


if __name__ == "__main__":
    main()
