"""Small scenes that several tests share: a 2 x 2 array in front of an obstacle, 24 mm across."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from autdtorch.analytic import fluid_sphere, impedance_sphere, rigid_sphere
from autdtorch.fdtd.kernels.contract import Receivers, Sources, WaveState
from autdtorch.fdtd.stepping import Assembly, assemble
from autdtorch.propagators.plan import region_of
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.geometry import Plane
from autdtorch.scene.obstacles import Box, Cylinder, Mesh, Sphere, VoxelMask
from autdtorch.scene.scene import Medium, Scene

AIR = Medium(density=1.293, sound_speed=340.0)
CUBE = Box(center=(12e-3, 12e-3, 12e-3), size=(6e-3, 8e-3, 4e-3), density=100.0, sound_speed=340.0)
CORNER = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"  # a mesh
#: A scene as a file has it.
SECTION = {
    "frequency": 40e3,
    "medium": {"density": 1.2, "sound_speed": 340.0},
    "array": {"type": "grid", "shape": [2, 2], "pitch": 10e-3, "center": [0, 0, 0]},
    "control_points": {"type": "points", "positions": [[0.05, 0, 0], [0.05, 0.01, 0]]},
}
NO_SOURCES = Sources(torch.zeros(0, dtype=torch.int64), torch.zeros((1, 0, 2), dtype=torch.float64))
NO_RECEIVERS = Receivers(torch.zeros((0, 1), dtype=torch.int64), torch.zeros((0, 1), dtype=torch.float64))


def small_scene(obstacles=(), extent=0.024, absorption=0.0, radius=0.0):
    """A 2 x 2 array at one face of a cube of air, three control points near the other, none on a cell."""
    array = TransducerArray.grid((2, 2), pitch=8e-3, center=(1.2e-3, extent / 2, extent / 2), radius=radius)
    air = Medium(AIR.density, AIR.sound_speed, absorption)
    points = [
        [extent - 1.7e-3, 0.31 * extent, 0.6 * extent],
        [extent - 4.1e-3, 0.7 * extent, 0.52 * extent],
        [extent - 2.6e-3, 0.44 * extent, 0.23 * extent],
    ]
    return Scene(array, air, 40e3, points, obstacles, domain=((0, 0, 0), (extent,) * 3))


def scene_of_all_kinds(folder: Path) -> Scene:
    """One obstacle of every kind, with an observation plane; the mesh is written to `folder`."""
    path = folder / "corner.obj"
    path.write_text(CORNER, encoding="utf-8")
    obstacles = (
        Box((40e-3, 20e-3, 20e-3), (10e-3, 14e-3, 8e-3), rotation=(0.3, 0.2, 0.5), rigid=True),
        Sphere((40e-3, 50e-3, 50e-3), 8e-3, rigid=True),
        Cylinder((40e-3, 80e-3, 20e-3), 5e-3, 20e-3, axis=(1, 1, 1), rigid=True),
        Mesh(path, scale=15e-3, offset=(35e-3, 75e-3, 75e-3), rigid=True),
        VoxelMask(np.ones((3, 2, 3), bool), 4e-3, origin=(35e-3, 15e-3, 75e-3), rigid=True),
    )
    return Scene(
        array=TransducerArray.grid((2, 2), pitch=10e-3, center=(1e-3, 50e-3, 50e-3)),
        medium=AIR,
        frequency=40e3,
        control_points=[(80e-3, 50e-3, 50e-3)],
        obstacles=obstacles,
        observation_plane=Plane((80e-3, 50e-3, 50e-3), (1, 0, 0), (0.1, 0.1)),
    )


def matrix_of_sphere(
    scene: Scene, points: torch.Tensor | None = None, scattered: bool = False
) -> torch.Tensor:
    """The transfer matrix of a scene with one sphere, by its series."""
    (sphere,) = scene.obstacles
    places = scene.control_points if points is None else points
    where = places, scene.array.positions, scene.wavenumber, sphere.center, sphere.radius
    if sphere.impedance is not None:
        field = impedance_sphere(*where, sphere.impedance, scattered=scattered)
    elif (fluid := sphere.fluid_at(scene.frequency)) is None:
        field = rigid_sphere(*where, scattered=scattered)
    else:
        ratios = fluid[0] / scene.medium.density, fluid[1] / scene.medium.sound_speed
        field = fluid_sphere(*where, *ratios, scattered=scattered)
    return 4 * math.pi * scene.array.source_strength * field


def random_frames(count: int, transducers: int, seed: int = 0) -> torch.Tensor:
    """Drives (count, transducers) of random phases and amplitudes."""
    generator = torch.Generator().manual_seed(seed)
    phases, amplitudes = torch.rand((2, count, transducers), generator=generator, dtype=torch.float64)
    return torch.polar(amplitudes, 2 * torch.pi * phases)


def assembled_parts(scene: Scene, spacing: float, dtype: torch.dtype) -> tuple[Assembly, Sources, Receivers]:
    """A small scene on its grid, its transducers with four phasors, and its control points."""
    assembly = assemble(region_of(scene), spacing, dtype)
    strength = torch.tensor([1.0, 1j, -0.4, 0.3 - 0.7j], dtype=torch.complex128)
    sources = assembly.sources(scene.array.positions, strength)
    return assembly, sources, assembly.receivers(scene.control_points)


def all_tensors(state: WaveState, recorded: torch.Tensor) -> list[torch.Tensor]:
    """All results of a run: pressure, record, and the memory of layers and columns."""
    return [state.now, state.before, recorded, *(part for layer in state.memory for part in layer)]


def assert_slopes(
    function: Callable[[torch.Tensor], torch.Tensor], place: torch.Tensor, steps: list[float]
) -> None:
    """Check the gradient at a place (n,) against central differences, which err by the steps squared."""
    place = place.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(function(place), place)
    for entry, step, aside in zip(gradient, steps, torch.eye(len(steps), dtype=torch.float64), strict=True):
        ends = (float(function(place.detach() + sign * step * aside)) for sign in (1, -1))
        slope = (next(ends) - next(ends)) / (2 * step)
        assert abs(float(entry) - slope) <= 1e-4 * max(abs(slope), float(gradient.abs().max()))


def relative_error(value: torch.Tensor, reference: torch.Tensor) -> float:
    """Complex relative L2 error."""
    return float((value - reference).norm() / reference.norm())
