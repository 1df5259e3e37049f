"""Surfaces that react locally: their admittance as mass and damping of the elements they cut.

A surface of admittance Y, over that of air, takes the flow Y p. In the equation of a cell, divided by -i w,
it adds

    i slope / 2 sum_j T_ij p_j,    T_ij = integral of Y N_i N_j over the surface,

with the trilinear functions N of the vertices, and the slope of the stencil's symbol, by which the discrete
flow of a wave differs from the true one. The real part of Y damps, a negative imaginary one (a spring) adds
mass, and a positive one (a mass) adds stiffness against silence: all are positive forms.
"""

from __future__ import annotations

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
    volume_coverage,
)
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array, Index

_GROWTH = 1e-3  # Distance [cells] by which a body grows and shrinks for the area of its surface
_CENTERS = (np.array(list(np.ndindex((SUBCELLS,) * 3))) + 0.5) / SUBCELLS  # of the sub-cells (64, 3)
_LEAST_GRADIENT = 0.3  # Least gradient of a signed distance with which a place is moved to the surface


class Facets(NamedTuple):
    """The surface of a material in the sub-cells of n elements."""

    area: Array  # (n, 64) [cells^2]
    place: Array  # from the first vertex (n, 64, 3) [cells]


def facets(distance: Array, material: Index, number: int, materials: Materials) -> Facets:
    """Return the surface of a material towards fluids, from signed distances (K, n, 125) of all bodies."""
    same = (material == number)[:, None, None]

    def fluid(growth: float) -> Array:
        share = shares(volume_coverage, distance - growth * same, material, len(materials.density))
        return np.asarray(share[..., ~materials.rigid].sum(axis=2))

    area = (fluid(-_GROWTH) - fluid(_GROWTH)) / (2 * _GROWTH) / SUBCELLS**3
    level = np.where(same, distance, FAR).min(axis=0)
    normal = subcell_gradients(level)
    steep = np.linalg.norm(normal, axis=2, keepdims=True)
    depth = subcell_means(level)[..., None] / np.maximum(steep, _LEAST_GRADIENT) ** 2
    return Facets(np.maximum(area, 0), np.clip(_CENTERS - depth * normal, 0, 1))


def with_impedance(
    elements: InterfaceElements,
    distance: Array,
    material: Index,
    materials: Materials,
    stencil: Stencil,
) -> InterfaceElements:
    """Return n elements with the admittances of the surfaces in them; see `facets` for the arguments."""
    if materials.losses is None or not materials.losses.admittance.any():
        return elements
    admittance = materials.losses.admittance
    coupling, mass = np.zeros((len(elements.mass), 28), complex), np.zeros(elements.mass.shape, complex)
    near = np.asarray((np.abs(distance) < FAR).any(axis=2))
    for number in np.flatnonzero(admittance).tolist():
        some = np.flatnonzero(near[material == number].any(axis=0))
        surface = facets(distance[:, some], material, number, materials)
        open_vertices = ~materials.rigid[elements.material[some]] | elements.finite[some, None]
        added = _added(surface, open_vertices, elements.finite[some])
        for total, part in zip((coupling, mass), added, strict=True):
            total[some] += admittance[number] * part
    factor = 0.5j * stencil.slope.real
    coupling, mass = factor * coupling, factor * mass
    loss = -coupling.imag, mass.imag, np.maximum(-mass.real, 0)
    return elements._replace(
        coupling=elements.coupling + coupling.real,
        mass=elements.mass + np.maximum(mass.real, 0) / stencil.symbol,
        loss=elements.loss + np.concatenate(loss, axis=1),
    )


def _added(
    surface: Facets, open_vertices: NDArray[np.bool_], finite: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Return T of a unit admittance: off its diagonal (n, 28), and sums of its rows (n, 8).

    Only finite elements have pressures on both sides of the surface. Others share it among their open
    vertices.
    """
    place = surface.place[:, :, None]
    hats = np.where(VERTICES == 1, place, 1 - place).prod(axis=3) * open_vertices[:, None]
    whole = hats.sum(axis=2, keepdims=True)
    hats = np.divide(hats, whole, out=np.zeros_like(hats), where=whole > 0)
    weighted = surface.area[:, :, None] * hats
    both = np.where(finite[:, None, None], weighted.transpose(0, 2, 1) @ hats, 0)
    return both[:, PAIRS[:, 0], PAIRS[:, 1]], weighted.sum(axis=1)
