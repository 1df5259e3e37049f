"""Faces along the grid that react locally.

Their elements have vertices in air on the outer side alone, at a depth d < 1. Let p and q be the pressures at
the depths d and d + 1. The pressure at the face is a p + b q, and the term of its flow (`impedance.py`) is

    T = (a, b)^T (a, b) Y / (1 - i Y s).

Two forces radiate as the face does for a cos(kappa d) + b cos(kappa (d + 1)) = 1. Their reactions differ,

    s = a^2 cos(kappa d) sin(kappa d) + 2 a b cos(kappa d) sin(kappa (d + 1))
        + b^2 cos(kappa (d + 1)) sin(kappa (d + 1)),

and normal incidence is exact. With a + b = 1 a pressure that is constant across the face is so too: no
incidence has an error of second order. From p alone (b = 0) a face would absorb too much by (kappa d)^2
times the squared sine of incidence. As a square, T is passive.

Each vertex has the part of a face that is in its cell. Interpolation between the vertices would take
pressures from beyond the edges, where they turn.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.aligned import Blocks
from autdtorch.fdtd.assembly.element import PAIRS, VERTICES, InterfaceElements, Materials
from autdtorch.fdtd.assembly.impedance import LARGEST_PHASE
from autdtorch.fdtd.stencil import Stencil, flat_strides
from autdtorch.utils.array_types import Array, ComplexArray, Index

# Largest |b Y|, so that time steps stay long, and largest part of it that adds mass, relative to kappa: the
# second vertex gives this mass, and keeps most of its own
_LARGEST, _LARGEST_MASS = 0.5, 0.3
_PAIR = np.zeros((8, 8), np.int64)  # Number of each pair of vertices in `PAIRS`
_PAIR[PAIRS[:, 0], PAIRS[:, 1]] = _PAIR[PAIRS[:, 1], PAIRS[:, 0]] = np.arange(len(PAIRS))
_NEXT = (4, 2, 1)  # Difference of the numbers of two vertices along each axis


class _Faces(NamedTuple):
    """n rectangles of surfaces that face up or down an axis, each in one cell and in one element."""

    material: Index  # number of the material behind (n,)
    first: Index  # first cell of the element (n, 3)
    place: Array  # centre, from the first vertex (n, 3) [cells]
    area: Array  # [cells^2] (n,)


def _faces(blocks: Blocks, axis: int, up: int, materials: Materials) -> _Faces:
    """Return the faces of reacting materials towards fluids that face up an axis (`up` 1) or down it (0)."""
    others = [other for other in range(3) if other != axis]
    parts = [blocks.planes[other].parts for other in others]
    material = np.moveaxis(blocks.material, axis, 0)[:, parts[0].block][:, :, parts[1].block]
    behind, front = (material[:-1], material[1:]) if up else (material[1:], material[:-1])
    number, *places = np.nonzero(materials.reacting[behind] & ~materials.rigid[front])
    middle, area = np.zeros((len(number), 3)), np.ones(len(number))
    middle[:, axis] = blocks.planes[axis].places[number]
    for other, part, place in zip(others, parts, places, strict=True):
        middle[:, other] = part.middle[place]
        area *= part.width[place]
    first = np.floor(middle).astype(np.int64)
    return _Faces(behind[number, places[0], places[1]], first, middle - first, area)


def with_impedance_faces(
    elements: InterfaceElements,
    index: Index,
    shape: Sequence[int],
    uncut: NDArray[np.bool_],
    blocks: Blocks,
    materials: Materials,
    stencil: Stencil,
) -> InterfaceElements:
    """Return n elements along the grid with the admittances of faces of blocks in them.

    `index` (n,) are their flat indices on a grid of `shape` elements, ascending. The mask `uncut` (n,) has
    those without a face, beside the others.
    """
    if materials.losses is None or not materials.reacting.any() or len(index) == 0:
        return elements
    # T off its diagonal, and sums of its rows where it adds mass and stiffness
    coupling, mass = np.zeros((len(index), 28), complex), np.zeros((2, len(index), 8), complex)
    strides = flat_strides(shape)
    for axis, up in np.ndindex(3, 2):
        faces = _faces(blocks, axis, up, materials)
        row, along = _rows(faces.first @ strides, index)
        usable = (VERTICES[:, axis] == up) & ~materials.rigid[elements.material[row]]
        distance = np.linalg.norm(VERTICES - faces.place[:, None], axis=2)
        vertex = np.where(usable, distance, np.inf).argmin(axis=1)  # of the cell, where it is in a fluid
        beyond, linked = _rows(index[row] + (2 * up - 1) * strides[axis], index)
        depth, admittance = np.abs(up - faces.place[:, axis]), materials.losses.admittance[faces.material]
        first, second, flow = _face(depth, linked & uncut[beyond], admittance, stencil.kappa)
        flow *= faces.area * (along & usable.any(axis=1))
        kind = np.where(flow.imag > 0, 1, 0)
        np.add.at(mass, (kind, row, vertex), flow * first * (first + second))
        np.add.at(mass, (kind, beyond, vertex), flow * second * (first + second))
        np.add.at(coupling, (beyond, _PAIR[vertex, vertex ^ _NEXT[axis]]), flow * first * second)
    factor = stencil.slope.real / 2
    links, (heavy, stiff) = factor * coupling, factor * mass
    return elements._replace(
        coupling=elements.coupling - links.imag,
        mass=elements.mass - heavy.imag / stencil.symbol,
        loss=elements.loss + np.concatenate((-links.real, heavy.real + stiff.real, stiff.imag), axis=1),
    )


def _rows(flat: Index, index: Index) -> tuple[Index, NDArray[np.bool_]]:
    """Return the places of flat indices (n,) in an ascending `index`, and a mask of those in it."""
    row = np.searchsorted(index, flat).clip(max=len(index) - 1)
    return row, index[row] == flat


def _face(
    depth: Array, linked: NDArray[np.bool_], admittance: ComplexArray, kappa: float
) -> tuple[Array, Array, ComplexArray]:
    """Return a, b and Y / (1 - i Y s) of faces at depths [cells]; b is 0 where `linked` is."""
    near = np.clip(kappa * depth, 0, LARGEST_PHASE)
    p, q = np.exp(1j * near), np.exp(1j * (near + kappa))

    def face(b: Array) -> tuple[Array, Array, ComplexArray]:
        a = (1 - b * q.real) / p.real
        s = a**2 * p.real * p.imag + 2 * a * b * p.real * q.imag + b**2 * q.real * q.imag
        return a, b, admittance / (1 - 1j * admittance * s)

    b = linked * (1 - p.real) / (q.real - p.real)
    flows = np.stack((face(b)[2], face(0 * b)[2]))
    largest = np.maximum(abs(flows) / _LARGEST, -flows.imag / (_LARGEST_MASS * kappa)).max(axis=0)
    return face(b / np.maximum(np.abs(b) * largest, 1))
