"""Compile the kernels of a dtype, for the processes of pytest to load. A program that `make test` runs."""

import sys

import torch
from small_scenes import CUBE, small_scene

import autdtorch as at


def main(dtype: str) -> None:
    """Simulate in a box and differentiate, and in float64 run holography."""
    scene = small_scene((CUBE,))
    matrix = at.make_propagator(scene, "box", 2e-3, dtype=dtype, cache=False).transfer_matrix()
    density = torch.tensor([CUBE.density], dtype=torch.float64, requires_grad=True)
    drive = torch.ones(4, dtype=torch.complex128)
    field = at.differentiable_field(scene, drive, density=density, spacing=2e-3, dtype=dtype)
    field.abs().sum().backward()
    if dtype == "float64":
        for algorithm in ("naive", "gs"):
            at.holography(matrix, algorithm=algorithm)


if __name__ == "__main__":
    main(sys.argv[1])
