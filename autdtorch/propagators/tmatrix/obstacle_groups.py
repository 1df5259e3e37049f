"""The bodies of a scene: groups of obstacles whose circumscribed spheres neither overlap nor touch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch

from autdtorch.propagators.tmatrix.body_matrix import BodyMatrix
from autdtorch.scene.arrays import radii_of
from autdtorch.scene.obstacles import Obstacle, Sphere
from autdtorch.scene.obstacles.moving import circumscribed
from autdtorch.scene.scene import Scene
from autdtorch.utils.validation import LENGTH_TOLERANCE, invalid

_MOST_BODIES, _MOST_WAVES = 3, 2000
"""Bodies, and waves around all, up to which "auto" takes T-matrices."""


@dataclass(frozen=True, eq=False)
class ObstacleGroup:
    """Obstacles that scatter as one body.

    Attributes:
        numbers: ascending indices of the scene's obstacles.
        obstacles: these obstacles.
        center: of the circumscribed sphere (3,) [m].
        radius: of this sphere [m].
    """

    numbers: tuple[int, ...]
    obstacles: tuple[Obstacle, ...]
    center: torch.Tensor
    radius: float


def bodies_of(obstacles: Sequence[Obstacle]) -> list[ObstacleGroup]:
    """Return the bodies of obstacles: those whose spheres overlap are joined, until none do."""
    bodies = [_body(obstacles, (index,)) for index in range(len(obstacles))]
    while pair := next((pair for pair in combinations(bodies, 2) if _overlap(*pair)), None):
        joined = sorted(pair[0].numbers + pair[1].numbers)
        bodies = [body for body in bodies if body not in pair] + [_body(obstacles, tuple(joined))]
    return sorted(bodies, key=lambda body: body.numbers)


def has_closed_form(obstacles: Sequence[Obstacle]) -> bool:
    """Return whether T of a body has a closed form: a sphere."""
    return len(obstacles) == 1 and type(obstacles[0]) is Sphere


def enough_degrees(size: float, error: float) -> int:
    """Return the degree up to which waves reach a body of size ka, to a relative error.

    ka + 1.8 D^(2/3) (ka)^(1/3) for D digits (Song and Chew 2001, doi:10.1109/5.940280).
    """
    digits: float = max(-math.log10(error), 1.0)
    return math.ceil(size + 1.8 * math.pow(digits, 2 / 3) * math.pow(size, 1 / 3))


def waves_to_simulate(scene: Scene, error: float, most: int | None = None) -> int | None:
    """Return the number of waves, up to a relative error, of the bodies that have no closed form.

    With `most` it is None where T-matrices are not the quickest: for more waves than that, for points or
    transducers inside a body's sphere, for more than a few bodies or waves.
    """

    def waves(radius: float) -> int:
        return int((enough_degrees(scene.wavenumber * radius, error) + 1) ** 2)

    obstacles = scene.obstacles
    if most is not None:  # without circumscribed spheres, which take time
        unknown = [obstacle for obstacle in obstacles if not has_closed_form([obstacle])]
        if any(waves(max(np.subtract(obstacle.upper, obstacle.lower)) / 2) > most for obstacle in unknown):
            return None
    bodies = bodies_of(obstacles)
    for number, reflector in enumerate(scene.reflectors):
        if any(float(reflector.mirror.height(body.center)) < body.radius for body in bodies):
            if most is not None:
                return None
            accepted = f"needs the spheres around obstacles to be in front of reflector {number}; take box"
            raise invalid("method", "tmatrix", accepted)
    unknown_bodies = [body for body in bodies if not has_closed_form(body.obstacles)]
    simulated = sum(waves(body.radius) for body in unknown_bodies)
    if most is None:
        return simulated
    places = torch.cat([scene.control_points, scene.array.nodes.positions.reshape(-1, 3)])
    few = len(bodies) <= _MOST_BODIES and sum(waves(body.radius) for body in bodies) <= _MOST_WAVES
    return simulated if few and simulated <= most and are_outside(places, bodies).all() else None


def are_outside(points: torch.Tensor, bodies: Sequence[ObstacleGroup]) -> torch.Tensor:
    """Return which points (P, 3) [m] are outside the spheres of all bodies."""
    apart = torch.stack([(points - body.center).norm(dim=1) - body.radius for body in bodies])
    return (apart > LENGTH_TOLERANCE).all(dim=0)


def room_around(place: torch.Tensor, bodies: Sequence[ObstacleGroup | BodyMatrix], scene: Scene) -> float:
    """Return the distance [m] of a place (3,) [m] from some bodies' spheres, reflectors and transducers."""
    offsets, normals = place - scene.array.positions, scene.array.normals
    along, across = (offsets * normals).sum(dim=-1), torch.linalg.cross(offsets, normals).norm(dim=-1)
    apart = [float(torch.hypot(along, (across - radii_of(scene.array)).clamp_min(0)).min())]
    apart += [float((place - body.center).norm()) - body.radius for body in bodies]
    return min(apart + [float(reflector.mirror.height(place)) for reflector in scene.reflectors])


def _body(obstacles: Sequence[Obstacle], numbers: tuple[int, ...]) -> ObstacleGroup:
    group = tuple(obstacles[number] for number in numbers)
    return ObstacleGroup(numbers, group, *circumscribed(group))


def _overlap(one: ObstacleGroup, other: ObstacleGroup) -> bool:
    return float((one.center - other.center).norm()) <= one.radius + other.radius + LENGTH_TOLERANCE
