"""What fills the grid: the material of every element, and which elements a surface cuts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from autdtorch.fdtd.grid import Grid
from autdtorch.fdtd.stencil import Stencil
from autdtorch.fdtd.surface import FAR, LATTICE, CutElements, Materials, cut_elements
from autdtorch.obstacles import Obstacle
from autdtorch.scene import Medium, Scene

Array = NDArray[np.float64]
Body = list[Obstacle]
"""Consecutive obstacles of one material, which need not be told apart."""

RIGID = 1e5
"""Density, relative to air, that rigid obstacles are assembled with; what it leaves open is then sealed."""

_REACH = 0.87
"""Half the diagonal of an element: a surface farther from its centre does not cut it [cells]."""

_TOUCHING = 1e-9
"""What obstacles are larger by [cells], so that two that touch leave no film of air, in whatever plane."""

_ELEMENTS_AT_ONCE = 4096


@dataclass(frozen=True)
class ElementMedium:
    """What fills the elements of a grid of (nx, ny, nz) cells.

    Attributes:
        materials: density and mass of each material, air first.
        rigid: which materials are rigid (m,).
        number: material of each element (nx - 1, ny - 1, nz - 1), for a cut one that of its centre.
        cut: flat indices of the cut elements (n,), ascending.
        elements: their bonds and masses.
    """

    materials: Materials
    rigid: NDArray[np.bool_]
    number: NDArray[np.int16]
    cut: NDArray[np.int64]
    elements: CutElements


def speed_factor(stencil: Stencil, speed_ratio: float) -> float:
    """Symbol of air over the symbol at the wavenumber of a material `speed_ratio` times as fast.

    Divided by it, the mass of a cell gives a wave in the material its right frequency.
    """
    return stencil.symbol / stencil.isotropic_symbol(stencil.kappa / speed_ratio)


def _flow_factor(kappa: float, speed_ratio: float) -> float:
    """What a material's bonds and mass are multiplied with for its impedance to be right beside air.

    The difference between two cells is a wave's slope times sin(k / 2) / (k / 2), with the material's own k:
    only where it is that of air do both sides agree on the flow between them.
    """
    return float(np.sinc(kappa / (2 * np.pi)) / np.sinc(kappa / speed_ratio / (2 * np.pi)))


def fill_elements(scene: Scene, grid: Grid, stencil: Stencil) -> ElementMedium:
    """Find the material of every element, and the bonds and masses of those that surfaces cut.

    Where obstacles overlap the later wins. Those that reach beyond the interior go on through the boundary
    layer as they leave the interior.
    """
    bodies, numbers, materials, rigid = _bodies(scene, stencil)
    centers = [
        _clamped(grid, axis, 0.5 + np.arange(grid.shape[axis] - 1, dtype=np.float64)) for axis in range(3)
    ]
    number = np.zeros([len(c) for c in centers], np.int16)
    cut = np.zeros(number.shape, bool)
    for body, own in zip(bodies, numbers, strict=True):
        for window, distance in _windows(body, centers, grid.spacing):
            number[window][distance < 0] = own
            cut[window] = (cut[window] | (distance < _REACH)) & (distance > -_REACH)
    index = np.flatnonzero(cut)
    return ElementMedium(
        materials, rigid, number, index, _cut(bodies, numbers, index, grid, materials, stencil)
    )


def _bodies(
    scene: Scene, stencil: Stencil
) -> tuple[list[Body], NDArray[np.int64], Materials, NDArray[np.bool_]]:
    """Obstacles joined where consecutive ones share a material, and the materials that there are."""
    air = scene.medium
    known: list[Medium | None] = [air]
    bodies: list[Body] = []
    numbers: list[int] = []
    for obstacle in scene.obstacles:
        material = None if obstacle.rigid else Medium(obstacle.density, obstacle.sound_speed)  # type: ignore[arg-type]
        if material not in known:
            known.append(material)
        own = known.index(material)
        if numbers and numbers[-1] == own:
            bodies[-1].append(obstacle)
        else:
            bodies.append([obstacle])
            numbers.append(own)
    density = [
        RIGID
        if m is None
        else m.density / air.density / _flow_factor(stencil.kappa, m.sound_speed / air.sound_speed)
        for m in known
    ]
    factor = [1.0 if m is None else speed_factor(stencil, m.sound_speed / air.sound_speed) for m in known]
    materials = Materials(np.array(density), 1 / (np.array(density) * np.array(factor)))
    return bodies, np.array(numbers, np.int64), materials, np.array([m is None for m in known])


def _clamped(grid: Grid, axis: int, cell: Array) -> Array:
    """Coordinates [m] of places in cells, moved into the interior: the layer repeats what it touches."""
    inside = np.clip(cell, grid.first[axis], grid.last[axis] - 1)
    return np.asarray(grid.origin[axis] + grid.spacing * inside)


def _distance(body: Body, points: Array, spacing: float) -> Array:
    """Signed distance (...) [cells] of points (..., 3) [m]."""
    places = torch.from_numpy(points)
    nearest = torch.stack([obstacle.signed_distance(places) for obstacle in body]).amin(dim=0)
    return np.asarray(nearest.numpy() / spacing - _TOUCHING)


def _windows(body: Body, centers: list[Array], spacing: float) -> Iterator[tuple[tuple[slice, ...], Array]]:
    """Slabs of elements around a body, with the signed distance [cells] of their centres."""
    lower = np.min([obstacle.lower for obstacle in body], axis=0) - spacing
    upper = np.max([obstacle.upper for obstacle in body], axis=0) + spacing
    ranges = [np.searchsorted(c, (low, high)) for c, low, high in zip(centers, lower, upper, strict=True)]
    for x in range(ranges[0][0], ranges[0][1]):
        window = (slice(x, x + 1), slice(*ranges[1]), slice(*ranges[2]))
        axes = (c[part] for c, part in zip(centers, window, strict=True))
        yield window, _distance(body, np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1), spacing)


def _cut(
    bodies: list[Body],
    numbers: NDArray[np.int64],
    index: NDArray[np.int64],
    grid: Grid,
    materials: Materials,
    stencil: Stencil,
) -> CutElements:
    parts = [CutElements(np.zeros((0, 28)), np.zeros((0, 8)), np.zeros((0, 8), np.int64))]
    shape = tuple(cells - 1 for cells in grid.shape)
    for start in range(0, len(index), _ELEMENTS_AT_ONCE):
        first = np.stack(np.unravel_index(index[start : start + _ELEMENTS_AT_ONCE], shape), axis=-1)
        points = np.stack([_clamped(grid, d, first[:, None, d] + LATTICE[:, d]) for d in range(3)], axis=-1)
        distance = np.full((len(bodies), *points.shape[:2]), FAR)
        for far, body in zip(distance, bodies, strict=True):
            low = np.min([obstacle.lower for obstacle in body], axis=0) - 2 * grid.spacing
            high = np.max([obstacle.upper for obstacle in body], axis=0) + 2 * grid.spacing
            near = ((points[:, 0] > low) & (points[:, 0] < high)).all(axis=1)
            if near.any():
                far[near] = _distance(body, points[near], grid.spacing)
        parts.append(cut_elements(distance, numbers, materials, stencil))
    return CutElements(
        np.concatenate([part.bonds for part in parts]),
        np.concatenate([part.mass for part in parts]),
        np.concatenate([part.number for part in parts]),
    )
