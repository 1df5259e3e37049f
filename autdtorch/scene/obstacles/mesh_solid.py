"""The solid that a triangle mesh encloses, bounded by one surface that does not cross itself.

A mesh consists of closed parts. Parts that overlap become their union. A part that is inside out, within
another, is a cavity of it. A part that crosses itself has no union in manifold3d, and is refused.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.spatial import (
    areas_of,
    connected_parts,
    doubled_normals,
    numbered_edges,
    paired_sides,
    sides_of,
)

Triangles: TypeAlias = tuple[Array, Index]
"""Vertices (V, 3) and the indices of each triangle's vertices (F, 3)."""

FARTHEST = 1e50
"""Largest coordinate of a vertex, in units of the file; volumes do not overflow."""

_EMPTY = 1e-12  # volumes below this share of area times extent are rounding errors
_SLIVER = 1e-9  # height, relative to the extent of the mesh, below which a triangle has no certain normal
_EQUAL = 1e-9  # relative difference of volumes and areas that differ by rounding
_SIMPLER = 1e-8  # shift of a surface that removes slivers of a union, relative to its extent
_INTACT = 1e-6  # relative change of a part's volume, as manifold3d takes it, that loses no face
_BESIDE = 1e-6  # distance from a triangle of points on both sides of it, relative to the extent
_END = 1e-6  # share of an edge, at each end, that may touch the triangles there
_MOST_CROSSINGS = 10**6  # of edges and triangles of all parts; a union with so many takes seconds
_TRIED = 1000  # edges on which they are counted
# Distances, relative to the extent, up to which vertices are joined, tried in steps of ten from the first to
# the last: 1 um for a body of 0.1 m, as in text with six decimals in metres
_ROUNDING, _ROUNDED = 1e-9, 1.0001e-5
_FOLDED = 1e-10  # 1 - cosine of the angle between faces that lie on each other
_AROUND = 1e-4  # distance from a crossing at which windings are counted, relative to the extent
_DIRECTIONS = np.array(list(itertools.product((-1.0, 0.3, 1.1), repeat=3)))


class _Part(NamedTuple):
    """A closed surface whose triangles are joined by edges."""

    vertices: Array  # (V, 3)
    faces: Index  # (F, 3)
    volume: float  # negative if it is inside out
    area: float


def solid_of(corners: Array, triangles: Index) -> Triangles:
    """Return the distinct vertices and the outward faces of the solid that triangles enclose.

    Raises:
        ValueError: the triangles are not closed, or a part crosses itself, is inside out or encloses nothing.
            The message names the place, in the coordinates of `corners`.
    """
    import igl

    require_triangles(corners, triangles)
    vertices, faces = joined(corners, triangles)
    if not len(faces):
        raise ValueError(f"{_box(vertices)} has no volume; must enclose a volume")
    label = _labels(vertices, faces)
    if _part(vertices, faces).volume < 0:
        faces = faces[:, ::-1]
    whole = _part(vertices, faces)
    parts = [_part(vertices, part) for part in _split(faces, label)]
    for part in parts:
        _require_simple(part)
    solids = [part for part in parts if abs(part.volume) > _EMPTY * part.area * _extent(part.vertices)]
    if not solids:
        raise ValueError(f"{_box(whole.vertices)} has no volume; must enclose a volume")
    _require_unfolded(vertices, faces)
    if not all(igl.is_edge_manifold(part.faces)[0] for part in parts):
        # manifold3d may join other sheets at an edge than the parts do
        _require_simple(whole)
        _require_air_beside(whole)
        return whole.vertices, whole.faces
    slivers = any(map(_has_sliver, parts))
    if len(parts) == 1 and not slivers:
        return whole.vertices, whole.faces
    _require_few_crossings(whole)
    union = _union(solids)
    chosen = union if slivers or not _agree(union, parts) else whole
    return chosen.vertices, chosen.faces


def joined(corners: Array, triangles: Index, farthest: float = _ROUNDED) -> Triangles:
    """Return the distinct vertices of triangles, and the faces that have an area.

    STL repeats a vertex for every triangle at it, in single precision or as text, with rounding errors: at
    edges that are open, vertices up to `farthest` apart, relative to the extent, become one if that closes
    edges. The smallest distance that closes all counts.
    """
    used, index = np.unique(triangles, return_inverse=True)
    vertices, number = np.unique(corners[used] + 0.0, axis=0, return_inverse=True)
    whole = number.reshape(-1)[index.reshape(-1, 3)].astype(np.int64)
    faces, open_ends = _cleaned(whole), open_edges(_cleaned(whole))
    apart = _ROUNDING
    while len(open_ends) and apart <= farthest:
        nearer = _near(vertices, np.unique(open_ends), apart * _extent(vertices))[whole]
        tried = _cleaned(nearer)
        left = open_edges(tried)
        if len(left) < len(open_ends):
            whole, faces, open_ends = nearer, tried, left
        apart *= 10
    return vertices, faces


def open_edges(faces: Index) -> Index:
    """Return the edges (n, 2) at which as many triangles do not meet from either side, and not twice."""
    ends, (edges, edge) = sides_of(faces), numbered_edges(faces)
    up = np.where(ends[:, 0] < ends[:, 1], 1, -1)
    return np.asarray(edges[np.bincount(edge, weights=up, minlength=len(edges)) != 0])


def _cleaned(faces: Index) -> Index:
    """Leave out triangles with two equal corners, and pairs of opposite ones."""
    return _without_sheets(faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)])


def _near(vertices: Array, some: Index, distance: float) -> Index:
    """Return the representative of each vertex: the first of `some` that are up to a distance apart."""
    from scipy.spatial import KDTree

    pairs = KDTree(vertices[some]).query_pairs(distance, output_type="ndarray")
    label = connected_parts(pairs.T, len(some))
    _, first = np.unique(label, return_index=True)
    nearest = np.arange(len(vertices))
    nearest[some] = some[first[label]]
    return nearest


def outer_parts(vertices: Array, faces: Index) -> NDArray[np.bool_]:
    """Return which faces (F,) of a solid bound it from outside: not those of cavities and bodies in these."""
    label = _labels(vertices, faces)
    parts = [_part(vertices, part) for part in _split(faces, label)]
    if all(part.volume >= 0 for part in parts):
        return np.ones(len(faces), bool)
    outer = np.array([part.volume > 0 for part in parts])
    for number in np.flatnonzero(outer):
        place = parts[number].vertices[parts[number].faces[0, 0]][None]
        others = [part for other, part in enumerate(parts) if other != number and part.volume > 0]
        outer[number] = not any(winding_number(*part[:2], place)[0] > 0.5 for part in others)
    return np.asarray(outer[label])


def winding_number(vertices: Array, faces: Index, points: Array) -> Array:
    """Return how often a closed surface winds around points (N,), to 1 % (Barill et al. 2018)."""
    import igl

    lower, upper = vertices.min(axis=0), vertices.max(axis=0)
    within = ((points >= lower) & (points <= upper)).all(axis=1)
    winding = np.zeros(len(points))
    if within.any():
        middle, extent = (lower + upper) / 2, _extent(vertices)  # libigl computes in single precision
        around = np.ascontiguousarray((vertices - middle) / extent)
        winding[within] = igl.fast_winding_number(around, faces, (points[within] - middle) / extent)
    return winding


def require_triangles(corners: Array, triangles: Index) -> None:
    """Check the shapes, the vertices and the indices."""
    if triangles.size == 0 or triangles.ndim != 2 or triangles.shape[1] != 3:
        raise ValueError(f"faces of shape {triangles.shape}; must be triangles (F, 3), F >= 1")
    if corners.ndim != 2 or corners.shape[1] != 3:
        raise ValueError(f"vertices of shape {corners.shape}; must be (V, 3)")
    if len(far := np.flatnonzero(~(np.abs(corners) <= FARTHEST).all(axis=1))):
        vertex = f"vertex {far[0]} at {place_of(corners[far[0]])}"
        raise ValueError(f"{vertex}; must be triangles with finite vertices, none beyond {FARTHEST:g}")
    if len(wrong := np.flatnonzero(((triangles < 0) | (triangles >= len(corners))).any(axis=1))):
        triangle = f"triangle {wrong[0]} of vertices {', '.join(map(str, triangles[wrong[0]]))}"
        raise ValueError(f"{triangle}; must be triangles of the {len(corners)} vertices, counted from 0")


def _without_sheets(faces: Index) -> Index:
    """Leave out pairs of opposite triangles, which enclose nothing: a wall between two parts, or a fin."""
    corners = np.sort(faces, axis=1)
    order = np.lexsort(corners.T)
    place = np.empty(len(faces), np.int64)
    place[order] = np.cumsum(np.diff(corners[order], axis=0, prepend=-1).any(axis=1)) - 1
    # the corners of a triangle descend once, those of an opposite one twice
    turn = np.where((faces > np.roll(faces, -1, axis=1)).sum(axis=1) == 1, 1, -1)
    return np.asarray(faces[np.bincount(place, weights=turn)[place] != 0])


def _labels(vertices: Array, faces: Index) -> Index:
    """Return the number of each triangle's part (F,), after checking that the surface is closed.

    Every side of a triangle meets one of the opposite direction. Of several on an edge, the first ones of
    each direction meet, because files list one part after the other.
    """
    ends, (edges, edge) = sides_of(faces), numbered_edges(faces)
    upwards = ends[:, 0] < ends[:, 1]
    up, down = (np.bincount(edge[chosen], minlength=len(edges)) for chosen in (upwards, ~upwards))
    if len(wrong := np.flatnonzero(up != down)):
        first = wrong[0]
        place = " to ".join(map(place_of, vertices[edges[first]]))
        open_sides = f"{len(wrong)} of its {len(edges)} edges do not join two triangles of one orientation"
        where = f"the first, {place}, has {up[first]} of one and {down[first]} of the other"
        turned = (up + down == 2).all()
        why = "no hole, but triangles are turned over" if turned else "must be watertight"
        raise ValueError(f"{open_sides} ({where}); {why}; repair=True may mend it")
    owner = np.tile(np.arange(len(faces)), 3)
    one, other = (owner[chosen][np.lexsort((owner[chosen], edge[chosen]))] for chosen in (upwards, ~upwards))
    return connected_parts((one, other), len(faces))


def _split(faces: Index, label: Index) -> list[Index]:
    """Return the faces of each part, in the order of its first face."""
    order = np.argsort(label, kind="stable")
    return np.split(faces[order], np.flatnonzero(np.diff(label[order])) + 1)


def _part(vertices: Array, faces: Index) -> _Part:
    """Return the surface of faces, with the vertices that they use."""
    used, index = np.unique(faces, return_inverse=True)
    corners, index = vertices[used], index.reshape(-1, 3)
    centred = corners[index] - corners.mean(axis=0)
    return _Part(corners, index, float(np.linalg.det(centred).sum() / 6), float(areas_of(centred).sum()))


def _require_unfolded(vertices: Array, faces: Index) -> None:
    """Check that no two triangles at an edge lie on each other."""
    ends, pairs = sides_of(faces), paired_sides(faces)
    corners = vertices[faces]
    normal = doubled_normals(corners)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    size = np.linalg.norm(normal, axis=1)
    certain = size > _SLIVER * _extent(vertices) * longest
    one, other = pairs.T % len(faces)
    cosine = (normal[one] * normal[other]).sum(axis=1)
    folded = (cosine < (_FOLDED - 1) * size[one] * size[other]) & certain[one] & certain[other]
    if folded.any():
        place = place_of(vertices[ends[pairs[folded][0, 0]]].mean(axis=0))
        raise ValueError(
            f"the surface is folded back on itself at {place}; must be simple; repair=True may mend it"
        )


def _require_simple(part: _Part) -> None:
    """Check that no edge passes through a triangle; a part may touch itself.

    Where two sheets cross, one of the four spaces between them is wound around twice or backwards.
    """
    tree, first, along = _edges(part)
    hit, share, _ = tree.intersect_ray_first(part.vertices, part.faces, first, along, 1.0)
    crossed = np.flatnonzero(hit >= 0)
    if not len(crossed):
        return
    some = crossed[np.linspace(0, len(crossed) - 1, min(len(crossed), _TRIED)).astype(np.int64)]
    places = first[some] + share[some, None] * along[some]
    around = places[:, None] + _AROUND * _extent(part.vertices) * _DIRECTIONS
    turns = winding_number(part.vertices, part.faces, around.reshape(-1, 3)).reshape(len(some), -1)
    turns = turns.round() * math.copysign(1, part.volume)
    _refuse_crossing(places[((turns < 0) | (turns > 1)).any(axis=1)])


def _require_few_crossings(whole: _Part) -> None:
    """Check, on some of the edges, that a union takes seconds; a forged file may cross itself everywhere."""
    tree, first, along = _edges(whole)
    chosen = np.linspace(0, len(first) - 1, _TRIED).astype(np.int64)
    most, crossings = _MOST_CROSSINGS * _TRIED / len(first), 0
    for few in np.array_split(chosen, _TRIED // 10):
        rays = tree.intersect_ray(whole.vertices, whole.faces, first[few], along[few])
        crossings += sum(hit[1] < 1 for ray in rays for hit in ray)
        if crossings > most:
            number = f"more than {_MOST_CROSSINGS:.0e} edges through triangles"
            raise ValueError(
                f"{_box(whole.vertices)} has {number}; must be parts that overlap in fewer places"
            )


def _edges(part: _Part) -> tuple[Any, Array, Array]:
    """Return a search tree of triangles, and begin and direction (E, 3) of the edges without their ends."""
    import igl

    tree = igl.AABB()
    tree.init(part.vertices, part.faces)
    ends = sides_of(part.faces)
    first, last = np.moveaxis(part.vertices[ends[ends[:, 0] < ends[:, 1]]], 1, 0)
    return tree, first + _END * (last - first), (1 - 2 * _END) * (last - first)


def _require_air_beside(whole: _Part) -> None:
    """Check that each triangle has air on one side only; triangles may lie on each other."""
    corners = whole.vertices[whole.faces]
    middle, normal = corners.mean(axis=1), doubled_normals(corners)
    length = np.linalg.norm(normal, axis=1)
    step = _BESIDE * _extent(whole.vertices) * normal / np.where(length > 0, length, 1)[:, None]
    outside, inside = (
        winding_number(whole.vertices, whole.faces, middle + way * step).round() for way in (1, -1)
    )
    _refuse_crossing(middle[(length > 0) & ((outside != 0) | (inside != 1))])


def _refuse_crossing(places: Array) -> None:
    if len(places):
        raise ValueError(
            f"the surface crosses itself at {place_of(places[0])}; parts may overlap, but each must be simple"
        )


def _has_sliver(part: _Part) -> bool:
    """Return whether a triangle is so flat that its normal is a rounding error."""
    corners = part.vertices[part.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    return bool((2 * areas_of(corners) < _SLIVER * _extent(part.vertices) * longest).any())


def _union(parts: Sequence[_Part]) -> _Part:
    """Return the surface of all bodies, each less the cavities in it."""
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
                where = _box(np.reshape(beyond.bounding_box(), (2, 3)))
                raise ValueError(
                    f"{where} is in a part that is inside out, but in no other; must face outwards"
                )
            whole -= hollow
        solids.append(whole)
    union = Manifold.batch_boolean(solids, OpType.Add)
    mesh = union.simplify(_SIMPLER * _extent(np.reshape(union.bounding_box(), (2, 3)))).to_mesh64()
    vertices, index = np.unique(mesh.vert_properties[:, :3], axis=0, return_inverse=True)
    return _part(vertices, index.reshape(-1)[mesh.tri_verts.astype(np.int64)])


def _owners(bodies: Sequence[_Part], cavities: Sequence[_Part]) -> Index:
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
        where = _box(cavities[alone[0]].vertices)
        raise ValueError(f"{where} is a part that is inside out, but in no other; must face outwards")
    return owner


def _manifold(part: _Part) -> Any:
    """Return a part, with outward faces, for manifold3d."""
    from manifold3d import Error, Manifold, Mesh64

    faces = part.faces if part.volume > 0 else part.faces[:, ::-1]
    body = Manifold(Mesh64(part.vertices, np.ascontiguousarray(faces, np.uint64)))
    if body.status() != Error.NoError or abs(body.volume() - abs(part.volume)) > _INTACT * abs(part.volume):
        raise ValueError(f"{_box(part.vertices)} has a part that is too thin; must enclose a volume")
    return body


def _agree(union: _Part, parts: Sequence[_Part]) -> bool:
    """Return whether a union has the volume and the area of its parts: none overlaps another."""
    volumes, areas = np.array([(part.volume, part.area) for part in parts]).T
    return all(
        abs(total - each.sum()) <= _EQUAL * np.abs(each).sum()
        for total, each in ((union.volume, volumes), (union.area, areas))
    )


def _extent(vertices: Array) -> float:
    return float(np.ptp(vertices, axis=0).max())


def place_of(point: Array) -> str:
    """Return a point (3,) as messages show it."""
    return f"({', '.join(f'{entry:.6g}' for entry in point)})"


def _box(points: Array) -> str:
    """Return the bounding box of points (N, 3) as messages show it."""
    return f"the space from {place_of(points.min(axis=0))} to {place_of(points.max(axis=0))}"
