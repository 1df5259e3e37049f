"""The force on a rigid sphere and cube against AcousTools' boundary elements.

Needs `pip install 'autdtorch[crosscheck]'`. AcousTools integrates the stress of its field over 1,280
triangles around the body. References are the closed form of the sphere, and the T-matrix of the cube by cells
of 0.5 mm.
"""

import math
import time
from importlib.metadata import version

import acoustools.Constants
import torch
import vedo
from acoustools.BEM.Force import force_mesh_surface
from acoustools.Mesh import calculate_features, get_CHIEF_points
from shared.document import Page, percent, table
from shared.scenes import relative_error
from shared.timing import timed

import autdtorch as at

DOCUMENT = "force.md"

AIR = at.Medium(acoustools.Constants.p_0, float(acoustools.Constants.c_0))
FREQUENCY = 40e3
WAVENUMBER = 2 * math.pi * FREQUENCY / AIR.sound_speed
ARRAY = at.TransducerArray.grid((4, 4), 10e-3, (0, 0, 0), (0, 0, 1.0), radius=0)
CENTER, EDGE = (3e-3, -2e-3, 50e-3), 8e-3
SPHERE, CUBE = at.Sphere(CENTER, 5e-3, rigid=True), at.Box(CENTER, (EDGE,) * 3, rigid=True)
AROUND = 9e-3  # radius of the surface of integration [m]


def main(page: Page) -> None:
    drive = at.drive_from_phases(at.focus_phases(ARRAY.positions, (0, 0, 50e-3), WAVENUMBER))

    def force(body: at.Obstacle, spacing: float) -> torch.Tensor:
        matrix = at.TMatrix.of(body, AIR, FREQUENCY, spacing, error=1e-4, cache=False)
        return at.radiation_force(matrix, drive, array=ARRAY, medium=AIR)

    force(CUBE, 2e-3)  # compiles the kernel
    rows = []
    ball = [vedo.IcoSphere(CENTER, SPHERE.radius, subdivisions=n) for n in (2, 3)]
    edges = [vedo.Box(CENTER, size=CUBE.size).triangulate().subdivide(n, method=1) for n in (3, 4)]
    for name, body, meshes in (("sphere", SPHERE, ball), ("cube", CUBE, edges)):
        exact = force(body, 0.5e-3)
        for mesh in meshes:
            result, seconds = timed(lambda mesh=mesh: by_elements(mesh, drive), time.process_time)
            cells = [f"AcousTools, {mesh.ncells} triangles", percent(relative_error(result, exact))]
            rows.append([name, *cells, f"{seconds:.2g} s"])
        result, seconds = timed(lambda body=body: force(body, 1e-3), time.process_time)
        kind = "closed form" if body is SPHERE else "1 mm"
        rows.append([name, f"autdtorch, {kind}", percent(relative_error(result, exact)), f"{seconds:.2g} s"])
    page.write(
        f"acoustools {version('acoustools')}, with CHIEF points, integrates over 1,280 triangles around the\n"
        "body. CPU times include the matrices of the bodies.",
        table(["rigid", "program", "error", "CPU time"], rows),
    )


def by_elements(mesh: vedo.Mesh, drive: torch.Tensor) -> torch.Tensor:
    around = vedo.IcoSphere(CENTER, AROUND, subdivisions=3)
    for each in (mesh, around):
        calculate_features(each)
    force = force_mesh_surface(
        drive.to(torch.complex64)[None, :, None], mesh, ARRAY.positions.float(), surface=around,
        use_cache_H=False, p_ref=ARRAY.source_strength, k=WAVENUMBER, transducer_radius=0.0,
        transducer_norms=ARRAY.normals.to(torch.complex64),
        internal_points=get_CHIEF_points(mesh, 30, "uniform", scale=3e-3),
    )  # fmt: skip
    return force.flatten().real.double()
