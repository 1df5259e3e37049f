"""Sections across bodies whose faces are parallel to the grid, and their elements without edges."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import label

from autdtorch.fdtd.assembly.element import coupling_by_edges
from autdtorch.fdtd.assembly.layers import long_wave_port, long_wave_shares
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array, Index

RING = 3  # Elements of a window on each side of its section
COLUMNS = np.array(list(itertools.product((0, 1), repeat=2)))  # Columns of an element (4, 2)
COLUMN_PAIRS = np.array(list(itertools.combinations(range(4), 2)))  # The six pairs of columns
# Number of sides between the columns of each pair
_SIDES = np.abs(COLUMNS[COLUMN_PAIRS[:, 0]] - COLUMNS[COLUMN_PAIRS[:, 1]]).sum(axis=1)
_ALONG_LINE = 32  # Points along a line between two columns for its mean density


class Kinds(NamedTuple):
    """Materials as tuples, which can be keys: density as assembled, mass of a cell, whether sound-hard."""

    density: tuple[float, ...]
    mass: tuple[float, ...]
    sound_hard: tuple[bool, ...]

    @property
    def mobility(self) -> Array:
        """Mobility of each material (m,), zero if sound-hard."""
        return np.where(self.sound_hard, 0, 1 / np.array(self.density))

    @property
    def masses(self) -> Array:
        """Mass of each material (m,), zero if sound-hard."""
        return np.where(self.sound_hard, 0, self.mass)


class Section(NamedTuple):
    """Elements across bodies, from (0, 0) to `size`. Blocks at its ends continue without end."""

    size: tuple[int, int]  # elements along both axes
    cuts: tuple[tuple[float, ...], tuple[float, ...]]  # places of the faces along both axes [cells]
    material: tuple[tuple[int, ...], ...]  # material of each block, (f + 1) by (g + 1)

    def blocks_at(self, x: Array, y: Array) -> tuple[Index, Index]:
        """Return the blocks at coordinates along both axes."""
        return np.searchsorted(self.cuts[0], x), np.searchsorted(self.cuts[1], y)

    def at_columns(self, x: int, y: int) -> Index:
        """Return the materials (4,) at the columns of an element."""
        places = np.array((x, y)) + COLUMNS
        return np.array(self.material)[self.blocks_at(*places.T)]

    def parts(self, x: int, y: int, sound_hard: Sequence[bool]) -> Index:
        """Return which part of an element each column (4,) is in, 0 for sound-hard material.

        Sound-hard material divides an element into parts.
        """
        *_, material = self.element(x, y)
        part, _ = label(~np.array(sound_hard)[material])
        return np.asarray(part[np.ix_((0, -1), (0, -1))].ravel(), np.int64)

    def ends(self, axis: int, begin: int) -> Array:
        """Return the ends of the blocks in the element that begins at a coordinate along an axis."""
        inner = [cut for cut in self.cuts[axis] if begin < cut < begin + 1]
        return np.array([begin, *inner, begin + 1.0])

    def element(self, x: int, y: int) -> tuple[Array, Array, Index]:
        """Return the ends of the blocks in an element along both axes, and their materials."""
        ends = self.ends(0, x), self.ends(1, y)
        middles = [(end[1:] + end[:-1]) / 2 for end in ends]
        return *ends, np.array(self.material)[np.ix_(*self.blocks_at(*middles))]


class Layered(NamedTuple):
    """An element that varies along one axis at most."""

    coupling: Array  # between its columns (6,)
    mass: Array  # of each column (2, 2)
    mobility: Array  # along each column (2, 2)


def uniform_columns(stencil: Stencil) -> Array:
    """Return the coupling (6,) between the columns of an element of air."""
    by_edges = coupling_by_edges(stencil)
    return np.asarray(2 * by_edges[_SIDES] + 2 * by_edges[_SIDES + 1])


def layered_element(section: Section, x: int, y: int, kinds: Kinds, stencil: Stencil) -> Layered | None:
    """Return an element for long waves, or None if it varies along both axes."""
    *ends, part = section.element(x, y)
    varied = [bool((np.diff(part, axis=axis) != 0).any()) for axis in (0, 1)]
    if all(varied):
        return None
    axis = int(varied[1])
    layers = part[:, 0] if axis == 0 else part[0]
    width, density = np.diff(ends[axis])[None], np.array(kinds.density)[None, layers]
    port, uniform = long_wave_port(width, density, np.ones_like(width)), uniform_columns(stencil)
    one, other = COLUMNS[COLUMN_PAIRS.T, axis]
    along = port.mobility[0, one] * (uniform[0] + uniform[2]) - port.link[0] * uniform[2]
    shares = np.expand_dims(long_wave_shares(width, density)[0], 1 - axis) / 2
    shares = np.repeat(shares, 2, axis=1 - axis)
    coupling = np.where(one != other, uniform * port.link[0], along)
    return Layered(coupling, shares @ kinds.masses[layers], shares @ kinds.mobility[layers])


def mean_densities(section: Section, x: int, y: int, kinds: Kinds) -> Array:
    """Return the mean densities (6,) along the lines between the columns of an element."""
    share = (np.arange(_ALONG_LINE) + 0.5) / _ALONG_LINE
    begin, end = (COLUMNS[COLUMN_PAIRS[:, side]][:, None] for side in (0, 1))
    places = np.array((x, y)) + begin + share[:, None] * (end - begin)
    block = section.blocks_at(places[..., 0], places[..., 1])
    return np.asarray(np.array(kinds.density)[np.array(section.material)[block]].mean(axis=1))
