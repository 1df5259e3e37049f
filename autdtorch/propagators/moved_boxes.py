"""Assembled boxes, kept for obstacles that only move: a box moves along, and nothing in it changes.

A box is assembled at a place of its own, its first cell at the origin, so that an obstacle's place does not
change the rounding: whether an assembly was kept changes no bit of a result.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import replace
from typing import Any, cast

import numpy as np
import torch

from autdtorch.fdtd.grid import Grid, make_box
from autdtorch.fdtd.region import Body, Region
from autdtorch.fdtd.stepping import Assembly, assemble_on
from autdtorch.fdtd.turning import turned
from autdtorch.scene.obstacles import Box, Cylinder, Mesh, Obstacle, Sphere, VoxelMask
from autdtorch.utils.array_types import Array

# The attribute that places an obstacle; boxes of others are not kept
_PLACES = {Box: "center", Sphere: "center", Cylinder: "center", Mesh: "offset", VoxelMask: "origin"}
_DIGITS = 14  # Decimals of a place [m]: far above its rounding, far below what an element can show
_MOST_BYTES = 100_000_000  # Most memory of the assemblies kept


class _Kept:
    """The assemblies used last, by what decides them."""

    def __init__(self) -> None:
        self._assemblies: OrderedDict[Hashable, Assembly] = OrderedDict()
        self._lock = threading.Lock()

    def find(self, key: Hashable) -> Assembly | None:
        with self._lock:
            found = self._assemblies.get(key)
            if found is not None:
                self._assemblies.move_to_end(key)
            return found

    def keep(self, key: Hashable, assembly: Assembly) -> None:
        with self._lock:
            self._assemblies[key] = assembly
            while sum(map(_bytes, self._assemblies.values())) > _MOST_BYTES:
                self._assemblies.popitem(last=False)


_kept = _Kept()


def assembled_box(
    region: Region, axes: Array, spacing: float, dtype: torch.dtype, time_step: float | None
) -> Assembly:
    """Assemble the box of a region on a grid along `axes`, one a row (3, 3); see `stepping.assemble_on`."""
    part = turned(region, axes)
    grid = make_box(part, spacing)
    if any(type(body.shape) not in _PLACES for body in region.bodies):
        return assemble_on(grid, part, dtype, time_step)
    here = replace(grid, origin=(0.0, 0.0, 0.0))
    bodies = tuple(_moved(body, grid, axes) for body in region.bodies)
    air = region.fluid, region.attenuation, region.frequency
    key = bodies, air, axes.tobytes(), here, dtype, time_step
    assembly = _kept.find(key)
    if assembly is None:
        assembly = assemble_on(here, turned(replace(region, bodies=bodies), axes), dtype, time_step)
        _kept.keep(key, assembly)
    return replace(assembly, grid=grid)


def _moved(body: Body, grid: Grid, axes: Array) -> Body:
    """Return a body as seen from the first cell of a grid along `axes`."""
    name = _PLACES[type(body.shape)]
    place = np.array(getattr(body.shape, name)) - np.array(grid.origin) @ axes
    there: dict[str, Any] = {name: tuple(place.round(_DIGITS).tolist())}
    return replace(body, shape=replace(cast(Obstacle, body.shape), **there))


def _bytes(assembly: Assembly) -> int:
    coefficients, cells = assembly.coefficients, assembly.heterogeneous
    return coefficients.heterogeneous_weight.nbytes + cells.weight.nbytes + cells.sound_hard.nbytes
