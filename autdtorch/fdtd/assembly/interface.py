"""Stiffness and mass of the elements that a surface intersects.

In an element of one material both are those of the tuned stencil. An interface element gets

- coupling in series: density averaged along the line between vertices, exact for a flow across the surface;
- for axis-aligned faces, a product of the direction across the faces and the two others;
- for other surfaces of fluids, a correction that gives two fields along the surface their exact energy. A
  third field crosses the surface with continuous pressure and flow, and keeps its energy in series. With L
  the stiffness in series, N the fields at the vertices and A their exact energies, the correction is
  C^T (A - N^T L N) C with the projection C = (N^T L N)^-1 N^T L. This is the consistency term of virtual
  element methods (Beirao da Veiga et al. 2013) for the local solutions of immersed finite elements (Li 1998);
- masses on their side of the surface: a sliver of air gives its mass to the vertices in air;
- at other surfaces of sound-hard bodies, the finite elements of `sound_hard.py` instead.

`docs/decisions/surfaces.md` compares this treatment with others.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.element import (
    CORNERS,
    EDGES_BETWEEN,
    FAR,
    LATTICE,
    PAIRS,
    SUBCELLS,
    VERTICES,
    InterfaceElements,
    Materials,
    coupling_by_edges,
    stiffness_matrix,
    uniform_coupling,
)
from autdtorch.fdtd.assembly.sound_hard import HATS, added_thickness, cut_coupling, cut_mass
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array, Index

_ABSENT_SHARE = 1e-4  # Share of an element's volume below which a material counts as absent
# Smallest mean gradient of a signed distance with one normal. The two faces of a thin plate cancel.
_LEAST_GRADIENT = 0.5
_PLANE_VARIATION = 1e-6  # Largest variation of a signed distance along an axis-aligned face: rounding
# Largest curvature [1/cells] of a surface that the local solutions follow. Edges have none.
_LARGEST_CURVATURE = 0.5
# Diagonal coupling that an element full of the heavier material supplies, relative to its own need. The
# element behind has a sixth to spare, and half of that is used.
_DIAGONAL_SHARE = 6.0
# Axes of the second derivatives in a quadratic fit
_SECOND = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def _quadratic(x: Array) -> Array:
    """Return monomials up to degree two at points (n, 3): value, gradient, second derivatives."""
    second = [x[:, a] * x[:, b] / (2 if a == b else 1) for a, b in _SECOND]
    return np.column_stack((np.ones(len(x)), x, *second))


_FIT = np.linalg.pinv(_quadratic(LATTICE - 0.5))
_FROM, _TO = VERTICES[PAIRS[:, 0], None], VERTICES[PAIRS[:, 1], None]
_ALONG = SUBCELLS * _FROM + np.arange(SUBCELLS + 1)[:, None] * (_TO - _FROM)
# Indices in the lattice of the points along the line between each pair of vertices (28, 5)
_LINES = np.ravel_multi_index(tuple(np.moveaxis(_ALONG, -1, 0)), (SUBCELLS + 1,) * 3)


class Bodies(NamedTuple):
    """Bodies near n elements; later ones take precedence."""

    distance: Array  # signed distances of K bodies (K, n, 125) [cells]; `FAR` for those that are not near
    material: Index  # number of the material of each body (K,)
    finite: NDArray[np.bool_]  # whether finite elements represent it in an element (K, n)
    reductions: Array  # share of the stiffness that is taken away near edges of such bodies (n, 3, 3)


def interface_elements(bodies: Bodies, materials: Materials, stencil: Stencil) -> InterfaceElements:
    """Return the stiffness and mass of n elements that surfaces of K bodies intersect."""
    count, (distance, material, finite, reductions) = len(materials.density), bodies
    # bodies that do not intersect an element must not enter its shares
    distance = np.where((distance > 0).all(axis=2, keepdims=True), FAR, distance)
    distance = np.where((distance < 0).all(axis=2, keepdims=True), -FAR, distance)
    volumes = _shares(_volume_coverage, distance, material, count)
    lines = _shares(_line_coverage, distance, material, count)
    coupling = _series_coupling(lines, materials, stencil)
    vertex = _vertex_materials(distance, material)
    layered = _layered_axis(distance)
    grown = ((np.abs(distance) < FAR).any(axis=2) & finite).any(axis=0) & (layered < 0)
    for axis in range(3):
        own = layered == axis
        coupling[own] = _layered_coupling(axis, vertex[own], volumes[own], materials, stencil)
    held = (vertex[:, :, None] == np.arange(count)).any(axis=1)
    present = volumes.mean(axis=1) > _ABSENT_SHARE
    two = (held.sum(axis=1) == 2) & (present <= held).all(axis=1)
    chosen = np.flatnonzero(two & (layered < 0) & ~grown)
    if len(chosen):
        inner = count - 1 - held[chosen, ::-1].argmax(axis=1)
        outer = held[chosen].argmax(axis=1)
        level = _distance_to_material(distance[:, chosen], material, inner)
        sides = materials.density[np.stack((outer, inner), axis=1)]
        flat, correction = _correction(level, sides, volumes[chosen], materials, coupling[chosen])
        coupling[chosen[flat]] += correction
    mass = _lumped_mass(vertex, volumes, materials)
    if grown.any():
        thickness = added_thickness(stencil.kappa) * finite[:, grown, None]
        shares = _shares(_volume_coverage, distance[:, grown] - thickness, material, count)
        coupling[grown] = cut_coupling(shares, materials, reductions[grown], stencil)
        mass[grown] = cut_mass(shares, materials)
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


def _layered_axis(distance: Array) -> Index:
    """Return the only axis (n,) along which signed distances (K, n, 125) vary, or -1."""
    cube = distance.reshape(*distance.shape[:2], *(SUBCELLS + 1,) * 3)
    found = np.full(distance.shape[1], -1)
    for axis in range(3):
        others = tuple(other + 2 for other in range(3) if other != axis)
        found[np.ptp(cube, axis=others).max(axis=(0, 2), initial=0) < _PLANE_VARIATION] = axis
    return found


def _layered_coupling(
    axis: int, vertex: Index, volumes: Array, materials: Materials, stencil: Stencil
) -> Array:
    """Return coupling coefficients (n, 28) of elements with faces across an axis, in product form.

    With p0 and p1 the pressures in the two planes of vertices, the energy is g (p1 - p0)^T W (p1 - p0), g
    being the series mobility. Each plane has the energy of air times a mobility t; a material counts for the
    plane that holds its vertices, or half for each. The energy of each direction by itself must be positive,
    or waves grow in a boundary layer that the faces enter. Off-diagonal coupling in W reduces it, and is
    limited by t of the heavier side; the rest is moved to the diagonal.
    """
    across = EDGES_BETWEEN[:, axis] == 1
    straight = across & (EDGES_BETWEEN.sum(axis=1) == 1)
    uniform = uniform_coupling(stencil)
    beside = np.where(across, 0, coupling_by_edges(stencil)[np.minimum(EDGES_BETWEEN.sum(axis=1) + 1, 3)])
    share = volumes.mean(axis=1)
    density = share @ materials.density
    side = VERTICES[:, axis]
    held = [(vertex[:, side == plane, None] == np.arange(share.shape[1])).any(axis=1) for plane in (0, 1)]
    part = np.stack((1.0 + held[0] - held[1], 1.0 + held[1] - held[0]))
    mobility = (part * share) @ (1 / materials.density)
    along = mobility[side[PAIRS[:, 0]]].T
    sides = materials.density[vertex]
    lightest, heaviest = sides.min(axis=1), sides.max(axis=1)
    heavy = np.where(materials.density >= heaviest[:, None], share, 0).sum(axis=1)
    allowed = (lightest / heaviest + 1) / 2 + _DIAGONAL_SHARE * heavy
    kept = np.minimum(1, allowed * density / heaviest)[:, None]
    even = np.where(straight, uniform[across].sum() / 4, 0)
    link = np.where(across, kept * uniform + (1 - kept) * even, -kept * beside) / density[:, None]
    return np.asarray(np.where(across, 0, along * (uniform + beside)) + link)


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
    depth = _subcell_means(level)
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
    """Return masses at the vertices (n, 8): each material's at the vertices in it, if there are any."""
    total = np.zeros(vertex.shape)
    for own, mass in enumerate(materials.mass):
        volume = volumes[:, :, own] @ HATS / SUBCELLS**3
        kept = volume * (vertex == own)
        whole, held = volume.sum(axis=1, keepdims=True), kept.sum(axis=1, keepdims=True)
        has = held > _ABSENT_SHARE * whole
        total += mass * np.where(has, kept * whole / np.where(has, held, 1), volume)
    return total


def _distance_to_material(distance: Array, material: Index, inner: Index) -> Array:
    """Return the signed distance (n, 125) to the region of material `inner` (n,), cut by later bodies."""
    level = np.full(distance.shape[1:], FAR)
    for far, number in zip(distance, material, strict=True):
        same = (inner == number)[:, None]
        level = np.where(same, np.minimum(level, far), np.maximum(level, -far))
    return level


def _subcell_means(values: Array) -> Array:
    """Return the means (n, 64) of lattice values (n, 125) over the corners of each sub-cell."""
    cube = values.reshape(-1, *(SUBCELLS + 1,) * 3)
    return _over_subcells(cube, None).reshape(len(values), SUBCELLS**3)


def _volume_coverage(distance: Array) -> Array:
    """Return the share of each sub-cell (..., 64) inside a body: exact for axis-aligned faces."""
    cube = distance.reshape(*distance.shape[:-1], *(SUBCELLS + 1,) * 3)
    mean, *slopes = (_over_subcells(cube, along) for along in (None, -3, -2, -1))
    width = np.abs(slopes).sum(axis=0)
    share = np.clip(0.5 - mean / np.maximum(width, 1e-12), 0, 1)
    return np.asarray(share.reshape(*distance.shape[:-1], SUBCELLS**3))


def _over_subcells(cube: Array, along: int | None) -> Array:
    """Return the mean over the corners of each sub-cell, of values or of differences along an axis."""
    for axis in (-3, -2, -1):
        low, high = (np.take(cube, np.arange(SUBCELLS) + end, axis) for end in (0, 1))
        cube = high - low if axis == along else (low + high) / 2
    return cube


def _line_coverage(distance: Array) -> Array:
    """Return the share inside a body of each quarter of the lines between vertices (..., 112)."""
    ends = distance[..., _LINES]
    low = np.minimum(ends[..., :-1], ends[..., 1:])
    high = np.maximum(ends[..., :-1], ends[..., 1:])
    share = np.clip(-low / np.maximum(high - low, 1e-12), 0, 1)
    return np.asarray(share.reshape(*distance.shape[:-1], -1))


def _shares(coverage: Callable[[Array], Array], distance: Array, material: Index, count: int) -> Array:
    """Return the share of each material (n, q, count) in the q parts that `coverage` divides an element into.

    Touching bodies, with distances (K, n, 125) [cells], leave no air between them: their union decides its
    share.
    """
    covered = coverage(distance)
    share = np.zeros((*covered.shape[1:], count))
    for cover, number in zip(covered, material, strict=True):
        share *= 1 - cover[..., None]
        share[..., number] += cover
    solid = share.sum(axis=2)
    union = coverage(distance.min(axis=0))
    share *= np.divide(union, solid, out=np.zeros_like(solid), where=solid > 0)[..., None]
    share[..., 0] += 1 - union
    return share
