"""Geometry on the grid: the material of every element, and the elements that surfaces intersect."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.distances import HALF_DIAGONAL, lattice_distances, located
from autdtorch.fdtd.assembly.edges import edges_of, reductions
from autdtorch.fdtd.assembly.element import FAR, LATTICE, InterfaceElements, Materials
from autdtorch.fdtd.assembly.interface import Bodies, interface_elements
from autdtorch.fdtd.assembly.smooth_faces import mean_gradient, roughness
from autdtorch.fdtd.grid import Grid
from autdtorch.fdtd.region import Fluid, Region, Shape, bounds
from autdtorch.fdtd.stencil import Stencil
from autdtorch.fdtd.turning import flat_faces
from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.progress import show_progress
from autdtorch.utils.threads import spread

# Density with which sound-hard bodies are assembled. Cells that stay almost uncoupled become sound-hard.
_SOUND_HARD_DENSITY = 1e5
# Distance by which bodies are grown, so that touching bodies leave no film of air between them
_CONTACT_GAP = 1e-9
_CHUNK = 8192  # Interface elements assembled at a time
# Depths below its surface at which a body must be there to be thick [cells]. Sound would pass through thinner
# walls of finite elements, whose vertices can belong to both sides.
_DEPTHS = np.array([1.2, 2.3, 3.5])
# Deviation [cells] of a signed distance from a quadratic one at which a second face is near
_ROUGH = 0.01
# Share of a rigid edge's reduction that edges of fluids have. With 0.15 and 0.3, tilted cubes of ratio
# 77 have errors of up to 2.4 and 2.7 % (15 mm) and 2.8 and 2.1 % (8 mm) at 1 mm.
_FLUID_REDUCTION = 0.3
_SAME = 1e-9  # Difference of distances [cells] up to which elements are alike
_LEAST_GRADIENT = 0.3  # Least mean gradient of a signed distance in an element with one surface


@dataclass(frozen=True)
class Elements:
    """Elements of a grid of (nx, ny, nz) cells."""

    materials: Materials  # density and mass of each material, air first
    # material of each element (nx - 1, ny - 1, nz - 1), of an interface element at its centre
    material: NDArray[np.int16]
    index: Index  # flat indices of the interface elements (n,), ascending
    interface: InterfaceElements  # their coupling coefficients and masses


@dataclass(frozen=True)
class _Union:
    """Union of consecutive bodies of one material."""

    shapes: tuple[Shape, ...]
    material: int
    continued: bool  # whether they continue through the boundary layers, unchanged from the interior
    aligned: bool  # whether all its faces are flat and parallel to the grid
    sound_hard: bool
    finite: bool  # whether finite elements represent its surface; of a fluid only the edges

    def distance(self, cell: Array, grid: Grid) -> Array:
        """Return the signed distance [cells] of positions (..., 3) in cells."""
        places = np.array(grid.origin) + grid.spacing * (grid.clip(cell) if self.continued else cell)
        each = [shape.signed_distance(torch.from_numpy(places)) for shape in self.shapes]
        distance = torch.stack(each).amin(dim=0).numpy() / grid.spacing - _CONTACT_GAP
        if self.continued:
            return np.asarray(distance)
        beyond = np.maximum(np.array(grid.first) - cell, cell - np.array(grid.last) + 1).max(axis=-1) + 0.5
        return np.asarray(np.maximum(distance, beyond))


def speed_factor(stencil: Stencil, speed_ratio: float) -> float:
    """Return the factor by which to divide masses, so that a wave in a material has the drive's frequency."""
    return stencil.symbol / stencil.isotropic_symbol(stencil.kappa / speed_ratio)


def flow_factor(kappa: float, speed_ratio: float) -> float:
    """Return the factor on a material's coupling and mass with which waves keep their flow at its surface.

    Where a wave of unit pressure and flow passes a grid, the discrete flow is sin(k) / k, with the material's
    own k. At oblique incidence the two normal k differ, but the ratio is unchanged to second order.
    """
    own = kappa / speed_ratio
    return math.sin(kappa) / kappa / (math.sin(own) / own)


def elements_of(region: Region, grid: Grid, stencil: Stencil) -> Elements:
    """Return the material of every element, set by the last body there, and the interface elements."""
    bodies, materials = _unions(region, stencil)
    material = np.zeros([cells - 1 for cells in grid.shape], np.int16)
    cut = np.zeros(material.shape, bool)
    for body in bodies:
        near, distance, inside = located(partial(body.distance, grid=grid), *_range(body, grid))
        own = tuple(near.T)
        material[tuple(near[distance < 0].T)] = material[tuple(inside.T)] = body.material
        cut[own] = (cut[own] | (distance < HALF_DIAGONAL)) & (distance > -HALF_DIAGONAL)
        cut[tuple(inside.T)] = False
    index = np.flatnonzero(cut)
    whole = np.where(cut, -1, material)
    return Elements(materials, material, index, _interface(bodies, index, whole, grid, materials, stencil))


def _unions(region: Region, stencil: Stencil) -> tuple[list[_Union], Materials]:
    """Return unions of consecutive bodies that share a material, and the materials."""
    air = region.fluid
    known: list[Fluid | None] = [air]
    unions: list[_Union] = []
    for body in region.bodies:
        if body.fluid not in known:
            known.append(body.fluid)
        aligned = flat_faces(body.shape).all_aligned(np.eye(3))
        own = _Union(
            (body.shape,),
            known.index(body.fluid),
            body.continued,
            aligned,
            body.fluid is None,
            not aligned and (body.fluid is None or body.fluid.density > air.density),
        )
        if unions and own == replace(unions[-1], shapes=own.shapes):
            unions[-1] = replace(own, shapes=(*unions[-1].shapes, body.shape))
        else:
            unions.append(own)
    density = np.full(len(known), _SOUND_HARD_DENSITY)
    factor, slowness = np.ones(len(known)), np.ones(len(known))
    for number, fluid in enumerate(known):
        if fluid is not None:
            ratio = fluid.sound_speed / air.sound_speed
            density[number] = fluid.density / air.density / flow_factor(stencil.kappa, ratio)
            factor[number], slowness[number] = speed_factor(stencil, ratio), 1 / ratio
    sound_hard = np.array([fluid is None for fluid in known])
    return unions, Materials(density, 1 / (density * factor), slowness, sound_hard)


def _range(body: _Union, grid: Grid) -> Index:
    """Return the first element around a body along each axis, and one past the last (2, 3)."""
    middle = [np.arange(cells - 1) + 0.5 for cells in grid.shape]
    lower, upper = bounds(body.shapes)
    ranges = []
    for axis, low, high in zip(range(3), lower - grid.spacing, upper + grid.spacing, strict=True):
        inside = middle[axis].clip(grid.first[axis], grid.last[axis] - 1)
        ranges.append(np.searchsorted(grid.origin[axis] + grid.spacing * inside, (low, high)))
    return np.array(ranges, np.int64).T


def _distances(bodies: list[_Union], first: Index, grid: Grid) -> Array:
    """Return distances (K, n, L) of bodies from the lattices of elements, by their first cells (n, 3)."""
    center = np.array(grid.origin) + grid.spacing * grid.clip(np.asarray(first + 0.5))
    distance = np.full((len(bodies), len(first), len(LATTICE)), FAR)
    for far, body in zip(distance, bodies, strict=True):
        lower, upper = bounds(body.shapes)
        near = ((center > lower - 2 * grid.spacing) & (center < upper + 2 * grid.spacing)).all(axis=1)
        if near.any():
            far[near] = lattice_distances(partial(body.distance, grid=grid), first[near])
    return distance


def _finite(
    bodies: list[_Union],
    distance: Array,
    first: Index,
    near_edge: NDArray[np.bool_],
    whole: NDArray[np.int16],
    grid: Grid,
) -> NDArray[np.bool_]:
    """Return whether finite elements represent bodies in elements (K, n); `whole` as in `_thick`.

    They do where a sound-hard body is thick enough, and at edges of a fluid without a thin sound-hard body.
    """
    near = np.asarray((np.abs(distance) < FAR).any(axis=2))
    finite, thin = near.copy(), np.zeros(len(first), bool)
    for body, own, level, here in zip(bodies, finite, distance, near, strict=True):
        own &= body.finite
        if body.sound_hard:
            own[own] = _thick(body, level[own], first[own], whole, grid)
            thin |= here & ~own
        else:
            own &= near_edge
            own[own] = roughness(level[own]) > _ROUGH
    hard = np.array([body.sound_hard for body in bodies])
    return np.asarray(finite & (hard[:, None] | ~thin))


def _thick(
    body: _Union, distance: Array, first: Index, whole: NDArray[np.int16], grid: Grid
) -> NDArray[np.bool_]:
    """Return whether a sound-hard body has one face in elements (n,), with enough of the body behind it.

    `whole` (nx - 1, ny - 1, nz - 1) is the material of elements that no surface intersects, else -1.
    """
    gradient, middle = mean_gradient(distance), distance.mean(axis=1)
    steep = np.linalg.norm(gradient, axis=1)  # small where the two faces of a plate cancel
    normal = gradient / np.maximum(steep, _LEAST_GRADIENT)[:, None]
    below = (middle[:, None] + _DEPTHS)[:, :, None] * normal[:, None]
    places = first[:, None] + 0.5 - below
    element = np.clip(places.astype(np.int64), 0, np.array(whole.shape) - 1)
    inside = whole[tuple(np.moveaxis(element, -1, 0))] == body.material
    inside[~inside] = body.distance(places[~inside], grid) < 0
    return np.asarray(inside.all(axis=1) & (steep > _LEAST_GRADIENT))


def _distinct(distance: Array, finite: NDArray[np.bool_], less: Array) -> tuple[Index, Index]:
    """Return the first of the elements (n,) that are alike, and the place of each (n,) among these.

    Along flat faces parallel to the grid, nearly all are alike.
    """
    count = len(less)
    parts = (np.moveaxis(distance, 1, 0) / _SAME, finite.T, less / _SAME)
    keys = np.concatenate([part.reshape(count, -1).round().astype(np.int64) for part in parts], axis=1)
    # sums modulo 2^64: keys that differ have the same sum once in 10^19
    sums = keys.view(np.uint64) @ np.random.default_rng(0).integers(
        2**64, size=keys.shape[1], dtype=np.uint64
    )
    _, first, place = np.unique(sums, return_index=True, return_inverse=True)
    return first, place


def _interface(
    bodies: list[_Union],
    index: Index,
    whole: NDArray[np.int16],
    grid: Grid,
    materials: Materials,
    stencil: Stencil,
) -> InterfaceElements:
    """Return the interface elements, at flat indices (n,); `whole` as in `_thick`."""
    none = np.zeros((0, 28)), np.zeros((0, 8)), np.zeros((0, 8), np.int64), np.zeros(0, bool)
    numbers = np.array([body.material for body in bodies], np.int64)
    aligned = np.array([body.aligned for body in bodies], bool)
    shapes = [shape for body in bodies for shape in body.shapes]
    edges = [
        replace(edge, reduction=edge.reduction * (1 if body.sound_hard else _FLUID_REDUCTION))
        for body in bodies
        if body.finite
        for shape in body.shapes
        for edge in edges_of(shape, [each for each in shapes if each is not shape])
    ]
    shape = tuple(cells - 1 for cells in grid.shape)

    def chunk(begin: int) -> InterfaceElements:
        first = np.stack(np.unravel_index(index[begin : begin + _CHUNK], shape), axis=-1)
        centers = np.array(grid.origin) + grid.spacing * (first + 0.5)
        less = reductions(edges, centers, grid.spacing)
        distance = _distances(bodies, first, grid)
        edged = np.asarray(less.any(axis=(1, 2)))
        finite = _finite(bodies, distance, first, edged, whole, grid)
        own, place = _distinct(distance, finite, less)
        near = Bodies(distance, numbers, aligned, finite, less).chosen(own)
        found = interface_elements(near, materials, stencil)
        progress.advance(len(first))
        return found.chosen(place)

    with show_progress(len(index), "measuring surfaces") as progress:
        parts = [InterfaceElements(*none), *spread(chunk, range(0, len(index), _CHUNK))]
    return InterfaceElements(*(np.concatenate(each) for each in zip(*parts, strict=True)))
