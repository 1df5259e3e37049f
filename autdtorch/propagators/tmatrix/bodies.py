"""The bodies of a scene: groups of obstacles whose circumscribed spheres neither overlap nor touch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import torch

from autdtorch.analytic.spherical_waves import enough_degrees
from autdtorch.scene.medium import Medium
from autdtorch.scene.obstacles import Obstacle, Sphere
from autdtorch.scene.obstacles.moving import circumscribed
from autdtorch.scene.scene import Scene
from autdtorch.utils.validation import LENGTH_TOLERANCE


@dataclass(frozen=True, eq=False)
class Body:
    """Obstacles that scatter as one body.

    Attributes:
        obstacles: ascending indices of the scene's obstacles.
        center: of the circumscribed sphere (3,) [m].
        radius: of this sphere [m].
    """

    obstacles: tuple[int, ...]
    center: torch.Tensor
    radius: float


def bodies_of(obstacles: Sequence[Obstacle]) -> list[Body]:
    """Return the bodies of obstacles: those whose spheres overlap are joined, until none do."""
    bodies = [_body(obstacles, (index,)) for index in range(len(obstacles))]
    while pair := next((pair for pair in combinations(bodies, 2) if _overlap(*pair)), None):
        joined = sorted(pair[0].obstacles + pair[1].obstacles)
        bodies = [body for body in bodies if body not in pair] + [_body(obstacles, tuple(joined))]
    return sorted(bodies, key=lambda body: body.obstacles)


def has_closed_form(obstacles: Sequence[Obstacle], medium: Medium) -> bool:
    """Return whether T of a body has a closed form: a sphere, in a medium without losses."""
    return len(obstacles) == 1 and type(obstacles[0]) is Sphere and medium.absorption == 0


def waves_to_simulate(scene: Scene, bodies: Sequence[Body], error: float) -> int:
    """Return the number of waves, up to a relative error, of the bodies that have no closed form."""
    simulated = [
        body
        for body in bodies
        if not has_closed_form([scene.obstacles[index] for index in body.obstacles], scene.medium)
    ]
    return waves_of(scene, simulated, error)


def fewest_waves(scene: Scene, error: float) -> int:
    """Return a lower limit of `waves_to_simulate`, from bounding boxes alone."""
    simulated = [one for one in scene.obstacles if not has_closed_form([one], scene.medium)]
    edges = [max(high - low for low, high in zip(one.lower, one.upper, strict=True)) for one in simulated]
    return max(((enough_degrees(scene.wavenumber * edge / 2, error) + 1) ** 2 for edge in edges), default=0)


def waves_of(scene: Scene, bodies: Sequence[Body], error: float) -> int:
    """Return the number of waves of bodies, up to a relative error."""
    return sum((enough_degrees(scene.wavenumber * body.radius, error) + 1) ** 2 for body in bodies)


def are_outside(points: torch.Tensor, bodies: Sequence[Body]) -> torch.Tensor:
    """Return which points (P, 3) [m] are outside the spheres of all bodies."""
    apart = torch.stack([(points - body.center).norm(dim=1) - body.radius for body in bodies])
    return (apart > LENGTH_TOLERANCE).all(dim=0)


def _body(obstacles: Sequence[Obstacle], chosen: tuple[int, ...]) -> Body:
    return Body(chosen, *circumscribed([obstacles[index] for index in chosen]))


def _overlap(one: Body, other: Body) -> bool:
    return float((one.center - other.center).norm()) <= one.radius + other.radius + LENGTH_TOLERANCE
