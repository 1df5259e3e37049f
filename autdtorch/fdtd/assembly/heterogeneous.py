"""Heterogeneous cells: assembled coupling coefficients, masses and stencil rows.

The scheme is m_i d2p_i/dt2 = sum_j K_ij (p_j - p_i). In air K holds the weights of the tuned stencil and
m = 1. Another uniform material divides K by its density, and m by density and speed factor. Interface
elements add theirs. K is symmetric: reciprocity and a conserved energy at any contrast.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.element import (
    PAIRS,
    VERTICES,
    InterfaceElements,
    stiffness_matrix,
    uniform_coupling,
)
from autdtorch.fdtd.assembly.elements import Elements
from autdtorch.fdtd.assembly.losses import COUPLING, GROUND, MASS, condensed_loss
from autdtorch.fdtd.assembly.neighbours import GridShape, enclosed_cells, in_parts, neighbours
from autdtorch.fdtd.stencil import Stencil, places_of
from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.spatial import distinct_cells, distinct_rows

logger = logging.getLogger(__name__)

# Sum of coupling coefficients, relative to air, up to which a cell in a rigid body is excluded. Cells at a
# surface have 0.3 or more, all others 0.03 or less. Vertices of finite elements inside a body remain
# unknowns, except in slivers: the least sum is relative to the densest fluid, and above the body's 1e-5.
_RIGID_COUPLING = 0.1
_SLIVER_COUPLING, _LEAST_COUPLING = 1e-3, 3e-5
# Eigenvalues below this share of the largest are rounding in a condensed stiffness matrix. A higher value
# would remove energy from nearly constant pressures.
_NULL_EIGENVALUE = 1e-10
_ROW_ROUNDING = 1e-9  # Stencil rows within this of air's are those of air
# Largest eigenvalue of elements, relative to a uniform material: lighter cells receive mass. From 5 cells per
# wavelength on 1.15 takes 7 % of the time step, errs less than 1.5 and leaves enough mass around. So much
# transferred mass holds waves at a surface on coarser grids: a hand at 4 cells took 250 periods, 33 with 2.1.
_FINE_MARGIN, _COARSE_MARGIN, _FINE_CELLS = 1.15, 2.1, 5.0
_TOGETHER = 20_000  # Elements whose eigenvalues are computed together
_MASS_TRANSFERS = 6  # Largest number of mass transfers to light cells; one is nearly always enough


@dataclass(frozen=True)
class LossyCells:
    """Damping coefficients of l lossy cells, and their stiffness against silence; see `losses.py`."""

    place: Index  # places of the cells among the heterogeneous ones (l,), ascending
    coupling: Array  # c_ij with the 27 neighbours (l, 27)
    mass: Array  # g_i beyond absorbing air's (l,)
    ground: Array  # stiffness against silence (l,)


@dataclass(frozen=True)
class HeterogeneousCells:
    """Cells whose stencil rows differ from those of uniform air."""

    index: Index  # flat cell indices (n,), ascending
    # stencil rows K_ij / m_i on (p_j - p_i) for the 27 neighbours (n, 27), before the time factor
    weight: Array
    mass: Array  # m_i (n,), 1 in air
    rigid: Index  # flat indices of the rigid cells, ascending
    shell: Index  # rigid cells next to other cells; no cell reads those behind them
    enclosed: Index  # rigid cells of air, which no sound reaches, ascending
    losses: LossyCells | None = None  # None if nothing absorbs
    tangent: float = 0.0  # largest ratio of damping to stiffness in a material

    @property
    def loss_rows(self) -> Array:
        """Losses of all cells (n, 29): coupling, mass and ground of `LossyCells`, zero elsewhere."""
        rows = np.zeros((len(self.index), 29))
        if self.losses is not None:
            losses = self.losses
            rows[losses.place] = np.column_stack((losses.coupling, losses.mass, losses.ground))
        return rows

    def mass_of(self, cells: Index) -> Array:
        """Return the mass (k,) of cells (k,) that are heterogeneous or of air."""
        mass = np.ones(len(cells))
        _, ours, theirs = np.intersect1d(self.index, cells, return_indices=True)
        mass[theirs] = self.mass[ours]
        return mass


def heterogeneous_cells(
    elements: Elements, stencil: Stencil, sources: Array | None = None
) -> HeterogeneousCells:
    """Assemble the stencil rows of all cells that are not of uniform air.

    Air that rigid bodies part from all `sources`, positions (M, 3) [cells], is enclosed.
    """
    x, y, z = elements.material.shape
    shape = (x + 1, y + 1, z + 1)
    touched = distinct_cells(_vertices(elements, shape), math.prod(shape))
    touched = touched[_inner(touched, shape)]
    coupling, mass, need, hard, interface = _without_rigid(elements, touched, shape, stencil)
    walls = elements.materials.rigid.any()
    usual = stencil.total / _densest(elements)
    enclosed = np.zeros(0, np.int64)
    if walls:
        enclosed = enclosed_cells(coupling, touched, hard, shape, usual, sources)
    hard[enclosed] = True
    if len(enclosed):
        coupling *= _both_open(hard, touched, shape)
    mass = _transferred_mass(coupling, mass, need, touched, shape)
    coupling /= mass[:, None]
    weight, air = coupling, stencil.weights
    changed = [(np.abs(part - air) > _ROW_ROUNDING).any(axis=1) for part in in_parts(weight)]
    changed = np.concatenate(changed) | (mass != 1)
    loss = _touched_losses(elements, interface, touched, hard, shape, stencil)
    changed |= loss.any(axis=1)
    changed &= ~hard[touched]
    surface = touched[changed], weight[changed], mass[changed], loss[changed]
    uniform = _uniform_cells(elements, touched, hard, shape, stencil)
    index, weight, mass, loss = (np.concatenate(part) for part in zip(surface, uniform, strict=True))
    order = np.argsort(index)
    around = np.zeros(math.prod(shape), bool)
    for part in in_parts(touched):
        around[neighbours(part, shape)] = True
    shell = np.flatnonzero(around & hard)
    shell = shell[_inner(shell, shape)]
    rows = index[order], weight[order], mass[order]
    losses = elements.materials.losses
    tangent = 0.0 if losses is None else losses.tangent
    return HeterogeneousCells(*rows, np.flatnonzero(hard), shell, enclosed, lossy_cells(loss[order]), tangent)


def lossy_cells(loss: Array) -> LossyCells | None:
    """Return the lossy of n cells, from the losses of all (n, 29): coupling, mass and ground."""
    place = np.flatnonzero(loss.any(axis=1))
    return LossyCells(place, loss[place, :27], *loss[place, 27:].T) if len(place) else None


def _inner(index: Index, shape: GridShape) -> NDArray[np.bool_]:
    """Return the mask (n,) of cells inside the outermost ring, which is always zero."""
    places = places_of(index, shape)
    return np.asarray(((places > 0) & (places < np.array(shape) - 1)).all(axis=1))


def _vertices(elements: Elements, shape: GridShape) -> Index:
    """Return the cells (n, 8) at the vertices of the interface elements."""
    first = places_of(elements.index, elements.material.shape)
    places = np.moveaxis(first[:, None] + VERTICES, -1, 0)
    return np.asarray(np.ravel_multi_index(tuple(places), shape), np.int64)


def _cell_material(elements: Elements) -> NDArray[np.int16]:
    """Return the material of each cell (k,), from its first element; exact where no interface is near."""
    return np.pad(elements.material, ((1, 0),) * 3, mode="edge").ravel()


def _without_rigid(
    elements: Elements, touched: Index, shape: GridShape, stencil: Stencil
) -> tuple[Array, Array, Array, NDArray[np.bool_], InterfaceElements]:
    """Return coupling, mass and least mass of the touched cells, rigid cells (k,), and the elements left."""
    vertices, interface = _vertices(elements, shape), elements.interface
    hard = elements.materials.rigid[_cell_material(elements)]
    hard[vertices] = elements.materials.rigid[interface.material]
    inside, count = hard[touched], -1
    densest = _densest(elements)
    sliver = np.zeros(len(hard), bool)
    sliver[vertices[interface.finite]] = True
    least = np.where(sliver[touched], max(_SLIVER_COUPLING / densest, _LEAST_COUPLING), _RIGID_COUPLING)
    least *= stencil.total
    hard[touched] = False
    margin = _FINE_MARGIN if stencil.kappa <= 2 * math.pi / _FINE_CELLS else _COARSE_MARGIN
    largest = margin * stencil.largest_symbol * float(elements.materials.speed.max())
    parts = _stiffness(elements, interface, stencil)
    coupling, mass, need = _assembled(elements, parts, touched, shape, largest)
    while True:
        coupling *= _both_open(hard, touched, shape)
        hard[touched] |= inside & (np.abs(coupling).sum(axis=1) <= least)
        if hard.sum() == count or not inside.any():
            return coupling, mass, need, hard, interface
        count, out = hard.sum(), hard[vertices]
        interface = condensed(elements.interface, out)
        changed = np.isin(touched, vertices[out.any(axis=1)])
        parts = _stiffness(elements, interface, stencil)
        some = _assembled(elements, parts, touched[changed], shape, largest)
        coupling[changed], mass[changed], need[changed] = some


def _touched_losses(
    elements: Elements,
    interface: InterfaceElements,
    touched: Index,
    hard: NDArray[np.bool_],
    shape: GridShape,
    stencil: Stencil,
) -> Array:
    """Return the losses of the touched cells (n, 29), as of `lossy_cells`; none (n, 0) if nothing absorbs."""
    losses = elements.materials.losses
    if losses is None:
        return np.zeros((len(touched), 0))
    pairs = losses.coupling[:, None] * uniform_coupling(stencil)
    vertices = np.repeat(losses.mass[:, None] / 8, 8, axis=1)
    loss = np.concatenate((np.column_stack((pairs, vertices, np.zeros_like(vertices))), interface.loss))
    (coupling, mass), (_, ground) = (
        _assembled(elements, (loss[:, COUPLING], loss[:, part]), touched, shape, math.inf)[:2]
        for part in (MASS, GROUND)
    )
    return np.column_stack((coupling * _both_open(hard, touched, shape), mass, ground))


def _stiffness(elements: Elements, interface: InterfaceElements, stencil: Stencil) -> list[Array]:
    """Return coupling (k, 28) and mass (k, 8) of elements of one material, then of those at surfaces."""
    kinds = elements.materials
    uniform = uniform_coupling(stencil) / kinds.density[:, None], np.repeat(kinds.mass[:, None] / 8, 8, 1)
    return [np.concatenate(part) for part in zip(uniform, interface[:2], strict=True)]


def _densest(elements: Elements) -> float:
    """Return the largest density, relative to air."""
    return float(elements.materials.density[~elements.materials.rigid].max())


def _both_open(hard: NDArray[np.bool_], touched: Index, shape: GridShape) -> NDArray[np.bool_]:
    """Return the mask (n, 27) of neighbours of touched cells where neither is in `hard` (k,)."""
    return np.concatenate([~(hard[part, None] | hard[neighbours(part, shape)]) for part in in_parts(touched)])


def condensed(interface: InterfaceElements, out: NDArray[np.bool_]) -> InterfaceElements:
    """Eliminate vertices `out` (n, 8) from the stiffness of elements by static condensation.

    Their pressure takes the value of least energy. To remove their coupling could make the energy negative.
    """
    some = np.flatnonzero(out.any(axis=1))
    # at flat faces nearly all elements are equal
    parts = interface.coupling[some], interface.loss[some], out[some].astype(float)
    first, kind = distinct_rows(np.concatenate(parts, axis=1))
    gone = out[some[first]]
    matrix = stiffness_matrix(interface.coupling[some[first]])
    both = gone[:, :, None] & gone[:, None, :]
    inverse = np.linalg.pinv(np.where(both, matrix, 0), rcond=_NULL_EIGENVALUE, hermitian=True)
    across = np.where(gone[:, None, :], matrix, 0)
    matrix = matrix - across @ inverse @ across.transpose(0, 2, 1)
    matrix[gone[:, :, None] | gone[:, None, :]] = 0
    coupling = interface.coupling.copy()
    coupling[some] = -matrix[:, PAIRS[:, 0], PAIRS[:, 1]][kind]
    loss = interface.loss.copy()
    if loss.shape[1]:
        inner = condensed_loss(loss[some[first]], -inverse @ across.transpose(0, 2, 1), gone)
        loss[some] = inner[kind]
    return interface._replace(coupling=coupling, mass=np.where(out, 0, interface.mass), loss=loss)


def _assembled(
    elements: Elements, parts: Sequence[Array], touched: Index, shape: GridShape, largest: float
) -> tuple[Array, Array, Array]:
    """Return coupling (n, 27), mass (n,) and least mass (n,) of the touched cells.

    They are sums over `parts` as of `_stiffness`, and over masses that limit eigenvalues to `largest`.
    """
    places = places_of(touched, shape)
    cells = tuple(cells - 1 for cells in shape)
    # elements by kind: of one material, then those that surfaces intersect
    count = len(elements.materials.density)
    kind = elements.material.astype(np.int32).ravel()
    kind[elements.index] = count + np.arange(len(elements.index))
    # at flat faces many elements are equal, and many cells are among equal ones
    first, equal = distinct_rows(np.concatenate(parts, axis=1))
    of_pairs, masses = (part[first] for part in parts)
    least = _least_mass(of_pairs, largest)
    kind = equal.astype(np.int32)[kind]
    around = [kind[np.ravel_multi_index(tuple((places - vertex).T), cells)] for vertex in VERTICES]
    some, number_of = distinct_rows(np.stack(around, axis=1))
    coupling, mass, need = np.zeros((len(some), 27)), np.zeros(len(some)), np.zeros(len(some))
    cube, pairs = coupling.reshape(-1, 3, 3, 3), np.zeros((len(masses), 8, 8))
    pairs[:, PAIRS[:, 0], PAIRS[:, 1]] = pairs[:, PAIRS[:, 1], PAIRS[:, 0]] = of_pairs
    for number, (vertex, kinds) in enumerate(zip(VERTICES, around, strict=True)):
        x, y, z = (slice(1 - end, 3 - end) for end in vertex)
        cube[:, x, y, z] += pairs[kinds[some], number].reshape(-1, 2, 2, 2)
        mass += masses[kinds[some], number]
        need += least[kinds[some], number]
    return coupling[number_of], mass[number_of], need[number_of]


def _least_mass(coupling: Array, largest: float) -> Array:
    """Return masses (k, 8) with which elements of `coupling` (k, 28) have eigenvalues up to `largest`.

    Eigenvalues of a sum of elements are then as small. Masses are in proportion to the stiffness of a vertex
    that moves alone, so that an element of air needs its mass.
    """
    masses = np.zeros((len(coupling), 8))
    for part in np.array_split(np.arange(len(coupling)), 1 + len(coupling) // _TOGETHER):
        matrix = stiffness_matrix(coupling[part])
        alone = np.diagonal(matrix, axis1=1, axis2=2).clip(min=0)
        scale = np.divide(1, np.sqrt(alone), out=np.zeros_like(alone), where=alone > 0)
        scaled = scale[:, :, None] * matrix * scale[:, None, :]
        masses[part] = alone * np.linalg.eigvalsh(scaled)[:, -1:] / largest
    return masses


def _transferred_mass(coupling: Array, mass: Array, need: Array, touched: Index, shape: GridShape) -> Array:
    """Return masses (n,) of at least `need` (n,), with which few cells shorten the time step.

    A light cell with strong coupling, in a heavy obstacle just below its surface, moves with the air. Mass is
    transferred to it from the cells it is coupled to.
    """
    mass, before = mass.copy(), mass.sum()
    for _ in range(_MASS_TRANSFERS):
        light = np.flatnonzero(need > mass)
        if len(light) == 0:
            break
        neighbour = neighbours(touched[light], shape)
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
    if mass.sum() > before * (1 + 1e-6):
        logger.debug("too little mass around light cells: added %.2g", mass.sum() - before)
    return np.where(mass > 0, mass, 1.0)


def _uniform_cells(
    elements: Elements, touched: Index, hard: NDArray[np.bool_], shape: GridShape, stencil: Stencil
) -> tuple[Index, Array, Array, Array]:
    """Return index, weight, mass and losses of cells inside obstacles that absorb or have another speed."""
    materials, material = elements.materials, _cell_material(elements)
    factor, losses = materials.speed, materials.losses
    loss = np.zeros((len(factor), 0))
    if losses is not None:
        nothing = np.zeros_like(losses.mass)
        loss = np.column_stack((losses.coupling[:, None] * stencil.weights, losses.mass, nothing))
    inside = ((factor != 1) | loss.any(axis=1))[material] & ~hard
    inside[touched] = False
    index = np.flatnonzero(inside)
    number = material[index := index[_inner(index, shape)]]
    return index, factor[number, None] * stencil.weights, materials.mass[number], loss[number]
