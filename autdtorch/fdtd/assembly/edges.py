"""Convex edges of bodies, at which the field is singular: straight, circular, and along bores."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from autdtorch.fdtd.shapes import Shape, Solids
from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.spatial import connected_parts, distinct_rows, doubled_normals, sides_of

_SHARP = np.radians(20)  # Smallest angle between the normals of two faces that meet in an edge
_SLIT = 1e-3  # Angle of two faces [rad] up to which they are those of a slit without width
_FEWEST_SIDES = 16  # Fewest sides of a polygon that represents a circle
_ROUND = 1e-6  # Largest relative deviation of its corners from the circle
_OUTSIDE = 1e-6  # Distance from a face of the point that shows whether another body covers it [m]
_PARTS = 32  # Parts of a side, each of which another body may cover
_STEP = 1e-3  # Distance of the points that tell the directions of two faces beside their edge [cells]
_NEAR = 2.0  # Distance from an edge of a bore up to which it is looked for [cells]
_ON = (
    0.1  # Distance from both surfaces, and from what is left, up to which a place is on such an edge [cells]
)


class Nearest(NamedTuple):
    """Places of an edge nearest to n points."""

    way: Array  # to the place (n, 3) [m], infinite beyond a rim's reach
    normals: Array  # unit vectors out of the two faces there (n, 2, 3)
    inside: Array  # distances along it from its two ends (n, 2) [m], negative beyond; infinite without ends


@dataclass(frozen=True)
class Segment:
    """A straight edge."""

    begin: Array  # its ends (3,) [m]
    end: Array
    normals: Array  # of its faces (2, 3)
    share: float = 1.0  # of what corrects a rigid edge in air

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Corners (3,) [m] of its bounding box."""
        return np.minimum(self.begin, self.end), np.maximum(self.begin, self.end)

    def nearest(self, points: Array) -> Nearest:
        """Return the places of its line nearest to points (n, 3) [m]."""
        whole = self.end - self.begin
        length = math.sqrt(whole @ whole)
        part = (points - self.begin) @ whole / length**2
        way = self.begin + part[:, None] * whole - points
        normals = np.broadcast_to(self.normals, (len(points), 2, 3))
        return Nearest(way, normals, length * np.column_stack((part, 1 - part)))


@dataclass(frozen=True)
class Circle:
    """A circular edge."""

    center: Array  # (3,) [m]
    normal: Array  # unit vector (3,)
    radius: float  # [m]
    slopes: Array  # components of the normals of its two faces along its own normal (2,)
    outwards: Array  # and away from its centre (2,)
    share: float = 1.0  # of what corrects a rigid edge in air

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Corners (3,) [m] of its bounding box."""
        reach = self.radius * np.sqrt(np.clip(1 - self.normal**2, 0, 1))
        return self.center - reach, self.center + reach

    def nearest(self, points: Array) -> Nearest:
        """Return its places nearest to points (n, 3) [m]."""
        from_center = points - self.center
        height = from_center @ self.normal
        flat = from_center - height[:, None] * self.normal
        from_axis = np.linalg.norm(flat, axis=1)
        on_axis = from_axis < 1e-9 * self.radius  # as near to one place as to another
        flat[on_axis], from_axis[on_axis] = _across(self.normal), 1
        away = flat / from_axis[:, None]
        normals = self.slopes[:, None] * self.normal + self.outwards[:, None] * away[:, None]
        return Nearest(self.radius * away - from_center, normals, np.full((len(points), 2), np.inf))


@dataclass(frozen=True)
class Rim:
    """Edges of what later fluids leave of rigid bodies, where the surfaces of two shapes cross."""

    shapes: tuple[Shape, Shape]
    solid: tuple[bool, bool]  # whether the bodies are inside of a shape, or outside
    bodies: Solids  # all rigid bodies, and the fluids that cut them
    spacing: float  # of the cells [m]
    share: float = 1.0  # of what corrects a rigid edge in air

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Corners (3,) [m] of its bounding box."""
        first, second = self.shapes
        return np.maximum(first.lower, second.lower), np.minimum(first.upper, second.upper)

    def nearest(self, points: Array) -> Nearest:
        """Return its places nearest to points (n, 3) [m], with faces that are flat there."""
        way, normals = np.full(points.shape, np.inf), np.zeros((len(points), 2, 3))
        endless = np.full((len(points), 2), np.inf)
        level = self._levels(points)
        near = np.flatnonzero((np.abs(level) < _NEAR * self.spacing).all(axis=1))
        if not len(near):
            return Nearest(way, normals, endless)
        steps = _STEP * self.spacing * np.eye(3)[:, None]
        ahead, behind = (self._levels(points[near] + step) for step in (steps, -steps))
        normal = np.moveaxis(ahead - behind, 0, -1) / (2 * _STEP * self.spacing)
        cosine = (normal[:, 0] * normal[:, 1]).sum(axis=1)
        sharp = np.abs(cosine) < math.cos(_SHARP)
        near, normal, cosine = near[sharp], normal[sharp], cosine[sharp]
        part = (cosine[:, None] * level[near, ::-1] - level[near]) / (1 - cosine**2)[:, None]
        ways = (part[:, :, None] * normal).sum(axis=1)
        places = points[near] + ways
        off = np.abs(np.column_stack((self._levels(places), self.bodies.distance(places)))).max(axis=1)
        # in front of each face and below the other is no body: at the seam of two fluids one of both is rigid
        beside = places[:, None] + 2 * _ON * self.spacing * (normal - 2 * normal[:, ::-1])
        real = (off < _ON * self.spacing) & (self.bodies.distance(beside) > 0).all(axis=1)
        way[near[real]], normals[near] = ways[real], normal
        return Nearest(way, normals, endless)

    def _levels(self, points: Array) -> Array:
        """Return the signed distances (..., 2) [m] of points (..., 3), negative in the bodies."""
        where = torch.from_numpy(points)
        pairs = zip(self.shapes, self.solid, strict=True)
        return np.stack(
            [(1 if solid else -1) * shape.signed_distance(where).numpy() for shape, solid in pairs], axis=-1
        )


Edge: TypeAlias = Segment | Circle | Rim


def edges_of(shape: Shape, others: Sequence[Shape] = ()) -> list[Segment | Circle]:
    """Return the convex edges of a shape that `others` do not cover."""
    vertices, triangles = (part.numpy() for part in shape.surface())
    ends, normals = _sharp_sides(vertices, triangles)
    if not len(ends):
        return []
    covered = _covered(ends, normals, others)
    corners = ends.reshape(-1, 3)
    _, once, number = np.unique(corners.round(9), axis=0, return_index=True, return_inverse=True)
    places = corners[once]
    first, second = number.reshape(-1, 2).T
    part = connected_parts((first, second), len(places))
    edges: list[Segment | Circle] = []
    for polygon in range(part.max(initial=-1) + 1):
        chosen = part[first] == polygon
        free = chosen & ~covered.all(axis=1)
        circle = _circle(places[part == polygon], ends[chosen], normals[chosen])
        if circle and free.any():  # whole: sides of a polygon would depend on its corners
            edges.append(circle)
        elif not circle:
            edges += [
                Segment(begin, end, normals[side])
                for side in np.flatnonzero(free)
                for begin, end in _parts(ends[side], ~covered[side])
            ]
    return edges


def sharp_sides(shape: Shape, others: Sequence[Shape], sharp: float) -> Array:
    """Return the ends (n, 2, 3) [m] of what `others` leave of the sides at convex edges of a shape.

    The angle [rad] between the normals of the two faces is at least `sharp`.
    """
    ends, normals = _sharp_sides(*(part.numpy() for part in shape.surface()))
    chosen = np.einsum("ij,ij->i", normals[:, 0], normals[:, 1]) < math.cos(sharp)
    ends, normals = ends[chosen], normals[chosen]
    parts = [_parts(*side) for side in zip(ends, ~_covered(ends, normals, others), strict=True)]
    return np.concatenate([np.zeros((0, 2, 3)), *parts])


def _covered(ends: Array, normals: Array, others: Sequence[Shape]) -> NDArray[np.bool_]:
    """Return which parts of sides, with ends (n, 2, 3) [m] between faces with normals (n, 2, 3), are covered.

    A mask (n, `_PARTS`): another shape has a place in front of one of both faces, next to the side.
    """
    covered = np.zeros((len(ends), _PARTS), bool)
    share = ((np.arange(_PARTS) + 0.5) / _PARTS)[:, None]
    for other in others:
        away = np.maximum(ends.min(axis=1) - other.upper, other.lower - ends.max(axis=1))
        near = np.flatnonzero((away < 2 * _OUTSIDE).all(axis=1))
        places = (1 - share) * ends[near, :1] + share * ends[near, 1:]
        beside = places[:, :, None] + _OUTSIDE * (normals - 2 * normals[:, ::-1])[near, None]
        covered[near] |= (other.signed_distance(torch.from_numpy(beside)) < 0).any(dim=2).numpy()
    return covered


def _parts(ends: Array, mask: NDArray[np.bool_]) -> Array:
    """Return the ends (r, 2, 3) [m] of runs of a mask (n,) over the parts of a side with ends (2, 3)."""
    runs = np.flatnonzero(np.diff(mask, prepend=False, append=False)).reshape(-1, 2) / len(mask)
    return np.asarray(ends[0] + runs[:, :, None] * (ends[1] - ends[0]))


def rims_of(
    shapes: Sequence[Shape], rigid: Sequence[bool], density: Sequence[float], spacing: float
) -> list[Rim]:
    """Return the edges on cells [m] of what later fluids of a relative density leave of rigid shapes.

    A dense fluid fills its bore like a rigid body: without an edge.
    """
    pairs = set()
    for number in np.flatnonzero(rigid).tolist():
        fluids = [later for later in range(number + 1, len(rigid)) if not rigid[later]]
        pairs |= set(combinations([number, *fluids], 2))
    rims, bodies = [], Solids(shapes, rigid)
    for first, second in sorted(pairs):
        both, solid = (shapes[first], shapes[second]), (rigid[first], rigid[second])
        share = 1 / max(1.0, *(density[number] for number in (first, second) if not rigid[number]))
        rim = Rim(both, solid, bodies, spacing, share)
        if (np.subtract(*rim.bounds) < 0).all():
            rims.append(rim)
    return rims


def _across(axis: Array) -> Array:
    """Return a unit vector (3,) across an axis (3,)."""
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    return np.asarray(across / np.linalg.norm(across))


def _circle(corners: Array, ends: Array, normals: Array) -> Circle | None:
    """Return the circle through `corners` (n, 3) [m] if these form a regular polygon, else None.

    Of its sides these are the `ends` (n, 2, 3) [m], and the `normals` of the faces (n, 2, 3).
    """
    if not _FEWEST_SIDES <= len(ends) == len(corners):
        return None
    center = corners.mean(axis=0)
    _, sizes, axes = np.linalg.svd(corners - center)
    radii = np.linalg.norm(corners - center, axis=1)
    radius = float(radii.mean())
    if sizes[2] > _ROUND * sizes[0] or np.ptp(radii) > _ROUND * radius:
        return None
    slopes, away = normals @ axes[2], ends.mean(axis=1) - center
    away /= np.linalg.norm(away, axis=1)[:, None]
    outwards = (normals * away[:, None]).sum(axis=2)
    order = slopes.argsort(axis=1)  # sides list their faces in any order
    slopes, outwards = (np.take_along_axis(each, order, axis=1).mean(axis=0) for each in (slopes, outwards))
    return Circle(center, axes[2], radius, slopes, outwards)


def _sharp_sides(vertices: Array, triangles: Index) -> tuple[Array, Array]:
    """Return the ends (n, 2, 3) [m] of the sides at convex edges of a surface, and their faces' normals."""
    _, number = distinct_rows(vertices.round(9) + 0.0)  # corners may be listed twice
    corners, place = vertices[triangles], number[triangles]
    normal = doubled_normals(corners)
    double = np.linalg.norm(normal, axis=1)
    normal = normal / np.where(double > 0, double, 1)[:, None]
    sides, ends = np.sort(sides_of(place), axis=1), vertices[sides_of(triangles)]
    side = sides[:, 1] * len(vertices) + sides[:, 0]
    order = np.argsort(side, kind="stable")
    pairs = np.flatnonzero(side[order][1:] == side[order][:-1])  # of two triangles each
    one, other = order[pairs] % len(triangles), order[pairs + 1] % len(triangles)
    angle = np.arccos(np.clip(np.einsum("ij,ij->i", normal[one], normal[other]), -1, 1))
    towards = corners[other].mean(axis=1) - corners[one].mean(axis=1)
    convex = np.einsum("ij,ij->i", normal[one], towards) < 0
    chosen = convex & (angle > _SHARP) & (angle < np.pi - _SLIT) & (double[one] > 0) & (double[other] > 0)
    both = np.stack((normal[one[chosen]], normal[other[chosen]]), axis=1)
    return ends[order[pairs[chosen]]], both
