"""The signed distance from a closed triangle mesh."""

from __future__ import annotations

import math

import numpy as np

from autdtorch.scene.obstacles.mesh_parts import winding_number
from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.process import parts_of_size, spread
from autdtorch.utils.spatial import doubled_normals

_IN_LEAF = 5  # Triangles of a leaf of the tree, at most
_TOGETHER = 4096  # Points in a task: one or two milliseconds
# Heights of triangles below which rounding may have turned them over, relative to the extent, and to the
# largest coordinate: four roundings in single precision, as of STL
_SLIVER, _ROUNDED = 1e-6, 2.0**-22


class MeshDistance:
    """The distance to a closed surface, negative inside.

    A point is outside if the normal at the nearest point of the surface points towards it. At an edge, this
    normal is the mean of two triangles, at a vertex the mean weighted by angles (Baerentzen and Aanaes 2005,
    doi:10.1109/TVCG.2005.49). The winding number decides at edges of more than two triangles, at vertices
    where parts meet, and at slivers, which rounding may turn over.
    """

    def __init__(self, vertices: Array, faces: Index) -> None:
        """Build the structures for vertices (V, 3) and outward triangles (F, 3)."""
        self._vertices, self._faces = vertices, faces
        self._boxes, order = _tree(vertices[faces])
        first, second, third = np.moveaxis(vertices[faces[order]], 1, 0)
        u, v, w = second - first, third - first, third - second
        normal = np.cross(u, v)
        shares = np.concatenate((np.cross(v, normal), np.cross(normal, u)), axis=1) * _inverse(normal)
        self._triangles = np.concatenate((first, u, v, shares, *map(_inverse, (u, v, w))), axis=1)
        self._normals, features = _normals(vertices, faces)
        self._features = features[order]

    def __call__(self, points: Array) -> Array:
        """Return the signed distances (N,) of points (N, 3), quickly where neighbours follow each other."""
        from autdtorch.scene.obstacles.nearest_triangles import nearest_triangles  # loads numba

        points, distance, above = np.ascontiguousarray(points), np.empty(len(points)), np.empty(len(points))
        tables = self._boxes, self._triangles, self._features, self._normals

        def measure(ends: tuple[int, int]) -> None:
            part = slice(*ends)
            nearest_triangles(points[part], *tables, distance[part], above[part])

        spread(measure, parts_of_size(len(points), _TOGETHER))
        inside = above < 0
        if len(uncertain := np.flatnonzero(np.isnan(above))):
            inside[uncertain] = winding_number(self._vertices, self._faces, points[uncertain]) > 0.5
        return np.where(inside, -distance, distance)


def _tree(corners: Array) -> tuple[Array, Index]:
    """Return the boxes of triangles with `corners` (F, 3, 3), and their order (n,); see `nearest_triangles`.

    Each node has half the triangles of the one above, to either side of a plane. Some occur twice, so that
    all leaves have as many.
    """
    lower, upper = corners.min(axis=1), corners.max(axis=1)
    middle, count = np.ascontiguousarray((lower + upper).T), len(corners)
    levels = math.ceil(math.log2(max(1, count / _IN_LEAF)))
    slots = math.ceil(count / 2**levels) << levels
    order = (np.arange(slots) * count // slots)[None]
    for _ in range(levels):
        places = middle[:, order]
        along = places[np.ptp(places, axis=2).argmax(axis=0), np.arange(len(order))]
        halves = np.argpartition(along, along.shape[1] // 2, axis=1)
        order = np.take_along_axis(order, halves, axis=1).reshape(2 * len(order), -1)
    ends = [(lower[order].min(axis=1), upper[order].max(axis=1))]
    for _ in range(levels):
        low, high = (each.reshape(-1, 2, 3) for each in ends[-1])
        ends.append((low.min(axis=1), high.max(axis=1)))
    boxes = [np.concatenate(pair, axis=1) for pair in reversed(ends)]
    return np.concatenate((np.zeros((1, 6)), *boxes)), order.ravel()


def _normals(vertices: Array, faces: Index) -> tuple[Array, Index]:
    """Return the normals (n, 3) of faces, edges and vertices, and their rows (F, 7); see `nearest_triangles`.

    They are NaN where more than two triangles meet at an edge, or parts at a vertex, and at slivers.
    """
    import igl

    corners = vertices[faces]
    normals = doubled_normals(corners)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    least = max(_SLIVER * np.ptp(vertices, axis=0).max(), _ROUNDED * np.abs(vertices).max())
    sliver = length[:, 0] < least * longest
    normals = np.divide(normals, length, out=np.full_like(normals, np.nan), where=~sliver[:, None])
    at_edge, _, edge = igl.per_edge_normals(vertices, faces, igl.PER_EDGE_NORMALS_WEIGHTING_TYPE_UNIFORM)
    at_edge[np.bincount(edge, minlength=len(at_edge)) != 2] = np.nan
    at_edge[edge.reshape(3, -1)[:, sliver]] = np.nan
    at_vertex = igl.per_vertex_normals(vertices, faces, igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_ANGLE)
    at_vertex[~igl.is_vertex_manifold(faces)] = np.nan
    at_vertex[faces[sliver]] = np.nan
    count = len(faces)
    rows = np.column_stack((np.arange(count), count + edge.reshape(3, -1).T, count + len(at_edge) + faces))
    return np.concatenate((normals, at_edge, at_vertex)), rows


def _inverse(vectors: Array) -> Array:
    """Return the inverse squared lengths (n, 1) of vectors (n, 3), 0 without a length."""
    square = (vectors * vectors).sum(axis=1, keepdims=True)
    return np.asarray(np.divide(1.0, square, out=np.zeros_like(square), where=square > 0))
