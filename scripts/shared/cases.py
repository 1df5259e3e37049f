"""Scenes with known transfer matrices, and errors of simulations against them."""

from __future__ import annotations

import dataclasses
import json
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import torch
from shared.document import DOCS
from shared.scenes import paper_scene, relative_error, uncached
from shared.timing import timed

import autdtorch as at
from autdtorch import analytic
from autdtorch.propagators.free_space import free_space_matrix
from autdtorch.scene.geometry import plane_basis

CUBE_MATRICES = DOCS / "reference" / "cubes.json"
TOLERANCE = 1e-3

AIR = at.Medium(density=1.293, sound_speed=340.0)

SPHERE_RADIUS, SPHERE_DENSITY_RATIO = 8e-3, 77.3
SPHERES: dict[str, float | None] = {"rigid sphere": None, "sphere": 1.0, "fast sphere": 4.0}
"""Sound speed relative to air; None: rigid."""
FACE = 22.2e-3
"""Front face of the slab and of the rigid wall along x [m]."""

CUBES = ("three_cubes", "two_cubes")


@dataclass(frozen=True)
class Case:
    """A scene, the points (P, 3) [m] where its pressure is compared, and the transfer matrix (P, M) [Pa]."""

    name: str
    scene: at.Scene
    points: torch.Tensor
    exact: torch.Tensor
    scattered: float | None  # norm of the scattered part of the matrix; None without obstacles
    method: str = "box"  # of the propagator


@dataclass(frozen=True)
class SimulatedCase:
    """A transfer matrix (P, M) [Pa], its run time [s], and whether every run reached the steady state."""

    matrix: torch.Tensor
    seconds: float
    settled: bool = True


def simulate(case: Case, spacing: float, tolerance: float = TOLERANCE) -> SimulatedCase:
    """Simulate the transfer matrix at `spacing` [mm], scene assembly included in the time."""

    def work() -> tuple[torch.Tensor, bool]:
        propagator = uncached(case.scene, case.method, spacing, tolerance)
        return propagator.transfer_matrix(case.points), all(run.reached for run in propagator.runs)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", at.SteadyStateWarning)  # `settled` reports it
        (matrix, settled), seconds = timed(work)
    return SimulatedCase(matrix, seconds, settled)


def close_scene(name: str, obstacles: Sequence[at.Obstacle] | None = None) -> at.Scene:
    """Load a scene of the paper with its first focus alone, in the smallest domain that holds everything.

    `obstacles` replace those of the scene.
    """
    scene = paper_scene(name)
    obstacles, focus = scene.obstacles if obstacles is None else tuple(obstacles), scene.control_points[:1]
    corners = [torch.tensor([o.lower, o.upper], dtype=torch.float64) for o in obstacles]
    inside = torch.cat((scene.array.positions, focus, *corners))
    # Whole millimetres, so that every grid lies as in the paper's domain.
    lower, upper = 1e-3 * (1e3 * inside.amin(0) - 3).floor(), 1e-3 * (1e3 * inside.amax(0) + 3).ceil()
    return dataclasses.replace(
        scene, obstacles=obstacles, control_points=focus, domain=torch.stack((lower, upper)),
        observation_plane=None,
    )  # fmt: skip


def free_space_case() -> Case:
    """Return the paper's scene without obstacles."""
    scene = close_scene("homogeneous")
    exact = free_space_matrix(scene.control_points, scene.array, scene.wavenumber)
    return Case("free space", scene, scene.control_points, exact, None, "full")


def sphere_case(name: str, shift: Sequence[float] = (0.0, 0.0, 0.0)) -> Case:
    """Return the paper's array and foci with a sphere between them, its centre moved by `shift` (3,) [m]."""
    empty = paper_scene("homogeneous")
    center = 41e-3 + shift[0], 50e-3 + shift[1], 50e-3 + shift[2]
    speed_ratio, air = SPHERES[name], empty.medium
    ratios = None if speed_ratio is None else (SPHERE_DENSITY_RATIO, speed_ratio)
    scene = close_scene("homogeneous", [sphere(center, SPHERE_RADIUS, ratios, air)])
    exact, scattered = (sphere_matrix(scene, center, SPHERE_RADIUS, ratios, part) for part in (False, True))
    return Case(name, scene, scene.control_points, exact, float(scattered.norm()))


Ratios = tuple[float, float] | complex | None
"""Density and sound speed of a fluid relative to air; the impedance of a surface; None for a rigid body."""


def sphere(center: Sequence[float], radius: float, ratios: Ratios, air: at.Medium) -> at.Sphere:
    """Return a sphere of a centre (3,) and radius [m]."""
    if ratios is None:
        return at.Sphere(tuple(center), radius, rigid=True)
    if isinstance(ratios, complex):
        return at.Sphere(tuple(center), radius, impedance=ratios)
    density, speed = ratios[0] * air.density, ratios[1] * air.sound_speed
    return at.Sphere(tuple(center), radius, density=density, sound_speed=speed)


def sphere_matrix(
    scene: at.Scene, center: Sequence[float], radius: float, ratios: Ratios, scattered: bool = False
) -> torch.Tensor:
    """Return the exact transfer matrix (P, M) [Pa] of a sphere alone, or its scattered part."""
    where = scene.control_points, scene.array.positions, scene.wavenumber, tuple(center), radius
    if ratios is None:
        field = analytic.rigid_sphere(*where, scattered=scattered)
    elif isinstance(ratios, complex):
        field = analytic.impedance_sphere(*where, ratios, scattered=scattered)
    else:
        field = analytic.fluid_sphere(*where, *ratios, scattered=scattered)
    return 4 * math.pi * scene.array.source_strength * field


def cube_case(name: str) -> Case:
    """Return a scene of cubes, with the stored transfer matrix of the finest grid."""
    scene = close_scene(name)
    stored = json.loads(CUBE_MATRICES.read_text(encoding="utf-8"))["scenes"][name]
    parts = (torch.tensor(stored[-1][part], dtype=torch.float64) for part in ("real", "imag"))
    return cubes_with(name, scene, torch.complex(*parts))


def cubes_with(name: str, scene: at.Scene, exact: torch.Tensor) -> Case:
    """Return a case of cubes with a known transfer matrix."""
    scattered = exact - free_space_matrix(scene.control_points, scene.array, scene.wavenumber)
    return Case(name, scene, scene.control_points, exact, float(scattered.norm()))


def slab_case() -> Case:
    """Return a point source in front of a slab of 5 mm, with points on both sides."""
    material = {"density": 3.0 * AIR.density, "sound_speed": 1.5 * AIR.sound_speed}
    slab = at.Box((FACE + 2.5e-3, 20e-3, 20e-3), (5e-3, 1.0, 1.0), **material)
    exact = partial(analytic.fluid_slab, thickness=5e-3, density_ratio=3.0, speed_ratio=1.5)
    return _layered_case("slab", slab, (14.1e-3, 34.6e-3), exact)


def wall_case() -> Case:
    """Return a point source and points in front of a rigid wall."""
    wall = at.Box((FACE + 0.5, 20e-3, 20e-3), (1.0, 1.0, 1.0), rigid=True)
    return _layered_case("rigid wall", wall, (14.1e-3,), analytic.rigid_plane)


def _layered_case(
    name: str, box: at.Box, planes: Sequence[float], exact: Callable[..., torch.Tensor]
) -> Case:
    """Return a point source before a box that leaves the domain, with points in `planes` along x [m]."""
    array = at.TransducerArray([(8.3e-3, 19.1e-3, 20.7e-3)], (1, 0, 0))
    points = torch.tensor(list(product(planes, (9.4e-3, 21e-3), (11.7e-3, 32.2e-3))), dtype=torch.float64)
    scene = at.Scene(array, AIR, 40e3, points, (box,), domain=((0, 0, 0), (40e-3,) * 3))
    where = (points, array.positions, scene.wavenumber, (FACE, 0, 0), (-1, 0, 0))
    strength = 4 * math.pi * array.source_strength
    total, scattered = (strength * exact(*where, scattered=part) for part in (False, True))
    return Case(name, scene, points, total, float(scattered.norm()), "full")


def piston_case() -> Case:
    """Return a tilted disc of radius 5 mm between the cells, with points 0 to 60 degrees off its axis."""
    center = torch.tensor([12.3e-3, 13.1e-3, 13.7e-3], dtype=torch.float64)
    tilt = 2.0, 1.0, 0.6
    array = at.TransducerArray(center[None], tilt, radius=5e-3)
    normal, (across, _) = array.normals[0], plane_basis(tilt)
    angles = torch.deg2rad(torch.arange(0, 61, 5, dtype=torch.float64))[:, None]
    points = center + 20e-3 * (angles.cos() * normal + angles.sin() * across)
    domain = torch.stack((points.amin(0).minimum(center - 6e-3), points.amax(0).maximum(center + 6e-3)))
    scene = at.Scene(array, AIR, 40e3, points, domain=domain)
    field = analytic.piston_field(points, array.positions, scene.wavenumber, 5e-3, tilt)
    exact = 4 * math.pi * array.source_strength * field
    return Case("piston", scene, points, exact, None, "full")


def error_of(case: Case, matrix: torch.Tensor) -> tuple[float, float | None]:
    """Return the relative errors of a transfer matrix and of its scattered part."""
    total = relative_error(matrix, case.exact)
    return total, None if case.scattered is None else total * float(case.exact.norm()) / case.scattered
