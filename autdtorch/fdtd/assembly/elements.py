"""Geometry on the grid: the material of every element, and the elements that surfaces intersect.

Signed distances are computed only around a surface, and in the elements that it cuts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from autdtorch.fdtd.assembly.aligned import MaterialBlocks, aligned_elements
from autdtorch.fdtd.assembly.edge_energy import changes
from autdtorch.fdtd.assembly.edges import Edge, edges_of, rims_of
from autdtorch.fdtd.assembly.interface import Bodies, interface_elements, is_near, left_by_fluids
from autdtorch.fdtd.assembly.losses import with_losses
from autdtorch.fdtd.assembly.near_surface import HALF_DIAGONAL, lattice_distances, near_surface
from autdtorch.fdtd.assembly.reference_element import (
    CORNERS,
    FAR,
    LATTICE,
    VERTICES,
    InterfaceElements,
    Materials,
)
from autdtorch.fdtd.assembly.smooth_faces import mean_gradient, roughness, unfolded, unfolded_from_beyond
from autdtorch.fdtd.assembly.surface_impedance import with_impedance, with_impedance_faces
from autdtorch.fdtd.assembly.thin_walls import Side, wall_sides
from autdtorch.fdtd.assembly.unions import (
    Union,
    measured,
    nearest_normals,
    rigid_distance,
    rigid_level,
    unions_of,
)
from autdtorch.fdtd.grid import Grid
from autdtorch.fdtd.region import Fluid, Region
from autdtorch.fdtd.shapes import Shape, bounds
from autdtorch.fdtd.stencil import Stencil, places_of
from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.process import one_library_thread, spread
from autdtorch.utils.progress import show_progress

_CHUNK = 4096  # Interface elements assembled at a time
# Depths below its surface [cells]: a body that contains points this deep is thick. Vertices inside a thinner
# wall can be near both of its sides.
_DEPTHS = np.array([1.0, 1.6, 2.2])
# Deviation [cells] of a signed distance from a quadratic one at which a second face is near
_ROUGH = 0.01
# Change of the stiffness at edges of fluids over that at rigid edges. With 0.15 and 0.3, tilted cubes of
# density ratio 77 have errors of up to 2.4 and 2.7 % (15 mm) and 2.8 and 2.1 % (8 mm) at 1 mm.
_FLUID_SHARE = 0.3
# Relative density from which a fluid in front of a rigid face leaves no edge there. Of a rigid tube of slabs
# around a fluid of three times the density of air, errors at 1.2 mm are 3 to 12 %, not 4 to 18 %.
_DENSE = 10.0
# Density, relative to air, of rigid bodies with a gap between centres of cells: little passes a millimetre.
# Sound in it is as fast as in air, so that time steps are as long.
_HEAVY = 1000.0
_SAME = 1e-9  # Difference of distances [cells] up to which elements are alike
_GROUND_GRADIENT = 0.3  # Least mean gradient of a signed distance in an element with one surface


@dataclass(frozen=True)
class Elements:
    """Elements of a grid of (nx, ny, nz) cells."""

    materials: Materials  # density and mass of each material, air first
    # material of each element (nx - 1, ny - 1, nz - 1), of an interface element at its centre
    material: NDArray[np.int16]
    index: Index  # flat indices of the interface elements (n,), ascending
    kind: Index  # the kind of each (n,): at flat faces many elements are equal
    interface: InterfaceElements  # coupling coefficients and masses of the kinds


@one_library_thread()  # fits of edges depend on the number of threads
def elements_of(region: Region, grid: Grid, stencil: Stencil) -> Elements:
    """Return the material of every element, set by the last body there, and the interface elements."""
    bodies, materials = unions_of(region, grid, stencil)
    blocks = _blocks_of_bodies(bodies, grid)
    hard = (materials.rigid & ~materials.reacting)[_materials_of_numbers(bodies)]
    if len(walls := blocks.beside_gaps(hard)):
        bodies, materials = unions_of(_with_heavy(region, walls - 1), grid, stencil)
    blocks = replace(blocks, material=_materials_of_numbers(bodies)[blocks.material])
    bodies = measured(bodies, grid.spacing)
    material, cut, beside = _measured(bodies, grid)
    material = np.where(beside, material, blocks.over_elements(blocks.at_centers.astype(np.int16)))
    cut = np.where(beside, cut, blocks.over_elements(np.any(blocks.varied, axis=0)))
    along = cut & ~beside
    if materials.reacting.any():
        # pressures in front of their faces are those of two cells
        along |= binary_dilation(along) & ~beside & ~materials.rigid[material]
    index = np.flatnonzero(along), np.flatnonzero(cut & beside)
    parts = [_aligned(index[0], ~cut, blocks, materials, stencil)]
    parts += _interface(bodies, index[1], np.where(cut, -1, material), grid, materials, stencil)
    count = np.cumsum([0] + [len(elements.mass) for elements, _ in parts])
    kind = np.concatenate([first + kinds for first, (_, kinds) in zip(count, parts, strict=False)])
    order = np.argsort(every := np.concatenate(index), kind="stable")  # of two runs
    interface = InterfaceElements.joined([elements for elements, _ in parts])
    return Elements(materials, material, every[order], kind[order], interface)


def _with_heavy(region: Region, some: Index) -> Region:
    """Return the region with some of its bodies of a heavy fluid, by their indices (k,).

    Cells of rigid bodies hold no sound. Beside a gap between centres of cells, those of a fluid hold what is
    in the gap.
    """
    heavy, bodies = Fluid(_HEAVY * region.fluid.inertia, region.fluid.phase_speed), list(region.bodies)
    for index in some.tolist():
        bodies[index] = replace(bodies[index], fluid=heavy)
    return replace(region, bodies=tuple(bodies))


def _aligned(
    index: Index, uncut: NDArray[np.bool_], blocks: MaterialBlocks, materials: Materials, stencil: Stencil
) -> tuple[InterfaceElements, Index]:
    """Return the kinds of the elements at flat indices (n,), and the kind of each (n,).

    These vary among blocks, or are `uncut` (nx - 1, ny - 1, nz - 1) in front of a surface with an impedance.
    """
    kinds, kind = blocks.kinds_among(index)
    elements = with_losses(lambda these: aligned_elements(kinds, blocks, these, stencil), materials, stencil)
    if not len(index) or not materials.reacting.any():
        return elements, kind
    here, shape = uncut.ravel()[index], uncut.shape
    every = with_impedance_faces(elements.chosen(kind), index, shape, here, blocks, materials, stencil)
    return every, np.arange(len(index))


def _materials_of_numbers(bodies: Sequence[Union]) -> Index:
    """Return the materials (n + 1,) of air and of the region's n bodies, in their order."""
    return np.array([0, *(body.material for body in bodies for _ in body.shapes)], np.int64)


def _blocks_of_bodies(bodies: Sequence[Union], grid: Grid) -> MaterialBlocks:
    """Return the blocks of the bodies whose faces are parallel to the grid.

    In place of materials they have the numbers of the region's bodies, from 1 on, and 0 in air.
    """
    parts = [part for body in bodies for part in body.parts()]
    aligned = [(number, part) for number, part in enumerate(parts, 1) if part.aligned]
    faces = [np.zeros((3, 0)), *(part.faces(grid) for _, part in aligned)]

    def body_at(cells: Array) -> Index:
        numbers = np.zeros(cells.shape[:-1], np.int64)
        for number, part in aligned:
            near = part.near(cells, grid)
            numbers[near][part.distance(cells[near], grid) < 0] = number
        return numbers

    places = [np.concatenate(along) for along in zip(*faces, strict=True)]
    return MaterialBlocks.between(places, [cells - 1 for cells in grid.shape], body_at)


def _measured(
    bodies: Sequence[Union], grid: Grid
) -> tuple[NDArray[np.int16], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the material at the centre of each element, whether a surface intersects it, and a mask.

    The mask has the elements beside a tilted or curved body. `_blocks_of_bodies` serves all others.
    """
    material = np.zeros([cells - 1 for cells in grid.shape], np.int16)
    cut, beside = np.zeros(material.shape, bool), np.zeros(material.shape, bool)
    if all(body.aligned for body in bodies):
        return material, cut, beside
    for body in bodies:
        near, distance, inside = near_surface(partial(body.distance, grid=grid), *body.range(grid))
        cells = tuple(near.T)
        material[tuple(near[distance < 0].T)] = material[tuple(inside.T)] = body.material
        cut[cells] = (cut[cells] | (distance < HALF_DIAGONAL)) & (distance > -HALF_DIAGONAL)
        cut[tuple(inside.T)] = False
        if not body.aligned:
            beside[tuple(near[distance < HALF_DIAGONAL].T)] = beside[tuple(inside.T)] = True
    return material, cut, beside


def _distances(bodies: list[Union], first: Index, grid: Grid) -> Array:
    """Return distances (K, n, L) of bodies from the lattices of elements, by their first cells (n, 3)."""
    center = np.array(grid.origin) + grid.spacing * grid.clip(np.asarray(first + 0.5))
    distance = np.empty((len(bodies), len(first), len(LATTICE)))
    for far, body in zip(distance, bodies, strict=True):
        lower, upper = bounds(body.shapes)
        near = ((center > lower - 2 * grid.spacing) & (center < upper + 2 * grid.spacing)).all(axis=1)
        far[~near] = FAR
        if near.any():
            measure = partial(body.distance, grid=grid)
            level = lattice_distances(measure, first[near])
            if not body.rigid:
                several = len(body.shapes) > 1
                level = unfolded_from_beyond(level, measure, first[near]) if several else unfolded(level)
            far[near] = level
    return distance


def _finite(
    bodies: list[Union],
    distance: Array,
    first: Index,
    near_edge: NDArray[np.bool_],
    whole: NDArray[np.int16],
    grid: Grid,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return a mask (K, n) of the bodies that finite elements represent, and elements with thin walls (n,).

    These are rigid bodies, and edges of fluids without a rigid body along the grid beside them. Where such a
    body crosses an element, no body is: sound would pass. `whole` as in `_thick`.
    """
    hard = np.array([body.rigid for body in bodies])
    near, left = is_near(distance), left_by_fluids(distance, hard)
    finite, thin, crossed = near.copy(), np.zeros(len(first), bool), np.zeros(len(first), bool)
    walls = np.zeros(len(first), bool)
    fluids = np.array([body.finite and not body.rigid for body in bodies])
    rough = near_edge.copy()
    if fluids.any() and rough.any():
        rough[rough] = roughness(unfolded(left[fluids][:, rough].min(axis=0))) > _ROUGH
    for body, mask, level, here in zip(bodies, finite, left, near, strict=True):
        if body.rigid and body.finite:
            walls[mask] |= ~_thick(bodies, level[mask], first[mask], whole, grid)
        elif body.rigid:
            crossed |= (level < 0).any(axis=1) & (level > 0).any(axis=1)
            thin |= here
        else:
            mask &= rough
        mask &= body.finite
    finite &= (hard[:, None] | ~thin) & ~crossed
    return finite, np.asarray(walls & finite.any(axis=0))


def _thick(
    bodies: list[Union], distance: Array, first: Index, whole: NDArray[np.int16], grid: Grid
) -> NDArray[np.bool_]:
    """Return whether a rigid body has one face in elements (n,), with enough rigid material behind it.

    A later fluid body may leave only a wall of it. `distance` (n, 125) is the body's signed distance.
    `whole` (nx - 1, ny - 1, nz - 1) is the material of elements that no surface intersects, else -1.
    """
    gradient, middle = mean_gradient(distance), distance.mean(axis=1)
    steep = np.linalg.norm(gradient, axis=1)  # small where the two faces of a plate cancel
    normal = gradient / np.maximum(steep, _GROUND_GRADIENT)[:, None]
    below = (middle[:, None] + _DEPTHS)[:, :, None] * normal[:, None]
    places = first[:, None] + 0.5 - below
    element = np.clip(places.astype(np.int64), 0, np.array(whole.shape) - 1)
    material = whole[tuple(np.moveaxis(element, -1, 0))]
    inside = np.isin(material, [body.material for body in bodies if body.rigid])
    cut = material < 0
    inside[cut] = rigid_distance(bodies, places[cut], grid) < 0
    return np.asarray(inside.all(axis=1) & (steep > _GROUND_GRADIENT))


def _wall_normals(
    bodies: list[Union], level: Array, first: Index, walls: NDArray[np.bool_], grid: Grid
) -> Array:
    """Return the normals (n, 8, 3) of the nearest faces at vertices inside thin rigid walls, else 0.

    Elements that share a vertex have the same one. It is 0 half-way between two faces. `level` (n, 125) is
    the signed distance from rigid bodies.
    """
    normal = np.zeros((len(first), 8, 3))
    row, vertex = np.nonzero((level[:, CORNERS] <= 0) & walls[:, None])
    if len(row):
        cells = (first[row] + VERTICES[vertex]).astype(np.float64)
        normal[row, vertex] = nearest_normals(bodies, cells, grid)
    return normal


def _distinct(
    distance: Array,
    finite: NDArray[np.bool_],
    less: Array,
    beside: NDArray[np.bool_],
    sides: Sequence[Side],
) -> tuple[Index, Index]:
    """Return the first of each kind of equal elements, and the kind of each element (n,)."""
    sums = _sums(distance[:, :, CORNERS].swapaxes(0, 1) / _SAME)
    _, kind, count = np.unique(sums, return_inverse=True, return_counts=True)
    some = np.flatnonzero(count[kind] > 1)  # few at curved surfaces
    outs = (side.out[some] for side in sides)
    between = distance[:, some].swapaxes(0, 1) / _SAME
    sums[some] = _sums(between, finite.T[some], less[some] / _SAME, beside[some], *outs)
    _, first, place = np.unique(sums, return_index=True, return_inverse=True)
    return first, place


def _sums(*parts: Array | NDArray[np.bool_]) -> NDArray[np.uint64]:
    """Return numbers (n,) of n elements with values (n, ...), which differ where rounded values do.

    They are sums modulo 2^64: rows that differ have the same sum once in 10^19.
    """
    rows = [part.reshape(len(part), -1).round().astype(np.int64) for part in parts if part.size]
    keys = np.concatenate(rows, axis=1) if rows else np.zeros((len(parts[0]), 0), np.int64)
    factors = np.random.default_rng(0).integers(2**64, size=keys.shape[1], dtype=np.uint64)
    return np.asarray(keys.view(np.uint64) @ factors)


def _interface(
    bodies: list[Union],
    index: Index,
    whole: NDArray[np.int16],
    grid: Grid,
    materials: Materials,
    stencil: Stencil,
) -> list[tuple[InterfaceElements, Index]]:
    """Return the kinds of the elements at flat indices (n,), and the kind of each, in parts of these.

    `whole` is as in `_thick`.
    """
    if not len(index):
        return []
    numbers = np.array([body.material for body in bodies], np.int64)
    edges: list[Edge] = [
        edge if body.rigid else replace(edge, share=_FLUID_SHARE)
        for body in bodies
        if body.finite
        for shape in body.shapes
        for edge in edges_of(shape, _covering(shape, body, bodies, materials))
    ]
    carved = [(shape, body) for body in bodies if body.finite or not body.rigid for shape in body.shapes]
    edges += rims_of(
        [shape for shape, _ in carved],
        [body.rigid for _, body in carved],
        [float(materials.density[body.material]) for _, body in carved],
        grid.spacing,
    )
    shape = tuple(cells - 1 for cells in grid.shape)

    def chunk(begin: int) -> tuple[InterfaceElements, Index]:
        first = places_of(index[begin : begin + _CHUNK], shape)
        centers = np.array(grid.origin) + grid.spacing * (first + 0.5)
        less, beside = changes(edges, centers, grid.spacing, stencil)
        distance = _distances(bodies, first, grid)
        edged = np.asarray(less.any(axis=(1, 2)))
        finite, walls = _finite(bodies, distance, first, edged, whole, grid)
        level = rigid_level(bodies, distance)
        sides = wall_sides(level, _wall_normals(bodies, level, first, walls, grid), walls)
        kinds, kind = _distinct(distance, finite, less, beside, sides)
        near = Bodies(distance, numbers, finite, less, beside, sides).chosen(kinds)
        elements = with_losses(lambda these: interface_elements(near, these, stencil), materials, stencil)
        elements = with_impedance(elements, near, materials, stencil)
        progress.advance(len(first))
        return elements, kind

    with show_progress(len(index), "measuring surfaces") as progress:
        return spread(chunk, range(0, len(index), _CHUNK))


def _covering(shape: Shape, body: Union, bodies: list[Union], materials: Materials) -> list[Shape]:
    """Return the shapes that leave no edge where they touch a shape of a body: more like it than like air."""
    enough = min(math.sqrt(materials.density[body.material]), _DENSE)
    covering = [each for each in bodies if materials.density[each.material] >= enough]
    return [each for other in covering for each in other.shapes if each is not shape]
