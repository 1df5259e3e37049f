"""Points and triangles in space: distances, neighbours, areas and normals; distinct rows and cells."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from autdtorch.utils.array_types import AnyArray, Array, Index
from autdtorch.utils.validation import LENGTH_TOLERANCE

_FLAT = 1 - 1e-9  # Cosine of the angle between the normals of triangles in a plane, at least
_LATTICE = 0.7548776662466927, 0.5698402909980532
"""Steps of a plane lattice of low discrepancy: powers of the root of x^3 + x^2 = 1 (Roberts 2018)."""

_MULTIPLIER = np.uint64(0x9E3779B97F4A7C15)  # odd, of the golden ratio: digests of rows
_HALF = np.uint64(32)
_TOGETHER = 4096  # Rows that stay in the cache while columns are added


def distances(points: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
    """Return the distances (P, M) [m] between `points` (P, 3) and `others` (M, 3)."""
    # By default cdist expands the square, which loses half the digits of short distances.
    return torch.cdist(points, others, compute_mode="donot_use_mm_for_euclid_dist")


def nearest(points: torch.Tensor, others: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the distance (P,) [m] of points (P, 3) to the nearest of `others` (M, 3), and its index (P,)."""
    from scipy.spatial import KDTree

    apart, index = KDTree(others.numpy(force=True)).query(points.numpy(force=True))
    return torch.from_numpy(apart), torch.from_numpy(index)


def closest_pair(points: torch.Tensor) -> tuple[float, int, int]:
    """Return the least distance [m] between two of the points (P, 3), inf for one, and their indices."""
    from scipy.spatial import KDTree

    places = points.numpy(force=True)
    apart, index = KDTree(places).query(places, k=2)
    first = int(apart[:, 1].argmin())
    one, other = index[first].tolist()
    return float(apart[first, 1]), first, other if one == first else one  # a coincident point may come first


def require_distinct(name: str, points: torch.Tensor) -> None:
    """Check that no two of the `points` (P, 3) [m] coincide."""
    apart, first, other = closest_pair(points)
    if apart < LENGTH_TOLERANCE:
        place = tuple(points[first].tolist())
        raise ValueError(
            f"{name}: points {first} and {other} coincide at {place} m; "
            f"they must be at least {LENGTH_TOLERANCE:g} m apart"
        )


def doubled_normals(corners: Array) -> Array:
    """Return the outward normals (T, 3) of triangles with `corners` (T, 3, 3), of twice their area."""
    first, second, third = np.moveaxis(corners, 1, 0)
    return np.asarray(np.cross(second - first, third - first))


def sides_of(triangles: Index) -> Index:
    """Return the vertices (3 T, 2) of the sides of triangles (T, 3): the first of each, then the others."""
    return np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])


def numbered_edges(triangles: Index) -> tuple[Index, Index]:
    """Return the edges (n, 2) of triangles (T, 3), ascending, and the edge (3 T,) of each of `sides_of`."""
    ends = sides_of(triangles).astype(np.int64, copy=False)
    count = ends.max(initial=0) + 1
    numbers, edge = np.unique(ends.min(axis=1) * count + ends.max(axis=1), return_inverse=True)
    return np.column_stack(np.divmod(numbers, count)), edge


def areas_of(corners: Array) -> Array:
    """Return the areas (T,) of triangles with `corners` (T, 3, 3)."""
    return np.asarray(np.linalg.norm(doubled_normals(corners), axis=1) / 2)


def spread_evenly(areas: Array, count: int) -> Index:
    """Return the numbers (count,) of triangles of `areas` (T,) on which places share the area evenly."""
    total = np.cumsum(areas)
    return np.asarray(np.searchsorted(total, (np.arange(count) + 0.5) / count * total[-1]))


def places_on(corners: Array, count: int) -> Array:
    """Return places (count, 3) that share the area of triangles with `corners` (T, 3, 3) evenly."""
    first, second, third = np.moveaxis(corners[spread_evenly(areas_of(corners), count)], 1, 0)
    a, b = np.outer(_LATTICE, np.arange(count))[:, :, None] % 1
    beyond = a + b > 1
    a, b = np.where(beyond, 1 - a, a), np.where(beyond, 1 - b, b)
    return np.asarray(first + a * (second - first) + b * (third - first))


def connected_parts(pairs: AnyArray | tuple[AnyArray, AnyArray], count: int) -> Index:
    """Return the number of the part (count,) of each of `count` things, of which pairs (2, n) are joined."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(pairs[0])), pairs), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def parts_of(vertices: Array, triangles: Index) -> list[Array]:
    """Return the corners (T, 3, 3) of each part of a surface, vertices (V, 3) [m], that touches no other."""
    joined = distinct_rows(np.round(vertices / LENGTH_TOLERANCE).astype(np.int64))[1][triangles]
    label = connected_parts(sides_of(joined).T, len(vertices))[joined[:, 0]]
    order = np.argsort(label, kind="stable")
    starts = np.flatnonzero(np.diff(label[order])) + 1
    return np.split(vertices[triangles[order]], starts)


def paired_sides(triangles: Index) -> Index:
    """Return the numbers (n, 2), in `sides_of`, of the sides that just two triangles share."""
    _, edge = numbered_edges(triangles)
    order, count = np.argsort(edge, kind="stable"), np.bincount(edge)
    return np.asarray(order[np.repeat(count == 2, count)].reshape(-1, 2))


def volume_and_area(vertices: Array, triangles: Index) -> tuple[float, float]:
    """Return volume and area of a closed surface, vertices (V, 3), triangles (T, 3)."""
    corners = vertices[triangles] - vertices.mean(axis=0)
    return float(abs(np.linalg.det(corners).sum() / 6)), float(areas_of(corners).sum())


def mean_thickness(vertices: Array, triangles: Index) -> float:
    """Return twice the volume over the area of a closed surface, vertices (V, 3), triangles (T, 3)."""
    volume, area = volume_and_area(vertices, triangles)
    return 2 * volume / area


def edge_length(vertices: Array, triangles: Index) -> float:
    """Return the length of the edges between faces of a surface, vertices (V, 3) [m], triangles (T, 3)."""
    joined = distinct_rows(np.round(vertices / LENGTH_TOLERANCE).astype(np.int64))[1][triangles]
    pairs, normals = paired_sides(joined), doubled_normals(vertices[triangles])
    normals /= np.maximum(np.linalg.norm(normals, axis=1), np.finfo(float).tiny)[:, None]
    one, other = normals[pairs.T % len(triangles)]
    ends = vertices[sides_of(triangles)[pairs[np.einsum("ij,ij->i", one, other) < _FLAT, 0]]]
    return float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).sum())


def places_along(ends: Array, step: float) -> Array:
    """Return places (n, 3) [m] along lines between ends (E, 2, 3) [m], at most a `step` [m] apart."""
    along = ends[:, 1] - ends[:, 0]
    counts = np.maximum(np.ceil(np.linalg.norm(along, axis=1) / step), 1).astype(np.int64)
    line = np.repeat(np.arange(len(ends)), counts)
    number = np.arange(len(line)) - np.repeat(counts.cumsum() - counts, counts)
    places: Array = ends[line, 0] + ((number + 0.5) / counts[line])[:, None] * along[line]
    return places


def extents(vertices: Array) -> Array:
    """Return the extents (3,) of vertices (V, 3) along their principal axes, the largest first."""
    centered = vertices - vertices.mean(axis=0)
    _, _, axes = np.linalg.svd(centered, full_matrices=False)
    return np.sort(np.ptp(centered @ axes.T, axis=0))[::-1]


def distinct_rows(rows: AnyArray) -> tuple[Index, Index]:
    """Return the places (k,) of the distinct of n rows, and the number (n,) of each row among these.

    Rows are compared bit by bit. All count as distinct where two of them have the same digest.
    """
    rows = np.ascontiguousarray(rows)
    digest, bits = np.zeros(len(rows), np.uint64), rows.view(np.dtype(f"u{rows.itemsize}"))
    for first_row in range(0, len(rows), _TOGETHER):
        some = slice(first_row, first_row + _TOGETHER)
        for column in bits[some].T:
            mixed = (digest[some] ^ column) * _MULTIPLIER
            digest[some] = mixed ^ (mixed >> _HALF)  # the upper bits, where those of numbers differ, count
    _, first, kind = np.unique(digest, return_index=True, return_inverse=True)
    distinct = rows[first]
    for first_row in range(0, len(rows), _TOGETHER):
        some = slice(first_row, first_row + _TOGETHER)
        if (distinct[kind[some]] != rows[some]).any():
            return np.arange(len(rows)), np.arange(len(rows))
    return first, kind


def distinct_cells(cells: Index, count: int) -> Index:
    """Return the distinct of flat indices (...) below `count`, ascending (n,)."""
    mask = np.zeros(count, bool)
    mask[cells] = True
    return np.flatnonzero(mask)


def places_among(distinct: Index, count: int) -> NDArray[np.int32]:
    """Return the place of each of `count` flat indices among `distinct` ones (n,); 0 of others."""
    place = np.zeros(count, np.int32)
    place[distinct] = np.arange(len(distinct), dtype=np.int32)
    return place
