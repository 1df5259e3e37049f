"""What fills the grid: the material of every element, and which elements a surface cuts."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.interface import FAR, LATTICE, InterfaceElements, Materials, interface_elements
from autdtorch.fdtd.grid import Grid
from autdtorch.fdtd.region import Fluid, Region, Shape
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.arrays import Array
from autdtorch.utils.progress import show_progress

logger = logging.getLogger(__name__)


RIGID = 1e5
"""Density, relative to air, that rigid obstacles are assembled with; what it leaves open is then sealed."""

_REACH = 0.87
"""Half the diagonal of an element: a surface farther from its centre does not cut it [cells]."""

_TOUCHING = 1e-9
"""What obstacles are larger by [cells], so that two that touch leave no film of air, in whatever plane."""

_ELEMENTS_AT_ONCE = 4096


@dataclass(frozen=True)
class Joined:
    """Consecutive bodies of one material, which need not be told apart.

    Attributes:
        shapes: the shapes it consists of.
        number: of its material.
        continued: whether it continues through the boundary layers, where it leaves the interior.
    """

    shapes: tuple[Shape, ...]
    number: int
    continued: bool

    @property
    def lower(self) -> Array:
        """Corner of the bounding box with the smallest coordinates (3,) [m]."""
        return np.asarray(np.array([shape.lower for shape in self.shapes]).min(axis=0))

    @property
    def upper(self) -> Array:
        """Corner of the bounding box with the largest coordinates (3,) [m]."""
        return np.asarray(np.array([shape.upper for shape in self.shapes]).max(axis=0))

    def distance(self, cell: Array, grid: Grid) -> Array:
        """Signed distance [cells] of places (..., 3) in cells."""
        places = np.array(grid.origin) + grid.spacing * (grid.clip(cell) if self.continued else cell)
        each = [shape.signed_distance(torch.from_numpy(places)) for shape in self.shapes]
        distance = torch.stack(each).amin(dim=0).numpy() / grid.spacing - _TOUCHING
        if self.continued:
            return np.asarray(distance)
        beyond = np.maximum(np.array(grid.first) - cell, cell - np.array(grid.last) + 1).max(axis=-1) + 0.5
        return np.asarray(np.maximum(distance, beyond))


@dataclass(frozen=True)
class Elements:
    """What fills the elements of a grid of (nx, ny, nz) cells.

    Attributes:
        materials: density and mass of each material, air first.
        rigid: which materials are rigid (m,).
        number: material of each element (nx - 1, ny - 1, nz - 1), for a cut one that of its centre.
        cut: flat indices of the cut elements (n,), ascending.
        elements: their coupling and masses.
    """

    materials: Materials
    rigid: NDArray[np.bool_]
    number: NDArray[np.int16]
    cut: NDArray[np.int64]
    elements: InterfaceElements


def speed_factor(stencil: Stencil, speed_ratio: float) -> float:
    """Symbol of air over the symbol at the wavenumber of a material `speed_ratio` times as fast.

    Divided by it, the mass of a cell gives a wave in the material its right frequency.
    """
    return stencil.symbol / stencil.isotropic_symbol(stencil.kappa / speed_ratio)


def flow_factor(kappa: float, speed_ratio: float) -> float:
    """What a material's coupling and mass are multiplied with for its impedance to be right beside air.

    Half-way between two cells a wave's slope is their difference over 2 sin(k / 2) / k, and its value their
    mean over cos(k / 2), with the material's own k: the grid's impedance is off by tan(k / 2) / (k / 2). For
    waves at an angle the two normal k differ, but to second order not the ratio of these factors.
    """
    air, own = kappa / 2, kappa / speed_ratio / 2
    return (math.tan(air) / air) / (math.tan(own) / own)


def elements_of(region: Region, grid: Grid, stencil: Stencil) -> Elements:
    """Find the material of every element, and the coupling and masses of those that surfaces cut.

    Where bodies overlap the later wins. Those that are `continued` go on through the boundary layer, as they
    leave the interior; others end before it.
    """
    bodies, materials, rigid = _bodies(region, stencil)
    number = np.zeros([cells - 1 for cells in grid.shape], np.int16)
    cut = np.zeros(number.shape, bool)
    for body in bodies:
        for window, distance in _windows(body, grid):
            number[window][distance < 0] = body.number
            cut[window] = (cut[window] | (distance < _REACH)) & (distance > -_REACH)
    index = np.flatnonzero(cut)
    return Elements(materials, rigid, number, index, _cut(bodies, index, grid, materials, stencil))


def _bodies(region: Region, stencil: Stencil) -> tuple[list[Joined], Materials, NDArray[np.bool_]]:
    """Bodies joined where consecutive ones share a material, and the materials that there are."""
    air = region.fluid
    known: list[Fluid | None] = [air]
    bodies: list[Joined] = []
    for body in region.bodies:
        if body.fluid not in known:
            known.append(body.fluid)
        kind = known.index(body.fluid), body.continued
        if bodies and kind == (bodies[-1].number, bodies[-1].continued):
            bodies[-1] = Joined((*bodies[-1].shapes, body.shape), *kind)
        else:
            bodies.append(Joined((body.shape,), *kind))
    density = [
        RIGID
        if m is None
        else m.density / air.density / flow_factor(stencil.kappa, m.sound_speed / air.sound_speed)
        for m in known
    ]
    factor = [1.0 if m is None else speed_factor(stencil, m.sound_speed / air.sound_speed) for m in known]
    materials = Materials(np.array(density), 1 / (np.array(density) * np.array(factor)))
    return bodies, materials, np.array([m is None for m in known])


def _windows(body: Joined, grid: Grid) -> Iterator[tuple[tuple[slice, ...], Array]]:
    """Slabs of elements around a body, with the signed distance [cells] of their centres."""
    middle = [np.arange(cells - 1) + 0.5 for cells in grid.shape]
    ranges = []
    for axis, low, high in zip(range(3), body.lower - grid.spacing, body.upper + grid.spacing, strict=True):
        inside = middle[axis].clip(grid.first[axis], grid.last[axis] - 1)
        ranges.append(np.searchsorted(grid.origin[axis] + grid.spacing * inside, (low, high)))
    for x in range(ranges[0][0], ranges[0][1]):
        window = (slice(x, x + 1), slice(*ranges[1]), slice(*ranges[2]))
        axes = (m[part] for m, part in zip(middle, window, strict=True))
        yield window, body.distance(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1), grid)


def _distances(bodies: list[Joined], first: NDArray[np.int64], grid: Grid) -> NDArray[np.float64]:
    """Distances (B, n, L) of bodies from the lattices of elements, by their first cells (n, 3)."""
    cell = first[:, None] + LATTICE
    center = np.array(grid.origin) + grid.spacing * grid.clip(np.asarray(first + 0.5))
    distance = np.full((len(bodies), *cell.shape[:2]), FAR)
    for far, body in zip(distance, bodies, strict=True):
        low, high = body.lower - 2 * grid.spacing, body.upper + 2 * grid.spacing
        near = ((center > low) & (center < high)).all(axis=1)
        if near.any():
            far[near] = body.distance(cell[near], grid)
    return distance


def _cut(
    bodies: list[Joined],
    index: NDArray[np.int64],
    grid: Grid,
    materials: Materials,
    stencil: Stencil,
) -> InterfaceElements:
    parts = [InterfaceElements(np.zeros((0, 28)), np.zeros((0, 8)), np.zeros((0, 8), np.int64))]
    numbers = np.array([body.number for body in bodies], np.int64)
    shape = tuple(cells - 1 for cells in grid.shape)
    with show_progress(len(index), "measuring surfaces") as progress:
        for start in range(0, len(index), _ELEMENTS_AT_ONCE):
            first = np.stack(np.unravel_index(index[start : start + _ELEMENTS_AT_ONCE], shape), axis=-1)
            parts.append(interface_elements(_distances(bodies, first, grid), numbers, materials, stencil))
            progress.advance(len(first))
    return InterfaceElements(
        np.concatenate([part.coupling for part in parts]),
        np.concatenate([part.mass for part in parts]),
        np.concatenate([part.number for part in parts]),
    )
