"""Assembled boxes, kept for obstacles that only move: a box moves along, and nothing in it changes.

A box is assembled at a place of its own, its first cell at the origin, so that an obstacle's place does not
change the rounding: whether an assembly was kept changes no bit of a result.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch

from autdtorch.fdtd.grid import Grid, make_box
from autdtorch.fdtd.region import Body, Fluid, Region
from autdtorch.fdtd.stepping import Assembly, assemble_on
from autdtorch.fdtd.turning import turned
from autdtorch.scene.obstacles import Obstacle
from autdtorch.scene.obstacles.moving import is_movable, shifted
from autdtorch.utils.array_types import Array
from autdtorch.utils.validation import Vector

# Assemblies kept, and the most cells of their grids: they hold about 20 bytes a cell, 250 MB in all
_KEPT, _MOST_CELLS = 4, 3_000_000


@dataclass(frozen=True)
class _Box:
    """A box with its first cell at the origin, and what decides its assembly."""

    bodies: tuple[Body, ...]
    axes: tuple[Vector, ...]
    grid: Grid
    air: Fluid
    attenuation: float
    frequency: float
    dtype: torch.dtype
    time_step: float | None


def assembled_box(
    region: Region, axes: Array, spacing: float, dtype: torch.dtype, time_step: float | None
) -> Assembly:
    """Assemble the box of a region on a grid along `axes`, one a row (3, 3); see `stepping.assemble_on`."""
    part = turned(region, axes)
    grid = make_box(part, spacing)
    if math.prod(grid.shape) > _MOST_CELLS or not all(map(is_movable, region.shapes)):
        return assemble_on(grid, part, dtype, time_step)
    bodies = tuple(_moved(body, grid, axes) for body in region.bodies)
    here, air = replace(grid, origin=(0.0, 0.0, 0.0)), (region.fluid, region.attenuation, region.frequency)
    box = _Box(bodies, tuple(map(tuple, axes.tolist())), here, *air, dtype, time_step)
    return replace(_assembled(box), grid=grid)


def forget_assemblies() -> None:
    """Keep none of the assemblies so far, such as before a measurement of time."""
    _assembled.cache_clear()


@functools.lru_cache(_KEPT)
def _assembled(box: _Box) -> Assembly:
    everywhere, nowhere = ((-math.inf,) * 3, (math.inf,) * 3), np.zeros((0, 3))
    region = Region(box.air, box.attenuation, box.frequency, box.bodies, everywhere, nowhere)
    return assemble_on(box.grid, turned(region, np.array(box.axes)), box.dtype, box.time_step)


def _moved(body: Body, grid: Grid, axes: Array) -> Body:
    """Return a body as seen from the first cell of a grid along `axes`."""
    offset = torch.from_numpy(-np.array(grid.origin) @ axes)
    return replace(body, shape=shifted(cast(Obstacle, body.shape), offset))
