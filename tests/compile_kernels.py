"""Compile the kernels of a dtype, for the processes of pytest to load. A program that `make test` runs."""

import sys

import torch
from small_scenes import CUBE, small_scene

import autdtorch as at

BALLS = (
    at.Sphere((8e-3, 12e-3, 12e-3), 3e-3, rigid=True),
    at.Sphere((16e-3, 12e-3, 12e-3), 3e-3, density=5.0, sound_speed=300.0),
)


def main(dtype: str) -> None:
    """Simulate in boxes and in free space, differentiate, run holography; in float64, spheres scatter too.

    Spheres and meshes have kernels of one dtype; the other process meanwhile compiles those of grids.
    """
    scene = small_scene((CUBE,))
    drive = torch.ones(4, dtype=torch.complex128)
    if dtype == "float64":
        at.Mesh.from_surface(CUBE.surface(), rigid=True).contains(CUBE.center)
        sphere = at.TMatrix.of(at.Sphere((0, 0, 0.05), 2e-3, rigid=True), scene.medium, scene.frequency)
        pair = at.TMatrixCluster([sphere, sphere.moved((5e-3, 0, 0))])
        at.radiation_force(pair, drive, array=scene.array, medium=scene.medium)
    matrix = at.make_propagator(small_scene(BALLS), "box", 2e-3, dtype=dtype, cache=False).transfer_matrix()
    density = torch.tensor([CUBE.density], dtype=torch.float64, requires_grad=True)
    field = at.differentiable_field(scene, drive, density=density, spacing=2e-3, dtype=dtype)
    field.abs().sum().backward()
    points = torch.rand((30_000, 3), dtype=torch.float64) + 1
    at.make_propagator(small_scene(()), "free_space", cache=False).transfer_matrix(points)
    for algorithm in ("naive", "gs"):
        at.holography(matrix.to(getattr(torch, dtype).to_complex()), algorithm=algorithm)


if __name__ == "__main__":
    main(sys.argv[1])
