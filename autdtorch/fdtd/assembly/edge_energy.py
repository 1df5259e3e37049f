"""The stiffness of finite elements beside convex edges, at which the field is singular.

At an edge with the angle w of air around it, the pressure varies as s = r^a cos(a t), with a = pi / w and
the angle t from one of its faces. Trilinear functions between the values of s at the vertices have another
energy than s, which would cost the whole field an order of accuracy. A change of the stiffness corrects this
(energy-corrected finite elements: Egger, Rüde and Wohlmuth 2014, doi:10.1137/120871377).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.assembly.edges import Edge
from autdtorch.fdtd.assembly.reference_element import (
    LATTICE,
    PAIRS,
    SUBCELLS,
    SUBCENTERS,
    VERTICES,
    cut_coupling,
    volume_coverage,
)
from autdtorch.fdtd.stencil import Stencil
from autdtorch.utils.array_types import Array, Index

_REACH = 1.5  # Distance from an edge within which the stiffness is changed [cells]
# Distance from an edge within which elements at faces along the grid are finite ones too [cells]. At their
# border the energy is wrong: with 1.5 and 4, by a sixth and a hundredth of what an unchanged stiffness adds.
_BESIDE = 5.0
# Share of the difference of energies: the field of least energy has less than that between the values of s.
# Around a rectangular edge in 2D, energies are then right in the mean over its places and tilts; their spread
# is an eighth of what an unchanged stiffness adds. Tilted rigid boxes of 8 to 15 mm have errors of 0.5 to 0.9
# and 0.15 to 0.23 % at 1 and 0.6 mm, with a reduction by the distance alone 0.7 to 1.4 and 0.36 to 0.54 %.
_SHARE = 0.85
# Weight of other edges near an edge, where they meet. With 1 and 4, cubes of 8 mm turned by 45 degrees have
# errors of 3.4 and 2.7 % at 1.4 mm, and plates of 0.6 and 2 mm turned so 1.9 and 2.2 % at 1 mm.
_MEETING = 2.5
_MOST = 0.7  # Largest relative reduction
_LEAST = -0.5  # and least: an increase
_HALF_WAY = 1e-3  # Difference of the depths below two faces up to which a vertex is between both [cells]
_TINY = 1e-9  # Energy of an element without air
_NEAREST = 0.35 / SUBCELLS  # [cells] from the edge: the slope here is taken for the whole sub-cell around it


class Changes(NamedTuple):
    """Changes of n elements by edges."""

    reductions: Array  # relative reductions of the stiffness (n, 3, 3)
    beside: NDArray[np.bool_]  # mask of elements whose faces must be finite ones (n,)


def changes(edges: Sequence[Edge], centers: Array, spacing: float, stencil: Stencil) -> Changes:
    """Return the changes of elements at `centers` (n, 3) [m] by edges.

    Those of several edges add up, but less where the edges meet. The stiffness along an edge is
    unchanged, as the field is not singular in this direction.
    """
    reach = _BESIDE * spacing
    lowest, highest = centers.min(axis=0) - reach, centers.max(axis=0) + reach
    total, beside, parts = np.zeros((len(centers), 3, 3)), np.zeros(len(centers), bool), []
    for edge in edges:
        lower, upper = edge.bounds
        if (lower > highest).any() or (upper < lowest).any():
            continue
        near = np.flatnonzero(((centers > lower - reach) & (centers < upper + reach)).all(axis=1))
        way, normals, inside = edge.nearest(centers[near])
        way, part = way / spacing, np.clip(0.5 + inside / spacing, 0, 1).sum(axis=1) - 1
        square = (way**2).sum(axis=1)
        beside[near[(square < _BESIDE**2) & (inside > -reach).all(axis=1)]] = True
        some = np.flatnonzero((square < _REACH**2) & (part > 0))
        parts.append((near[some], way[some], normals[some], part[some], np.full(len(some), edge.share)))
    if not parts:
        return Changes(total, beside)
    joined = [np.concatenate(each) for each in zip(*parts, strict=True)]
    order = np.argsort(joined[0], kind="stable")
    element, way, normals, part, share = (each[order] for each in joined)
    reduction = share * _reduction(way, normals, stencil)
    along = np.cross(normals[:, 0], normals[:, 1])
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    across = np.eye(3) - along[:, :, None] * along[:, None, :]
    weight = _weights(element, way, normals, part)
    np.add.at(total, element, (reduction * weight)[:, None, None] * across)
    whole = np.trace(total, axis1=1, axis2=2) / 2
    return Changes(np.asarray(total * (_MOST / np.maximum(whole, _MOST))[:, None, None]), beside)


def _weights(element: Index, way: Array, normals: Array, part: Array) -> Array:
    """Return the weights (k,) of edges that are a `way` (k, 3) [cells] from the centres of elements (k,).

    Elements are ascending. An edge between faces with `normals` (k, 2, 3) is beside a `part` (k,) of the
    element's length. Pieces of an edge, of which the faces agree, have weights as the whole one. Beside
    others that are near, an edge counts less: where they meet, the field is less singular than at each.
    """
    from autdtorch.fdtd.assembly.element_kernels import sum_edges  # loads numba

    near, sums = 1 - (way**2).sum(axis=1) / _REACH**2, np.empty((2, len(element)))
    sum_edges(element, way / _REACH, normals, part, near, sums)
    pieces, others = sums
    return np.asarray(part / np.maximum(1, pieces) * near / (near + _MEETING * others))


def _reduction(way: Array, normals: Array, stencil: Stencil) -> Array:
    """Return the relative reduction (k,) of the stiffness of elements beside an edge in air.

    The edge is a `way` (k, 3) [cells] from their centre, between faces with `normals` (k, 2, 3).
    """
    cosine = (normals[:, 0] * normals[:, 1]).sum(axis=1)
    power = np.pi / (np.pi + np.arccos(np.clip(cosine, -1, 1)))
    level = (normals @ (LATTICE.T - 0.5) - normals @ way[:, :, None]).max(axis=1)
    air = 1 - volume_coverage(level)
    radius, _ = _polar(SUBCENTERS.T - 0.5 - way[:, :, None], normals)
    slope = power[:, None] * np.maximum(radius, _NEAREST) ** (power[:, None] - 1)
    exact = (air * slope**2).mean(axis=1)
    places = VERTICES.T - 0.5 - way[:, :, None]
    radius, angle = _polar(places, normals)
    field = radius ** power[:, None] * np.cos(power[:, None] * angle)
    heights = normals @ places
    field[(np.abs(heights[:, 0] - heights[:, 1]) < _HALF_WAY) & (heights[:, 0] < 0)] = 0
    drops = field[:, PAIRS[:, 0]] - field[:, PAIRS[:, 1]]
    energy = (cut_coupling(air / SUBCELLS**3, stencil) * drops**2).sum(axis=1)
    return np.asarray(np.clip(_SHARE * (1 - exact / np.maximum(energy, _TINY)), _LEAST, _MOST))


def _polar(places: Array, normals: Array) -> tuple[Array, Array]:
    """Return the distances of places (k, 3, p) from an edge, and their angles from its first face (k, p).

    Beyond half the body angles are those from the other side.
    """
    first, second = normals[:, :1], normals[:, 1:]
    cosine = (first * second).sum(axis=2, keepdims=True)
    along = (cosine * first - second) / np.sqrt(1 - cosine**2)  # the first face, away from the edge
    height, forward = (first @ places)[:, 0], (along @ places)[:, 0]
    middle = (3 * np.pi + np.arccos(cosine[:, 0])) / 2  # of the body
    angle = np.mod(np.arctan2(height, forward) - middle, 2 * np.pi) + middle - 2 * np.pi
    return np.hypot(height, forward), angle
