"""Convex edges of bodies, at which the field is singular.

At an edge with the angle w of air around it, the pressure varies as r^(pi / w). Finite elements overestimate
the energy next to it, which would cost the whole field an order of accuracy. A reduced stiffness near the
edge corrects this (energy-corrected finite elements: Egger, Rüde and Wohlmuth 2014, doi:10.1137/120871377).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from autdtorch.fdtd.shapes import Shape
from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.spatial import connected_parts, doubled_normals, sides_of

_SHARP = np.radians(20)  # Smallest angle between the normals of two faces that meet in an edge
_REACH = 1.2  # Distance from an edge within which the stiffness is reduced [cells]
# Reduction of the stiffness at an edge of a cuboid. With 0.25, 0.3 and 0.35 a tilted rigid cube of 15 mm has
# errors of up to 1.6, 1.5 and 2.1 % at 1 mm and 0.7, 0.5 and 0.3 % at 0.5 mm.
_REDUCTION = 0.3
_FEWEST_SIDES = 16  # Fewest sides of a polygon that represents a circle
_ROUND = 1e-6  # Largest relative deviation of its corners from the circle
_OUTSIDE = 1e-6  # Distance from a face of the point that shows whether another body covers it [m]


@dataclass(frozen=True)
class Segment:
    """A straight edge."""

    begin: Array  # its ends (3,) [m]
    end: Array
    reduction: float  # relative reduction of the stiffness next to it

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Corners (3,) [m] of its bounding box."""
        return np.minimum(self.begin, self.end), np.maximum(self.begin, self.end)

    def nearest(self, points: Array) -> tuple[Array, Array]:
        """Return the distance (n,) [m] of points (n, 3), and the edge's direction (n, 3) next to them."""
        whole = self.end - self.begin
        share = np.clip((points - self.begin) @ whole / (whole @ whole), 0, 1)
        gap = points - self.begin - share[:, None] * whole
        return np.linalg.norm(gap, axis=1), np.broadcast_to(whole / np.linalg.norm(whole), gap.shape)


@dataclass(frozen=True)
class Circle:
    """A circular edge."""

    center: Array  # (3,) [m]
    normal: Array  # unit vector (3,)
    radius: float  # [m]
    reduction: float  # relative reduction of the stiffness next to it

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Corners (3,) [m] of its bounding box."""
        reach = self.radius * np.sqrt(np.clip(1 - self.normal**2, 0, 1))
        return self.center - reach, self.center + reach

    def nearest(self, points: Array) -> tuple[Array, Array]:
        """Return the distance (n,) [m] of points (n, 3), and the edge's direction (n, 3) next to them."""
        from_center = points - self.center
        height = from_center @ self.normal
        around = np.cross(self.normal, from_center)
        from_axis = np.linalg.norm(around, axis=1)
        direction = around / np.maximum(from_axis, 1e-9 * self.radius)[:, None]
        return np.hypot(from_axis - self.radius, height), direction


def reductions(edges: Sequence[Segment | Circle], centers: Array, spacing: float) -> Array:
    """Return the relative reductions (n, 3, 3) of the stiffness of elements at `centers` (n, 3) [m].

    A reduction falls to zero with the square of the distance from an edge; several edges are averaged. The
    stiffness along an edge is unchanged, as the field is not singular in this direction.
    """
    total, weights = np.zeros((len(centers), 3, 3)), np.zeros(len(centers))
    reach = _REACH * spacing
    lowest, highest = centers.min(axis=0) - reach, centers.max(axis=0) + reach
    for edge in edges:
        lower, upper = edge.bounds
        if (lower > highest).any() or (upper < lowest).any():
            continue
        near = np.flatnonzero(((centers > lower - reach) & (centers < upper + reach)).all(axis=1))
        distance, along = edge.nearest(centers[near])
        weight = np.maximum(0, 1 - (distance / reach) ** 2)
        across = np.eye(3) - along[:, :, None] * along[:, None, :]
        total[near] += (edge.reduction * weight**2)[:, None, None] * across
        weights[near] += weight
    return total / np.where(weights > 0, weights, 1)[:, None, None]


def edges_of(shape: Shape, others: Sequence[Shape] = ()) -> list[Segment | Circle]:
    """Return the convex edges of a shape that `others` do not cover."""
    vertices, triangles = (part.numpy() for part in shape.surface())
    ends, angles, beside = _sharp_sides(vertices, triangles)
    if not len(ends):
        return []
    covered = np.zeros(len(ends), bool)
    for other in others:
        covered |= (other.signed_distance(torch.from_numpy(beside)) < 0).any(dim=1).numpy()
    corners = ends.reshape(-1, 3)
    _, once, number = np.unique(corners.round(9), axis=0, return_index=True, return_inverse=True)
    places = corners[once]
    first, second = number.reshape(-1, 2).T
    part = connected_parts((first, second), len(places))
    edges: list[Segment | Circle] = []
    # 1 - pi / w is a third for a cuboid, whose normals are pi / 2 apart
    shares = _REDUCTION * 3 * angles / (np.pi + angles)
    for polygon in range(part.max(initial=-1) + 1):
        chosen = part[first] == polygon
        free = chosen & ~covered
        circle = _circle(places[part == polygon], float(shares[chosen].mean()), int(chosen.sum()))
        if circle and free.any():  # whole: sides of a polygon would depend on its corners
            edges.append(circle)
        elif not circle:
            edges += [
                Segment(begin, end, float(share))
                for (begin, end), share in zip(ends[free], shares[free], strict=True)
            ]
    return edges


def _circle(corners: Array, reduction: float, sides: int) -> Circle | None:
    """Return the circle through `corners` (n, 3) [m] if these form a regular polygon, else None."""
    if not _FEWEST_SIDES <= sides == len(corners):
        return None
    center = corners.mean(axis=0)
    _, sizes, axes = np.linalg.svd(corners - center)
    radii = np.linalg.norm(corners - center, axis=1)
    radius = float(radii.mean())
    flat = sizes[2] < _ROUND * sizes[0] and np.ptp(radii) < _ROUND * radius
    return Circle(center, axes[2], radius, reduction) if flat else None


def _sharp_sides(vertices: Array, triangles: Index) -> tuple[Array, Array, Array]:
    """Return ends, angles and outside points of the sides at convex edges of a surface.

    Ends are (n, 2, 3) [m], angles between the normals of the two faces (n,) [rad]. The points (n, 2, 3) [m]
    are just outside each face, next to the middle of the edge.
    """
    _, number = np.unique(vertices.round(9), axis=0, return_inverse=True)  # corners may be listed twice
    corners, place = vertices[triangles], number.ravel()[triangles]
    normal = doubled_normals(corners)
    double = np.linalg.norm(normal, axis=1)
    normal = normal / np.where(double > 0, double, 1)[:, None]
    sides, ends = np.sort(sides_of(place), axis=1), vertices[sides_of(triangles)]
    order = np.lexsort(sides.T)
    pairs = np.flatnonzero((sides[order][1:] == sides[order][:-1]).all(axis=1))  # of two triangles each
    one, other = order[pairs] % len(triangles), order[pairs + 1] % len(triangles)
    angle = np.arccos(np.clip(np.einsum("ij,ij->i", normal[one], normal[other]), -1, 1))
    towards = corners[other].mean(axis=1) - corners[one].mean(axis=1)
    convex = np.einsum("ij,ij->i", normal[one], towards) < 0
    chosen = convex & (angle > _SHARP) & (double[one] > 0) & (double[other] > 0)
    ends, first, second = ends[order[pairs[chosen]]], normal[one[chosen]], normal[other[chosen]]
    outside = np.stack((first - 2 * second, second - 2 * first), axis=1)
    return ends, angle[chosen], ends.mean(axis=1)[:, None] + _OUTSIDE * outside
