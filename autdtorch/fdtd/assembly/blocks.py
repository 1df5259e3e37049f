"""Exact geometry of bodies whose faces are parallel to the grid: blocks of one material.

The planes of all faces divide space into blocks. Elements that lie alike among the planes are equal, so that
few differ: those between the same planes along each axis are one kind.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.cached import cached_property

_ROUNDING = 1e-6  # Distance [cells] up to which planes are one
# Distance [cells] to which planes move from vertices: an edge then lies in an element
_OFF_VERTICES = 1e-5


@dataclass(frozen=True)
class Planes:
    """The planes across one axis, and the elements by their place among them.

    A kind of elements is the run of those that touch the same blocks.
    """

    places: Array  # ascending coordinates of the planes (f,) [cells]
    first: Index  # kind's first block (k,)
    last: Index  # kind's last block (k,)
    begin: Index  # kind's first element (k,)
    kind: Index  # kind of each element (n,)

    @classmethod
    def among(cls, places: Array, elements: int) -> Planes:
        """Divide elements, from vertex i to vertex i + 1, among planes."""
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

    def cuts(self, kinds: slice | int) -> Array:
        """Return the planes within a kind, or a run of kinds, relative to its first element [cells]."""
        some = np.arange(len(self.begin))[kinds]
        first, last = (some, some) if np.ndim(some) == 0 else (some[0], some[-1])
        return np.asarray(self.places[self.first[first] : self.last[last]] - self.begin[first])

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
class Blocks:
    """Blocks of one material between planes along the axes of a grid."""

    planes: tuple[Planes, Planes, Planes]
    material: Index  # material of each block (f + 1, g + 1, h + 1)

    @classmethod
    def between(
        cls, places: Sequence[Array], elements: Sequence[int], material: Callable[[Array], Index]
    ) -> Blocks:
        """Divide (nx, ny, nz) elements by planes at `places` along each axis; see `Planes`.

        `material` returns the material (...) at positions (..., 3) [cells].
        """
        x, y, z = (Planes.among(each, count) for each, count in zip(places, elements, strict=True))
        middles = np.stack(np.meshgrid(x.middles, y.middles, z.middles, indexing="ij"), axis=-1)
        return cls((x, y, z), material(middles))

    @cached_property
    def varied(self) -> NDArray[np.bool_]:
        """Whether elements of each kind (3, k, l, m) vary along each axis."""
        return np.stack([varies(self.material, self.planes, axis) for axis in range(3)])

    @property
    def kinds(self) -> tuple[Index, Index, Index]:
        """Kinds of the elements along each axis, to index arrays of kinds (k, l, m) with."""
        x, y, z = np.ix_(*(each.kind for each in self.planes))
        return x, y, z

    def kinds_of(self, first: Index) -> Index:
        """Return the kinds (n, 3) of elements by their first cells (n, 3)."""
        return np.stack([each.kind[own] for each, own in zip(self.planes, first.T, strict=True)], axis=-1)

    @property
    def at_centers(self) -> Index:
        """Material at the centre of each element (nx, ny, nz)."""
        return np.asarray(self.material[np.ix_(*(each.centers for each in self.planes))])

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
