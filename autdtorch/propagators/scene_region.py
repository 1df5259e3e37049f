"""The solver's region of a scene, and the walls that continue through its boundary layers."""

from __future__ import annotations

import logging

import numpy as np
import torch

from autdtorch.fdtd.region import Body, Fluid, Region
from autdtorch.scene.obstacles import Box
from autdtorch.scene.scene import Scene

logger = logging.getLogger(__name__)


def region_of(scene: Scene) -> Region:
    """Return the region of a scene; parallel walls across it continue through the boundary layers."""
    bodies = []
    for one, (_, continued) in zip(scene.obstacles, _walls(scene), strict=True):
        density, speed = one.density, one.sound_speed
        fluid = None if density is None or speed is None else Fluid(density, speed)
        bodies.append(Body(one, fluid, continued))
    medium, positions = scene.medium, np.asarray(scene.array.positions.numpy())
    air = Fluid(medium.density, medium.sound_speed)
    return Region(air, scene.attenuation, scene.frequency, tuple(bodies), scene.domain, positions)


def warn_of_ending_walls(scene: Scene) -> None:
    """Log which walls end before the boundary layers because an earlier wall has another direction."""
    walls = enumerate(_walls(scene))
    if ending := [str(index) for index, (wall, continued) in walls if wall and not continued]:
        logger.warning(
            "obstacle %s crosses the domain in another direction than a wall before: it ends where the"
            " boundary layer begins, and its end reflects", ", ".join(ending),
        )  # fmt: skip


def warn_of_near_points(scene: Scene, name: str, points: torch.Tensor, spacing: float) -> bool:
    """Log which points (P, 3) [m] are less than a cell from a surface, on either side; return whether any."""
    found = False
    for index, obstacle in enumerate(scene.obstacles):
        lower, upper = points.new_tensor([obstacle.lower, obstacle.upper])
        around = ((points > lower - spacing) & (points < upper + spacing)).all(dim=-1).nonzero()[:, 0]
        gap = obstacle.signed_distance(points[around]) if len(around) else points.new_zeros(0)
        if count := int((gap.abs() < spacing).sum()):
            found, nearest = True, int(gap.abs().argmin())
            point = int(around[nearest])
            logger.warning(
                "%s[%d] at %s mm is %.2g mm %s obstacle %d%s: less accurate within a cell, %.2g mm, of a"
                " surface", name, point, tuple(round(1e3 * entry, 3) for entry in points[point].tolist()),
                1e3 * abs(float(gap[nearest])), "inside" if gap[nearest] < 0 else "from", index,
                f", and {count - 1} more are near it" if count > 1 else "", 1e3 * spacing,
            )  # fmt: skip
    return found


def _walls(scene: Scene) -> list[tuple[bool, bool]]:
    """Return whether each obstacle is a wall, and whether it continues through the boundary layers.

    A wall or slab is aligned with the axes, and crosses the domain on two axes at least. Those parallel to
    the first one continue. Other shapes were measured to be unstable in the layers, and so were edges where
    walls of two directions meet.
    """
    found, normal = [], None
    for obstacle in scene.obstacles:
        corners = zip(obstacle.lower, obstacle.upper, *scene.domain, strict=True)
        ends = [axis for axis, (low, high, first, last) in enumerate(corners) if low > first or high < last]
        wall = isinstance(obstacle, Box) and obstacle.rotation == (0.0, 0.0, 0.0) and len(ends) <= 1
        continued = wall and (not ends or normal in (None, ends[0]))
        found.append((wall, continued))
        if continued and ends:
            normal = ends[0]
    return found
