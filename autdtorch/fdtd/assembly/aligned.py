"""Elements that only bodies with faces parallel to the grid intersect."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import label

from autdtorch.fdtd.assembly.blocks import Blocks, varies
from autdtorch.fdtd.assembly.element import VERTICES, InterfaceElements, Materials, uniform_coupling
from autdtorch.fdtd.assembly.layers import layered_elements, two_port
from autdtorch.fdtd.assembly.prisms import Prisms, prisms, stacked
from autdtorch.fdtd.assembly.sections import Kinds, Section
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array, Index

# Most elements along an axis of those that are fitted together; edges farther apart are fitted as if alone
_TOGETHER = 4
_CLOSED_DENSITY = 1e12
# Stiffness that elements at corners get beyond the mean of their slices, relative to what the slices lack
_STIFFER = 0.2


def aligned_elements(
    first: Index, blocks: Blocks, materials: Materials, stencil: Stencil
) -> InterfaceElements:
    """Return elements, by their first cells (n, 3), that vary among blocks.

    Elements of one kind are equal: each kind is assembled once.
    """
    kinds, place = np.unique(blocks.kinds_of(first), axis=0, return_inverse=True)
    varied = np.stack([each[tuple(kinds.T)] for each in blocks.varied], axis=1)
    coupling, mass = np.zeros((len(kinds), 28)), np.zeros((len(kinds), 8))
    for axis in range(3):
        for make, own in (
            (_layered, varied[:, axis] & (varied.sum(axis=1) == 1)),
            (_prismatic, ~varied[:, axis] & (varied.sum(axis=1) == 2)),
        ):
            coupling[own], mass[own] = make(axis, kinds[own], blocks, materials, stencil)
    own = varied.all(axis=1)
    coupling[own], mass[own] = _cornered(kinds[own], blocks, materials, stencil)
    vertex = blocks.at_vertices(first[:, None] + VERTICES)
    place = place.ravel()
    return InterfaceElements(coupling[place], mass[place], vertex, np.zeros(len(first), bool))


def _layered(
    axis: int, kinds: Index, blocks: Blocks, materials: Materials, stencil: Stencil
) -> tuple[Array, Array]:
    """Return coupling (n, 28) and mass (n, 8) of kinds of elements (n, 3) that vary along an axis alone."""
    planes, across = blocks.planes[axis], [other for other in range(3) if other != axis]
    columns = np.moveaxis(blocks.material, axis, 2)
    most = int((planes.last - planes.first)[kinds[:, axis]].max(initial=0)) + 1
    width, layer = np.zeros((len(kinds), most)), np.zeros((len(kinds), most), np.int64)
    for number, kind in enumerate(kinds):
        own, (one, other) = kind[axis], kind[across]
        first, last = planes.first[own], planes.last[own]
        place = tuple(
            blocks.planes[each].first[part] for each, part in zip(across, (one, other), strict=True)
        )
        ends = np.concatenate(([0.0], planes.cuts(own), [1.0]))
        width[number, : last - first + 1] = np.diff(ends)
        layer[number] = columns[place][np.minimum(first + np.arange(most), last)]
    wavenumber = stencil.kappa * materials.slowness[layer]
    ports = two_port(width, _densities(materials)[layer], wavenumber, stencil.kappa)
    return layered_elements(axis, ports, layer[:, [0, -1]], materials, stencil)


def _prismatic(
    axis: int, kinds: Index, blocks: Blocks, materials: Materials, stencil: Stencil
) -> tuple[Array, Array]:
    """Return coupling (n, 28) and mass (n, 8) of kinds of elements (n, 3) that do not vary along an axis."""
    number = _numbers(materials)
    coupling, mass = np.zeros((len(kinds), 28)), np.zeros((len(kinds), 8))
    planes = blocks.planes[axis]
    levels = planes.centers[planes.begin[kinds[:, axis]]]
    across = [other for other in range(3) if other != axis]
    for level in np.unique(levels):
        sections = _Sections(blocks, axis, int(level))
        for row in np.flatnonzero(levels == level):
            section, place = sections.around(kinds[row, across])
            own = Prisms(*(part[place] for part in prisms(section, number, stencil)))
            coupling[row], mass[row] = stacked(np.ones(1), [own], axis, stencil)
    return coupling, mass


def _densities(materials: Materials) -> Array:
    """Return the densities (m,) with sound-hard ones so large that the thinnest sheet lets nothing pass."""
    return np.where(materials.sound_hard, _CLOSED_DENSITY, materials.density)


def _numbers(materials: Materials) -> Kinds:
    """Return materials as numbers that can be keys."""
    return Kinds(
        tuple(_densities(materials).tolist()),
        tuple(materials.mass.tolist()),
        tuple(materials.sound_hard.tolist()),
    )


def _cornered(kinds: Index, blocks: Blocks, materials: Materials, stencil: Stencil) -> tuple[Array, Array]:
    """Return coupling (n, 28) and mass (n, 8) of kinds of elements (n, 3) that vary along all axes.

    Along each axis an element is a stack of slices that do not vary along it; the mean over the axes counts.
    """
    number = _numbers(materials)
    coupling, mass = np.zeros((len(kinds), 28)), np.zeros((len(kinds), 8))
    sections = {}
    for axis, planes in enumerate(blocks.planes):
        across = [other for other in range(3) if other != axis]
        for row, kind in enumerate(kinds):
            slices = []
            for level in range(planes.first[kind[axis]], planes.last[kind[axis]] + 1):
                if (axis, level) not in sections:
                    sections[axis, level] = _Sections(blocks, axis, level)
                section, place = sections[axis, level].around(kind[across])
                slices.append(Prisms(*(part[place] for part in prisms(section, number, stencil))))
            width = np.diff(np.concatenate(([0.0], planes.cuts(kind[axis]), [1.0])))
            for total, part in zip((coupling, mass), stacked(width, slices, axis, stencil), strict=True):
                total[row] += part / 3
    missing = 1 - coupling.sum(axis=1) / uniform_coupling(stencil).sum()
    return coupling * (1 + _STIFFER * np.maximum(missing, 0))[:, None], mass


class _Sections:
    """Sections across an axis, at the level of one block, around the elements that vary along both axes."""

    def __init__(self, blocks: Blocks, axis: int, level: int) -> None:
        """Find the elements, and which of them touch."""
        self._material = np.take(blocks.material, [level], axis=axis).squeeze(axis)
        self._planes = [planes for other, planes in enumerate(blocks.planes) if other != axis]
        varied = [varies(self._material, self._planes, each) for each in (0, 1)]
        self._group = np.asarray(label(varied[0] & varied[1], np.ones((3, 3)))[0])

    def around(self, kind: Index) -> tuple[Section, tuple[int, int]]:
        """Return the section of elements of a kind (2,) and those that touch them, and their place in it."""
        x, y = map(int, kind)
        ends = [(x, x), (y, y)]
        if self._group[x, y]:
            group = np.nonzero(self._group == self._group[x, y])
            together = [(int(own.min()), int(own.max())) for own in group]
            ends = together if max(b - a for a, b in together) < _TOGETHER else ends
        runs = list(zip(self._planes, ends, strict=True))
        rows, columns = (slice(planes.first[a], planes.last[b] + 1) for planes, (a, b) in runs)
        part, cuts = self._material[rows, columns], []
        for axis, (planes, (first, last)) in enumerate(runs):
            faces = (np.diff(part, axis=axis) != 0).any(axis=1 - axis)
            cuts.append(tuple(planes.cuts(slice(first, last + 1))[faces].tolist()))
            part = np.compress(np.append(True, faces), part, axis=axis)
        size = ends[0][1] - ends[0][0] + 1, ends[1][1] - ends[1][0] + 1
        section = Section(size, (cuts[0], cuts[1]), tuple(map(tuple, part.tolist())))
        return section, (x - ends[0][0], y - ends[1][0])
