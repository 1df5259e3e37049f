"""Heterogeneous cells: assembled coupling coefficients, masses and stencil rows.

The scheme is m_i d2p_i/dt2 = sum_j K_ij (p_j - p_i). In air K holds the weights of the tuned stencil and
m = 1. Another uniform material divides K by its density, and m by density and speed factor. Interface
elements add theirs. K is symmetric: reciprocity and a conserved energy at any contrast.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.elements import Elements
from autdtorch.fdtd.assembly.losses import COUPLING, GROUND, MASS, condensed_loss
from autdtorch.fdtd.assembly.neighbours import enclosed_cells, inner_cells, neighbours, with_neighbours
from autdtorch.fdtd.assembly.reference_element import (
    PAIR_OF,
    PAIRS,
    VERTICES,
    InterfaceElements,
    Materials,
    uniform_coupling,
    without_vertices,
)
from autdtorch.fdtd.interpolation import GridShape
from autdtorch.fdtd.stencil import Stencil, flat_offsets, flat_strides, places_of
from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.process import parts_of_size, spread
from autdtorch.utils.spatial import places_among

logger = logging.getLogger(__name__)

# Sum of coupling coefficients, relative to air, up to which a cell in a rigid body is excluded. Cells at a
# surface have 0.3 or more, all others 0.03 or less. Vertices of finite elements inside a body remain
# unknowns, except in slivers: the least sum is relative to the densest fluid, and above the body's 1e-5.
_RIGID_COUPLING = 0.1
_SLIVER_COUPLING, _LEAST_COUPLING = 1e-3, 3e-5
# Largest eigenvalue of elements, relative to a uniform material: those with a larger one receive mass. Flat
# faces of fluids have 1.05 or less. From 5 cells per wavelength on 1.15 takes 7 % of the time step, and
# curved rigid bodies err 10 % less than with 1.4. So much transferred mass holds waves at a surface on
# coarser grids: a hand at 4 cells took 250 periods, 33 with 2.1.
_FINE_MARGIN, _COARSE_MARGIN, _FINE_CELLS = 1.15, 2.1, 5.0
_TOGETHER = 4_096  # Cells or elements that are looked at together, which stay in the cache
_MASS_TRANSFERS = 6  # Largest number of mass transfers to light cells; one is nearly always enough


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
    inner: Index  # cells inside obstacles whose rows are those of air (k,), ascending
    inner_mass: Array  # and their mass (k,), which is not
    largest: float = math.inf  # upper bound of the eigenvalues of the rows, by their elements
    lossy: Index = field(default_factory=lambda: np.zeros(0, np.int64))  # those that absorb (l,), ascending
    # their losses (l, 29): damping coefficients c_ij with the 27 neighbours and g_i beyond absorbing air's,
    # and stiffness against silence; see `losses.py`
    loss: Array = field(default_factory=lambda: np.zeros((0, 29)))
    tangent: float = 0.0  # largest ratio of damping to stiffness in a material

    @property
    def loss_rows(self) -> Array:
        """Losses of all cells (n, 29)."""
        rows = np.zeros((len(self.index), 29))
        rows[self.lossy] = self.loss
        return rows

    def mass_of(self, cells: Index) -> Array:
        """Return the mass (k,) of distinct cells (k,)."""
        mass = np.ones(len(cells))
        for index, masses in ((self.index, self.mass), (self.inner, self.inner_mass)):
            _, ours, theirs = np.intersect1d(index, cells, return_indices=True)
            mass[theirs] = masses[ours]
        return mass


def heterogeneous_cells(
    elements: Elements, stencil: Stencil, sources: Array | None = None
) -> HeterogeneousCells:
    """Assemble the stencil rows of all cells that are not of uniform air.

    Air that rigid bodies part from all `sources`, positions (M, 3) [cells], is enclosed.
    """
    x, y, z = elements.material.shape
    shape = (x + 1, y + 1, z + 1)
    vertices, around = _vertices(elements, shape), np.zeros(shape, bool)
    around.ravel()[vertices] = True
    touched = inner_cells(around)
    # the eigenvalue that no element exceeds, and therefore no sum of elements
    margin = _FINE_MARGIN if stencil.kappa <= 2 * math.pi / _FINE_CELLS else _COARSE_MARGIN
    largest = margin * stencil.largest_symbol * float(elements.materials.speed.max())
    cut, hard, rows = _without_rigid(elements, vertices, touched, shape, stencil, largest)
    enclosed = np.zeros(0, np.int64)
    if elements.materials.rigid.any():
        usual = stencil.total / _densest(elements)
        enclosed = enclosed_cells(rows.coupling, rows.total, touched, hard, shape, usual, sources)
    if len(enclosed):
        hard[enclosed] = True
        rows = cut.rows(touched, hard)
    mass = _transferred_mass(rows.coupling, rows.mass, rows.least, touched, shape)
    loss = cut.losses(touched, hard)
    weight, changed = rows.coupling, (mass != 1) | loss.any(axis=1)

    def divide(ends: tuple[int, int]) -> None:
        part = slice(*ends)
        weight[part] /= mass[part, None]
        changed[part] |= stencil.differs_from(weight[part])

    spread(divide, parts_of_size(len(touched), _TOGETHER))
    changed &= ~hard[touched]
    cells = [part[changed] for part in (touched, weight, mass, loss)]
    uniform, inner, inner_mass = _uniform_cells(elements, touched, hard, shape, stencil)
    if len(uniform[0]):
        cells = [np.concatenate(parts) for parts in zip(cells, uniform, strict=True)]
        order = np.argsort(cells[0], kind="stable")  # of two runs
        cells = [part[order] for part in cells]
    index, weight, mass, loss = cells
    shell = inner_cells(with_neighbours(touched, shape) & hard.reshape(shape))
    losses, lossy = elements.materials.losses, np.flatnonzero(loss.any(axis=1))
    tangent = 0.0 if losses is None else losses.tangent
    return HeterogeneousCells(
        index, weight, mass, np.flatnonzero(hard), shell, enclosed, inner, inner_mass,
        largest, lossy, loss[lossy].reshape(len(lossy), 29), tangent,
    )  # fmt: skip


def _vertices(elements: Elements, shape: GridShape) -> Index:
    """Return the cells (n, 8) at the vertices of the interface elements."""
    strides = flat_strides(shape)
    first = places_of(elements.index, elements.material.shape) @ strides
    return np.asarray(first[:, None] + VERTICES @ strides)


def _cell_material(elements: Elements) -> NDArray[np.int16]:
    """Return the material of each cell (k,), from its first element; exact where no interface is near."""
    return np.pad(elements.material, ((1, 0),) * 3, mode="edge").ravel()


_OTHERS = np.array([[other for other in range(8) if other != vertex] for vertex in range(8)])
# Of a vertex and the seven others: numbers of the pairs, and numbers of the neighbours in `OFFSETS` (8, 7)
_PAIR = np.take_along_axis(PAIR_OF, _OTHERS, axis=1)
_NEIGHBOUR = (VERTICES[_OTHERS] - VERTICES[:, None] + 1) @ (9, 3, 1)


class _Rows(NamedTuple):
    """Sums over the elements around n cells."""

    coupling: Array  # (n, 27), none with rigid cells
    mass: Array  # (n,)
    least: Array  # least mass (n,)
    total: Array  # sum of the magnitudes of the coupling (n,)


class _ElementSums(NamedTuple):
    """Elements by kind, to be summed around cells."""

    number: NDArray[np.int32]  # kind of the element whose first vertex is a cell, of all cells (nx, ny, nz)
    kinds: InterfaceElements
    least: Array  # masses of the kinds that limit eigenvalues (k, 8)

    def rows(self, cells: Index, hard: NDArray[np.bool_]) -> _Rows:
        """Return the rows of cells (n,), without the rigid ones of a mask."""
        return self._sums(cells, hard, self.kinds.coupling, self.kinds.mass, self.least)

    def losses(self, cells: Index, hard: NDArray[np.bool_]) -> Array:
        """Return the losses of cells (n, 29), of `HeterogeneousCells`; none (n, 0) if nothing absorbs."""
        if not self.kinds.loss.shape[1]:
            return np.zeros((len(cells), 0))
        parts = (self.kinds.loss[:, part] for part in (COUPLING, MASS, GROUND))
        return np.column_stack(self._sums(cells, hard, *parts)[:3])

    def _sums(
        self, cells: Index, hard: NDArray[np.bool_], coupling: Array, mass: Array, least: Array
    ) -> _Rows:
        """Return sums of coupling (k, 28) and of two values at the vertices (k, 8)."""
        from autdtorch.fdtd.assembly.cell_kernels import add_elements  # loads numba

        shape = self.number.shape
        vertices, neighbours = VERTICES @ flat_strides(shape), flat_offsets(shape)
        numbers = tuple(each.astype(np.uint64) for each in (vertices, neighbours, _PAIR, _NEIGHBOUR))
        # numba compiles again for arrays with gaps
        tables = tuple(map(np.ascontiguousarray, (coupling, mass, least)))
        kind, rows, sums = self.number.ravel(), np.empty((len(cells), 27)), np.empty((3, len(cells)))
        spread(
            lambda ends: add_elements(*ends, cells, kind, tables, numbers, hard, rows, sums),
            parts_of_size(len(cells), _TOGETHER),
        )
        return _Rows(rows, *sums)


def _without_rigid(
    elements: Elements, vertices: Index, touched: Index, shape: GridShape, stencil: Stencil, largest: float
) -> tuple[_ElementSums, NDArray[np.bool_], _Rows]:
    """Return the elements without rigid vertices, the mask of rigid cells (k,), and the touched rows."""
    materials = elements.materials
    every = InterfaceElements.joined([_uniform_elements(materials, stencil), elements.interface])
    kind = len(materials.density) + elements.kind
    hard = materials.rigid[_cell_material(elements)]
    hard[vertices] = materials.rigid[every.material][kind]
    inside, densest = touched[hard[touched]], _densest(elements)
    sliver = np.zeros(len(hard), bool)
    sliver[vertices[every.finite[kind]]] = True
    enough = np.where(sliver[inside], max(_SLIVER_COUPLING / densest, _LEAST_COUPLING), _RIGID_COUPLING)
    enough *= stencil.total
    hard[touched] = False
    number, least = np.zeros(shape, np.int32), _least_mass(every, largest)
    number[:-1, :-1, :-1] = elements.material
    number.ravel()[vertices[:, 0]] = kind
    sums = _ElementSums(number, every, least)
    before = np.zeros_like(hard)
    while len(inside):
        loose = sums.rows(inside, hard).total <= enough
        hard[inside[loose]] = True
        if not (new := hard & ~before).any():
            break
        inside, enough = inside[~loose], enough[~loose]
        some, before = np.flatnonzero(new[vertices].any(axis=1)), hard.copy()
        out = hard[vertices[some]]
        both = kind[some] << 8 | np.packbits(out, axis=1)[:, 0]
        _, first, other = np.unique(both, return_index=True, return_inverse=True)
        less = _all_condensed(every.chosen(kind[some[first]]), out[first])
        number.ravel()[vertices[some, 0]] = len(sums.least) + other
        needed = np.concatenate((sums.least, _least_mass(less, largest)))
        sums = _ElementSums(number, InterfaceElements.joined([sums.kinds, less]), needed)
    return sums, hard, sums.rows(touched, hard)


def _uniform_elements(materials: Materials, stencil: Stencil) -> InterfaceElements:
    losses, count = materials.losses, len(materials.density)
    loss = np.zeros((count, 0))
    if losses is not None:
        vertices = np.repeat(losses.mass[:, None] / 8, 8, axis=1)
        coupling = losses.coupling[:, None] * uniform_coupling(stencil)
        loss = np.concatenate((coupling, vertices, np.zeros_like(vertices)), axis=1)
    number = np.repeat(np.arange(count)[:, None], 8, axis=1)
    coupling = uniform_coupling(stencil) / materials.density[:, None]
    flat = np.ones(count, bool)
    return InterfaceElements(coupling, materials.mass[number] / 8, number, ~flat, flat, loss)


def _densest(elements: Elements) -> float:
    return float(elements.materials.density[~elements.materials.rigid].max())


def _all_condensed(interface: InterfaceElements, out: NDArray[np.bool_]) -> InterfaceElements:
    parts = [slice(*ends) for ends in parts_of_size(len(out), _TOGETHER)]
    return InterfaceElements.joined(spread(lambda part: condensed(interface.chosen(part), out[part]), parts))


def condensed(interface: InterfaceElements, out: NDArray[np.bool_]) -> InterfaceElements:
    """Eliminate vertices `out` (n, 8) from the stiffness of elements by static condensation.

    Their pressure takes the value of least energy. To remove their coupling could make the energy negative.
    """
    coupling, followed = without_vertices(interface.coupling, out)
    loss = interface.loss
    if loss.shape[1]:
        loss = condensed_loss(loss, followed, out)
    return interface._replace(coupling=coupling, mass=np.where(out, 0, interface.mass), loss=loss)


def _least_mass(elements: InterfaceElements, largest: float) -> Array:
    """Return masses (k, 8) with which k elements have eigenvalues up to `largest`.

    Eigenvalues of a sum of elements are then as small. Masses at flat faces stay where they suffice: they are
    exact, and a transfer erred by up to 7 % of the wave that passes a resonant slab. Others are in proportion
    to the stiffness of a vertex that moves alone, so that an element of air needs its mass.
    """
    from autdtorch.fdtd.assembly.cell_kernels import least_masses  # loads numba

    coupling = np.ascontiguousarray(elements.coupling)
    mass = np.where(elements.flat[:, None], elements.mass, 0)
    least = np.empty_like(mass)

    def limit(ends: tuple[int, int]) -> None:
        part = slice(*ends)
        least_masses(coupling[part], mass[part], PAIRS, largest, least[part])

    spread(limit, parts_of_size(len(coupling), _TOGETHER))
    return least


def _transferred_mass(coupling: Array, mass: Array, need: Array, touched: Index, shape: GridShape) -> Array:
    """Return masses (n,) of at least `need` (n,), with which few cells shorten the time step.

    A light cell with strong coupling, in a heavy obstacle just below its surface, moves with the air. Mass is
    transferred to it from the cells it is coupled to.
    """
    mass, before, places = mass.copy(), mass.sum(), places_among(touched, math.prod(shape))
    for _ in range(_MASS_TRANSFERS):
        light = np.flatnonzero(need > mass)
        if len(light) == 0:
            break
        neighbour = neighbours(touched[light], shape)
        place = places[neighbour]
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
) -> tuple[list[Array], Index, Array]:
    """Return the cells inside obstacles whose rows are not those of air, and others with their mass.

    Of the former, which absorb or have another speed, indices, rows, masses and losses.
    """
    materials = elements.materials
    factor, losses = materials.speed, materials.losses
    loss = np.zeros((len(factor), 0))
    if losses is not None:
        nothing = np.zeros_like(losses.mass)
        loss = np.column_stack((losses.coupling[:, None] * stencil.weights, losses.mass, nothing))
    stepped, material = (factor != 1) | loss.any(axis=1), _cell_material(elements)
    inside = (stepped | (materials.mass != 1))[material] & ~hard
    inside[touched] = False
    index = inner_cells(inside.reshape(shape))
    number = material[index]
    differs = stepped[number]
    inner = index[~differs], materials.mass[number[~differs]]
    index, number = index[differs], number[differs]
    rows = factor[number, None] * stencil.weights
    return [index, rows, materials.mass[number], loss[number]], *inner
