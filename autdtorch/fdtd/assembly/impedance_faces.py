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
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.element import PAIRS, VERTICES, InterfaceElements, Materials
from autdtorch.fdtd.assembly.impedance import LARGEST_PHASE, facets, outer_side
from autdtorch.fdtd.stencil import Stencil, flat_strides
from autdtorch.utils.array_types import Array, ComplexArray, Index

_CHUNK = 8192  # Elements measured at a time
_ACROSS = 0.99  # Least component along an axis of the normal of a face across it
# Largest |b Y|, so that time steps stay long, and largest part of it that adds mass, relative to kappa: the
# second vertex gives this mass, and keeps most of its own
_LARGEST, _LARGEST_MASS = 0.5, 0.3
_PAIR = np.zeros((8, 8), np.int64)  # Number of each pair of vertices in `PAIRS`
_PAIR[PAIRS[:, 0], PAIRS[:, 1]] = _PAIR[PAIRS[:, 1], PAIRS[:, 0]] = np.arange(len(PAIRS))
_NEXT = (4, 2, 1)  # Difference of the numbers of two vertices along each axis


def with_impedance_faces(
    elements: InterfaceElements,
    index: Index,
    shape: Sequence[int],
    uncut: NDArray[np.bool_],
    distances: Callable[[Index], Array],
    material: Index,
    materials: Materials,
    stencil: Stencil,
) -> InterfaceElements:
    """Return n elements along the grid with the admittances of faces in them.

    `index` (n,) are their flat indices on a grid of `shape` elements, ascending. The mask `uncut` (n,) has
    those without a face, beside the others. `distances` returns the signed distances (K, k, 125) of bodies of
    the materials (K,) in some elements (k,).
    """
    admittance = np.zeros(0) if materials.losses is None else materials.losses.admittance
    coupling = np.zeros((2, len(index), 28), complex)  # T off its diagonal, where it adds mass and stiffness
    mass = np.zeros((2, len(index), 8), complex)  # and sums of its rows
    cut = np.flatnonzero(~uncut)
    for begin in range(0, len(cut), _CHUNK):
        rows = cut[begin : begin + _CHUNK]
        distance = distances(rows)
        for number in np.flatnonzero(admittance).tolist():
            surface = facets(distance, material, number, materials)
            depth, shares = outer_side(surface, materials.rigid[elements.material[rows]])
            across = np.abs(surface.normal) > _ACROSS
            for vertex, axis in np.ndindex(8, 3):
                step = (2 * VERTICES[vertex, axis] - 1) * flat_strides(shape)[axis]
                beyond = np.searchsorted(index, index[rows] + step).clip(max=len(index) - 1)
                linked = uncut[beyond] & (index[beyond] == index[rows] + step)
                here = across[:, :, axis] if axis else across[:, :, 0] | ~across.any(axis=2)
                second = np.where(linked[:, None] & across[:, :, axis], 1.0, 0.0)
                first, second, flow = _face(depth[:, :, vertex], second, admittance[number], stencil.kappa)
                flow *= surface.area * shares[:, :, vertex] * here
                for kind, of_kind in enumerate((flow.imag <= 0, flow.imag > 0)):
                    part = np.where(of_kind, flow, 0)
                    mass[kind, rows, vertex] += (part * first * (first + second)).sum(axis=1)
                    mass[kind, beyond, vertex] += (part * second * (first + second)).sum(axis=1)
                    pair = _PAIR[vertex, vertex ^ _NEXT[axis]]
                    coupling[kind, beyond, pair] += (part * first * second).sum(axis=1)
    factor = stencil.slope.real / 2
    heavy, stiff = factor * mass
    links = factor * coupling.sum(axis=0)
    return elements._replace(
        coupling=elements.coupling - links.imag,
        mass=elements.mass - heavy.imag / stencil.symbol,
        loss=elements.loss + np.concatenate((-links.real, heavy.real + stiff.real, stiff.imag), axis=1),
    )


def _face(
    depth: Array, linked: Array, admittance: complex, kappa: float
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
