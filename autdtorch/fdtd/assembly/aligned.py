"""Elements at bodies whose faces are parallel to the grid.

The planes of all faces divide space into blocks of one material, which are exact. Elements between equal
planes along each axis are of one kind, and each kind is assembled once.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.layered_elements import layered_elements
from autdtorch.fdtd.assembly.prisms import prisms, stacked
from autdtorch.fdtd.assembly.reference_element import (
    VERTICES,
    InterfaceElements,
    Materials,
    tend_to_mean,
    uniform_coupling,
)
from autdtorch.fdtd.assembly.sections import MaterialKey, Prisms, Section
from autdtorch.fdtd.stencil import Stencil, places_of
from autdtorch.utils.array_types import AnyArray, Array, Index, triple
from autdtorch.utils.process import cached_property
from autdtorch.utils.spatial import distinct_cells, places_among

_ROUNDING = 1e-6  # Distance [cells] up to which planes are one
_LEAST_GAP = 0.05  # Width of a gap [cells] below which little passes
# Distance [cells] to which planes move from vertices: an edge then lies in an element
_OFF_VERTICES = 1e-5


class Parts(NamedTuple):
    """Parts of elements along an axis, each in one block and in one cell."""

    middle: Array  # their centres (n,) [cells]
    width: Array  # [cells] (n,)
    block: Index  # (n,)


@dataclass(frozen=True)
class Planes:
    """The planes across one axis, and the elements between them.

    A kind is a run of elements that touch equal blocks.
    """

    places: Array  # ascending coordinates of the planes (f,) [cells]
    first: Index  # kind's first block (k,)
    last: Index  # kind's last block (k,)
    begin: Index  # kind's first element (k,)
    kind: Index  # kind of each element (n,)

    @classmethod
    def among(cls, places: Array, elements: int) -> Planes:
        """Divide elements, from vertex i to vertex i + 1, among planes at `places` [cells]."""
        near = np.round(places)
        outward = np.where(near < elements / 2, -_OFF_VERTICES, _OFF_VERTICES)
        places = np.unique(np.where(np.abs(places - near) < _OFF_VERTICES, near + outward, places))
        places = places[np.diff(places, prepend=-np.inf) > _ROUNDING]
        number = np.arange(elements)
        first = np.searchsorted(places, number, side="right")
        last = np.searchsorted(places, number + 1, side="left")
        new = np.ones(elements, bool)
        new[1:] = (first[1:] != first[:-1]) | (last[1:] != last[:-1]) | (first[1:] != last[1:])
        begin = np.flatnonzero(new)
        return cls(places, first[begin], last[begin], begin, np.cumsum(new) - 1)

    def cuts(self, kind: int) -> Array:
        """Return the planes within a kind, relative to its first element [cells]."""
        return np.asarray(self.places[self.first[kind] : self.last[kind]] - self.begin[kind])

    @property
    def parts(self) -> Parts:
        """The parts into which the planes and the cells divide the elements."""
        ends = np.union1d(np.arange(2 * len(self.kind) + 1) / 2, self.places)
        middle = (ends[1:] + ends[:-1]) / 2
        return Parts(middle, np.diff(ends), np.searchsorted(self.places, middle, side="right"))

    @property
    def middles(self) -> Array:
        """A coordinate within each block (f + 1,) [cells]."""
        if not len(self.places):
            return np.zeros(1)
        ends = np.concatenate((self.places[:1] - 2, self.places, self.places[-1:] + 2))
        return np.asarray((ends[1:] + ends[:-1]) / 2)

    @property
    def centers(self) -> Index:
        """The block at the centre of each element (n,)."""
        return np.searchsorted(self.places, np.arange(len(self.kind)) + 0.5, side="right")

    @property
    def vertices(self) -> Index:
        """The block at each vertex (n + 1,), above a plane through it."""
        return np.searchsorted(self.places, np.arange(len(self.kind) + 1), side="right")


@dataclass(frozen=True, eq=False)
class MaterialBlocks:
    """Blocks of one material between planes along the axes of a grid."""

    planes: tuple[Planes, Planes, Planes]
    material: Index  # material of each block (f + 1, g + 1, h + 1)

    @classmethod
    def between(
        cls, places: Sequence[Array], elements: Sequence[int], material: Callable[[Array], Index]
    ) -> MaterialBlocks:
        """Divide (nx, ny, nz) elements by planes at `places` along each axis; see `Planes`.

        `material` returns the material (...) at positions (..., 3) [cells].
        """
        planes = triple(Planes.among(each, count) for each, count in zip(places, elements, strict=True))
        middles = np.meshgrid(*(each.middles for each in planes), indexing="ij")
        return cls(planes, material(np.stack(middles, axis=-1)))

    @cached_property
    def varied(self) -> NDArray[np.bool_]:
        """Mask (3, k, l, m) of the kinds of elements that vary along each axis."""
        return np.stack([varies(self.material, self.planes, axis) for axis in range(3)])

    def beside_gaps(self, closed: NDArray[np.bool_]) -> Index:
        """Return which of `closed` materials (m,) are beside gaps between these without a plane of vertices.

        Planes of bodies elsewhere may divide a gap.
        """
        beside = np.zeros(len(closed), bool)
        for axis, planes in enumerate(self.planes):
            blocks = np.moveaxis(self.material, axis, 2)
            walls, number = closed[blocks], np.arange(blocks.shape[2])
            before = np.maximum.accumulate(np.where(walls, number, -1), axis=2)
            after = np.minimum.accumulate(np.where(walls, number, len(number))[..., ::-1], axis=2)[..., ::-1]
            begin = np.append(planes.places, [math.inf, -math.inf])[before]
            end = np.append(-math.inf, np.append(planes.places, math.inf))[after]
            narrow = ~walls & (end - begin > _LEAST_GAP) & (np.floor(begin) == np.floor(end))
            row, column, _ = np.nonzero(narrow)
            for side in (before, after):
                beside[blocks[row, column, side[narrow]]] = True
        return np.flatnonzero(beside)

    def over_elements(self, of_kinds: AnyArray) -> AnyArray:
        """Return the values (nx, ny, nz) of all elements, from values (k, l, m) of their kinds."""
        for axis in (2, 1, 0):  # the last copies whole planes
            of_kinds = of_kinds.take(self.planes[axis].kind, axis=axis)
        return of_kinds

    def kinds_among(self, index: Index) -> tuple[Index, Index]:
        """Return the distinct kinds (k, 3) of elements at flat indices (n,), and the kind of each (n,)."""
        shape = self.varied.shape[1:]
        flat = self.over_elements(np.arange(math.prod(shape)).reshape(shape)).ravel()[index]
        distinct = distinct_cells(flat, math.prod(shape))
        place = places_among(distinct, math.prod(shape))[flat]
        return places_of(distinct, shape), place.astype(np.int64)

    @property
    def at_centers(self) -> Index:
        """Material at the centres of the elements of each kind (k, l, m)."""
        return np.asarray(self.material[np.ix_(*(each.centers[each.begin] for each in self.planes))])

    def at_vertices(self, cells: Index) -> Index:
        """Return the material (...) at cells (..., 3)."""
        return np.asarray(
            self.material[tuple(each.vertices[cells[..., axis]] for axis, each in enumerate(self.planes))]
        )


def varies(material: Index, planes: Sequence[Planes], axis: int) -> NDArray[np.bool_]:
    """Return whether kinds of elements, among planes along each axis, vary along one of them."""
    changes = np.diff(material, axis=axis) != 0
    for other, each in enumerate(planes):
        end = each.last + (other != axis)
        before = [(int(number == other), 0) for number in range(material.ndim)]
        sums = np.pad(np.cumsum(changes, axis=other, dtype=np.int64), before)
        changes = sums.take(end, axis=other) > sums.take(each.first, axis=other)
    return np.asarray(changes)


_RIGID_DENSITY = 1e12
# Stiffness added to elements at corners, relative to the difference of the mean of their slices from air
_STIFFER = 0.2


def aligned_elements(
    kinds: Index, blocks: MaterialBlocks, materials: Materials, stencil: Stencil
) -> InterfaceElements:
    """Return elements of each of the kinds (k, 3)."""
    coupling, mass = _coupling_and_mass(kinds, blocks, materials, stencil)
    for pair, some, part in _seams(kinds, blocks, materials):
        of_pair = np.isin(blocks.material, pair)
        singles = []
        for number in pair:
            single = replace(blocks, material=np.where(of_pair, number, blocks.material))
            singles.append(_coupling_and_mass(kinds[some], single, materials, stencil))
        tend_to_mean((coupling, mass), some, singles, part, materials.alike(*pair))
    first = np.stack([each.begin[kind] for each, kind in zip(blocks.planes, kinds.T, strict=True)], axis=-1)
    vertex = blocks.at_vertices(first[:, None] + VERTICES)
    flat = np.ones(len(kinds), bool)
    return InterfaceElements(coupling, mass, vertex, ~flat, flat, np.zeros((len(kinds), 0)))


def _seams(
    kinds: Index, blocks: MaterialBlocks, materials: Materials
) -> Iterator[tuple[tuple[int, int], Index, Array]]:
    """Yield pairs of fluids, the kinds at their seam that a third material touches, and their parts (n, 2).

    If they are alike, such elements tend to the mean of elements of each of the two.
    """
    fluids = np.flatnonzero(~materials.rigid & np.isin(np.arange(len(materials.rigid)), blocks.material))
    if len(fluids) < 2 or not len(kinds):
        return
    share = np.stack([_volumes(kind, blocks, len(materials.rigid)) for kind in kinds.tolist()])
    for pair in itertools.combinations(fluids.tolist(), 2):
        some = np.flatnonzero((share[:, pair] > 0).all(axis=1) & ((share > 0).sum(axis=1) > 2))
        if len(some):
            part = share[some][:, pair]
            yield pair, some, part / part.sum(axis=1, keepdims=True)


def _volumes(kind: Sequence[int], blocks: MaterialBlocks, count: int) -> Array:
    """Return the volume (count,) of each material in elements of a kind (3,)."""
    each = list(zip(blocks.planes, kind, strict=True))
    part = blocks.material[np.ix_(*(range(planes.first[k], planes.last[k] + 1) for planes, k in each))]
    x, y, z = (np.diff(np.concatenate(([0.0], planes.cuts(k), [1.0]))) for planes, k in each)
    return np.asarray(np.bincount(part.ravel(), np.einsum("i,j,k->ijk", x, y, z).ravel(), count), np.float64)


def _coupling_and_mass(
    kinds: Index, blocks: MaterialBlocks, materials: Materials, stencil: Stencil
) -> tuple[Array, Array]:
    """Return coupling (k, 28) and mass (k, 8) of elements of each of the kinds (k, 3)."""
    varied = np.stack([each[tuple(kinds.T)] for each in blocks.varied], axis=1)
    coupling, mass = np.zeros((len(kinds), 28)), np.zeros((len(kinds), 8))
    for axis in range(3):
        for make, mask in (
            # elements that do not vary have one layer
            (_layered, (varied[:, axis] | (axis == 0)) & (varied.sum(axis=1) == varied[:, axis])),
            (_prismatic, ~varied[:, axis] & (varied.sum(axis=1) == 2)),
        ):
            coupling[mask], mass[mask] = make(axis, kinds[mask], blocks, materials, stencil)
    corners = varied.all(axis=1)
    coupling[corners], mass[corners] = _cornered(kinds[corners], blocks, materials, stencil)
    return coupling, mass


def _layered(
    axis: int, kinds: Index, blocks: MaterialBlocks, materials: Materials, stencil: Stencil
) -> tuple[Array, Array]:
    """Return coupling (n, 28) and mass (n, 8) of kinds of elements (n, 3) that vary along an axis alone."""
    planes, across = blocks.planes[axis], [other for other in range(3) if other != axis]
    columns = np.moveaxis(blocks.material, axis, 2)
    most = int((planes.last - planes.first)[kinds[:, axis]].max(initial=0)) + 1
    width, layer = np.zeros((len(kinds), most)), np.zeros((len(kinds), most), np.int64)
    for number, kind in enumerate(kinds):
        first, last = planes.first[kind[axis]], planes.last[kind[axis]]
        place = tuple(blocks.planes[other].first[kind[other]] for other in across)
        ends = np.concatenate(([0.0], planes.cuts(kind[axis]), [1.0]))
        width[number, : last - first + 1] = np.diff(ends)
        layer[number] = columns[place][np.minimum(first + np.arange(most), last)]
    return layered_elements(axis, width, layer, _densities(materials), materials, stencil)


def _prismatic(
    axis: int, kinds: Index, blocks: MaterialBlocks, materials: Materials, stencil: Stencil
) -> tuple[Array, Array]:
    """Return coupling (n, 28) and mass (n, 8) of kinds of elements (n, 3) that do not vary along an axis."""
    planes = blocks.planes[axis]
    levels = planes.centers[planes.begin[kinds[:, axis]]][:, None].tolist()
    return _stacked(axis, kinds, levels, [np.ones(1)] * len(kinds), blocks, materials, stencil)


def _densities(materials: Materials) -> Array:
    """Return the densities (m,); rigid materials have one with which the thinnest sheet lets nothing pass."""
    return np.where(materials.rigid, _RIGID_DENSITY, materials.density)


def _key(materials: Materials) -> MaterialKey:
    return MaterialKey(
        tuple(_densities(materials).tolist()),
        tuple(materials.mass.tolist()),
        tuple(materials.rigid.tolist()),
    )


def _cornered(
    kinds: Index, blocks: MaterialBlocks, materials: Materials, stencil: Stencil
) -> tuple[Array, Array]:
    """Return coupling (n, 28) and mass (n, 8) of kinds of elements (n, 3) that vary along all axes.

    Along each axis an element is a stack of slices that do not vary along it. The element is the mean of the
    three stacks.
    """
    coupling, mass = np.zeros((len(kinds), 28)), np.zeros((len(kinds), 8))
    for axis, planes in enumerate(blocks.planes):
        levels = [range(planes.first[kind], planes.last[kind] + 1) for kind in kinds[:, axis]]
        widths = [np.diff(np.concatenate(([0.0], planes.cuts(kind), [1.0]))) for kind in kinds[:, axis]]
        stacks = _stacked(axis, kinds, levels, widths, blocks, materials, stencil)
        for total, part in zip((coupling, mass), stacks, strict=True):
            total += part / 3
    missing = 1 - coupling.sum(axis=1) / uniform_coupling(stencil).sum()
    return coupling * (1 + _STIFFER * np.maximum(missing, 0))[:, None], mass


def _stacked(
    axis: int,
    kinds: Index,
    levels: Sequence[Sequence[int]],
    widths: Sequence[Array],
    blocks: MaterialBlocks,
    materials: Materials,
    stencil: Stencil,
) -> tuple[Array, Array]:
    """Return coupling (n, 28) and mass (n, 8) of kinds of elements (n, 3), stacks of slices along an axis.

    A slice of an element is at a level, and has a width [cells]; see `stacked`.
    """
    across = [other for other in range(3) if other != axis]
    key = _key(materials)
    stacks = [
        [prisms(_section(blocks, axis, level, kind), key, stencil) for level in of_kind]
        for kind, of_kind in zip(kinds[:, across], levels, strict=True)
    ]
    coupling, mass = np.zeros((len(stacks), 28)), np.zeros((len(stacks), 8))
    layers = np.array([len(slices) for slices in stacks], np.int64)
    for count in np.unique(layers):
        rows = np.flatnonzero(layers == count).tolist()
        parts = zip(*(zip(*stacks[row], strict=True) for row in rows), strict=True)
        width = np.array([widths[row] for row in rows])
        coupling[rows], mass[rows] = stacked(width, Prisms(*map(np.array, parts)), axis, stencil)
    return coupling, mass


def _section(blocks: MaterialBlocks, axis: int, level: int, kind: Index) -> Section:
    """Return the section across an axis, at the level of one block, through elements of a kind (2,)."""
    planes = [each for other, each in enumerate(blocks.planes) if other != axis]
    place: list[slice | int] = [
        slice(each.first[k], each.last[k] + 1) for each, k in zip(planes, kind, strict=True)
    ]
    place.insert(axis, level)
    part, cuts = blocks.material[tuple(place)], []
    for along, (each, k) in enumerate(zip(planes, kind, strict=True)):
        faces = (np.diff(part, axis=along) != 0).any(axis=1 - along)
        cuts.append(tuple(each.cuts(k)[faces].tolist()))
        part = np.compress(np.append(True, faces), part, axis=along)
    return Section((cuts[0], cuts[1]), tuple(map(tuple, part.tolist())))
