"""Rigid sphere and cubes against AcousTools' BEM.

Needs `pip install 'autdtorch[crosscheck]'`. The sources are points: AcousTools' pistons with radius 0. Scenes
and errors are those of `benchmark.py accuracy`, with rigid cubes. The reference is the exact series for the
sphere, and the limit of our grids for the cubes.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from importlib.metadata import version

import torch
import vedo
from acoustools.BEM import compute_E
from acoustools.Mesh import calculate_features, get_CHIEF_points
from shared.cases import SPHERE_RADIUS, Case, close_scene, cubes_with, simulate, sphere_case
from shared.document import Page, percent, printed, table
from shared.scenes import relative_error
from shared.timing import shortest

import autdtorch as at

DOCUMENT = "benchmarks.md"
PACKAGES = ("acoustools", "vedo")

SPHERE_SUBDIVISIONS, CUBE_SUBDIVISIONS = (3, 4), (4,)
SPACINGS = (1.0, 0.5)
"""Spacings of our grids [mm]."""
FINEST = 0.25
"""Spacing of the reference of the cubes [mm]."""

CHIEF_POINTS, CHIEF_DEPTH = 30, 3e-3
"""Approximate number of inner points with zero field, and their depth [m]."""

REPETITIONS = 3
"""Repetitions of a run; the fastest counts."""


def main(page: Page) -> None:
    sphere, cubes = sphere_case("rigid sphere"), rigid_cubes(3)
    meshes = [
        (sphere, [sphere_mesh(sphere.scene, n) for n in SPHERE_SUBDIVISIONS]),
        (cubes, [cube_mesh(cubes.scene, n) for n in CUBE_SUBDIVISIONS]),
    ]
    lines = printed(row for case, finer in meshes for row in rows(case, finer))
    page.write(
        f"{', '.join(f'{name} {version(name)}' for name in PACKAGES)}; with CHIEF points.",
        table(("scene", "program", "error", "run time"), lines),
    )


def rigid_cubes(count: int, spacing: float = FINEST) -> Case:
    """Return the paper's three cubes, rigid, or the middle one, as a grid of `spacing` [mm] has them."""
    scene = close_scene("three_cubes")
    chosen = scene.obstacles if count == 3 else scene.obstacles[1:2]
    cubes = tuple(at.Box(cube.center, cube.size, rigid=True) for cube in chosen)
    scene = dataclasses.replace(scene, obstacles=cubes)
    name = "three rigid cubes" if count == 3 else "rigid cube"
    empty = cubes_with(name, scene, torch.zeros(()))
    return cubes_with(name, scene, simulate(empty, spacing).matrix)


def sphere_mesh(scene: at.Scene, subdivisions: int) -> vedo.Mesh:
    """Return 20 * 4^subdivisions triangles with their corners on the sphere."""
    (sphere,) = scene.obstacles
    return featured(vedo.IcoSphere(sphere.center, SPHERE_RADIUS, subdivisions=subdivisions))


def cube_mesh(scene: at.Scene, subdivisions: int) -> vedo.Mesh:
    """Return 12 * 4^subdivisions triangles per cube."""
    cubes = [vedo.Box(obstacle.center, size=obstacle.size).triangulate() for obstacle in scene.obstacles]
    return featured(vedo.merge([cube.subdivide(subdivisions, method=1) for cube in cubes]))


def featured(mesh: vedo.Mesh) -> vedo.Mesh:
    """Return the mesh with areas and normals, which AcousTools needs."""
    calculate_features(mesh)
    return mesh


def boundary_elements(case: Case, mesh: vedo.Mesh) -> torch.Tensor:
    """Return AcousTools' transfer matrix (P, M) [Pa], with inner CHIEF points."""
    scene = case.scene
    normals = scene.array.normals.to(torch.complex64)
    inside = get_CHIEF_points(mesh, CHIEF_POINTS, "uniform", scale=CHIEF_DEPTH)
    points, sources = case.points.T[None].to(torch.complex64), scene.array.positions.float()
    matrix = compute_E(
        *(mesh, points, sources), use_cache_H=False, H_method="LU", p_ref=scene.array.source_strength,
        norms=normals, k=scene.wavenumber, transducer_radius=0.0, internal_points=inside,
    )  # fmt: skip
    return matrix[0].to(torch.complex128)


def rows(case: Case, meshes: Sequence[vedo.Mesh]) -> Iterator[list[str]]:
    for mesh in meshes:
        matrix, seconds = shortest(lambda m=mesh: boundary_elements(case, m), REPETITIONS)
        error = percent(relative_error(matrix, case.exact))
        yield [case.name, f"AcousTools, {mesh.ncells} triangles", error, f"{seconds:.3g} s"]
    simulate(case, SPACINGS[0])  # compiles the kernel
    for spacing in SPACINGS:
        run, seconds = shortest(lambda h=spacing: simulate(case, h).matrix, REPETITIONS)
        error = percent(relative_error(run, case.exact))
        yield [case.name, f"autdtorch, {spacing:g} mm", error, f"{seconds:.3g} s"]
