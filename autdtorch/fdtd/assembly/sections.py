"""Sections across bodies whose faces are parallel to the grid, and the fields of long waves in them.

The fields in a window around a section are solved by finite elements, on a mesh that is graded towards the
edges, where fields are singular. At the window's rim they are the smoothest that the materials allow.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.ndimage import label
from scipy.sparse import coo_array, csr_array
from scipy.sparse.linalg import splu

from autdtorch.fdtd.assembly.layered_elements import long_wave_port, long_wave_shares, two_port
from autdtorch.fdtd.assembly.reference_element import coupling_by_edges
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array, Index

RING = 3  # Elements of a window on each side of the one at the edge
COLUMNS = np.array(list(itertools.product((0, 1), repeat=2)))  # Columns of an element (4, 2)
COLUMN_PAIRS = np.array(list(itertools.combinations(range(4), 2)))  # The six pairs of columns
# Number of sides between the columns of each pair
SIDES = np.abs(COLUMNS[COLUMN_PAIRS[:, 0]] - COLUMNS[COLUMN_PAIRS[:, 1]]).sum(axis=1)
_ALONG_LINE = 32  # Points along a line between two columns for its mean density


class MaterialKey(NamedTuple):
    """Materials as tuples, which can be a key of caches."""

    density: tuple[float, ...]  # as assembled
    mass: tuple[float, ...]  # mass of a cell
    rigid: tuple[bool, ...]

    @property
    def mobility(self) -> Array:
        """Mobility of each material (m,), zero if rigid."""
        return np.where(self.rigid, 0, 1 / np.array(self.density))

    @property
    def masses(self) -> Array:
        """Mass of each material (m,), zero if rigid."""
        return np.where(self.rigid, 0, self.mass)


class Section(NamedTuple):
    """An element across bodies, from (0, 0) to (1, 1); the blocks at its ends are infinite."""

    cuts: tuple[tuple[float, ...], tuple[float, ...]]  # places of the faces along both axes [cells]
    material: tuple[tuple[int, ...], ...]  # material of each block, (f + 1) by (g + 1)

    def blocks_at(self, x: Array, y: Array) -> tuple[Index, Index]:
        """Return the blocks at coordinates along both axes."""
        return np.searchsorted(self.cuts[0], x), np.searchsorted(self.cuts[1], y)

    @property
    def at_columns(self) -> Index:
        """The materials (4,) at its columns."""
        return np.array(self.material)[self.blocks_at(*COLUMNS.T)]

    def parts(self, rigid: Sequence[bool]) -> Index:
        """Return the part of it, between rigid materials, that holds each column (4,), else 0."""
        part, _ = label(~np.array(rigid)[np.array(self.material)])
        return np.asarray(part[np.ix_((0, -1), (0, -1))].ravel(), np.int64)

    def ends(self, axis: int, begin: int) -> Array:
        """Return the ends of the blocks in the element that begins at a coordinate along an axis."""
        inner = [cut for cut in self.cuts[axis] if begin < cut < begin + 1]
        return np.array([begin, *inner, begin + 1.0])

    def element(self, x: int, y: int) -> tuple[Array, Array, Index]:
        """Return the ends of the blocks in the element at (x, y) along both axes, and their materials."""
        ends = self.ends(0, x), self.ends(1, y)
        middles = [(end[1:] + end[:-1]) / 2 for end in ends]
        return *ends, np.array(self.material)[np.ix_(*self.blocks_at(*middles))]


class Prisms(NamedTuple):
    """The element of a section, one cell long."""

    coupling: Array  # of the `COLUMN_PAIRS` (6,)
    mass: Array  # of each column (2, 2)
    mobility: Array  # along each column (2, 2)


def uniform_columns(stencil: Stencil) -> Array:
    """Return the coupling (6,) between the columns of an element of air."""
    by_edges = coupling_by_edges(stencil)
    return np.asarray(2 * by_edges[SIDES] + 2 * by_edges[SIDES + 1])


def layered_element(
    section: Section, x: int, y: int, materials: MaterialKey, stencil: Stencil, air: float | None = None
) -> Prisms | None:
    """Return the element at (x, y) in the window, or None if it varies along both axes.

    It is for long waves, or for a wavenumber `air` [rad/cell] if its materials are air or rigid.
    """
    *ends, part = section.element(x, y)
    varied = [bool((np.diff(part, axis=axis) != 0).any()) for axis in (0, 1)]
    if all(varied):
        return None
    axis = int(varied[1])
    layers = part[:, 0] if axis == 0 else part[0]
    width, density = np.diff(ends[axis])[None], np.array(materials.density)[None, layers]
    port, uniform = long_wave_port(width, density, np.ones_like(width)), uniform_columns(stencil)
    shares = long_wave_shares(width, density)[0]
    mass, mobility = shares @ materials.masses[layers], shares @ materials.mobility[layers]
    if air is not None:
        port = two_port(width, density, np.full_like(width, air), air)
        mass = port.thickness[0] * materials.masses[layers[[0, -1]]]
    one, other = COLUMNS[COLUMN_PAIRS.T, axis]
    along = port.mobility[0, one] * (uniform[0] + uniform[2]) - port.link[0] * uniform[2]
    coupling = np.where(one != other, uniform * port.link[0], along)
    of_columns = [np.expand_dims(part, 1 - axis).repeat(2, axis=1 - axis) / 2 for part in (mass, mobility)]
    return Prisms(coupling, *of_columns)


def mean_densities(section: Section, materials: MaterialKey) -> Array:
    """Return the mean densities (6,) along the lines between the columns of a section."""
    share = (np.arange(_ALONG_LINE) + 0.5) / _ALONG_LINE
    begin, end = (COLUMNS[COLUMN_PAIRS[:, side]][:, None] for side in (0, 1))
    places = begin + share[:, None] * (end - begin)
    block = section.blocks_at(places[..., 0], places[..., 1])
    return np.asarray(np.array(materials.density)[np.array(section.material)[block]].mean(axis=1))


# Elements of the mesh on each side of a section: more than those of the window, in which fields are smoother
_REACH = 5
# Lines of the mesh on each side of a face: distance of the farthest [cells], ratio of successive distances,
# number of lines, and least distance from other lines over the distance from the face
_FARTHEST, _NEARER, _LINES, _APART = 0.5, 0.4, 6, 0.6
_RIM_STEP = 0.25  # Distance of the points that determine the fields at the rim [cells]
_ROUNDING = 1e-9  # Distance of lines that are one [cells]
# Quadratic elements of unit length: stiffness, mass and integral
_STIFFNESS = np.array([[7, -8, 1], [-8, 16, -8], [1, -8, 7]]) / 3
_MASS = np.array([[4, 2, -1], [2, 16, 2], [-1, 2, 4]]) / 30
_INTEGRAL = np.array([1, 4, 1]) / 6
_ALONG_X = np.einsum("ab,cd->acbd", _STIFFNESS, _MASS).reshape(9, 9)
_ALONG_Y = np.einsum("ab,cd->acbd", _MASS, _STIFFNESS).reshape(9, 9)


class PlaneFields(NamedTuple):
    """m fields of long waves in the window around a section; the first one is constant."""

    values: Array  # at the vertices of the window's elements (p, p, m); zero in rigid materials
    present: NDArray[np.bool_]  # mask of the vertices outside rigid materials (p, p)
    order: Array  # power of the distance with which each field grows (m,)
    lines: tuple[Array, Array]  # lines of the mesh, in the coordinates of the section
    material: Index  # material of each cell of the mesh (c, d)
    integrals: Array  # integral of each field over each cell of the mesh (c, d, m)

    def over_section(self, weight: Array) -> Array:
        """Return the integrals (m,) over the section, with a weight for each material."""
        (first, last), (low, high) = (
            np.searchsorted(line, (-_ROUNDING, 1 - _ROUNDING)) for line in self.lines
        )
        weights = weight[self.material[first:last, low:high]]
        return np.asarray(np.einsum("cd,cdm->m", weights, self.integrals[first:last, low:high]))


def plane_fields(section: Section, mobility: Array, count: int) -> PlaneFields:
    """Return the constant field and `count` others, by the mobility of each material, zero if rigid."""
    x, y = (_mesh_lines(np.array(cuts)) for cuts in section.cuts)
    middles = [(line[1:] + line[:-1]) / 2 for line in (x, y)]
    material = np.array(section.material)[np.ix_(*section.blocks_at(*middles))]
    nodes = [np.sort(np.concatenate(pair)) for pair in zip((x, y), middles, strict=True)]
    shape = len(nodes[0]), len(nodes[1])
    width, height = np.diff(x)[:, None], np.diff(y)[None, :]
    first = 2 * np.arange(len(width))[:, None] * shape[1] + 2 * np.arange(height.size)
    number = first[:, :, None] + (np.arange(3)[:, None] * shape[1] + np.arange(3)).ravel()
    matrix = _stiffness(number, mobility[material], width, height, shape)
    used, rim = np.zeros(shape, bool), np.ones(shape, bool)
    used.ravel()[number[mobility[material] > 0]] = True
    rim[1:-1, 1:-1] = False
    fixed, free = (used & rim).ravel(), (used & ~rim).ravel()
    outside, order = _rim_fields(section, mobility, nodes, count)
    field = np.zeros((used.size, len(order)))
    field[:, 0] = used.ravel()
    field[fixed, 1:] = outside.reshape(used.size, -1)[fixed]
    if len(order) > 1:
        field[free, 1:] = _solved(matrix[free][:, free], matrix[free][:, fixed] @ -field[fixed, 1:])
    share = width[:, :, None] * height[:, :, None] * np.outer(_INTEGRAL, _INTEGRAL).ravel()
    vertices = np.arange(-RING, RING + 2) - _ROUNDING
    at = np.ix_(*(np.searchsorted(each, vertices) for each in nodes))
    return PlaneFields(
        field.reshape(*shape, -1)[at],
        used[at],
        order,
        (x, y),
        material,
        np.einsum("cdn,cdnm->cdm", share, field[number], optimize=True),
    )


def _mesh_lines(cuts: Array) -> Array:
    """Return the lines of the mesh along an axis: vertices, faces, and lines graded towards the faces."""
    fixed = np.unique(np.concatenate((np.arange(-_REACH, _REACH + 2.0), cuts)))
    distance = _FARTHEST * _NEARER ** np.arange(_LINES)
    lines = [fixed]
    for cut in cuts:
        graded = cut + np.concatenate((-distance, distance))
        others = fixed[fixed != cut]
        gap = np.abs(graded[:, None] - others).min(axis=1)
        lines.append(graded[gap > _APART * np.abs(graded - cut)])
    return _distinct(np.concatenate(lines))


def _distinct(places: Array) -> Array:
    """Return places in ascending order, those within rounding once."""
    places = np.unique(places)
    return places[np.diff(places, prepend=-np.inf) > _ROUNDING]


def _stiffness(
    number: Index, mobility: Array, width: Array, height: Array, shape: tuple[int, int]
) -> csr_array:
    """Return the stiffness matrix of biquadratic elements with nodes `number` (c, d, 9)."""
    used = mobility > 0
    along_x, along_y = (mobility * height / width)[used], (mobility * width / height)[used]
    local = along_x[:, None, None] * _ALONG_X + along_y[:, None, None] * _ALONG_Y
    rows = np.broadcast_to(number[used][:, :, None], local.shape)
    columns = np.broadcast_to(number[used][:, None, :], local.shape)
    size = shape[0] * shape[1]
    return csr_array(coo_array((local.ravel(), (rows.ravel(), columns.ravel())), (size, size)))


def _solved(matrix: csr_array, right: Array) -> Array:
    settings = {"SymmetricMode": True}
    solver = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=settings)
    return np.asarray(solver.solve(right))


def _rim_fields(section: Section, mobility: Array, nodes: list[Array], count: int) -> tuple[Array, Array]:
    """Return values (nx, ny, count) at the nodes on the rim, and the orders (count + 1,) of all fields.

    The values are the smoothest eigenfunctions of the second derivative along the rim, weighted by mobility.
    """
    (low_x, high_x), (low_y, high_y) = ((each[0], each[-1]) for each in nodes)
    along = [
        _distinct(np.concatenate((np.arange(low, high + _ROUNDING, _RIM_STEP), cuts)))
        for low, high, cuts in ((low_x, high_x, section.cuts[0]), (low_y, high_y, section.cuts[1]))
    ]
    wide, tall = high_x - low_x, high_y - low_y
    whole = 2 * (wide + tall)
    up, right = along[0][:-1] - low_x, along[1][:-1] - low_y
    back, left = high_x - along[0][:0:-1], high_y - along[1][:0:-1]
    place = np.concatenate((up, wide + right, wide + tall + back, 2 * wide + tall + left))
    step = np.diff(place, append=whole)
    middle = place + step / 2
    corners = np.cumsum([0.0, wide, tall, wide, tall])
    x = np.interp(middle, corners, (low_x, high_x, high_x, low_x, low_x))
    y = np.interp(middle, corners, (low_y, low_y, high_y, high_y, low_y))
    value, order = _smoothest(step, mobility[np.array(section.material)[section.blocks_at(x, y)]], count)
    at = np.full((len(nodes[0]), len(nodes[1])), np.nan)
    at[0], at[:, -1] = 2 * wide + tall + high_y - nodes[1], wide + tall + high_x - nodes[0]
    at[-1], at[:, 0] = wide + nodes[1] - low_y, nodes[0] - low_x
    ends, closed = np.append(place, whole), np.vstack((value, value[:1]))
    outside = np.empty((*at.shape, len(order)))
    for number, each in enumerate(closed.T):
        outside[..., number] = np.interp(at, ends, each)
    return outside, np.concatenate(([0.0], order * whole / (2 * np.pi)))


def _smoothest(step: Array, mobility: Array, count: int) -> tuple[Array, Array]:
    """Return functions (n, count) on a closed line, of least energy, and their wavenumbers (count,).

    Linear elements of lengths (n,); where the mobility (n,) is zero, the line is interrupted.
    """
    size, here = len(step), np.arange(len(step))
    ahead = np.roll(here, -1)
    stiffness, mass = np.zeros((size, size)), np.zeros(size)
    slope = mobility / step
    for end in (here, ahead):
        np.add.at(stiffness, (end, end), slope)
        np.add.at(mass, end, mobility * step / 2)
    np.add.at(stiffness, (here, ahead), -slope)
    np.add.at(stiffness, (ahead, here), -slope)
    some = np.flatnonzero(mass)
    scale = 1 / np.sqrt(mass[some])
    last = max(0, min(count, len(some) - 1))
    value = np.zeros((size, last))
    if not last:  # all of the line is in rigid material: around a duct
        return value, np.zeros(0)
    square, vectors = eigh(stiffness[np.ix_(some, some)] * scale[:, None] * scale, subset_by_index=(1, last))
    value[some] = vectors * scale[:, None] * np.sqrt(mass.sum())
    return value, np.sqrt(np.maximum(square, 0))
