"""The bodies of a scene: groups of obstacles whose circumscribed spheres neither overlap nor touch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch

from autdtorch.analytic.spherical_waves import enough_degrees
from autdtorch.scene.medium import Medium
from autdtorch.scene.obstacles import Obstacle, Sphere
from autdtorch.scene.obstacles.moving import circumscribed
from autdtorch.scene.scene import Scene
from autdtorch.utils.validation import LENGTH_TOLERANCE

_MOST_BODIES, _MOST_WAVES = 3, 2000
"""Bodies, and waves around all, up to which "auto" takes T-matrices."""


@dataclass(frozen=True, eq=False)
class ObstacleGroup:
    """Obstacles that scatter as one body.

    Attributes:
        obstacles: ascending indices of the scene's obstacles.
        center: of the circumscribed sphere (3,) [m].
        radius: of this sphere [m].
    """

    obstacles: tuple[int, ...]
    center: torch.Tensor
    radius: float


def bodies_of(obstacles: Sequence[Obstacle]) -> list[ObstacleGroup]:
    """Return the bodies of obstacles: those whose spheres overlap are joined, until none do."""
    bodies = [_body(obstacles, (index,)) for index in range(len(obstacles))]
    while pair := next((pair for pair in combinations(bodies, 2) if _overlap(*pair)), None):
        joined = sorted(pair[0].obstacles + pair[1].obstacles)
        bodies = [body for body in bodies if body not in pair] + [_body(obstacles, tuple(joined))]
    return sorted(bodies, key=lambda body: body.obstacles)


def has_closed_form(obstacles: Sequence[Obstacle], medium: Medium) -> bool:
    """Return whether T of a body has a closed form: a sphere, in a medium without losses."""
    return len(obstacles) == 1 and type(obstacles[0]) is Sphere and medium.absorption == 0


def waves_to_simulate(scene: Scene, error: float) -> int:
    """Return the number of waves, up to a relative error, of the bodies that have no closed form."""
    simulated = [body for body in bodies_of(scene.obstacles) if not _has_closed_form(scene, body)]
    return sum(_waves(scene, body.radius, error) for body in simulated)


def fewer_waves(scene: Scene, error: float, runs: int) -> int | None:
    """Return `waves_to_simulate` if T-matrices take fewer simulations than so many runs, or else None.

    Points and transducers must be outside of all bodies, and bodies and waves few: more are slower.
    """
    unknown = [obstacle for obstacle in scene.obstacles if not has_closed_form([obstacle], scene.medium)]
    edges = [max(np.subtract(obstacle.upper, obstacle.lower)) for obstacle in unknown]
    if any(_waves(scene, edge / 2, error) > runs for edge in edges):  # without its circumscribed sphere
        return None
    bodies = bodies_of(scene.obstacles)
    places = torch.cat([scene.control_points, scene.array.nodes.positions.reshape(-1, 3)])
    many = (
        len(bodies) > _MOST_BODIES or sum(_waves(scene, body.radius, error) for body in bodies) > _MOST_WAVES
    )
    waves = sum(_waves(scene, body.radius, error) for body in bodies if not _has_closed_form(scene, body))
    return None if many or waves > runs or not are_outside(places, bodies).all() else waves


def are_outside(points: torch.Tensor, bodies: Sequence[ObstacleGroup]) -> torch.Tensor:
    """Return which points (P, 3) [m] are outside the spheres of all bodies."""
    apart = torch.stack([(points - body.center).norm(dim=1) - body.radius for body in bodies])
    return (apart > LENGTH_TOLERANCE).all(dim=0)


def _body(obstacles: Sequence[Obstacle], chosen: tuple[int, ...]) -> ObstacleGroup:
    return ObstacleGroup(chosen, *circumscribed([obstacles[index] for index in chosen]))


def _overlap(one: ObstacleGroup, other: ObstacleGroup) -> bool:
    return float((one.center - other.center).norm()) <= one.radius + other.radius + LENGTH_TOLERANCE


def _has_closed_form(scene: Scene, body: ObstacleGroup) -> bool:
    return has_closed_form([scene.obstacles[index] for index in body.obstacles], scene.medium)


def _waves(scene: Scene, radius: float, error: float) -> int:
    """Return the number of waves around a sphere, up to a relative error."""
    return int((enough_degrees(scene.wavenumber * radius, error) + 1) ** 2)
