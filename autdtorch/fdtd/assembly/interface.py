"""Stiffness and mass of the elements that a surface intersects.

In an element of one material both are those of the tuned stencil. An interface element gets

- coupling in series: density averaged along the line between vertices, exact for a flow across the surface;
- for axis-aligned faces, a product of the direction across the faces and the two others;
- for other surfaces of fluids, a correction that gives two fields along the surface their exact energy. A
  third field crosses the surface with continuous pressure and flow, and keeps its energy in series. With L
  the stiffness in series, N the fields at the vertices and A their exact energies, the correction is
  C^T (A - N^T L N) C with the projection C = (N^T L N)^-1 N^T L. This is the consistency term of virtual
  element methods (Beirao da Veiga et al. 2013) for the local solutions of immersed finite elements (Li 1998);
- masses on their side of the surface, but for the share of a flow through it that reaches the other side;
- at other surfaces of sound-hard bodies, the finite elements of `sound_hard.py` instead.

`docs/decisions/surfaces.md` compares this treatment with others.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.aligned_edges import edge_elements
from autdtorch.fdtd.assembly.aligned_faces import layered_axis, layered_elements, mean_thickness
from autdtorch.fdtd.assembly.coverage import (
    distance_to_material,
    line_coverage,
    shares,
    subcell_means,
    volume_coverage,
)
from autdtorch.fdtd.assembly.element import (
    CORNERS,
    FAR,
    LATTICE,
    PAIRS,
    SUBCELLS,
    VERTICES,
    InterfaceElements,
    Materials,
    stiffness_matrix,
    uniform_coupling,
)
from autdtorch.fdtd.assembly.sound_hard import HATS, added_thickness, cut_coupling, cut_mass
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array, Index

_ABSENT_SHARE = 1e-4  # Share of an element's volume below which a material counts as absent
# Smallest mean gradient of a signed distance with one normal. The two faces of a thin plate cancel.
_LEAST_GRADIENT = 0.5
# Largest curvature [1/cells] of a surface that the local solutions follow. Edges have none.
_LARGEST_CURVATURE = 0.5
# Axes of the second derivatives in a quadratic fit
_SECOND = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def _quadratic(x: Array) -> Array:
    """Return monomials up to degree two at points (n, 3): value, gradient, second derivatives."""
    second = [x[:, a] * x[:, b] / (2 if a == b else 1) for a, b in _SECOND]
    return np.column_stack((np.ones(len(x)), x, *second))


_FIT = np.linalg.pinv(_quadratic(LATTICE - 0.5))


class Bodies(NamedTuple):
    """Bodies near n elements; later ones take precedence."""

    distance: Array  # signed distances of K bodies (K, n, 125) [cells]; `FAR` for those that are not near
    material: Index  # number of the material of each body (K,)
    aligned: NDArray[np.bool_]  # whether all faces of a body are parallel to the grid (K,)
    finite: NDArray[np.bool_]  # whether finite elements represent it in an element (K, n)
    reductions: Array  # share of the stiffness that is taken away near edges of such bodies (n, 3, 3)


def interface_elements(bodies: Bodies, materials: Materials, stencil: Stencil) -> InterfaceElements:
    """Return the stiffness and mass of n elements that surfaces of K bodies intersect."""
    count, (distance, material, aligned, finite, reductions) = len(materials.density), bodies
    # bodies that do not intersect an element must not enter its shares
    distance = np.where((distance > 0).all(axis=2, keepdims=True), FAR, distance)
    distance = np.where((distance < 0).all(axis=2, keepdims=True), -FAR, distance)
    volumes = shares(volume_coverage, distance, material, count)
    lines = shares(line_coverage, distance, material, count)
    coupling = _series_coupling(lines, materials, stencil)
    vertex = _vertex_materials(distance, material)
    layered = layered_axis(vertex, volumes, distance[~aligned])
    near = (np.abs(distance) < FAR).any(axis=2)
    straight = (aligned[:, None] | ~near).all(axis=0) | (layered >= 0)
    moved = np.flatnonzero(~straight)
    grow = mean_thickness(materials, stencil)[material, None, None]
    volumes[moved] = shares(volume_coverage, distance[:, moved] - grow, material, count)
    mass = _lumped_mass(vertex, volumes, materials)
    grown = (near & finite).any(axis=0) & (layered < 0)
    for axis in range(3):
        own = np.flatnonzero(layered == axis)
        share = volumes[own].mean(axis=1)
        coupling[own], mass[own] = layered_elements(axis, vertex[own], share, mass[own], materials, stencil)
    held = (vertex[:, :, None] == np.arange(count)).any(axis=1)
    present = volumes.mean(axis=1) > _ABSENT_SHARE
    two = (held.sum(axis=1) == 2) & (present <= held).all(axis=1)
    cornered = np.flatnonzero(straight & (layered < 0))
    edged, *found = edge_elements(
        distance[:, cornered], material, vertex[cornered], volumes[cornered], materials, stencil
    )
    edged = cornered[edged]
    coupling[edged], mass[edged] = found
    two[edged] = False
    chosen = np.flatnonzero(two & (layered < 0) & ~grown)
    if len(chosen):
        inner = count - 1 - held[chosen, ::-1].argmax(axis=1)
        outer = held[chosen].argmax(axis=1)
        level = distance_to_material(distance[:, chosen], material, inner)
        sides = materials.density[np.stack((outer, inner), axis=1)]
        flat, correction = _correction(level, sides, volumes[chosen], materials, coupling[chosen])
        coupling[chosen[flat]] += correction
    if grown.any():
        thickness = added_thickness(stencil.kappa) * finite[:, grown, None]
        part = shares(volume_coverage, distance[:, grown] - thickness, material, count)
        coupling[grown] = cut_coupling(part, materials, reductions[grown], stencil)
        mass[grown] = cut_mass(part, materials)
    return InterfaceElements(coupling, mass, vertex, grown)


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


def _correction(
    level: Array, sides: Array, volumes: Array, materials: Materials, coupling: Array
) -> tuple[NDArray[np.bool_], Array]:
    """Return which elements have one normal (n,), and coupling that gives local solutions their exact energy.

    `level` (n, 125) is the signed distance to the surface, negative in the inner material. `sides` (n, 2)
    holds the densities of the outer and the inner material, and `coupling` (n, 28) is in series.
    """
    fit = level @ _FIT.T
    steep = np.linalg.norm(fit[:, 1:4], axis=1)
    flat = steep > _LEAST_GRADIENT
    level, sides, volumes, coupling, fit, steep = (
        p[flat] for p in (level, sides, volumes, coupling, fit, steep)
    )
    normal = fit[:, 1:4] / steep[:, None]
    tangents = _tangents(normal)
    bend = _curvature(fit, tangents)

    # Fields at the vertices: surface coordinates of the foot of the vertex, and the kinked one.
    depth = level[:, CORNERS]
    along = (VERTICES - 0.5) @ tangents.transpose(0, 2, 1)
    along = along - depth[:, :, None] * (along @ bend)
    kinked = np.where(depth < 0, sides[:, 1:], sides[:, :1]) * depth
    fields = np.concatenate((along, kinked[:, :, None]), axis=2)

    # Exact energies of the first two by quadrature over the sub-cells; the third keeps its own.
    depth = subcell_means(level)
    stretch = np.eye(2) - depth[:, :, None, None] * bend[:, None]
    mobility = (volumes @ (1 / materials.density)) / SUBCELLS**3
    energy = np.zeros((len(level), 3, 3))
    energy[:, :2, :2] = np.einsum("nq,nqab,nqcb->nac", mobility, stretch, stretch)
    flow = stiffness_matrix(coupling) @ fields
    own = fields.transpose(0, 2, 1) @ flow
    energy[:, 2, 2] = own[:, 2, 2]
    projection = np.linalg.solve(own, flow.transpose(0, 2, 1))
    added = projection.transpose(0, 2, 1) @ (energy - own) @ projection
    return flat, -added[:, PAIRS[:, 0], PAIRS[:, 1]]


def mean_gradient(level: Array) -> Array:
    """Return the mean gradient (..., 3) of signed distances at the lattice (..., 125)."""
    return np.asarray(level @ _FIT[1:4].T)


def _tangents(normal: Array) -> Array:
    """Return two unit vectors (n, 2, 3) orthogonal to unit vectors (n, 3)."""
    helper = np.where(np.abs(normal[:, :1]) < 0.7, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack((first, np.cross(normal, first)), axis=1)


def _curvature(fit: Array, tangents: Array) -> Array:
    """Return the curvature (n, 2, 2) [1/cells] of the surface, zero where it is too sharp to follow."""
    hessian = np.zeros((len(fit), 3, 3))
    for column, (a, b) in enumerate(_SECOND, start=4):
        hessian[:, a, b] = hessian[:, b, a] = fit[:, column]
    bend = tangents @ hessian @ tangents.transpose(0, 2, 1)
    bend[np.abs(np.linalg.eigvalsh(bend)).max(axis=1) > _LARGEST_CURVATURE] = 0
    return bend


def _lumped_mass(vertex: Index, volumes: Array, materials: Materials) -> Array:
    """Return masses at the vertices (n, 8).

    Vertices in a material take its mass, but for the share of a flow through the surface that reaches those
    of other fluids. With one face across the line between two vertices, both standing waves are then exact.
    """
    total = np.zeros(vertex.shape)
    mean = volumes.mean(axis=1) @ materials.density
    for own, mass in enumerate(materials.mass):
        inside = vertex == own
        beside = ~inside & ~materials.sound_hard[vertex]
        beside[~inside.any(axis=1)] = True
        near, far = inside @ HATS.T, beside @ HATS.T
        passed = np.minimum(1, (materials.density[own] / mean)[:, None] * far)
        passed[~inside.any(axis=1)] = 1
        volume = volumes[:, :, own] / SUBCELLS**3
        here = (volume * np.divide(1 - passed, near, out=np.zeros_like(near), where=near > 0)) @ HATS
        there = (volume * np.divide(passed, far, out=np.zeros_like(far), where=far > 0)) @ HATS
        total += mass * (np.where(inside, here, 0) + np.where(beside, there, 0))
    return total
