"""Surfaces with an impedance, which react locally: admittance as mass and damping of the elements they cut.

A surface of admittance Y, as a ratio to air, takes the flow Y p. The equation of a cell, divided by -i w,
gets a term.

    i slope / 2 sum_j T_ij p_j,    T_ij = integral of Y N_i N_j over the surface.

The N are the trilinear functions of the vertices. By the slope of the stencil's symbol, the discrete flow of
a wave differs from the true one. The real part of Y damps, a negative imaginary one (a spring) adds
mass, and a positive one (a mass) adds stiffness against silence: all are positive forms.

Along the grid, the elements of a face have vertices in air on its outer side alone, at a depth d < 1. Let p
and q be the pressures at the depths d and d + 1. The pressure at the face is a p + b q, and the term of its
flow is

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

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.aligned import MaterialBlocks
from autdtorch.fdtd.assembly.interface import Bodies
from autdtorch.fdtd.assembly.reference_element import (
    FAR,
    PAIR_OF,
    PAIRS,
    SUBCELLS,
    SUBCENTERS,
    VERTICES,
    InterfaceElements,
    Materials,
    hat_slopes,
    hats,
    shares,
    subcell_gradients,
    subcell_means,
)
from autdtorch.fdtd.stencil import Stencil, flat_strides
from autdtorch.utils.array_types import Array, ComplexArray, Index

_GROWTH = 1e-3  # Distance [cells] by which a body grows and shrinks for the area of its surface
_LARGEST_PHASE = 1.2  # Largest phase between a vertex and a surface [rad]
_LEAST_WIDTH = 4e-3  # Least change of a distance over a sub-cell [cells]: cubes of it are not rounding
# Shares of the square of the slope along a surface [cells^2], and of the square of the wavenumber: with both,
# tilted half-spaces reflect as they should to second order, at any incidence, tilt and place
_ALONG, _EXCESS = 0.19, 0.03
_LEAST_GRADIENT = 0.3  # Least gradient of a signed distance with which a place is moved to the surface

# Largest |b Y|, so that time steps stay long, and largest part of it that adds mass, relative to kappa: the
# second vertex gives this mass, and keeps most of its own
_LARGEST, _LARGEST_MASS = 0.5, 0.3
_NEXT = (4, 2, 1)  # Difference of the numbers of two vertices along each axis


class _Facets(NamedTuple):
    """The surface of a material in the sub-cells of n elements."""

    area: Array  # (n, 64) [cells^2]
    place: Array  # from the first vertex (n, 64, 3) [cells]
    normal: Array  # outwards (n, 64, 3)

    def chosen(self, some: NDArray[np.bool_]) -> _Facets:
        return _Facets(*(part[some] for part in self))


def _facets(distance: Array, material: Index, number: int, materials: Materials) -> _Facets:
    """Return the surface of a material towards fluids in the sub-cells of n elements.

    Signed distances (K, n, 125) are those of all bodies.
    """
    same = (material == number)[:, None, None]

    def fluid(growth: float) -> Array:
        share = shares(_coverage, distance - growth * same, material, len(materials.density))
        return np.asarray(share[..., ~materials.rigid].sum(axis=2))

    area = (fluid(-_GROWTH) - fluid(_GROWTH)) / (2 * _GROWTH) / SUBCELLS**3
    level = np.where(same, distance, FAR).min(axis=0)
    gradient = subcell_gradients(level)
    steep = np.maximum(np.linalg.norm(gradient, axis=2, keepdims=True), _LEAST_GRADIENT)
    place = SUBCENTERS - subcell_means(level)[..., None] * gradient / steep**2
    return _Facets(np.maximum(area, 0), np.clip(place, 0, 1), gradient / steep)


def _coverage(distance: Array) -> Array:
    """Return the share of each sub-cell (..., 64) inside a body, exact for faces at any tilt.

    Along each axis a linear distance is spread evenly: the share is the distribution of a sum of three.
    """
    slopes = np.moveaxis(subcell_gradients(distance), -1, 0)
    width = np.maximum(np.abs(slopes) / SUBCELLS, _LEAST_WIDTH)
    level = np.clip(subcell_means(distance), -1, 1)
    total = np.zeros_like(level)
    for sides in itertools.product((-1, 1), repeat=3):
        end = (np.array(sides) / 2) @ width.reshape(3, -1)
        total += np.prod(sides) * np.maximum(end.reshape(level.shape) - level, 0) ** 3
    return np.asarray(np.clip(total / (6 * width.prod(axis=0)), 0, 1))


def with_impedance(
    elements: InterfaceElements, bodies: Bodies, materials: Materials, stencil: Stencil
) -> InterfaceElements:
    """Return n elements with the admittances of the surfaces of K bodies in them."""
    if materials.losses is None or not materials.losses.admittance.any():
        return elements
    admittance = materials.losses.admittance
    coupling, mass = np.zeros((len(elements.mass), 28), complex), np.zeros(elements.mass.shape, complex)
    near = np.asarray((np.abs(bodies.distance) < FAR).any(axis=2))
    for number in np.flatnonzero(admittance).tolist():
        some = np.flatnonzero(near[bodies.material == number].any(axis=0))
        surface = _facets(bodies.distance[:, some], bodies.material, number, materials)
        finite, solid = elements.finite[some], materials.rigid[elements.material[some]]
        parts = [(_lumped, ~finite, np.ones_like(surface.area), solid)]
        parts += [(_consistent, finite, *side.chosen(some)) for side in bodies.sides]
        for make, chosen, share, out in parts:
            which = chosen & share.any(axis=1)
            part = surface._replace(area=surface.area * share).chosen(which)
            added = make(part, out[which], admittance[number], stencil.kappa)
            for total, each in zip((coupling, mass), added, strict=True):
                total[some[which]] += each
    factor = 0.5j * stencil.slope.real
    coupling, mass = factor * coupling, factor * mass
    loss = -coupling.imag, mass.imag, np.maximum(-mass.real, 0)
    return elements._replace(
        coupling=elements.coupling + coupling.real,
        mass=elements.mass + np.maximum(mass.real, 0) / stencil.symbol,
        loss=elements.loss + np.concatenate(loss, axis=1),
    )


def _consistent(
    surface: _Facets, out: NDArray[np.bool_], admittance: complex, kappa: float
) -> tuple[ComplexArray, ComplexArray]:
    """Return T of finite elements: off its diagonal (n, 28), and sums of its rows (n, 8).

    Linear interpolation underestimates the power of a pressure that varies along the surface: the squares of
    slopes along it are added. Vertices `out` (n, 8) have no share.
    """
    share = hats(surface.place) * ~out[:, None]
    whole = share.sum(axis=2, keepdims=True)
    whole[whole == 0] = np.inf
    area, share = surface.area[:, :, None], share / whole
    both = (1 - _EXCESS * kappa**2) * (area * share).transpose(0, 2, 1) @ share
    total, across = both.sum(axis=2), np.zeros_like(share)
    for axis in range(3):
        slope = hat_slopes(surface.place, axis) * ~out[:, None] / whole
        slope -= share * slope.sum(axis=2, keepdims=True)
        both += _ALONG * (area * slope).transpose(0, 2, 1) @ slope
        across += surface.normal[:, :, axis, None] * slope
    both -= _ALONG * (area * across).transpose(0, 2, 1) @ across
    links = both[:, PAIRS[:, 0], PAIRS[:, 1]]
    return np.asarray(admittance * links, complex), np.asarray(admittance * total, complex)


def _lumped(
    surface: _Facets, out: NDArray[np.bool_], admittance: complex, kappa: float
) -> tuple[ComplexArray, ComplexArray]:
    """Return T of other elements, at the vertices in fluids on the surface's outer side; see `_consistent`.

    The air between a vertex and the surface, a distance d away, is in the element's mass. With t = tan(k d),
    the admittance Y behind it acts as Y (1 + t^2) / (1 - i Y t).
    """
    depth = ((VERTICES - surface.place[:, :, None]) * surface.normal[:, :, None]).sum(axis=3)
    share = hats(surface.place) * (~out[:, None] & (depth > 0))  # vertices behind have none
    whole = share.sum(axis=2, keepdims=True)
    share = np.divide(share, whole, out=np.zeros_like(share), where=whole > 0)
    slope = np.tan(np.minimum(kappa * depth, _LARGEST_PHASE))
    behind = admittance * (1 + slope**2) / (1 - 1j * admittance * slope)
    return np.zeros((len(share), 28), complex), (surface.area[:, :, None] * share * behind).sum(axis=1)


class _Faces(NamedTuple):
    """n rectangles of surfaces that face up or down an axis, each in one cell and in one element."""

    material: Index  # number of the material behind (n,)
    first: Index  # first cell of the element (n, 3)
    place: Array  # centre, from the first vertex (n, 3) [cells]
    area: Array  # [cells^2] (n,)


def _faces(blocks: MaterialBlocks, axis: int, up: int, materials: Materials) -> _Faces:
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
    blocks: MaterialBlocks,
    materials: Materials,
    stencil: Stencil,
) -> InterfaceElements:
    """Return n elements along the grid with the admittances of faces of blocks in them.

    `index` (n,) are their flat indices on a grid of `shape` elements, ascending. The mask `uncut` (n,) has
    those without a face, beside the others.
    """
    assert materials.losses
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
        np.add.at(coupling, (beyond, PAIR_OF[vertex, vertex ^ _NEXT[axis]]), flow * first * second)
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
    near = np.clip(kappa * depth, 0, _LARGEST_PHASE)
    p, q = np.exp(1j * near), np.exp(1j * (near + kappa))

    def face(b: Array) -> tuple[Array, Array, ComplexArray]:
        a = (1 - b * q.real) / p.real
        s = a**2 * p.real * p.imag + 2 * a * b * p.real * q.imag + b**2 * q.real * q.imag
        return a, b, admittance / (1 - 1j * admittance * s)

    b = linked * (1 - p.real) / (q.real - p.real)
    flows = np.stack((face(b)[2], face(0 * b)[2]))
    largest = np.maximum(abs(flows) / _LARGEST, -flows.imag / (_LARGEST_MASS * kappa)).max(axis=0)
    return face(b / np.maximum(np.abs(b) * largest, 1))
