"""Random scenes by family: each kind of body that a claim of error must hold for, next to three points.

Sizes are of things on a bench: paper and phone backs, slits between them, wires, balls of foam, scans.
"""

from __future__ import annotations

import cmath
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pyvista
import torch
from shared import cases
from shared.cases import Ratios
from shared.random_scenes import log_uniform

import autdtorch as at
from autdtorch.scene.geometry import rotation_matrix
from autdtorch.utils.array_types import Array
from autdtorch.utils.validation import Vector

AIR, FREQUENCY = at.Medium(1.2, 343.0), 40e3
_CLEAR = 4e-3  # Least distance of sources and points from a surface [m]


class Exact(NamedTuple):
    """A sphere whose series is the truth: centre (3,) and radius [m], and what it is."""

    center: Array
    radius: float
    ratios: Ratios


class Drawn(NamedTuple):
    """The bodies of a scene, the sphere that is the same, if any, and how far behind them the points are [m].

    Without a distance, sources and points are all around, in front of `reflectors`.
    """

    bodies: list[at.Obstacle]
    exact: Exact | None = None
    behind: float | None = None
    reflectors: Sequence[at.Reflector] = ()


Family = Callable[[np.random.Generator], Drawn]


def _angles(rng: np.random.Generator) -> Vector:
    """Draw angles, in every third scene none."""
    x, y, z = rng.uniform(-math.pi, math.pi, 3) * (rng.uniform() < 0.67)
    return float(x), float(y), float(z)


def _material(rng: np.random.Generator) -> dict[str, Any]:
    """Draw a rigid body or a fluid that is denser than air."""
    if rng.uniform() < 0.5:
        return {"rigid": True}
    speed = AIR.sound_speed * log_uniform(rng, 0.9, 5.0)
    return {"density": AIR.density * log_uniform(rng, 2.0, 5e3), "sound_speed": speed}


def _middle(rng: np.random.Generator) -> Array:
    return rng.uniform(-1.5e-3, 1.5e-3, 3)


def _placed(rotation: Vector, parts: list[tuple[Array, Array]], material: dict[str, Any]) -> Drawn:
    """Return boxes of centres and sizes (3,) [m] that turn together."""
    turn = rotation_matrix(rotation).numpy()
    boxes = [
        at.Box(tuple((turn @ center).tolist()), tuple(size.tolist()), rotation, **material)
        for center, size in parts
    ]
    return Drawn(boxes)


def plate(rng: np.random.Generator) -> Drawn:
    """A plate of 0.02 to 1 mm."""
    size = np.array([log_uniform(rng, 0.02e-3, 1e-3), *rng.uniform(6e-3, 14e-3, 2)])
    return _placed(_angles(rng), [(_middle(rng), rng.permutation(size))], _material(rng))


def slit(rng: np.random.Generator) -> Drawn:
    """Two blocks with a slit of 0.3 to 2 mm."""
    gap, size = log_uniform(rng, 0.3e-3, 2e-3), rng.uniform(4e-3, 9e-3, 3)
    apart, middle = np.array([(gap + size[0]) / 2, 0, 0]), _middle(rng)
    return _placed(_angles(rng), [(middle - apart, size), (middle + apart, size)], _material(rng))


def corner(rng: np.random.Generator) -> Drawn:
    """An L of two plates of 0.3 to 1.5 mm."""
    thick, (long, wide), middle = log_uniform(rng, 0.3e-3, 1.5e-3), rng.uniform(7e-3, 12e-3, 2), _middle(rng)
    floor = middle, np.array([long, wide, thick])
    wall = middle + np.array([thick - long, 0, long - thick]) / 2, np.array([thick, wide, long])
    return _placed(_angles(rng), [floor, wall], _material(rng))


def block(rng: np.random.Generator) -> Drawn:
    """A cuboid of 5 to 16 mm."""
    return _placed(_angles(rng), [(_middle(rng), rng.uniform(5e-3, 16e-3, 3))], _material(rng))


def apart(rng: np.random.Generator) -> Drawn:
    """A cuboid and a ball that do not touch."""
    left, right = (np.array([side, 0.0, 0.0]) + _middle(rng) for side in (-8e-3, 8e-3))
    box = at.Box(
        tuple(left.tolist()), tuple(rng.uniform(4e-3, 8e-3, 3).tolist()), _angles(rng), **_material(rng)
    )
    ball = at.Sphere(tuple(right.tolist()), rng.uniform(3e-3, 6e-3), **_material(rng))
    return Drawn([box, ball])


def needle(rng: np.random.Generator) -> Drawn:
    """A wire of 0.2 to 1 mm, 15 to 25 mm long."""
    axis = rng.normal(size=3) if rng.uniform() < 0.67 else np.eye(3)[rng.integers(3)]
    height, radius = rng.uniform(15e-3, 25e-3), log_uniform(rng, 0.1e-3, 0.5e-3)
    body = at.Cylinder(tuple(_middle(rng).tolist()), radius, height, tuple(axis.tolist()), **_material(rng))
    return Drawn([body])


def cylinder(rng: np.random.Generator) -> Drawn:
    """A cylinder from a coin to a rod."""
    radius, height = rng.uniform(2e-3, 7e-3), log_uniform(rng, 1e-3, 12e-3)
    axis, center = rng.normal(size=3).tolist(), _middle(rng).tolist()
    return Drawn([at.Cylinder(tuple(center), radius, height, tuple(axis), **_material(rng))])


def _ball(rng: np.random.Generator, radius: float, ratios: Ratios) -> Drawn:
    center = _middle(rng)
    return Drawn([cases.sphere(center.tolist(), radius, ratios, AIR)], Exact(center, radius, ratios))


def sphere(rng: np.random.Generator) -> Drawn:
    """A fluid ball, light or dense."""
    return _ball(rng, rng.uniform(2e-3, 9e-3), (log_uniform(rng, 0.05, 1e4), log_uniform(rng, 0.6, 10)))


def slow(rng: np.random.Generator) -> Drawn:
    """A ball of a fluid in which sound is slow."""
    return _ball(rng, rng.uniform(1e-3, 3e-3), (log_uniform(rng, 0.1, 100), log_uniform(rng, 0.3, 0.6)))


def _soft_body(
    rng: np.random.Generator, center: Vector, reach: float, material: dict[str, Any]
) -> at.Obstacle:
    """Draw a cuboid, cylinder, ball or ellipsoid in a reach [m] around a centre."""
    kind, sizes = rng.integers(4), rng.uniform(0.4 * reach, reach, 3)
    if kind == 0:
        return at.Box(center, tuple((1.1 * sizes).tolist()), _angles(rng), **material)
    if kind == 1:
        return at.Cylinder(
            center, 0.7 * sizes[0], 1.4 * sizes[1], tuple(rng.normal(size=3).tolist()), **material
        )
    if kind == 2:
        return at.Sphere(center, sizes[0], **material)
    ball = pyvista.ParametricEllipsoid(*(1e3 * sizes), u_res=40, v_res=40, w_res=40).clean().triangulate()
    return at.Mesh.from_surface(ball, scale=1e-3, rotation=_angles(rng), offset=center, **material)


def tissue(rng: np.random.Generator) -> Drawn:
    """One or two small bodies of fluids as foam, tissue, water and plastics are to air."""
    bodies: list[at.Obstacle] = []
    places = ((0.0,), (-6e-3, 6e-3))[rng.integers(2)]
    for side in places:
        ratios = log_uniform(rng, 3.0, 1e3), log_uniform(rng, 0.5, 5.0)
        material = {"density": ratios[0] * AIR.density, "sound_speed": ratios[1] * AIR.sound_speed}
        x, y, z = (_middle(rng) + np.array([side, 0.0, 0.0])).tolist()
        bodies.append(_soft_body(rng, (x, y, z), 4.4e-3 * (3 - len(places)), material))
    if len(bodies) == 1 and isinstance(body := bodies[0], at.Sphere):
        return Drawn(bodies, Exact(np.array(body.center), body.radius, ratios))
    return Drawn(bodies)


def _impedance(rng: np.random.Generator) -> complex:
    """Draw an impedance from soft to nearly rigid, with a phase of up to 70 degrees."""
    return cmath.rect(log_uniform(rng, 0.3, 20), rng.uniform(-1.2, 1.2))


def absorber(rng: np.random.Generator) -> Drawn:
    """A cuboid, plate, cylinder or ring whose surface has an impedance."""
    bodies = (block, plate, cylinder, torus)[rng.integers(4)](rng).bodies
    surface = {"rigid": False, "density": None, "sound_speed": None, "impedance": _impedance(rng)}
    return Drawn([replace(body, **surface) for body in bodies])


def lined(rng: np.random.Generator) -> Drawn:
    """A ball whose surface has an impedance."""
    return _ball(rng, rng.uniform(2e-3, 9e-3), _impedance(rng))


def touching(rng: np.random.Generator) -> Drawn:
    """Two cubes that touch at faces, edges or corners."""
    edges, middle = rng.uniform(4e-3, 8e-3, 2), _middle(rng)
    apart = edges.sum() / 2 * np.array([1, *(rng.uniform(size=2) < 0.5)])
    cubes = [(middle, np.full(3, edges[0])), (middle + apart, np.full(3, edges[1]))]
    return _placed(_angles(rng), cubes, _material(rng))


def torus(rng: np.random.Generator) -> Drawn:
    """A ring as a mesh."""
    tube = rng.uniform(0.8, 2.5)
    ring = pyvista.ParametricTorus(ringradius=rng.uniform(4, 7), crosssectionradius=tube, u_res=60, v_res=30)
    place = {"scale": 1e-3, "rotation": _angles(rng), "offset": tuple(_middle(rng).tolist())}
    return Drawn([at.Mesh.from_surface(ring.clean().triangulate(), **place, **_material(rng))])


def shell(rng: np.random.Generator) -> Drawn:
    """A hollow rigid ball with a wall of 0.3 to 3 mm; no sound enters."""
    radius, center = rng.uniform(6e-3, 11e-3), _middle(rng)
    within = radius - log_uniform(rng, 0.3e-3, 3e-3)
    balls = [pyvista.Icosphere(radius=each, nsub=5) for each in (radius, within)]
    outer, inner = (ball.faces.reshape(-1, 4)[:, 1:] for ball in balls)
    vertices = np.concatenate([ball.points for ball in balls]).astype(np.float64) + center
    surface = vertices, np.concatenate([outer, inner[:, ::-1] + len(balls[0].points)])
    # the ball of the same volume: facets are within the sphere
    same = radius * (balls[0].volume / (4 / 3 * math.pi * radius**3)) ** (1 / 3)
    return Drawn([at.Mesh.from_surface(surface, rigid=True)], Exact(center, same, None))


def voxels(rng: np.random.Generator) -> Drawn:
    """A rigid ball as a mask of voxels of 0.4 to 1.2 mm."""
    radius, edge, center = rng.uniform(6e-3, 11e-3), log_uniform(rng, 0.4e-3, 1.2e-3), _middle(rng)
    count = math.ceil(2 * radius / edge) + 3
    lower = center - edge * (count / 2 + rng.uniform(-0.5, 0.5, 3))
    places = np.stack(np.meshgrid(*[np.arange(count) + 0.5] * 3, indexing="ij"), axis=-1) * edge + lower
    mask = np.linalg.norm(places - center, axis=-1) < radius
    return Drawn([at.VoxelMask(mask, edge, tuple(lower.tolist()), rigid=True)], Exact(center, radius, None))


def shadow(rng: np.random.Generator) -> Drawn:
    """A rigid plate of 40 to 80 mm before all points."""
    size = (*rng.uniform(40e-3, 80e-3, 2).tolist(), float(rng.uniform(3e-3, 8e-3)))
    tilt = (*rng.uniform(0, 0.4, 2).tolist(), 0.0)
    return Drawn([at.Box((0.0, 0.0, 0.0), size, tilt, rigid=True)], behind=50e-3)


def room(rng: np.random.Generator) -> Drawn:
    """One or two bodies, some of which absorb, in front of one or two planes, some of which do."""
    bodies = (apart, absorber, block, touching)[rng.integers(4)](rng).bodies
    surface = np.concatenate([body.surface()[0].numpy() for body in bodies])
    planes = []
    for normal in rotation_matrix(_angles(rng)).numpy()[: rng.integers(1, 3)]:
        absorbs = rng.uniform() < 0.4  # which is refused next to bodies
        reflection = rng.uniform(-1, 1) if absorbs else 1.0
        behind = 45e-3 if absorbs else rng.uniform(1e-3, 8e-3) - float((surface @ normal).min())
        planes.append(at.Reflector(-behind * normal, normal, reflection))
    return Drawn(bodies, reflectors=planes)


FAMILIES: Mapping[str, Family] = {
    each.__name__: each
    for each in (
        *(plate, slit, corner, block, apart, needle, cylinder),
        *(sphere, slow, tissue, absorber, lined, touching, torus, shell, voxels, shadow, room),
    )
}


def scene_of(family: str, seed: int) -> tuple[at.Scene, torch.Tensor | None]:
    """Return a scene of three sources and three points around drawn bodies, and its exact matrix if known."""
    rng = np.random.default_rng([seed, *family.encode()])
    bodies, exact, behind, reflectors = FAMILIES[family](rng)
    places: list[Array] = []
    if behind is not None:
        across = rng.uniform(-behind / 3, behind / 3, (6, 2))
        places = [np.array([*xy, -behind if number < 3 else behind]) for number, xy in enumerate(across)]
    while len(places) < 6:
        direction = rng.normal(size=3)
        place = direction / np.linalg.norm(direction) * rng.uniform(18e-3, 34e-3)
        gaps = [float(body.signed_distance(torch.from_numpy(place)[None])) for body in bodies]
        gaps += [float((place - plane.point) @ plane.normal) for plane in reflectors]
        if min(gaps) > _CLEAR:
            places.append(place)
    array = at.TransducerArray(np.array(places[:3]), (1, 0, 0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", at.ScaleWarning)  # densities and sound speeds of no material
        scene = at.Scene(array, AIR, FREQUENCY, np.array(places[3:]), bodies, reflectors=reflectors)
    return scene, None if exact is None else cases.sphere_matrix(scene, *exact)
