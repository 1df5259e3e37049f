"""Signed distances to a triangle mesh, from search structures that are built once."""

from __future__ import annotations

import atexit
from weakref import WeakSet

import numpy as np

from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.spatial import doubled_normals

_ON_SIDE = 1e-9  # barycentric coordinate of a nearest point that lies on a side of its triangle
_FINE = 2.0  # accuracy of winding numbers as libigl counts it: errors are below 0.05


_known: WeakSet[MeshDistance] = WeakSet()


@atexit.register
def _drop_all() -> None:
    """Drop the search structures: libigl warns of any that outlive the interpreter."""
    for each in tuple(_known):
        vars(each).clear()


class MeshDistance:
    """The distance to a closed surface, negative inside.

    The nearest point of the surface is on a triangle, an edge or at a vertex. A point is outside if it is on
    the side of its normal: that of the triangle, the mean of two at an edge, the mean by angles at a vertex
    (Baerentzen and Aanaes 2005, doi:10.1109/TVCG.2005.49). Where more than two triangles meet at an edge, or
    parts at a vertex, the winding number decides.
    """

    def __init__(self, vertices: Array, faces: Index) -> None:
        """Build the structures for vertices (V, 3) and outward triangles (F, 3)."""
        import igl

        _known.add(self)
        self._vertices, self._faces = np.ascontiguousarray(vertices), np.ascontiguousarray(faces)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)
        self._winding = None
        if igl.is_edge_manifold(self._faces)[0] and igl.is_vertex_manifold(self._faces).all():
            by_angle = igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_ANGLE
            uniform = igl.PER_EDGE_NORMALS_WEIGHTING_TYPE_UNIFORM
            self._face_normals = _unit(doubled_normals(self._vertices[self._faces]))
            self._vertex_normals = igl.per_vertex_normals(self._vertices, self._faces, by_angle)
            self._edge_normals, _, self._edge = igl.per_edge_normals(self._vertices, self._faces, uniform)
        else:
            lower, upper = self._vertices.min(axis=0), self._vertices.max(axis=0)
            self._middle, self._extent = (lower + upper) / 2, float((upper - lower).max())
            self._winding = igl.FastWindingNumberBVH()  # in single precision
            self._winding.init((self._vertices - self._middle) / self._extent, self._faces)

    def __call__(self, points: Array) -> Array:
        """Return the signed distances (N,) of points (N, 3)."""
        points = np.ascontiguousarray(points)
        if len(points) == 0:
            return np.zeros(0)
        square, face, nearest = self._tree.squared_distance(self._vertices, self._faces, points)
        if self._winding is None:
            inside = ((points - nearest) * self._normals(face, nearest)).sum(axis=1) < 0
        else:
            inside = self._winding.winding_number((points - self._middle) / self._extent, _FINE) > 0.5
        return np.asarray(np.where(inside, -np.sqrt(square), np.sqrt(square)))

    def _normals(self, face: Index, nearest: Array) -> Array:
        """Return the normals (N, 3) of the surface at points on triangles `face` (N,)."""
        normal = self._face_normals[face]
        first, second, third = (self._vertices[corner] for corner in self._faces[face].T)
        opposite = zip((second, third, first), (third, first, second), strict=True)
        whole = np.linalg.norm(np.cross(second - first, third - first), axis=1)
        # the share of the triangle opposite each corner, zero for a point on the side opposite it
        area = [(np.cross(b - nearest, c - nearest) * normal).sum(axis=1) for b, c in opposite]
        share = np.stack(area, axis=1) / np.where(whole > 0, whole, 1)[:, None]
        on_side = np.abs(share) < _ON_SIDE
        at_edge = np.flatnonzero(on_side.sum(axis=1) == 1)
        side = on_side[at_edge].argmax(axis=1)
        normal[at_edge] = self._edge_normals[self._edge[face[at_edge] + len(self._faces) * side]]
        at_vertex = np.flatnonzero(on_side.sum(axis=1) > 1)
        corner = share[at_vertex].argmax(axis=1)
        normal[at_vertex] = self._vertex_normals[self._faces[face[at_vertex], corner]]
        return np.asarray(normal)


def _unit(vectors: Array) -> Array:
    """Return vectors (n, 3) divided by their length, where it is not zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, 1))
