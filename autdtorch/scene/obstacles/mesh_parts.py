"""The closed parts of a mesh, how messages show their place, and their union, by manifold3d.

Parts of an assembly touch up to rounding errors: their union would keep slits of no width, and lose parts
of the body as slivers are removed. So parts grow by a small distance first. The union shrinks by as much, and
vertices of the parts return to their places, so that no fins stay where a seam meets an edge.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.spatial import areas_of, doubled_normals

_EQUAL = 1e-9  # relative difference of volumes and areas that differ by rounding
_INTACT = 1e-6  # relative change of a part's volume, as manifold3d takes it, that loses no face
# Distance by which parts grow, relative to the extent of all: 1 um for a body of 0.1 m, the rounding of text
# with six decimals in metres. It closes slits of twice this width
_GROWTH = 1e-5
_FARTHEST = 10.0  # move of a vertex relative to its faces': edges of 11.5 degrees and more grow exactly
_SEAM = 1e-4  # area of seams, relative to all: parts that meet at edges alone have less when they grow
_ALONG = 1e-8  # weight of directions for which the faces at a vertex do not tell how far it moves


class Part(NamedTuple):
    """A closed surface whose triangles are joined by edges."""

    vertices: Array  # (V, 3)
    faces: Index  # (F, 3)
    volume: float  # negative if it is inside out
    area: float


def part_of(vertices: Array, faces: Index) -> Part:
    """Return the surface of faces, with the vertices that they use."""
    used, index = np.unique(faces, return_inverse=True)
    corners, index = vertices[used], index.reshape(-1, 3)
    centred = corners[index] - corners.mean(axis=0)
    return Part(corners, index, float(np.linalg.det(centred).sum() / 6), float(areas_of(centred).sum()))


def with_three(faces: Index) -> Index:
    """Leave out triangles with two equal corners."""
    return np.asarray(faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)])


def without_sheets(faces: Index, label: Index | int = 0) -> Index:
    """Leave out pairs of opposite triangles of one part: a fin, or a wall, which encloses nothing."""
    corners = np.column_stack((np.sort(faces, axis=1), np.broadcast_to(label, len(faces))))
    order = np.lexsort(corners.T)
    place = np.empty(len(faces), np.int64)
    place[order] = np.cumsum(np.diff(corners[order], axis=0, prepend=-1).any(axis=1)) - 1
    # the corners of a triangle descend once, those of an opposite one twice
    turn = np.where((faces > np.roll(faces, -1, axis=1)).sum(axis=1) == 1, 1, -1)
    return np.asarray(faces[np.bincount(place, weights=turn)[place] != 0])


def winding_number(vertices: Array, faces: Index, points: Array) -> Array:
    """Return how often a closed surface winds around points (N,), to 1 % (Barill et al. 2018)."""
    import igl

    lower, upper = vertices.min(axis=0), vertices.max(axis=0)
    within = ((points >= lower) & (points <= upper)).all(axis=1)
    winding = np.zeros(len(points))
    if within.any():
        middle, extent = (lower + upper) / 2, longest_side(vertices)  # libigl computes in single precision
        around = np.ascontiguousarray((vertices - middle) / extent)
        winding[within] = igl.fast_winding_number(around, faces, (points[within] - middle) / extent)
    return winding


def longest_side(vertices: Array) -> float:
    """Return the longest side of the bounding box of vertices (V, 3)."""
    return float(np.ptp(vertices, axis=0).max())


def place_of(point: Array) -> str:
    """Return a point (3,) as messages show it."""
    return f"({', '.join(f'{entry:.6g}' for entry in point)})"


def box_of(points: Array) -> str:
    """Return the bounding box of points (N, 3) as messages show it."""
    return f"the space from {place_of(points.min(axis=0))} to {place_of(points.max(axis=0))}"


def union_of(parts: Sequence[Part]) -> tuple[Part, bool]:
    """Return the surface of all bodies less their cavities, and whether no two overlap or share a face."""
    bare, vertices = _united(parts), np.concatenate([part.vertices for part in parts])
    growth = _GROWTH * longest_side(vertices)
    grown = _united([_grown(part, growth) for part in parts])
    shrunk = _grown(_simpler(grown, growth), -growth)
    union = _snapped(shrunk, vertices, 2 * _FARTHEST * growth)
    with contextlib.suppress(ValueError):  # bodies that meet at an edge alone are no manifold
        union = _simpler(_manifold(union), growth)
    volumes, areas = np.array([(part.volume, part.area) for part in parts]).T
    apart = (
        _equal(bare.volume(), volumes, _EQUAL)
        and _equal(bare.surface_area(), areas, _EQUAL)
        and _equal(union.area, areas, _SEAM)
    )
    return union, apart


def _simpler(body: Any, shift: float) -> Part:
    """Return the surface of a manifold3d body, without vertices whose removal shifts it by less.

    At times manifold3d removes corners too: then vertices are removed that shift the surface less, or none.
    """
    body = simple = body.as_original()
    for share in (1.0, 0.1, 0.01):
        tried = body.simplify(share * shift)
        if abs(tried.volume() - body.volume()) < shift * body.surface_area():
            simple = tried
            break
    mesh = simple.to_mesh64()
    vertices, index = np.unique(mesh.vert_properties[:, :3], axis=0, return_inverse=True)
    return part_of(vertices, index.reshape(-1)[mesh.tri_verts.astype(np.int64)])


def _equal(total: float, each: Array, difference: float) -> bool:
    return bool(abs(total - each.sum()) <= difference * np.abs(each).sum())


def _grown(part: Part, distance: float) -> Part:
    """Return a part whose faces are moved outwards by a distance.

    A vertex moves with the planes of its faces, by least squares with their areas as weights: slivers,
    which have no certain normal, do not count.
    """
    normal = doubled_normals(part.vertices[part.faces])
    area = np.linalg.norm(normal, axis=1)
    unit = normal / np.where(area > 0, area, 1)[:, None]
    planes, towards = np.zeros((len(part.vertices), 3, 3)), np.zeros((len(part.vertices), 3))
    for corner in part.faces.T:
        np.add.at(planes, corner, normal[:, :, None] * unit[:, None])
        np.add.at(towards, corner, normal)
    least = _ALONG * np.trace(planes, axis1=1, axis2=2)[:, None, None]
    planes += np.where(least > 0, least, 1) * np.eye(3)
    move = np.linalg.solve(planes, towards[:, :, None])[:, :, 0]
    move /= np.maximum(1, np.linalg.norm(move, axis=1, keepdims=True) / _FARTHEST)
    return part_of(part.vertices + distance * move, part.faces)


def _snapped(part: Part, places: Array, distance: float) -> Part:
    """Return a part whose vertices are moved to the nearest of places (n, 3) up to a distance away."""
    from scipy.spatial import KDTree

    away, nearest = KDTree(places).query(part.vertices, distance_upper_bound=distance)
    moved = part.vertices.copy()
    moved[np.isfinite(away)] = places[nearest[np.isfinite(away)]]
    vertices, index = np.unique(moved, axis=0, return_inverse=True)
    return part_of(vertices, without_sheets(with_three(index.reshape(-1)[part.faces])))


def _united(parts: Sequence[Part]) -> Any:
    """Return the union of all bodies, each less the cavities in it, as manifold3d has it."""
    from manifold3d import Manifold, OpType

    bodies = sorted((part for part in parts if part.volume > 0), key=lambda part: -part.volume)
    cavities = [part for part in parts if part.volume < 0]
    owner = _owners(bodies, cavities)
    solids = []
    for number, body in enumerate(bodies):
        whole = _manifold(body)
        if holes := [
            _manifold(cavity)
            for cavity, body_number in zip(cavities, owner, strict=True)
            if body_number == number
        ]:
            hollow = Manifold.batch_boolean(holes, OpType.Add)
            beyond = hollow - whole
            if beyond.volume() > _EQUAL * hollow.volume():
                where = box_of(np.reshape(beyond.bounding_box(), (2, 3)))
                raise ValueError(
                    f"{where} is in a part that is inside out, but in no other; must face outwards"
                )
            whole -= hollow
        solids.append(whole)
    return Manifold.batch_boolean(solids, OpType.Add)


def _owners(bodies: Sequence[Part], cavities: Sequence[Part]) -> Index:
    """Return the number of the smallest body around each cavity, of bodies from large to small."""
    owner = np.full(len(cavities), -1, np.int64)
    if cavities:
        points = np.concatenate([cavity.vertices for cavity in cavities])
        of_cavity = np.repeat(np.arange(len(cavities)), [len(cavity.vertices) for cavity in cavities])
    for number, body in enumerate(bodies if cavities else ()):
        # vertices on the surface of the body have half its winding number
        winding = winding_number(body.vertices, body.faces, points)
        owner[np.bincount(of_cavity, winding) > 0.25 * np.bincount(of_cavity)] = number
    if len(alone := np.flatnonzero(owner < 0)):
        where = box_of(cavities[alone[0]].vertices)
        raise ValueError(f"{where} is a part that is inside out, but in no other; must face outwards")
    return owner


def _manifold(part: Part) -> Any:
    """Return a part, with outward faces, for manifold3d."""
    from manifold3d import Error, Manifold, Mesh64

    faces = part.faces if part.volume > 0 else part.faces[:, ::-1]
    body = Manifold(Mesh64(part.vertices, np.ascontiguousarray(faces, np.uint64)))
    if body.status() != Error.NoError or abs(body.volume() - abs(part.volume)) > _INTACT * abs(part.volume):
        raise ValueError(f"{box_of(part.vertices)} has a part that is too thin; must enclose a volume")
    return body
