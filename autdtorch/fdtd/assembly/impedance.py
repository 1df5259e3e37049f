"""Surfaces that react locally: their admittance as mass and damping of the elements they cut.

A surface of admittance Y, as a ratio to air, takes the flow Y p. The equation of a cell, divided by -i w,
gets a term.

    i slope / 2 sum_j T_ij p_j,    T_ij = integral of Y N_i N_j over the surface.

The N are the trilinear functions of the vertices. By the slope of the stencil's symbol, the discrete flow of
a wave differs from the true one. The real part of Y damps, a negative imaginary one (a spring) adds
mass, and a positive one (a mass) adds stiffness against silence: all are positive forms.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.element import (
    FAR,
    PAIRS,
    SUBCELLS,
    VERTICES,
    InterfaceElements,
    Materials,
    shares,
    subcell_gradients,
    subcell_means,
)
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array, ComplexArray, Index

_GROWTH = 1e-3  # Distance [cells] by which a body grows and shrinks for the area of its surface
_CENTERS = (np.array(list(np.ndindex((SUBCELLS,) * 3))) + 0.5) / SUBCELLS  # of the sub-cells (64, 3)
LARGEST_PHASE = 1.2  # Largest phase between a vertex and a surface [rad]
_LEAST_WIDTH = 4e-3  # Least change of a distance over a sub-cell [cells]: cubes of it are not rounding
# Shares of the square of the slope along a surface [cells^2], and of the square of the wavenumber: with both,
# tilted half-spaces reflect as they should to second order, at any incidence, tilt and place
_ALONG, _EXCESS = 0.19, 0.03
_LEAST_GRADIENT = 0.3  # Least gradient of a signed distance with which a place is moved to the surface


class _Facets(NamedTuple):
    """The surface of a material in the sub-cells of n elements."""

    area: Array  # (n, 64) [cells^2]
    place: Array  # from the first vertex (n, 64, 3) [cells]
    normal: Array  # outwards (n, 64, 3)

    def chosen(self, some: NDArray[np.bool_]) -> _Facets:
        """Return the surface in some of the elements."""
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
    place = _CENTERS - subcell_means(level)[..., None] * gradient / steep**2
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
    elements: InterfaceElements,
    distance: Array,
    material: Index,
    materials: Materials,
    stencil: Stencil,
) -> InterfaceElements:
    """Return n elements with the admittances of the surfaces in them; see `_facets` for the arguments."""
    if materials.losses is None or not materials.losses.admittance.any():
        return elements
    admittance = materials.losses.admittance
    coupling, mass = np.zeros((len(elements.mass), 28), complex), np.zeros(elements.mass.shape, complex)
    near = np.asarray((np.abs(distance) < FAR).any(axis=2))
    for number in np.flatnonzero(admittance).tolist():
        some = np.flatnonzero(near[material == number].any(axis=0))
        surface = _facets(distance[:, some], material, number, materials)
        finite = elements.finite[some]
        for make, part in ((_consistent, finite), (_lumped, ~finite)):
            chosen, solid = some[part], materials.rigid[elements.material[some[part]]]
            added = make(surface.chosen(part), solid, admittance[number], stencil.kappa)
            for total, each in zip((coupling, mass), added, strict=True):
                total[chosen] += each
    factor = 0.5j * stencil.slope.real
    coupling, mass = factor * coupling, factor * mass
    loss = -coupling.imag, mass.imag, np.maximum(-mass.real, 0)
    return elements._replace(
        coupling=elements.coupling + coupling.real,
        mass=elements.mass + np.maximum(mass.real, 0) / stencil.symbol,
        loss=elements.loss + np.concatenate(loss, axis=1),
    )


def _consistent(
    surface: _Facets, solid: NDArray[np.bool_], admittance: complex, kappa: float
) -> tuple[ComplexArray, ComplexArray]:
    """Return T of finite elements: off its diagonal (n, 28), and sums of its rows (n, 8).

    Linear interpolation underestimates the power of a pressure that varies along the surface: the squares of
    slopes along it are added.
    """
    area, hats = surface.area[:, :, None], _hats(surface.place)
    both = (1 - _EXCESS * kappa**2) * (area * hats).transpose(0, 2, 1) @ hats
    total, across = both.sum(axis=2), np.zeros_like(hats)
    for axis in range(3):
        slope = _slopes(surface.place, axis)
        both += _ALONG * (area * slope).transpose(0, 2, 1) @ slope
        across += surface.normal[:, :, axis, None] * slope
    both -= _ALONG * (area * across).transpose(0, 2, 1) @ across
    links = both[:, PAIRS[:, 0], PAIRS[:, 1]]
    return np.asarray(admittance * links, complex), np.asarray(admittance * total, complex)


def _lumped(
    surface: _Facets, solid: NDArray[np.bool_], admittance: complex, kappa: float
) -> tuple[ComplexArray, ComplexArray]:
    """Return T of other elements, at the vertices in fluids on the surface's outer side; see `_consistent`.

    The air between a vertex and the surface, a distance d away, is in the element's mass. With t = tan(k d),
    the admittance Y behind it acts as Y (1 + t^2) / (1 - i Y t).
    """
    depth, hats = _outer_side(surface, solid)
    slope = np.tan(np.minimum(kappa * depth, LARGEST_PHASE))
    behind = admittance * (1 + slope**2) / (1 - 1j * admittance * slope)
    return np.zeros((len(hats), 28), complex), (surface.area[:, :, None] * hats * behind).sum(axis=1)


def _outer_side(surface: _Facets, solid: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return the depths (n, 64, 8) [cells] of vertices in front of a surface, and their shares in its flow.

    `solid` (n, 8) is the mask of the vertices in rigid bodies. These, and vertices behind, have no share.
    """
    depth = ((VERTICES - surface.place[:, :, None]) * surface.normal[:, :, None]).sum(axis=3)
    hats = _hats(surface.place) * (~solid[:, None] & (depth > 0))
    whole = hats.sum(axis=2, keepdims=True)
    return depth, np.divide(hats, whole, out=np.zeros_like(hats), where=whole > 0)


def _hats(place: Array) -> Array:
    """Return the trilinear functions (n, q, 8) of the vertices at places (n, q, 3)."""
    place = place[:, :, None]
    return np.asarray(np.where(VERTICES == 1, place, 1 - place).prod(axis=3))


def _slopes(place: Array, axis: int) -> Array:
    """Return the derivatives (n, q, 8) of these functions along an axis."""
    place = place[:, :, None]
    factors = np.where(VERTICES == 1, place, 1 - place)
    factors[..., axis] = 2 * VERTICES[:, axis] - 1
    return np.asarray(factors.prod(axis=3))
