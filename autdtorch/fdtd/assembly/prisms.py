"""Elements that do not vary along one axis, as at edges of bodies whose faces are parallel to the grid.

The field at an edge is singular. In a plane across it, the couplings of the element at the edge are fitted:
the scheme must reproduce the smoothest fields of long waves in the window of cells around it, given their
pressure at its rim. Without the fit the error of a cuboid depends on where its faces fall, and is up to
twenty times as large. Each element is fitted as if its edges were alone in the window. Long waves do not
determine the couplings of several: fitted together, those of a grating of bars let 20 % more pass than there
is, and erred by 10 %, not 1. Single edges of rigid bodies are then fitted to waves of the drive's frequency
(`edge_waves.py`).
"""

from __future__ import annotations

import itertools
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from scipy.optimize import lsq_linear

from autdtorch.fdtd.assembly.edge_fit import fitted_couplings, importance
from autdtorch.fdtd.assembly.edge_waves import at_the_drive, rigid_corner
from autdtorch.fdtd.assembly.reference_element import (
    PAIRS,
    coupling_by_edges,
    stiffness_matrix,
    without_negative,
)
from autdtorch.fdtd.assembly.sections import (
    COLUMN_PAIRS,
    RING,
    SIDES,
    MaterialKey,
    Prisms,
    Section,
    layered_element,
    plane_fields,
    uniform_columns,
)
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array

_FIELDS = 8  # Fields of the fit beside the constant one
# Largest mass of a column in a heavy body, relative to its material's or to its coupling (air: 1). A column
# that air reaches weakly would otherwise be a pipe that resonates.
_REACHED = 2.0
_LEAST_WEIGHT, _EXACT, _MOST_STEPS = 1e-12, 1e-14, 100
_SUM = 100.0  # Weight of the sum of masses, relative to their moments
_LEAST_MOBILITY = 1e-9  # Mobility of a column that a rigid material closes
_DECIMALS = 9  # Sections that agree to so many decimals [cells] share their fit
_PAIR_OF = np.zeros((4, 4), np.int64)  # Number of each pair of columns in `COLUMN_PAIRS`
_PAIR_OF[tuple(COLUMN_PAIRS.T)] = _PAIR_OF[tuple(COLUMN_PAIRS.T[::-1])] = np.arange(len(COLUMN_PAIRS))

SquareSymmetry: TypeAlias = tuple[bool, bool, bool]
"""A symmetry of the square: exchange the axes, then mirror the first, then mirror the second."""

_IMAGES = [(a, b, c) for a, b, c in itertools.product((False, True), repeat=3)]


@lru_cache(maxsize=4096)
def prisms(section: Section, materials: MaterialKey, stencil: Stencil) -> Prisms:
    """Return the fitted element of a section.

    Images of a section share a fit, and the fit of a symmetric one is the mean over its images: symmetric
    scenes stay symmetric.
    """
    images = [(_image_of_section(section, image), image) for image in _IMAGES]
    key = min(each for each, _ in images)
    fit = _fitted(key, materials, stencil)
    alike = [_original(fit, image) for each, image in images if each == key]
    return Prisms(*(np.asarray(sum(parts) / len(parts)) for parts in zip(*alike, strict=True)))


def _image_of_section(section: Section, image: SquareSymmetry) -> Section:
    """Return an image of a section, rounded."""
    exchanged, *mirrored = image
    (one, other), blocks = section.cuts, np.array(section.material)
    if exchanged:
        one, other, blocks = other, one, blocks.T
    blocks = np.flip(blocks, tuple(axis for axis, mirror in enumerate(mirrored) if mirror))
    cuts = _mirrored(one, mirrored[0]), _mirrored(other, mirrored[1])
    return Section(cuts, tuple(map(tuple, blocks.tolist())))


def _mirrored(cuts: tuple[float, ...], mirror: bool) -> tuple[float, ...]:
    """Return the places of faces along an axis, or their mirror images, rounded."""
    places = [1 - cut for cut in reversed(cuts)] if mirror else cuts
    return tuple(round(cut, _DECIMALS) for cut in places)


def _original(fit: Prisms, image: SquareSymmetry) -> Prisms:
    """Return the element of the section that an image was fitted for."""
    exchanged, *mirrored = image
    axes = tuple(axis for axis, mirror in enumerate(mirrored) if mirror)
    columns = np.flip(np.arange(4).reshape(2, 2), axes)
    columns = columns.T if exchanged else columns
    pairs = _PAIR_OF[tuple(columns.ravel()[COLUMN_PAIRS].T)]
    return Prisms(fit.coupling[pairs], *(part.ravel()[columns] for part in fit[1:]))


def stacked(width: Array, slices: Prisms, axis: int, stencil: Stencil) -> tuple[Array, Array]:
    """Return the coupling (n, 28) and mass (n, 8) of elements, stacks of L slices of prisms along an axis.

    Each slice has a width (n, L). A flow along a column passes all slices, which decides the pressure in
    each. The energy across the columns is the sum over the slices, at their pressures. The energy along the
    columns is made positive: the stencil would subtract some where couplings are strong.
    """
    flat, mass, mobility = slices
    resistance = width[:, :, None, None] / np.maximum(mobility, _LEAST_MOBILITY)
    total = resistance.sum(axis=1, keepdims=True)
    end, drop = np.cumsum(resistance, axis=1) / total, resistance / total
    middle = end - drop / 2
    by_edges = coupling_by_edges(stencil)
    straight, oblique = by_edges[SIDES], by_edges[SIDES + 1]
    # share of a coupling in the difference of the stencil from pressures that vary linearly along the columns
    further = ((straight + oblique) / 3 - oblique) / (2 * (straight + oblique))
    number = np.moveaxis(np.arange(8).reshape(2, 2, 2), axis, 0).reshape(2, 4)  # vertices at both ends
    matrix, masses = np.zeros((len(width), 8, 8)), np.zeros((len(width), 8))
    low, high = np.eye(8)[number]
    for layer in range(width.shape[1]):
        coupling, thick = flat[:, layer], width[:, layer, None, None]
        part, place, change = (each[:, layer].reshape(-1, 4, 1) for each in (mass, middle, drop))
        at_middle = (1 - place) * low + place * high
        along = change * (high - low)
        across, beyond = (stiffness_matrix(each, COLUMN_PAIRS) for each in (coupling, further * coupling))
        conductance = np.eye(4) * (1 / resistance[:, layer].reshape(-1, 1, 4))
        lengthwise = conductance + thick / 12 * across + beyond / thick
        between = thick * at_middle.mT @ across @ at_middle
        matrix += between + along.mT @ without_negative(lengthwise) @ along
        masses[:, number] += thick * np.stack(((1 - place) * part, place * part), axis=1)[..., 0]
    return -matrix[:, PAIRS[:, 0], PAIRS[:, 1]], masses


@lru_cache(maxsize=4096)
def _fitted(section: Section, materials: MaterialKey, stencil: Stencil) -> Prisms:
    """Return the element of a section, fitted in the window around it if it varies along both axes."""
    if (element := layered_element(section, 0, 0, materials, stencil)) is not None:
        return element
    fields = plane_fields(section, materials.mobility, _FIELDS)
    coupling = fitted_couplings(section, fields, materials, stencil)
    of_air = 2 * uniform_columns(stencil).sum() / 4  # coupling of a column
    reached = np.bincount(COLUMN_PAIRS.ravel(), np.repeat(coupling, 2), 4) / of_air
    values = fields.values[RING : RING + 2, RING : RING + 2].reshape(4, -1)
    lumped = []
    for weight in (materials.masses, materials.mobility):
        at_columns = weight[section.at_columns]
        most = np.maximum(at_columns, _REACHED * reached) / 4
        most = np.where(at_columns < weight.max(), most, np.inf)
        lumped.append(_lumped(values, fields.over_section(weight), fields.order, most))
    mass, mobility = lumped
    if (corner := rigid_corner(section, materials)) is not None:
        coupling, masses = at_the_drive(section, corner, coupling, mass.ravel(), materials, stencil)
        mass = mobility = masses.reshape(2, 2)  # in air, both are volumes
    return Prisms(coupling, mass, mobility)


def _lumped(values: Array, integrals: Array, order: Array, most: Array) -> Array:
    """Return weights (2, 2) of the columns with which fields (4, m) have their integrals (m,).

    The integral of the constant field is nearly exact, the others as exact as weights from 0 up to `most`
    (4,) allow.
    """
    weight = importance(order)
    weight[0] = _SUM
    bounds = np.zeros(4), np.maximum(most, _LEAST_WEIGHT)
    fit = lsq_linear(
        weight[:, None] * values.T,
        weight * integrals,
        bounds,
        method="bvls",
        tol=_EXACT,
        max_iter=_MOST_STEPS,
    )
    return np.asarray(fit.x.reshape(2, 2))
