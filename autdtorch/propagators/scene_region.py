"""The solver's region of a scene, and the walls that continue through its boundary layers."""

from __future__ import annotations

import logging

import numpy as np

from autdtorch.fdtd.region import Body, Fluid, Region
from autdtorch.scene.obstacles import Box, Obstacle
from autdtorch.scene.scene import Scene

logger = logging.getLogger(__name__)


def region_of(scene: Scene) -> Region:
    """Return the region of a scene; parallel walls across it continue through the boundary layers."""
    bodies = []
    for one, continued in zip(scene.obstacles, _continued(scene), strict=True):
        density, speed = one.density, one.sound_speed
        fluid = None if density is None or speed is None else Fluid(density, speed)
        bodies.append(Body(one, fluid, continued))
    medium, positions = scene.medium, np.asarray(scene.array.positions.numpy())
    air = Fluid(medium.density, medium.sound_speed)
    return Region(air, scene.attenuation, scene.frequency, tuple(bodies), scene.domain, positions)


def _is_wall(scene: Scene, obstacle: Obstacle) -> bool:
    """Return whether an obstacle is an axis-aligned wall or slab across the domain on two axes at least."""
    aligned = isinstance(obstacle, Box) and obstacle.rotation == (0.0, 0.0, 0.0)
    return aligned and len(_ends(scene, obstacle)) <= 1


def warn_of_ending_walls(scene: Scene) -> None:
    """Log which walls end before the boundary layers because an earlier wall has another direction."""
    continued = zip(scene.obstacles, _continued(scene), strict=True)
    ending = [index for index, (one, goes_on) in enumerate(continued) if _is_wall(scene, one) and not goes_on]
    if ending:
        logger.warning(
            "obstacle %s crosses the domain in another direction than a wall before: it ends where the"
            " boundary layer begins, and its end reflects", ", ".join(map(str, ending)),
        )  # fmt: skip


def _ends(scene: Scene, obstacle: Obstacle) -> list[int]:
    """Return the axes on which an obstacle does not cross the whole domain."""
    corners = zip(obstacle.lower, obstacle.upper, *scene.domain, strict=True)
    return [axis for axis, (low, high, first, last) in enumerate(corners) if low > first or high < last]


def _continued(scene: Scene) -> list[bool]:
    """Return which obstacles continue through the boundary layers: walls parallel to the first one.

    Other shapes were measured to be unstable in the layers, and so were edges where walls of two directions
    meet.
    """
    continued, normal = [], None
    for obstacle in scene.obstacles:
        wall, ends = _is_wall(scene, obstacle), _ends(scene, obstacle)
        continued.append(wall and (not ends or normal in (None, ends[0])))
        if continued[-1] and ends:
            normal = ends[0]
    return continued
