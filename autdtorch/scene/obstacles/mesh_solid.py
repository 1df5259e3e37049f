"""The solid that a triangle mesh encloses, bounded by one surface that does not cross itself.

A mesh consists of closed parts. Parts that overlap or touch become their union. A part that is inside out,
within another, is a cavity of it. A part that crosses itself has no union in manifold3d, and is refused.
"""

from __future__ import annotations

import itertools
import math
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from autdtorch.scene.obstacles.mesh_parts import (
    Part,
    box_of,
    longest_side,
    part_of,
    place_of,
    union_of,
    winding_number,
    with_three,
    without_sheets,
)
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


def solid_of(corners: Array, triangles: Index) -> Triangles:
    """Return the distinct vertices and the outward faces of the solid that triangles enclose.

    Raises:
        ValueError: the triangles are not closed, or a part crosses itself, is inside out or encloses nothing.
            The message names the place, in the coordinates of `corners`.
    """
    import igl

    require_triangles(corners, triangles)
    vertices, faces = joined(corners, triangles)
    faces = without_sheets(faces, _labels(vertices, faces))  # parts keep walls between them, until united
    if not len(faces):
        raise ValueError(f"{box_of(vertices)} has no volume; must enclose a volume")
    label = _labels(vertices, faces)
    if part_of(vertices, faces).volume < 0:
        faces = faces[:, ::-1]
    whole = part_of(vertices, faces)
    parts = [part_of(vertices, part) for part in _split(faces, label)]
    for part in parts:
        _require_simple(part)
    solids = [part for part in parts if abs(part.volume) > _EMPTY * part.area * longest_side(part.vertices)]
    if not solids:
        raise ValueError(f"{box_of(whole.vertices)} has no volume; must enclose a volume")
    for solid in solids:
        _require_unfolded(solid)
    if not all(igl.is_edge_manifold(part.faces)[0] for part in parts):
        # manifold3d may join other sheets at an edge than the parts do
        whole = part_of(vertices, without_sheets(faces))
        _require_simple(whole)
        _require_air_beside(whole)
        return whole.vertices, whole.faces
    slivers = any(map(_has_sliver, parts))
    if len(parts) == 1 and not slivers:
        return whole.vertices, whole.faces
    _require_few_crossings(whole)
    union, apart = union_of(solids)
    chosen = whole if apart and len(solids) == len(parts) and not slivers else union
    return chosen.vertices, chosen.faces


def joined(corners: Array, triangles: Index, farthest: float = _ROUNDED) -> Triangles:
    """Return the distinct vertices of triangles, and the faces with three of them.

    STL repeats a vertex for every triangle at it, in single precision or as text, with rounding errors: at
    edges that are open, vertices up to `farthest` apart, relative to the extent, become one if that closes
    edges. The smallest distance that closes all counts.
    """
    used, index = np.unique(triangles, return_inverse=True)
    vertices, number = np.unique(corners[used] + 0.0, axis=0, return_inverse=True)
    whole = number.reshape(-1)[index.reshape(-1, 3)].astype(np.int64)
    faces, open_ends = with_three(whole), open_edges(with_three(whole))
    apart = _ROUNDING
    while len(open_ends) and apart <= farthest:
        nearer = _near(vertices, np.unique(open_ends), apart * longest_side(vertices))[whole]
        tried = with_three(nearer)
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
    parts = [part_of(vertices, part) for part in _split(faces, label)]
    if all(part.volume >= 0 for part in parts):
        return np.ones(len(faces), bool)
    outer = np.array([part.volume > 0 for part in parts])
    for number in np.flatnonzero(outer):
        place = parts[number].vertices[parts[number].faces[0, 0]][None]
        others = [part for other, part in enumerate(parts) if other != number and part.volume > 0]
        outer[number] = not any(winding_number(*part[:2], place)[0] > 0.5 for part in others)
    return np.asarray(outer[label])


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


def _require_unfolded(part: Part) -> None:
    """Check that no two triangles at an edge lie on each other."""
    vertices, faces = part.vertices, part.faces
    ends, pairs = sides_of(faces), paired_sides(faces)
    corners = vertices[faces]
    normal = doubled_normals(corners)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    size = np.linalg.norm(normal, axis=1)
    certain = size > _SLIVER * longest_side(vertices) * longest
    one, other = pairs.T % len(faces)
    cosine = (normal[one] * normal[other]).sum(axis=1)
    folded = (cosine < (_FOLDED - 1) * size[one] * size[other]) & certain[one] & certain[other]
    if folded.any():
        place = place_of(vertices[ends[pairs[folded][0, 0]]].mean(axis=0))
        raise ValueError(
            f"the surface is folded back on itself at {place}; must be simple; repair=True may mend it"
        )


def _require_simple(part: Part) -> None:
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
    around = places[:, None] + _AROUND * longest_side(part.vertices) * _DIRECTIONS
    turns = winding_number(part.vertices, part.faces, around.reshape(-1, 3)).reshape(len(some), -1)
    turns = turns.round() * math.copysign(1, part.volume)
    _refuse_crossing(places[((turns < 0) | (turns > 1)).any(axis=1)])


def _require_few_crossings(whole: Part) -> None:
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
                f"{box_of(whole.vertices)} has {number}; must be parts that overlap in fewer places"
            )


def _edges(part: Part) -> tuple[Any, Array, Array]:
    """Return a search tree of triangles, and begin and direction (E, 3) of the edges without their ends."""
    import igl

    tree = igl.AABB()
    tree.init(part.vertices, part.faces)
    ends = sides_of(part.faces)
    first, last = np.moveaxis(part.vertices[ends[ends[:, 0] < ends[:, 1]]], 1, 0)
    return tree, first + _END * (last - first), (1 - 2 * _END) * (last - first)


def _require_air_beside(whole: Part) -> None:
    """Check that each triangle has air on one side only; triangles may lie on each other."""
    corners = whole.vertices[whole.faces]
    middle, normal = corners.mean(axis=1), doubled_normals(corners)
    length = np.linalg.norm(normal, axis=1)
    step = _BESIDE * longest_side(whole.vertices) * normal / np.where(length > 0, length, 1)[:, None]
    outside, inside = (
        winding_number(whole.vertices, whole.faces, middle + way * step).round() for way in (1, -1)
    )
    _refuse_crossing(middle[(length > 0) & ((outside != 0) | (inside != 1))])


def _refuse_crossing(places: Array) -> None:
    if len(places):
        raise ValueError(
            f"the surface crosses itself at {place_of(places[0])}; parts may overlap, but each must be simple"
        )


def _has_sliver(part: Part) -> bool:
    """Return whether a triangle is so flat that its normal is a rounding error."""
    corners = part.vertices[part.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    return bool((2 * areas_of(corners) < _SLIVER * longest_side(part.vertices) * longest).any())
