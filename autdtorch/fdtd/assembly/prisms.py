"""Elements that do not vary along one axis, as at edges of bodies whose faces are parallel to the grid.

The field at an edge is singular. In a plane across it, the couplings of the elements at the edge are fitted
so that the scheme reproduces the smoothest fields of long waves on the cells around them. Edges that are
closer than a cell, as those of a thin plate or at the mouth of a slit, are fitted together. Without this the
error of a cuboid depends on where its faces fall, and is up to twenty times as large.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy.optimize import lsq_linear

from autdtorch.fdtd.assembly.element import PAIRS, coupling_by_edges, stiffness_matrix
from autdtorch.fdtd.assembly.plane_fields import plane_fields
from autdtorch.fdtd.assembly.prism_fit import fitted_couplings, importance
from autdtorch.fdtd.assembly.sections import (
    COLUMN_PAIRS,
    COLUMNS,
    RING,
    Kinds,
    Section,
    layered_element,
    uniform_columns,
)
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array, Index

# Fields of the fit of one element; each further one needs two more, up to a limit
_FIELDS, _MOST_FIELDS = 8, 12
# Most mass of a column in a heavy body, relative to its material's or to how strongly it is coupled (air: 1).
# One that air reaches weakly would else be a pipe that resonates
_REACHED = 2.0
_LEAST_WEIGHT, _EXACT, _MOST_STEPS = 1e-12, 1e-14, 100
_SUM = 100.0  # Weight of the sum of masses, relative to their moments
_LEAST_MOBILITY = 1e-9  # Mobility of a column that a sound-hard material closes
_DECIMALS = 9  # Sections that agree to so many decimals [cells] share their fit


class Prisms(NamedTuple):
    """The elements (a, b) of a section, one cell long."""

    coupling: Array  # between columns (a, b, 2, 2, 2, 2), relative to the stencil's
    mass: Array  # mass of each column (a, b, 2, 2)
    mobility: Array  # mobility along each column (a, b, 2, 2)


Image: TypeAlias = tuple[bool, bool, bool]
"""A symmetry of the square: exchange the axes, then mirror the first, then mirror the second."""

_IMAGES = [(a, b, c) for a, b, c in itertools.product((False, True), repeat=3)]


@lru_cache(maxsize=4096)
def prisms(section: Section, kinds: Kinds, stencil: Stencil) -> Prisms:
    """Return the fitted elements of a section.

    Images of a section share a fit, and the fit of a symmetric one is the mean over its images: symmetric
    scenes stay symmetric.
    """
    images = [(_image_of_section(section, image), image) for image in _IMAGES]
    key = min(each for each, _ in images)
    fit = _fitted(key, kinds, stencil)
    alike = [_original(fit, image) for each, image in images if each == key]
    return Prisms(*(np.asarray(sum(parts) / len(parts)) for parts in zip(*alike, strict=True)))


def _image_of_section(section: Section, image: Image) -> Section:
    """Return an image of a section, rounded."""
    exchanged, *mirrored = image
    (a, b), (one, other), blocks = section.size, section.cuts, np.array(section.material)
    if exchanged:
        a, b, one, other, blocks = b, a, other, one, blocks.T
    for axis, mirror in enumerate(mirrored):
        blocks = np.flip(blocks, axis) if mirror else blocks
    cuts = _mirrored(one, a, mirrored[0]), _mirrored(other, b, mirrored[1])
    return Section((a, b), cuts, tuple(map(tuple, blocks.tolist())))


def _mirrored(cuts: tuple[float, ...], size: int, mirror: bool) -> tuple[float, ...]:
    """Return the places of faces along an axis, or their mirror images, rounded."""
    places = [size - cut for cut in reversed(cuts)] if mirror else cuts
    return tuple(round(cut, _DECIMALS) for cut in places)


def _original(fit: Prisms, image: Image) -> Prisms:
    """Return the elements of the section that an image was fitted for."""
    exchanged, *mirrored = image
    axes = [axis for axis, mirror in enumerate(mirrored) if mirror]

    def turned(part: Array) -> Array:
        for axis in axes:
            part = np.flip(part, tuple(range(axis, part.ndim, 2)))
        order = [axis + 1 - 2 * (axis % 2) for axis in range(part.ndim)]
        return part.transpose(order) if exchanged else part

    return Prisms(*map(turned, fit))


def stacked(width: Array, slices: Sequence[Prisms], axis: int, stencil: Stencil) -> tuple[Array, Array]:
    """Return the coupling (28,) and mass (8,) of an element, a stack of slices of prisms along an axis.

    Each slice has a width (L,). A flow along a column passes all slices, which decides the pressure in each.
    The energy across the columns is that of a slice, at the pressures there. What pressures that differ at
    the ends of the columns have beyond is not negative: the stencil would take some from strong couplings.
    """
    flat, mass, mobility = (np.stack(parts) for parts in zip(*slices, strict=True))
    resistance = width[:, None, None] / np.maximum(mobility, _LEAST_MOBILITY)
    end = np.cumsum(resistance, axis=0) / resistance.sum(axis=0)
    drop = resistance / resistance.sum(axis=0)
    middle = end - drop / 2
    by_edges, sides = coupling_by_edges(stencil), _sides_between()
    straight, oblique = by_edges[sides], by_edges[np.minimum(sides + 1, 3)]
    number = np.moveaxis(np.arange(8).reshape(2, 2, 2), axis, 0).reshape(2, 4)  # vertices at both ends
    matrix, masses = np.zeros((8, 8)), np.zeros(8)
    low, high = np.eye(8)[number]
    slices_of = zip(flat, width, mass, resistance, middle, drop, strict=True)
    for own, thick, part, passed, place, change in slices_of:
        at_middle = (1 - place).reshape(4, 1) * low + place.reshape(4, 1) * high
        along = change.reshape(4, 1) * (high - low)
        across = _stiffness(2 * (straight + oblique) * own)
        # what the stencil has beyond pressures that vary linearly along the columns
        beyond = _stiffness(((straight + oblique) / 3 - oblique) * own)
        own_along = np.diag(1 / passed.ravel()) + thick / 12 * across + beyond / thick
        matrix += thick * at_middle.T @ across @ at_middle + along.T @ _without_negative(own_along) @ along
        masses[number] += thick * np.stack(((1 - place) * part, place * part)).reshape(2, 4)
    return -matrix[PAIRS[:, 0], PAIRS[:, 1]], masses


def _without_negative(matrix: Array) -> Array:
    """Return a symmetric matrix without its negative eigenvalues."""
    value, vector = np.linalg.eigh(matrix)
    return np.asarray((vector * np.maximum(value, 0)) @ vector.T) if value[0] < 0 else matrix


def _stiffness(coupling: Array) -> Array:
    """Return the stiffness matrix (4, 4) of coupling between columns (2, 2, 2, 2)."""
    return stiffness_matrix(coupling.reshape(4, 4)[tuple(COLUMN_PAIRS.T)], COLUMN_PAIRS)


def _sides_between() -> Index:
    """Return the number of sides between two columns (2, 2, 2, 2)."""
    first, second = np.indices((2, 2, 2, 2)).reshape(2, 2, -1)
    return np.asarray(np.abs(first - second).sum(axis=0).reshape((2,) * 4), np.int64)


@lru_cache(maxsize=4096)
def _fitted(section: Section, kinds: Kinds, stencil: Stencil) -> Prisms:
    """Return the elements of a section, those that vary along both axes fitted in the window around it."""
    uniform, varied = uniform_columns(stencil), []
    found = Prisms(np.zeros((*section.size, 2, 2, 2, 2)), *np.zeros((2, *section.size, 2, 2)))
    for x, y in np.ndindex(section.size):
        if (element := layered_element(section, x, y, kinds, stencil)) is None:
            varied.append((x, y))
        else:
            found.coupling[x, y] = _by_columns(element.coupling / uniform)
            found.mass[x, y], found.mobility[x, y] = element.mass, element.mobility
    if not varied:
        return found
    fields = plane_fields(section, kinds.mobility, min(_FIELDS + 2 * (len(varied) - 1), _MOST_FIELDS))
    couplings = fitted_couplings(section, varied, fields, kinds, stencil)
    for (x, y), coupling in zip(varied, couplings, strict=True):
        found.coupling[x, y] = _by_columns(coupling / uniform)
        reached = np.bincount(COLUMN_PAIRS.ravel(), np.repeat(coupling, 2), 4) / (2 * uniform.sum() / 4)
        values = fields.values[RING + x : RING + x + 2, RING + y : RING + y + 2].reshape(4, -1)
        for part, weight in ((found.mass, kinds.masses), (found.mobility, kinds.mobility)):
            own = weight[section.at_columns(x, y)]
            most = np.where(own < weight.max(), np.maximum(own, _REACHED * reached) / 4, np.inf)
            part[x, y] = _lumped(values, fields.over_element(weight, x, y), fields.order, most)
    return found


def _by_columns(coupling: Array) -> Array:
    """Return coupling (6,) of pairs by the places of their columns (2, 2, 2, 2)."""
    found = np.zeros((2,) * 4)
    for (one, other), value in zip(COLUMNS[COLUMN_PAIRS], coupling, strict=True):
        found[(*one, *other)] = found[(*other, *one)] = value
    return found


def _lumped(values: Array, integrals: Array, order: Array, most: Array) -> Array:
    """Return weights (2, 2) of the columns with which fields (4, m) have their integrals (m,).

    Their sum is nearly exact, the others as exact as weights from 0 up to `most` (4,) allow.
    """
    weight = importance(order)
    weight[0] = _SUM
    bounds = np.zeros(4), np.maximum(most, _LEAST_WEIGHT)
    found = lsq_linear(
        weight[:, None] * values.T,
        weight * integrals,
        bounds,
        method="bvls",
        tol=_EXACT,
        max_iter=_MOST_STEPS,
    )
    return np.asarray(found.x.reshape(2, 2))
