"""Assembled boxes, which a body has in any scene and at any place."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch

from autdtorch.fdtd.grid import Grid, make_box
from autdtorch.fdtd.grouping import PlannedGrid
from autdtorch.fdtd.region import Body, Region
from autdtorch.fdtd.stepping import Assembly, assemble_on
from autdtorch.propagators.store import BODIES, key_of
from autdtorch.scene.obstacles import Obstacle
from autdtorch.scene.obstacles.moving import is_movable, shifted
from autdtorch.utils.array_types import Array

_CELL_BYTES = 20
"""Memory of an assembled cell [bytes]."""


@dataclass(frozen=True)
class _AssembledBox:
    """An assembled box with its first cell at the origin."""

    assembly: Assembly

    @property
    def nbytes(self) -> int:
        """Memory [bytes], about."""
        return _CELL_BYTES * math.prod(self.assembly.grid.shape)


def assembled_box(planned: PlannedGrid, dtype: torch.dtype, time_step: float | None) -> Assembly:
    """Assemble the box of a planned grid; see `stepping.assemble_on`.

    It is assembled with its first cell at the origin: for a body that moves it is the same, to the last bit.
    """
    region, axes = planned.part, planned.axes
    part = region.turned(axes)
    grid = make_box(part, planned.spacing, planned.extent)
    if not all(isinstance(shape, Obstacle) and is_movable(shape) for shape in region.shapes):
        return assemble_on(grid, part, dtype, time_step)
    bodies = tuple(_shifted(body, grid, axes) for body in region.bodies)
    here = replace(grid, origin=(0.0, 0.0, 0.0))

    def assembled() -> _AssembledBox:
        everywhere, nowhere = ((-math.inf,) * 3, (math.inf,) * 3), np.zeros((0, 3))
        still = Region(region.fluid, region.attenuation, region.frequency, bodies, everywhere, nowhere)
        return _AssembledBox(assemble_on(here, still.turned(axes), dtype, time_step))

    medium = region.fluid, region.attenuation, region.frequency
    key = key_of("box", bodies, axes, here, *medium, str(dtype), time_step)
    return replace(BODIES.get(key, assembled).assembly, grid=grid, region=part)


def _shifted(body: Body, grid: Grid, axes: Array) -> Body:
    """Return a body as seen from the first cell of a grid along `axes`."""
    offset = torch.from_numpy(-np.array(grid.origin) @ axes)
    return replace(body, shape=shifted(cast(Obstacle, body.shape), offset))
