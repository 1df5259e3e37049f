"""Stiffness and mass of the elements that a surface intersects.

In an element of one material both are those of the tuned stencil. An interface element gets

- coupling in series: density averaged along the line between vertices, exact for a flow across the surface;
- for axis-aligned faces, a product of the direction across the faces and the two others;
- for other surfaces of fluids, the forces or the energies of local fields (`smooth_faces.py`);
- masses on their side of the surface, except for the share of a flow through it which reaches the other side;
- at other surfaces of sound-hard bodies, and edges of fluids, the finite elements of `sound_hard.py` instead.

`docs/decisions/surfaces.md` compares this treatment with others.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.coverage import (
    distance_to_material,
    line_coverage,
    shares,
    volume_coverage,
)
from autdtorch.fdtd.assembly.element import (
    CORNERS,
    FAR,
    PAIRS,
    SUBCELLS,
    InterfaceElements,
    Materials,
    uniform_coupling,
)
from autdtorch.fdtd.assembly.flat_faces import crossed_by_layers, flat_elements, layered_axis
from autdtorch.fdtd.assembly.layers import mean_thickness
from autdtorch.fdtd.assembly.masses import balanced_mass, lumped_mass
from autdtorch.fdtd.assembly.smooth_faces import Surface, smooth_stiffness, surfaces
from autdtorch.fdtd.assembly.sound_hard import added_thickness, cut_coupling, cut_mass
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array, Index

# Share of a rigid face's thickness by which the heavier fluid of a smooth surface is shrunk, and the ratio of
# densities that halves it: the mean phase of tilted half-spaces is then right
_SHRUNK, _SHRUNK_RATIO = 0.5, 12.0
_ABSENT_SHARE = 1e-4  # Share of an element's volume below which a material counts as absent


class Bodies(NamedTuple):
    """Bodies near n elements; later ones take precedence."""

    distance: Array  # signed distances of K bodies (K, n, 125) [cells]; `FAR` for those that are not near
    material: Index  # number of the material of each body (K,)
    finite: NDArray[np.bool_]  # whether finite elements represent it in an element (K, n)
    reductions: Array  # share of the stiffness that is taken away near edges of such bodies (n, 3, 3)

    def chosen(self, some: Index | NDArray[np.bool_]) -> Bodies:
        """Return the bodies near some of the elements."""
        return self._replace(
            distance=self.distance[:, some], finite=self.finite[:, some], reductions=self.reductions[some]
        )


def interface_elements(bodies: Bodies, materials: Materials, stencil: Stencil) -> InterfaceElements:
    """Return the stiffness and mass of n elements that surfaces of K bodies intersect."""
    distance, material = bodies.distance, bodies.material
    # bodies that do not intersect an element must not enter its shares
    crossed = crossed_by_layers(distance)
    outside, inside = (distance > 0).all(axis=2) & ~crossed, (distance < 0).all(axis=2) & ~crossed
    distance = np.where(outside[:, :, None], FAR, np.where(inside[:, :, None], -FAR, distance))
    bodies = bodies._replace(distance=distance)
    volumes = shares(volume_coverage, distance, material, len(materials.density))
    vertex = _vertex_materials(distance, material)
    layered = layered_axis(distance)
    near = (np.abs(distance) < FAR).any(axis=2)
    finite = (near & bodies.finite).any(axis=0) & (layered < 0)
    coupling, mass = np.zeros((len(vertex), 28)), np.zeros(vertex.shape)
    if finite.any():
        coupling[finite], mass[finite] = _finite_elements(bodies.chosen(finite), materials, stencil)
    if (other := ~finite).any():
        cut = _Cut(vertex[other], volumes[other], coupling[other], mass[other])
        _set_others(cut, bodies.chosen(other), layered[other], materials, stencil)
        coupling[other], mass[other] = cut.coupling, cut.mass
    return InterfaceElements(coupling, mass, vertex, finite)


class _Cut(NamedTuple):
    """Elements that surfaces intersect, whose coupling and mass are set in place."""

    vertex: Index  # material at the vertices (n, 8)
    volumes: Array  # shares of the materials in the sub-cells (n, 64, m)
    coupling: Array  # (n, 28)
    mass: Array  # (n, 8)


def _set_others(cut: _Cut, bodies: Bodies, layered: Index, materials: Materials, stencil: Stencil) -> None:
    """Set elements that are no finite elements.

    `layered` (n,) is the axis along which alone an element varies, or -1.
    """
    count, distance, material = len(materials.density), bodies.distance, bodies.material
    vertex, volumes, coupling, mass = cut
    moved = np.flatnonzero(layered < 0)
    grow = mean_thickness(materials, stencil)[material, None, None]
    volumes[moved] = shares(volume_coverage, distance[:, moved] - grow, material, count)
    lines = shares(line_coverage, distance, material, count)
    coupling[:] = _series_coupling(lines, materials, stencil)
    mass[:] = lumped_mass(vertex, volumes, materials)
    for axis in range(3):
        own = np.flatnonzero(layered == axis)
        coupling[own], mass[own] = flat_elements(axis, distance[:, own], material, materials, stencil)
    held = (vertex[:, :, None] == np.arange(count)).any(axis=1)
    present = volumes.mean(axis=1) > _ABSENT_SHARE
    two = (held.sum(axis=1) == 2) & (present <= held).all(axis=1) & (layered < 0)
    _set_smooth(cut, bodies, held, np.flatnonzero(two), materials, stencil)


def _set_smooth(
    cut: _Cut,
    bodies: Bodies,
    held: NDArray[np.bool_],
    chosen: Index,
    materials: Materials,
    stencil: Stencil,
) -> None:
    """Set the `chosen` elements of two materials in which the surface between them has one normal.

    `held` (n, m) are the materials at the vertices.
    """
    count = len(materials.density)
    inner = count - 1 - held[chosen, ::-1].argmax(axis=1)
    level = distance_to_material(bodies.distance[:, chosen], bodies.material, inner)
    sides = np.stack((held[chosen].argmax(axis=1), inner), axis=1)
    flat, surface = surfaces(level, materials.density[sides])
    own, pair = chosen[flat], sides[flat]
    mobility = cut.volumes[own] @ (1 / materials.density) / SUBCELLS**3
    cut.coupling[own], weight = smooth_stiffness(
        surface, mobility, cut.coupling[own], uniform_coupling(stencil)
    )
    some = weight > 0
    own, pair, surface, weight = own[some], pair[some], surface.chosen(some), weight[some, None]
    part = _moved_shares(surface, pair, added_thickness(stencil.kappa), count)
    lumped = lumped_mass(cut.vertex[own], part, materials)
    cut.mass[own] += weight * (balanced_mass(surface, materials.mass[pair], lumped) - cut.mass[own])


def _finite_elements(bodies: Bodies, materials: Materials, stencil: Stencil) -> tuple[Array, Array]:
    """Return coupling (n, 28) and mass (n, 8) of finite elements, the bodies grown by the added thickness."""
    contrast = np.where(materials.sound_hard, 1, (materials.density - 1) / (materials.density + 1))
    contrast = contrast[bodies.material, None, None] * bodies.finite[:, :, None]
    grown = bodies.distance - added_thickness(stencil.kappa) * contrast
    part = shares(volume_coverage, grown, bodies.material, len(materials.density))
    return cut_coupling(part, materials, bodies.reductions, stencil), cut_mass(part, materials)


def _vertex_materials(distance: Array, material: Index) -> Index:
    """Return the material at each vertex (n, 8), from distances at the lattice (K, n, 125)."""
    vertex = np.zeros((distance.shape[1], 8), np.int64)
    for far, own in zip(distance, material, strict=True):
        vertex[far[:, CORNERS] < 0] = own
    return vertex


def _series_coupling(lines: Array, materials: Materials, stencil: Stencil) -> Array:
    """Return coupling coefficients (n, 28) with the density averaged along each line (n, 112, m)."""
    density = (lines @ materials.density).reshape(-1, len(PAIRS), SUBCELLS).mean(axis=2)
    return np.asarray(uniform_coupling(stencil) / density)


def _moved_shares(surface: Surface, pair: Index, thickness: float, count: int) -> Array:
    """Return the shares (n, 64, count) of two materials (n, 2), with the heavier one shrunk.

    A wave on the grid is otherwise reflected in front of the surface, by a part of a rigid face's thickness.
    """
    outer, inner = surface.density.T
    ratio = np.maximum(outer, inner) / np.minimum(outer, inner)
    shrunk = _SHRUNK * thickness / (1 + ratio / _SHRUNK_RATIO) * (inner - outer) / np.maximum(outer, inner)
    part = volume_coverage(surface.level + shrunk[:, None])
    share = np.zeros((*part.shape, count))
    np.put_along_axis(share, pair[:, None, :1], (1 - part)[:, :, None], axis=2)
    np.put_along_axis(share, pair[:, None, 1:], part[:, :, None], axis=2)
    return share
