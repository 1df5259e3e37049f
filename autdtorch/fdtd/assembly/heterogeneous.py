"""Where the medium varies: coupling between cells, the mass of cells, and the rows a kernel steps with.

The scheme is m_i d2p_i/dt2 = sum_j B_ij (p_j - p_i). In air B is the tuned stencil and m = 1; in another
uniform material B is divided by its density, and m by its density and speed factor; the elements that
surfaces cut bring their own (`surface.py`). Bonds are symmetric, which keeps reciprocity and an energy at any
contrast.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.elements import Elements
from autdtorch.fdtd.assembly.interface import (
    PAIRS,
    VERTICES,
    InterfaceElements,
    stiffness_matrix,
    uniform_coupling,
)
from autdtorch.fdtd.stencil import Stencil, flat_offsets
from autdtorch.utils.arrays import Array, Index

logger = logging.getLogger(__name__)

Shape = tuple[int, int, int]

_SEALED = 0.1
"""Sum of coupling, relative to air, up to which a cell of a rigid obstacle is closed to sound; those at a
surface have 0.3 and more, all others 0.03 at most."""

_NO_ENERGY = 1e-10
"""Share of the largest below which an eigenvalue of closed vertices is rounding. More left out would take
energy from pressures that are nearly constant."""

_ROUNDING = 1e-9
"""Rows closer than this to those of air are air."""

_ROOM = 1.1
"""By how much rows at a surface may exceed those of a uniform material before they take mass. The largest
eigenvalue of air is farther than that from Gershgorin's bound. With the paper's cubes 1.1 costs 3 % of the
time step, 1.2 would cost 8 %; a slab of density ratio 3 keeps its mass."""

_ROUNDS = 6
"""Times that light cells ask for mass; once is nearly always enough."""


@dataclass(frozen=True)
class HeterogeneousCells:
    """The cells whose rows differ from those of uniform air.

    Attributes:
        index: flat cell indices (n,), ascending.
        weight: what (p_j - p_i) is multiplied with for the 27 neighbours, B_ij / m_i (n, 27), to be scaled
            by the time factor.
        mass: m_i (n,), 1 in air.
        sound_hard: flat indices of the cells that sound does not enter, ascending.
        shell: those of them next to cells that it does enter; what lies behind is never reached.
    """

    index: Index
    weight: Array
    mass: Array
    sound_hard: Index
    shell: Index

    def mass_of(self, cells: Index) -> Array:
        """Mass (k,) of cells (k,) that are heterogeneous or of air."""
        mass = np.ones(len(cells))
        _, ours, theirs = np.intersect1d(self.index, cells, return_indices=True)
        mass[theirs] = self.mass[ours]
        return mass


def heterogeneous_cells(medium: Elements, stencil: Stencil) -> HeterogeneousCells:
    """Find the cells that a sweep of uniform air would get wrong, and their rows."""
    x, y, z = medium.number.shape
    shape = (x + 1, y + 1, z + 1)
    touched = np.unique(_cut_vertices(medium, shape))
    touched = touched[_inner(touched, shape)]
    coupling, mass, closed = _closed_up(medium, touched, shape, stencil)
    mass = _shared_mass(coupling, mass, touched, shape, _largest_row(medium, stencil))
    weight = coupling / mass[:, None]
    changed = (np.abs(weight - stencil.weights) > _ROUNDING).any(axis=1) | (mass != 1)
    changed &= ~closed[touched]
    parts = (
        (touched[changed], weight[changed], mass[changed]),
        _bulk(medium, touched, closed, shape, stencil),
    )
    index, weight, mass = (np.concatenate(part) for part in zip(*parts, strict=True))
    order = np.argsort(index)
    around = np.unique(_neighbours(touched, shape))
    shell = around[closed[around] & _inner(around, shape)]
    return HeterogeneousCells(index[order], weight[order], mass[order], np.flatnonzero(closed), shell)


def _neighbours(index: Index, shape: Shape) -> Index:
    """Flat indices (n, 27) of cells and their neighbours."""
    return np.asarray(index[:, None] + flat_offsets(shape), np.int64)


def _inner(index: Index, shape: Shape) -> NDArray[np.bool_]:
    """Which cells (n,) are not on the rim, which stays silent."""
    places = np.stack(np.unravel_index(index, shape), axis=-1)
    return np.asarray(((places > 0) & (places < np.array(shape) - 1)).all(axis=1))


def _cut_vertices(medium: Elements, shape: Shape) -> Index:
    """Cells (n, 8) at the vertices of the cut elements."""
    first = np.stack(np.unravel_index(medium.cut, medium.number.shape), axis=-1)
    places = np.moveaxis(first[:, None] + VERTICES, -1, 0)
    return np.asarray(np.ravel_multi_index(tuple(places), shape), np.int64)


def _rigid(medium: Elements, shape: Shape) -> NDArray[np.bool_]:
    """Which cells (k,) have their centre in a rigid obstacle."""
    rigid = medium.rigid[_cell_number(medium)].ravel()
    rigid[_cut_vertices(medium, shape)] = medium.rigid[medium.elements.number]
    return rigid


def _closed_up(
    medium: Elements, touched: Index, shape: Shape, stencil: Stencil
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Bonds and mass of the touched cells, and which cells (k,) of rigid obstacles are closed to sound."""
    rigid, parts = _rigid(medium, shape), medium.elements
    inside = rigid[touched]
    closed, known = rigid.copy(), -1
    closed[touched] = False
    while True:
        coupling, mass = _assembled(medium, parts, touched, shape, stencil)
        coupling *= ~(closed[touched, None] | closed[_neighbours(touched, shape)])
        closed[touched] |= inside & (np.abs(coupling).sum(axis=1) <= _SEALED * stencil.total)
        if closed.sum() == known or not inside.any():
            return coupling, mass, closed
        known = closed.sum()
        parts = _condensed(medium, closed, shape)


def _condensed(medium: Elements, closed: NDArray[np.bool_], shape: Shape) -> InterfaceElements:
    """The cut elements without their closed vertices, whose pressure takes the value of least energy.

    Leaving out their coupling alone could make the energy of the others negative.
    """
    out = closed[_cut_vertices(medium, shape)]
    some = np.flatnonzero(out.any(axis=1))
    gone = out[some]
    matrix = stiffness_matrix(medium.elements.coupling[some])
    both = gone[:, :, None] & gone[:, None, :]
    inverse = np.linalg.pinv(np.where(both, matrix, 0), rcond=_NO_ENERGY, hermitian=True)
    across = np.where(gone[:, None, :], matrix, 0)
    matrix = matrix - across @ inverse @ across.transpose(0, 2, 1)
    matrix[gone[:, :, None] | gone[:, None, :]] = 0
    coupling, mass = medium.elements.coupling.copy(), np.where(out, 0, medium.elements.mass)
    coupling[some] = -matrix[:, PAIRS[:, 0], PAIRS[:, 1]]
    return InterfaceElements(coupling, mass, medium.elements.number)


def _assembled(
    medium: Elements, parts: InterfaceElements, touched: Index, shape: Shape, stencil: Stencil
) -> tuple[Array, Array]:
    """Bonds (n, 27) and mass (n,) of the cells that cut elements touch, summed over their elements."""
    coupling, mass = np.zeros((len(touched), 27)), np.zeros(len(touched))
    places = np.stack(np.unravel_index(touched, shape), axis=-1)
    elements = tuple(cells - 1 for cells in shape)
    cut = np.zeros(elements, bool)
    cut.ravel()[medium.cut] = True
    cut_pairs = np.zeros((8, 8, len(medium.cut)))
    for column, (a, b) in enumerate(PAIRS):
        cut_pairs[a, b] = cut_pairs[b, a] = parts.coupling[:, column]
    air_pairs = np.zeros((8, 8))
    air_pairs[PAIRS[:, 0], PAIRS[:, 1]] = air_pairs[PAIRS[:, 1], PAIRS[:, 0]] = uniform_coupling(stencil)
    for own, vertex in enumerate(VERTICES):
        element = np.ravel_multi_index(tuple((places - vertex).T), elements)
        is_cut = cut.ravel()[element]
        place = np.searchsorted(medium.cut, element[is_cut])
        number = medium.number.ravel()[element]
        for other, target in enumerate(VERTICES):
            column = int((target - vertex + 1) @ (9, 3, 1))
            part = air_pairs[own, other] / medium.materials.density[number]
            part[is_cut] = cut_pairs[own, other, place]
            coupling[:, column] += part
        part = medium.materials.mass[number] / 8
        part[is_cut] = parts.mass[place, own]
        mass += part
    return coupling, mass


def _cell_number(medium: Elements) -> NDArray[np.int16]:
    """Material of each cell (nx, ny, nz): its first element's, which stands for all where none is cut."""
    return np.pad(medium.number, ((1, 0),) * 3, mode="edge")


def _largest_row(medium: Elements, stencil: Stencil) -> float:
    """Sum of weights that a row may have: what air or the fastest obstacle needs, and some more."""
    return _ROOM * stencil.total * float(medium.materials.speed.max())


def _shared_mass(coupling: Array, mass: Array, touched: Index, shape: Shape, largest: float) -> Array:
    """Mass (n,) with which no row sums to more than `largest`, so that none shortens the time step.

    A light cell with strong coupling, in a heavy obstacle just below its surface, moves with the air. It
    takes mass from the cells it is coupled to; their sum is unchanged. Gershgorin's circles then bound the
    operator at any contrast.
    """
    mass, need = mass.copy(), np.abs(coupling).sum(axis=1) / largest
    asked = mass.sum()
    for _ in range(_ROUNDS):
        light = np.flatnonzero(need > mass)
        if len(light) == 0:
            break
        neighbour = _neighbours(touched[light], shape)
        place = np.searchsorted(touched, neighbour).clip(max=len(touched) - 1)
        spare = np.maximum(mass - need, 0)
        offer = np.abs(coupling[light]) * np.where(touched[place] == neighbour, spare[place], 0)
        whole = offer.sum(axis=1, keepdims=True)
        wish = (need - mass)[light, None] * np.divide(offer, whole, out=np.zeros_like(offer), where=whole > 0)
        wished = np.bincount(place.ravel(), wish.ravel(), len(mass))
        wish *= np.divide(spare, wished, out=np.ones_like(spare), where=wished > spare)[place]
        mass -= np.bincount(place.ravel(), wish.ravel(), len(mass))
        mass[light] += wish.sum(axis=1)
    mass = np.maximum(mass, need)
    if mass.sum() > asked * (1 + 1e-6):
        logger.debug("light cells found too little mass around them: %.2g of it added", mass.sum() - asked)
    return np.where(mass > 0, mass, 1.0)


def _bulk(
    medium: Elements, touched: Index, closed: NDArray[np.bool_], shape: Shape, stencil: Stencil
) -> tuple[Index, Array, Array]:
    """Cells inside obstacles whose sound speed is not that of air: index, weight and mass."""
    factor = medium.materials.speed
    number = _cell_number(medium).ravel()
    inside = (factor != 1)[number] & ~closed
    inside[touched] = False
    index = np.flatnonzero(inside)
    index = index[_inner(index, shape)]
    return index, factor[number[index], None] * stencil.weights, medium.materials.mass[number[index]]
