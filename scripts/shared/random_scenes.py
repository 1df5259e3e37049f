"""Random scenes for stress tests: small domains, obstacles of every kind, contrast and position.

A scene is 6 to 12 cells across at 3 to 20 cells per wavelength. It holds one to four obstacles, which may be
rigid, absorbing, thin, touching or overlapping, with sources and control points close to them. Some have
reflectors, which may cut obstacles.
"""

import cmath
import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from autdtorch.fdtd.grid import make_grid
from autdtorch.fdtd.region import MIN_CELLS_PER_WAVELENGTH
from autdtorch.propagators.plan import region_of
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.obstacles import Box, Cylinder, Mesh, Obstacle, Sphere, VoxelMask
from autdtorch.scene.reflectors import Reflector
from autdtorch.scene.scene import Medium, OverlapWarning, ScaleWarning, Scene
from autdtorch.utils.array_types import Array

AIR = Medium(density=1.2, sound_speed=340.0)
FREQUENCY = 40e3
WAVELENGTH = AIR.sound_speed / FREQUENCY

STEPS, LONG_STEPS = 2_000, 100_000
LONG_SHARE = 0.01
"""Share of the scenes with `LONG_STEPS`; these are the smallest, 6 cells across."""
INSIDE_SHARE = 0.75
"""Share of the scenes without obstacles in the absorbing layer."""
KINDS = {
    **{"box": 0.15, "rotated box": 0.1, "sphere": 0.1, "cylinder": 0.1, "plate": 0.15, "needle": 0.1},
    **{"shell": 0.05, "voxels": 0.05, "mesh": 0.05, "wall": 0.15},
}
"""Kinds of obstacles and their shares; walls are unbounded, in the scenes that allow it."""
MATERIALS = {"fluid": 0.5, "rigid": 0.15, "absorbing": 0.2, "impedance": 0.15}
"""Materials of obstacles and their shares."""
REFLECTOR_SHARE = 0.2
"""Share of the scenes with a reflector, and of these with a second one."""

UNBOUNDED = 1e3
"""Extent of a wall [cells]."""

TETRAHEDRON = np.eye(4)[:, 1:], np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
"""Vertices and triangles of a corner of a cube of edge 1."""


@dataclass(frozen=True)
class Trial:
    """A random scene and its run."""

    number: int  # draws the scene again
    scene: Scene
    spacing: float  # edge of a cell [m]
    dtype: torch.dtype
    steps: int  # of each run, at least; the driven run takes `FEWEST_PERIODS` if these are more
    labels: tuple[str, ...]
    inside: bool  # whether all obstacles are inside the domain; else some may reach into the absorbing layer
    refused: int  # scenes drawn before it that are refused

    def __str__(self) -> str:
        cells = f"{WAVELENGTH / self.spacing:.2f} cells per wavelength"
        obstacles = "\n    ".join(map(repr, self.scene.obstacles))
        return f"scene {self.number}: {cells}, {self.dtype}, {', '.join(self.labels)}\n    {obstacles}"


def draw_trial(seed: int, number: int, long_share: float = LONG_SHARE) -> Trial:
    """Draw scene `number` of a seed."""
    rng = np.random.default_rng((seed, number))
    long, inside, refused = bool(rng.uniform() < long_share), bool(rng.uniform() < INSIDE_SHARE), 0
    while True:
        spacing = WAVELENGTH / log_uniform(rng, MIN_CELLS_PER_WAVELENGTH, 20.0)
        domain = np.full(3, 6.0) if long else rng.integers(6, 13, 3).astype(float)
        draft = _Draft(rng, spacing, domain, [], {"long"} if long else set())
        for _ in range(rng.integers(1, 5)):
            draft.add_obstacle(inside)
        scene = draft.scene()
        if scene is None:
            continue
        if not _refused(scene, spacing):
            break
        refused += 1
    dtype = torch.float32 if rng.uniform() < 0.5 else torch.float64
    steps = LONG_STEPS if long else STEPS
    draft.labels.add(str(dtype).removeprefix("torch."))
    return Trial(number, scene, spacing, dtype, steps, tuple(sorted(draft.labels)), inside, refused)


def _refused(scene: Scene, spacing: float) -> bool:
    """Return whether an obstacle is too slow for the spacing, or a wall that reacts: all errors here."""
    region = region_of(scene).whole
    for wall in (body for body in region.bodies if body.continued):
        if wall.impedance is not None or (wall.fluid is not None and wall.fluid.density.imag):
            return True
    try:
        make_grid(region, spacing)
    except ValueError as error:
        if "cells per wavelength in obstacle" not in str(error):
            raise
        return True
    return False


@dataclass
class _Draft:
    """A scene while it is drawn, lengths in cells."""

    rng: np.random.Generator
    spacing: float  # edge of a cell [m]
    domain: Array  # its extent (3,)
    obstacles: list[Obstacle]
    labels: set[str]

    def scene(self) -> Scene | None:
        """Return the scene, with points in its air; None if the obstacles leave too little air."""
        reflectors = self._reflectors()
        candidates = self.spacing * self.domain * self.rng.uniform(0.02, 0.98, (512, 3))
        for reflector in reflectors:
            height = reflector.mirror.height(torch.from_numpy(candidates)).numpy()
            candidates = candidates[height > 0.1 * self.spacing]
            surfaces = [obstacle.surface()[0] for obstacle in self.obstacles]
            if min(reflector.mirror.height(surface).max() for surface in surfaces) < 0.1 * self.spacing:
                return None  # an obstacle is behind it
        gap = np.min([o.signed_distance(candidates).numpy() for o in self.obstacles], axis=0) / self.spacing
        # the distance to voxels is not exact between their centres
        inside = np.any([o.contains(candidates, margin=1e-6).numpy() for o in self.obstacles], axis=0)
        free, chosen = np.flatnonzero((gap > 0.2) & ~inside), []
        if len(free) < 4:
            return None
        for _ in range(4):
            if self.rng.uniform() < 0.5:
                order = np.abs(gap[free] - self.rng.uniform(0.2, 1.5))
            else:
                order = self.rng.uniform(size=len(free))
            chosen.append(free[order.argmin()])
            free = np.setdiff1d(free, chosen)
        if gap[chosen].min() < 1.5:
            self.labels.add("point at a wall")
        array = TransducerArray(candidates[chosen[:2]], (1.0, 0.0, 0.0), radius=0.0)
        corners = np.array((np.zeros(3), self.spacing * self.domain))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", OverlapWarning)
            warnings.simplefilter("ignore", ScaleWarning)  # points behind sources, odd materials
            return Scene(
                array, AIR, FREQUENCY, candidates[chosen[2:]], self.obstacles, domain=corners,
                reflectors=reflectors,
            )  # fmt: skip

    def _reflectors(self) -> list[Reflector]:
        """Return up to two planes at right angles, in the first third of the domain from a side."""
        reflectors, rng = [], self.rng
        for axis in rng.permutation(3)[: (rng.uniform(size=2) < REFLECTOR_SHARE).cumprod().sum()]:
            sign, place = rng.choice((-1.0, 1.0)), rng.choice((0.0, rng.uniform(0, 0.33)))
            point = np.where(sign > 0, place, 1 - place) * self.domain * self.spacing
            reflectors.append(Reflector(point, sign * np.eye(3)[axis], rng.choice((-1.0, 1.0))))
            self.labels.add("reflector")
        return reflectors

    def add_obstacle(self, inside: bool) -> None:
        """Draw one more, fully `inside` the domain or partly."""
        while True:
            obstacle, labels = self._obstacle()
            lower, upper = np.array(obstacle.lower) / self.spacing, np.array(obstacle.upper) / self.spacing
            if inside:
                fits = (lower >= -1e-6).all() and (upper <= self.domain + 1e-6).all()
            else:
                fits = (upper > 0.1).all() and (lower < self.domain - 0.1).all()
            if fits:
                break
        self.obstacles.append(obstacle)
        self.labels |= labels

    def _obstacle(self) -> tuple[Obstacle, set[str]]:
        """Return an obstacle that may lie anywhere, and its labels."""
        rng, aligned, thin = self.rng, self.rng.uniform() < 0.4, self.rng.uniform() < 0.25
        kind = str(rng.choice(list(KINDS), p=list(KINDS.values())))
        size = np.exp(rng.uniform(0, math.log(8.0), 3))
        if kind == "wall":
            size[np.arange(3) != rng.integers(3)] = UNBOUNDED
        axis, turn = rng.normal(size=3), rng.uniform(-math.pi, math.pi, 3)
        if aligned:
            size, axis, turn = np.rint(size), np.eye(3)[rng.integers(3)], np.zeros(3)
        if kind == "plate":
            size[rng.integers(3)] = log_uniform(rng, 0.01, 1.0)
        elif kind == "needle":
            size[0] = log_uniform(rng, 0.1, 1.5)
        elif kind == "shell":
            size[:] = size.max()
        elif thin:
            size[rng.integers(3)] = log_uniform(rng, 0.1, 1.0)
        center, place = self._center(size)
        if aligned and place == "apart":
            center = np.rint(2 * center) / 2
        material, names = draw_material(rng)
        obstacle = make_obstacle(kind, self.spacing * center, self.spacing * size, axis, turn, rng, material)
        names |= {kind, place} | ({"aligned"} if aligned else set()) | ({"thin"} if thin else set())
        return obstacle, names

    def _center(self, size: Array) -> tuple[Array, str]:
        """Return the centre of an obstacle of `size` (3,), anywhere or at the previous one, and a label."""
        rng, chance = self.rng, self.rng.uniform()
        if not self.obstacles or chance < 0.4:
            return self.domain * rng.uniform(0, 1, 3), "apart"
        last = self.obstacles[-1]
        lower, upper = (np.array(corner) / self.spacing for corner in (last.lower, last.upper))
        lower, upper = lower.clip(min=-self.domain), upper.clip(max=2 * self.domain)
        middle, extent = (lower + upper) / 2, upper - lower
        if chance < 0.7:
            towards = np.sign(rng.normal(size=3)) * (rng.uniform(size=3) < 0.6)
            return middle + towards * (extent + size) / 2, "touching"
        return middle + rng.uniform(-0.5, 0.5, 3) * extent, "overlapping"


def draw_material(rng: np.random.Generator) -> tuple[dict[str, Any], set[str]]:
    """Return the material arguments of an obstacle, and labels."""
    kind = str(rng.choice(list(MATERIALS), p=list(MATERIALS.values())))
    if kind == "rigid":
        return {"rigid": True}, {kind}
    if kind == "impedance":
        turn = cmath.exp(0.5j * math.pi * rng.uniform(-1, 1))
        return {"impedance": log_uniform(rng, 0.03, 1e3) * turn}, {kind}
    density = AIR.density * log_uniform(rng, 1e-3, 1e4)
    speed = AIR.sound_speed * log_uniform(rng, 0.2, 17.0)
    labels = {"light" if density < AIR.density else "heavy", "slow" if speed < AIR.sound_speed else "fast"}
    material: dict[str, Any] = {"density": density, "sound_speed": speed}
    if kind == "absorbing":  # the phases of the density and of the bulk modulus, up to 80 degrees
        inertia, compression = (log_uniform(rng, 1e-4, 1.4) * (rng.uniform() < 0.7) for _ in range(2))
        material["density"] *= cmath.exp(1j * inertia)
        material["sound_speed"] *= cmath.exp(-0.5j * (inertia + compression))
        labels.add(kind)
    return material, labels


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number evenly by its logarithm."""
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


def make_obstacle(
    kind: str, center: Array, size: Array, axis: Array, turn: Array, rng: np.random.Generator, material: Any
) -> Obstacle:
    """Return an obstacle with its centre and size (3,) [m], axis (3,) and rotation (3,) [rad]."""
    middle, (x, y, z), angles = tuple(center.tolist()), size.tolist(), tuple(turn.tolist())
    if kind == "sphere":
        return Sphere(middle, x / 2, **material)
    if kind in ("cylinder", "needle"):
        return Cylinder(middle, x / 2, z, tuple(axis.tolist()), **material)
    if kind in ("box", "wall"):
        return Box(middle, (x, y, z), **material)
    if kind in ("rotated box", "plate"):
        return Box(middle, (x, y, z), angles, **material)
    if kind == "shell":
        return _hollow(size, **material, offset=middle, rotation=angles, wall=rng.uniform(0.02, 0.3))
    if kind == "voxels":
        mask = rng.uniform(size=(3, 3, 3)) < 0.6
        mask[1, 1, 1] = True
        return VoxelMask(mask, x / 3, tuple((center - x / 2).tolist()), **material)
    return Mesh.from_surface(TETRAHEDRON, x, middle, angles, **material)


def _hollow(size: Array, wall: float, **placed: Any) -> Mesh:
    """Return a hollow cuboid of size (3,) [m], with a wall of that share of it."""
    vertices, triangles = Box((0, 0, 0), (1.0, 1.0, 1.0), rigid=True).surface()
    both = np.concatenate([size * vertices.numpy(), (1 - 2 * wall) * size * vertices.numpy()])
    faces = np.concatenate([triangles.numpy(), triangles.numpy()[:, ::-1] + len(vertices)])
    return Mesh.from_surface((both, faces), **placed)
