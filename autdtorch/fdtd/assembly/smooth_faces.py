"""Elements that one smooth surface between two fluids cuts: local fields and the forces they cause.

The local fields are two coordinates along the surface, and a kinked one, continuous in pressure and flow. The
flow through a face of the element is divided among its vertices from that face's data only, so that two
elements sharing it get opposite forces: such fields cause no net force at any vertex.

N holds the fields at the vertices, G their forces, and S is the stiffness in series. The energies are
A = N^T G, and the stiffness is

    G A^-1 G^T + (I - N P)^T S (I - N P),    P = A^-1 G^T.

Where the surface bends too much, only the energies A of the local fields are prescribed:

    S + C^T (A - N^T S N) C,    C = (N^T S N)^-1 N^T S.

Both are virtual elements (Beirao da Veiga et al. 2013) with the local solutions of immersed finite elements
(Li 1998).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from autdtorch.fdtd.assembly.reference_element import (
    CORNERS,
    LATTICE,
    PAIRS,
    SUBCELLS,
    VERTICES,
    stiffness_matrix,
    subcell_means,
)
from autdtorch.utils.array_types import Array, Index

# Smallest mean gradient of a signed distance with one normal. The two faces of a thin plate cancel.
_LEAST_GRADIENT = 0.5
# Axes of the second derivatives in a quadratic fit
_SECOND = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
# Curvature [1/cells] that local solutions follow if only their energies are prescribed
_LARGEST_CURVATURE = 0.5
# Forces are exact for flat surfaces. Up to this curvature [1/cells], times the square root of the ratio of
# densities, they are better than energies; 5 % on either side both are blended.
_WEAK_CURVATURE, _BLEND = 0.0156, 0.05
# Ratios of densities between which energies replace forces: four vertices of a face cannot have all moments,
# and the energy of the forces would not be positive
# (Finite elements in place of energies would halve the errors of balls 170 to 800 times as dense as air, with
# fast sound, at 1.7 mm. But they displace resonances of others, whose fields err by 2 to 10 %, not 1, and the
# power that tissue absorbs would err by 34 %, not 6.)
_LARGE_RATIO, _TOO_LARGE = 80.0, 160.0
_LEAST_ENERGY = 0.01  # Smallest energy of a sum of fields, relative to theirs, that is safely positive
_MIDDLE = len(LATTICE) // 2  # The centre of an element in the lattice
# Weight of a vertex for the flow on the other side of a surface: power of the ratio of densities
_BESIDE = 0.33
# Weights of slopes and second derivatives, for those that few places do not show
_FLAT, _BENT = 1e-9, 1e-6
# Largest deviations of a smooth face from a quadratic function [cells], and of its slope from one
_UNFOLDED, _STEEP = 0.01, 0.1
# Of lattices of n elements, a place alone and with those beside it
_ALONE, _AROUND = np.ones((1, 1, 1, 1), bool), np.ones((1, 3, 3, 3), bool)
_SQUARES = 2  # Squares along each side of a face, each of four triangles on which distances are linear
_SINGULAR = 1e-10  # Relative size of eigenvalues that are rounding


def quadratic(x: Array) -> Array:
    """Return monomials up to degree two at points (n, 3): value, gradient, second derivatives."""
    second = [x[:, a] * x[:, b] / (2 if a == b else 1) for a, b in _SECOND]
    return np.column_stack((np.ones(len(x)), x, *second))


_BEYOND = 2 * LATTICE - 0.5  # places around an element, up to half a cell off
_MONOMIALS, _MONOMIALS_BEYOND = quadratic(LATTICE - 0.5), quadratic(_BEYOND - 0.5)
_FIT = np.linalg.pinv(_MONOMIALS)


def _face_geometry() -> tuple[Index, Index]:
    """Return the vertices (6, 4) of the faces, and the lattice's points (6, 16, 3) of their triangles.

    Squares are cut along both diagonals, so that a mirrored surface has mirrored forces.
    """
    square = np.array([(0, 0), (1, 0), (0, 1), (1, 1)])
    corners = [square[list(each)] for each in ((0, 1, 2), (3, 1, 2), (1, 0, 3), (2, 0, 3))]
    vertices, triangles = [], []
    for axis in range(3):
        for end in (0, 1):
            vertices.append(np.flatnonzero(VERTICES[:, axis] == end))
            plane = np.array([each + c for each in np.ndindex((_SQUARES,) * 2) for c in corners])
            points = np.insert(plane * (SUBCELLS // _SQUARES), axis, end * SUBCELLS, axis=2)
            triangles.append(points @ ((SUBCELLS + 1) ** 2, SUBCELLS + 1, 1))
    return np.array(vertices), np.array(triangles)


_FACE_VERTICES, _TRIANGLES = _face_geometry()
_AXIS, _OUTWARD = np.repeat(np.arange(3), 2), np.tile((-1.0, 1.0), 3)


class Surface(NamedTuple):
    """A surface in n elements, from the signed distances at their lattices."""

    level: Array  # signed distance at the lattice (n, 125), negative in the inner material
    normal: Array  # unit vector (n, 3)
    tangents: Array  # unit vectors (n, 2, 3)
    bend: Array  # curvature (n, 2, 2) [1/cells]
    density: Array  # of the outer and the inner material (n, 2)

    def chosen(self, some: Index | NDArray[np.bool_]) -> Surface:
        """Return the surface in some of the elements."""
        return Surface(*(part[some] for part in self))


def mean_gradient(level: Array) -> Array:
    """Return the mean gradient (..., 3) of signed distances at the lattice (..., 125)."""
    return np.asarray(level @ _FIT[1:4].T)


def roughness(level: Array) -> Array:
    """Return the largest deviation (n,) of signed distances (n, 125) from a quadratic function."""
    return np.asarray(np.abs(level - level @ _FIT.T @ _MONOMIALS.T).max(axis=1))


def unfolded(level: Array) -> Array:
    """Return signed distances (n, 125) of unions, continued from outside into them where a face is smooth.

    Inside, the distance of the nearest of several shapes is not that from their union: it has a ridge at the
    seam of two that touch. Outside, and inside beside the face, it is exact.
    """
    level = level.copy()
    for around in (_ALONE, _AROUND):  # a few places outside do not show the slope
        some = _folded(level)
        here = level[some]
        seen = binary_dilation((here > 0).reshape(-1, *(SUBCELLS + 1,) * 3), around)
        level[some] = _continued(here, here, seen.reshape(here.shape), _MONOMIALS)
    return level


def unfolded_from_beyond(level: Array, measure: Callable[[Array], Array], first: Index) -> Array:
    """Return distances (n, 125) as of `unfolded`, the rest of them from places outside beyond the elements.

    `measure` returns those of places (..., 3) [cells], and `first` (n, 3) are the elements' first cells.
    """
    level = unfolded(level)
    some = _folded(level)
    far, way = measure(first[some, None] + _BEYOND), (level[some] > 0) @ (LATTICE - 0.5)
    seen = (far > 0) & (way @ (_BEYOND - 0.5).T > 0)  # not of a face behind
    level[some] = _continued(level[some], far, seen, _MONOMIALS_BEYOND)
    return level


def _folded(level: Array) -> Index:
    """Return the elements (k,) that a surface intersects, and whose distances (n, 125) are not smooth."""
    outside = level > 0
    return np.flatnonzero(outside.any(axis=1) & ~outside.all(axis=1) & (roughness(level) > _UNFOLDED))


def _continued(level: Array, shown: Array, seen: NDArray[np.bool_], monomials: Array) -> Array:
    """Return signed distances (n, 125) with those inside from quadratic functions, where these serve.

    They fit distances `shown` (n, l), at places with `monomials` (l, 10), where these are `seen`. They serve
    if they do so, have a slope of one, and are negative inside.
    """
    masked = seen[:, :, None] * monomials
    least = np.diag([_FLAT] * 4 + [_BENT] * 6)
    factors = np.linalg.solve(masked.mT @ monomials + least, masked.mT @ shown[:, :, None])[:, :, 0]
    fit, inside = factors @ _MONOMIALS.T, level <= 0
    smooth = (np.abs(factors @ monomials.T - shown) < _UNFOLDED).all(axis=1, where=seen)
    smooth &= np.abs(np.linalg.norm(factors[:, 1:4], axis=1) - 1) < _STEEP
    smooth &= (fit < _UNFOLDED).all(axis=1, where=inside)
    return np.where(inside & smooth[:, None], np.minimum(fit, level), level)


def surfaces(level: Array, density: Array) -> tuple[NDArray[np.bool_], Surface]:
    """Return the mask (n,) of elements in which the surface has one normal, and the surface in these."""
    fit = level @ _FIT.T
    steep = np.linalg.norm(fit[:, 1:4], axis=1)
    flat = steep > _LEAST_GRADIENT
    normal = fit[flat, 1:4] / steep[flat, None]
    tangents = _tangents(normal)
    return flat, Surface(level[flat], normal, tangents, _curvature(fit[flat], tangents), density[flat])


def _tangents(normal: Array) -> Array:
    """Return two unit vectors (n, 2, 3) orthogonal to unit vectors (n, 3)."""
    helper = np.where(np.abs(normal[:, :1]) < 0.7, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    first = np.cross(normal, helper)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack((first, np.cross(normal, first)), axis=1)


def _curvature(fit: Array, tangents: Array) -> Array:
    """Return the curvature (n, 2, 2) [1/cells]."""
    hessian = np.zeros((len(fit), 3, 3))
    for column, (a, b) in enumerate(_SECOND, start=4):
        hessian[:, a, b] = hessian[:, b, a] = fit[:, column]
    return np.asarray(tangents @ hessian @ tangents.transpose(0, 2, 1))


def fields(surface: Surface) -> Array:
    """Return the local fields (n, 8, 3) at the vertices.

    They are the coordinates of the foot of a place along the surface, and the kinked field.
    """
    depth = surface.level[:, CORNERS]
    along = (VERTICES - 0.5) @ surface.tangents.transpose(0, 2, 1)
    along = along - depth[:, :, None] * (along @ surface.bend)
    kinked = np.where(depth < 0, surface.density[:, 1:], surface.density[:, :1]) * depth
    return np.concatenate((along, kinked[:, :, None]), axis=2)


def weight_of_forces(surface: Surface) -> Array:
    """Return the share (n,) of the forces in the stiffness; energies have the rest."""
    depth = surface.level[:, _MIDDLE, None]
    curvature = np.linalg.eigvalsh(surface.bend)
    curvature = np.abs(curvature / np.maximum(1 - depth * curvature, 0.1)).max(axis=1)  # at the surface
    ratio = surface.density.max(axis=1) / surface.density.min(axis=1)
    bent = curvature / (_WEAK_CURVATURE * np.sqrt(ratio))
    weight = np.clip((1 + _BLEND - bent) / (2 * _BLEND), 0, 1)
    return np.asarray(weight * np.clip((_TOO_LARGE - ratio) / (_TOO_LARGE - _LARGE_RATIO), 0, 1))


def smooth_stiffness(
    surface: Surface, mobility: Array, coupling: Array, uniform: Array
) -> tuple[Array, Array]:
    """Return the coupling (n, 28) of elements with a smooth surface, and the share (n,) of forces in it.

    Sub-cells have `mobility` (n, 64). The coupling in series is `coupling` (n, 28), in air `uniform` (28,).
    """
    weight = weight_of_forces(surface)
    total = np.zeros((len(weight), 8, 8))
    some = np.flatnonzero(weight)
    # a line in a sliver of a light fluid would be much stiffer than the element
    series = stiffness_matrix(np.minimum(coupling, mobility.sum(axis=1)[:, None] * uniform)[some])
    total[some], positive = _with_forces(surface.chosen(some), series)
    weight[some[~positive]] = 0
    some = np.flatnonzero(weight < 1)
    energies = _with_energies(surface.chosen(some), mobility[some], stiffness_matrix(coupling[some]))
    share = weight[some, None, None]
    total[some] = share * total[some] + (1 - share) * energies
    return np.asarray(-total[:, PAIRS[:, 0], PAIRS[:, 1]]), weight


def _with_energies(surface: Surface, mobility: Array, series: Array) -> Array:
    """Return the stiffness (n, 8, 8) with the exact energy of the two fields along the surface.

    The energy of the third is that in series.
    """
    sharp = np.abs(np.linalg.eigvalsh(surface.bend)).max(axis=1) > _LARGEST_CURVATURE  # edges
    surface = surface._replace(bend=np.where(sharp[:, None, None], 0, surface.bend))
    local, depth = fields(surface), subcell_means(surface.level)
    stretch = np.eye(2) - depth[:, :, None, None] * surface.bend[:, None]
    energy = np.zeros((len(depth), 3, 3))
    energy[:, :2, :2] = np.einsum("nq,nqab,nqcb->nac", mobility, stretch, stretch)
    flow = series @ local
    in_series = local.transpose(0, 2, 1) @ flow
    energy[:, 2, 2] = in_series[:, 2, 2]
    projection = np.linalg.solve(in_series, flow.transpose(0, 2, 1))
    return np.asarray(series + projection.transpose(0, 2, 1) @ (energy - in_series) @ projection)


def _with_forces(surface: Surface, series: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the stiffness (n, 8, 8) with the local fields' forces, and whether their energy is positive.

    The energy of all other fields is that in series.
    """
    local, force = fields(surface), forces(surface)
    force = force - force.mean(axis=1, keepdims=True)  # the curvature alone leaves a sum
    energy = local.transpose(0, 2, 1) @ force
    energy = (energy + energy.transpose(0, 2, 1)) / 2
    size = np.sqrt(np.maximum(energy[:, range(3), range(3)], 1e-12))
    least = np.linalg.eigvalsh(energy / size[:, :, None] / size[:, None])[:, 0]
    positive = (least > _LEAST_ENERGY) & (energy[:, range(3), range(3)] > 0).all(axis=1)
    energy[~positive] = np.eye(3)
    projection = np.linalg.solve(energy, force.transpose(0, 2, 1))
    rest = np.eye(8) - local @ projection
    return force @ projection + rest.transpose(0, 2, 1) @ series @ rest, positive


def forces(surface: Surface) -> Array:
    """Return the forces (n, 8, 3) of the local fields at the vertices: their flow out of the element."""
    total = np.zeros((len(surface.level), 8, 3))
    for face in range(6):
        total[:, _FACE_VERTICES[face]] += face_forces(surface, face)
    return total


def face_forces(surface: Surface, face: int) -> Array:
    """Return the forces (n, 4, 3) of the fields' flow through a face at its vertices.

    Flow is summed over the parts of triangles on both sides of the surface, at the centre of each.
    """
    from autdtorch.fdtd.assembly.element_kernels import face_flows  # loads numba

    vertices, count = _FACE_VERTICES[face], len(surface.level)
    corners = fields(surface)[:, vertices]
    middle = corners.mean(axis=1)
    light, dense = surface.density.min(axis=1), surface.density.max(axis=1)
    # numba compiles again for arrays in another order
    inner = np.ascontiguousarray(surface.level[:, CORNERS[vertices]] < 0)
    near, moments, share = np.empty((count, 4, 3)), np.empty((count, 3, 3)), np.empty(count)
    plane = _AXIS[face], _OUTWARD[face], VERTICES[vertices], _TRIANGLES[face], LATTICE - 0.5
    parts = tuple(map(np.ascontiguousarray, surface))
    face_flows(plane, parts, middle, inner, (light / dense) ** _BESIDE, near, moments, share)

    # in units in which the three fields have similar energies
    shares = np.stack((1 - share, share), axis=1)
    mobility, density = (shares / surface.density).sum(axis=1), (shares * surface.density).sum(axis=1)
    scale = np.sqrt(np.stack((mobility, mobility, density), axis=1))[:, None]
    weight = np.where(inner, surface.density[:, 1:], surface.density[:, :1]) / light[:, None]
    near, moments = near / scale, moments / scale / scale.transpose(0, 2, 1)
    local = (corners - middle[:, None]) / scale
    return np.asarray(scale * _distributed(near, moments, near.sum(axis=1), local, weight))


def _distributed(near: Array, moments: Array, total: Array, local: Array, weight: Array) -> Array:
    """Return forces (n, 4, 3) close to `near`, with exact totals (n, 3) and as exact moments as possible.

    Entry (a, b) of `moments` (n, 3, 3) is the moment of the flow of field b with field a, and `local` (n, 4,
    3) are the fields at the vertices. Four forces cannot have all moments where two fields are equal at the
    vertices. Their antisymmetric part is exact, so that the forces belong to an energy.
    """
    square = local @ local.transpose(0, 2, 1)
    square[:, range(4), range(4)] += weight
    inverse = np.linalg.inv(square)
    fitted = inverse @ (weight[:, :, None] * near + local @ moments)
    rules, exact = np.zeros((len(near), 6, 4, 3)), np.zeros((len(near), 6))
    rules[:, range(3), :, range(3)] = 1
    exact[:, :3] = total
    for number, (one, other) in enumerate(((0, 1), (0, 2), (1, 2)), start=3):
        rules[:, number, :, other] = local[:, :, one]
        rules[:, number, :, one] = -local[:, :, other]
        exact[:, number] = moments[:, one, other] - moments[:, other, one]
    gap = exact - np.einsum("nril,nil->nr", rules, fitted)
    moved = np.einsum("nij,nrjl->nril", inverse, rules)
    gram = np.einsum("nril,nsil->nrs", rules, moved, optimize=True)
    factors = np.linalg.pinv(gram, rcond=_SINGULAR, hermitian=True) @ gap[:, :, None]
    return np.asarray(fitted + np.einsum("nril,nr->nil", moved, factors[:, :, 0]))
