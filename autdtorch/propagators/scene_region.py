"""The solver's region of a scene, and the walls that continue through its boundary layers."""

from __future__ import annotations

import logging
import math
from dataclasses import replace
from typing import cast

import numpy as np

from autdtorch.fdtd.region import Body, Fluid, Region
from autdtorch.fdtd.shapes import Shape
from autdtorch.scene.obstacles import Obstacle
from autdtorch.scene.scene import Scene
from autdtorch.utils.spatial import mean_thickness

logger = logging.getLogger(__name__)

# Ratio of sound speeds from which heavy bodies have no sharp resonances at the drive's frequency
_STIFF = 2.0
# Relative difference of a sphere from a rigid one, times its density ratio. Narrow resonances have up to half
# more, which is still less than the error of a grid at such a contrast.
_NEAR_RIGID = 1.4


def region_of(scene: Scene) -> Region:
    """Return the region of a scene; parallel walls across it continue through the boundary layers."""
    bodies = []
    for number, (obstacle, (_, continued)) in enumerate(zip(scene.obstacles, walls_of(scene), strict=True)):
        material = obstacle.fluid_at(scene.frequency)
        fluid = None if material is None else Fluid(*material)
        bodies.append(Body(obstacle, fluid, continued, obstacle.uncertainty, 0.0, obstacle.impedance, number))
    medium, positions = scene.medium, np.asarray(scene.array.positions.numpy())
    air = Fluid(medium.density, medium.sound_speed)
    return Region(
        air, scene.attenuation, scene.frequency, tuple(bodies), scene.domain, positions,
        tuple(one.mirror for one in scene.reflectors),
    )  # fmt: skip


def with_rigid(region: Region, tolerance: float) -> Region:
    """Return the region with its hard bodies rigid, where that changes the field by less than a tolerance.

    That is relative to the field in free space: errors count it (`rigid_errors`). A body that a later one
    may cut into keeps its material: what is left of it may be thin. No sound enters the cavities of rigid
    bodies, so they are filled.
    """
    bodies, hard = [], []
    for index, body in enumerate(region.bodies):
        whole = not any(_overlap(body.shape, later.shape) for later in region.bodies[index + 1 :])
        if body.fluid is not None and whole:
            difference = difference_from_rigid(body, region)
            if difference <= tolerance:
                hard.append(str(index))
                body = replace(body, fluid=None, rigid_error=difference)
        if body.fluid is None and whole:
            body = replace(body, shape=cast(Obstacle, body.shape).filled())
        bodies.append(body)
    if hard:
        logger.debug("obstacle %s is taken as rigid: the difference is below the tolerance", ", ".join(hard))
    return replace(region, bodies=tuple(bodies))


def _overlap(one: Shape, other: Shape) -> bool:
    """Return whether the bounding boxes of two shapes overlap."""
    apart = np.maximum(one.lower, other.lower) >= np.minimum(one.upper, other.upper)
    return not apart.any()


def difference_from_rigid(body: Body, region: Region) -> float:
    """Return the approximate relative difference between the fields of a fluid body and of a rigid one.

    For a density ratio m and an impedance ratio z, complex where the body absorbs, it moves in proportion to
    1 / |m| and yields in proportion to 1 / |z|. Through a wall of thickness d, 1 / (|m| k d) passes (mass
    law); here d is the mean thickness.
    """
    assert body.fluid is not None
    heavier = abs(body.fluid.density) / abs(region.fluid.density)
    stiffer = abs(body.fluid.sound_speed) / abs(region.fluid.sound_speed)
    if heavier <= 1 or stiffer < _STIFF:
        return math.inf
    thickness = mean_thickness(*(part.numpy() for part in body.shape.surface()))
    moved = 1 + 1 / (region.wavenumber * thickness)
    return float(_NEAR_RIGID * (moved + 1 / stiffer) / heavier)


def walls_of(scene: Scene) -> list[tuple[bool, bool]]:
    """Return whether each obstacle is a wall, and whether it continues through the boundary layers.

    A wall or slab is aligned with the axes, and crosses the domain on two axes at least. Those parallel to
    the first one continue. Other shapes were measured to be unstable in the layers, and so were edges where
    walls of two directions meet.
    """
    walls, normal = [], None
    for obstacle in scene.obstacles:
        corners = zip(obstacle.lower, obstacle.upper, *scene.domain, strict=True)
        ends = [axis for axis, (low, high, first, last) in enumerate(corners) if low > first or high < last]
        wall = obstacle.fills_bounds and len(ends) <= 1
        continued = wall and (not ends or normal in (None, ends[0]))
        walls.append((wall, continued))
        if continued and ends:
            normal = ends[0]
    return walls
