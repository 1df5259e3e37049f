"""The body of voxels: a smooth surface through their samples, or the union of the cuboids.

A mask says for each voxel whether its centre is in the body. A body of cubes would have too large a surface,
and stairs on tilted faces. So the mask is smoothed and becomes a level set. The normals of its triangles are
averaged with nearby ones that are nearly parallel (bilateral filter: Zheng et al. 2011,
doi:10.1109/TVCG.2010.264), so that faces become flat and edges stay sharp. Vertices follow the normals (Sun
et al. 2007, doi:10.1109/TVCG.2007.1065), and the volume is restored. The surface of grey values, such as
those of a scan, is at a level between voxels.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from autdtorch.scene.obstacles.mesh_distance import MeshDistance
from autdtorch.scene.obstacles.primitives import BOX_TRIANGLES
from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.process import cached_property
from autdtorch.utils.spatial import doubled_normals

_BLUR = 0.5  # Standard deviation of the first smoothing [voxels]
# Rounds of the filter, and in each the averages of normals and the moves of vertices
_ROUNDS, _AVERAGED, _MOVED = 3, 12, 12
# Standard deviations of the distance between triangles whose normals are averaged [voxels], and of the
# difference of these normals: with 0.3 spheres get facets, with 0.5 edges are rounded
_NEAR, _PARALLEL = 1.8, 0.38
_REACH = 1.7  # Largest distance of triangles that are averaged, relative to `_NEAR`
_VOLUME_STEPS, _VOLUME_ERROR = 20, 1e-9  # Most steps that restore the volume, and the relative error left
# Standard deviations of the levels of smoothing that are compared [voxels], and the difference from the mask
# at which a level is too smooth
_LEVELS, _MISSED = (0.5, 0.8, 1.2, 1.8, 2.6), 0.15
# Uncertainty, relative to the rms distance of the sharpened surface from the smooth one; fitted to the fields
# of spheres and boxes
_UNCERTAIN = 0.5
_UNCERTAIN_SMOOTH, _UNCERTAIN_GREY = 0.1, 0.02  # Of the smooth surface and of grey values [voxels]
# Depth [voxels] by which a surface may have the centre of a voxel on the wrong side. Sharpened surfaces of
# balls and boxes reach 0.2; more is a body of few voxels, a thin part or a hole that is lost
_WRONG_SIDE = 0.25
_MOST_WRONG = 0.05  # Share of nearby voxels on the wrong side, above which a mask is too thin
_LEAST = 1e-7  # Share of a smoothed mask that is rounding
_AIR = 2  # Voxels of air around cuboids in the distance transform; points farther away use a search tree


class ThinError(ValueError):
    """Little is left of a mask once it is smoothed."""


class VoxelSurface:
    """A closed surface through voxels with edges (3,) [m]; coordinates from the corner of the first one on.

    A mask (nx, ny, nz) is smoothed; of grey values the surface at a level counts, with the body above it.

    Attributes:
        uncertainty: distance [m] by which the surface may be off (rms).
        lost: number of voxels whose centres are on the wrong side, as they are too small to be smooth.
    """

    def __init__(self, values: NDArray[Any], edges: Array, level: float | None) -> None:
        """Take a mask, or grey values with a level.

        Raises:
            ThinError: a mask of single voxels, or one as thin.
        """
        self._values, self._edges, self._level = values, edges, level
        self._vertices, self._faces, self.uncertainty, self.lost = self._build()

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Corners (3,) [m] of the bounding box."""
        return self._vertices.min(axis=0), self._vertices.max(axis=0)

    def surface(self) -> tuple[Array, Index]:
        """Return vertices (V, 3) [m] and outward triangles (F, 3)."""
        return self._vertices, self._faces

    def inside(self, points: Array) -> NDArray[np.bool_]:
        """Return which points (N, 3) are in the body."""
        return np.asarray(self.distance(points) < 0)

    def distance(self, points: Array) -> Array:
        """Return the signed distances (N,) [m] of points (N, 3)."""
        return self._distance(points)

    def _build(self) -> tuple[Array, Index, float, int]:
        """Return vertices, triangles, the uncertainty and the number of voxels lost.

        The first of three surfaces is used that has the centres of all voxels on their side: sharpening makes
        cubes of balls of few voxels, and restoring the volume swells bodies that have lost thin parts.
        """
        edge = float(np.cbrt(np.prod(self._edges)))
        if self._level is not None:
            return *_contour(_padded(self._level - self._values), self._edges, 1), _UNCERTAIN_GREY * edge, 0
        rough = _contour(*_smoothed(self._values, self._edges, _BLUR))
        smooth = _contour(*_smoothest(self._values, self._edges))
        if not len(rough[1]) or not len(smooth[1]):
            raise ThinError
        places, sides = _beside_surface(self._values, self._edges)
        for vertices, faces, uncertain in self._tried(*rough, *smooth):
            wrong = np.maximum(0, -sides * MeshDistance(vertices, faces)(places))
            uncertainty = math.hypot(uncertain, math.sqrt(float((wrong**2).mean())))
            lost = int((wrong > _WRONG_SIDE * edge).sum())
            if not lost:
                break
        if lost > _MOST_WRONG * len(places):
            raise ThinError
        return vertices, faces, uncertainty, lost

    def _tried(
        self, rough: Array, rough_faces: Index, smooth: Array, smooth_faces: Index
    ) -> Iterator[tuple[Array, Index, float]]:
        """Yield surfaces, each with its uncertainty [m]: sharpened, smooth with the volume, and smooth."""
        uncertain = _UNCERTAIN_SMOOTH * float(np.cbrt(np.prod(self._edges)))
        sharpened = _sharpened(rough, rough_faces, float(self._edges.max()))
        sharp = _with_volume(sharpened, rough_faces, self._volume)
        off = math.sqrt(float((MeshDistance(*sharp)(smooth) ** 2).mean()))
        yield *sharp, _UNCERTAIN * off
        yield *_with_volume(smooth, smooth_faces, self._volume), uncertain
        yield smooth, smooth_faces, uncertain

    @property
    def _volume(self) -> float:
        return float(self._values.sum() * np.prod(self._edges))

    @cached_property
    def _distance(self) -> MeshDistance:
        return MeshDistance(self._vertices, self._faces)

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the search structures, which are built again."""
        return {name: value for name, value in vars(self).items() if name != "_distance"}


class VoxelCubes:
    """The union of the cuboids of a mask (nx, ny, nz) with edges (3,) [m]; coordinates from its corner on.

    The signed distance at a voxel centre is the distance to the cuboid of the nearest voxel of the other
    kind. Between centres it is interpolated: exact at flat faces, with an error of up to half a voxel at
    edges and corners and on the medial axis.
    """

    def __init__(self, mask: NDArray[np.bool_], edges: Array, uncertainty: float = 0.0) -> None:
        """Take a mask, the edges of its voxels, and the distance [m] by which their faces may be off."""
        self._values, self._edges, self.uncertainty = mask, edges, uncertainty

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Corners (3,) [m] of the bounding box."""
        return self._extent[0] * self._edges, self._extent[1] * self._edges

    def surface(self) -> tuple[Array, Index]:
        """Return vertices (V, 3) [m] and triangles (F, 3) of the faces between body and air."""
        mask = np.pad(self._values, 1)
        corners = np.indices((2, 2, 2)).reshape(3, 8).T
        quads = []
        for side, triangles in enumerate(BOX_TRIANGLES.reshape(6, 2, 3).numpy()):
            axis, step = side // 2, 2 * (side % 2) - 1
            bare = np.argwhere(mask & ~np.roll(mask, -step, axis=axis)) - 1
            quads.append((bare[:, None, None, :] + corners[triangles]).reshape(-1, 3))
        nodes, index = np.unique(np.concatenate(quads), axis=0, return_inverse=True)
        return nodes * self._edges, index.reshape(-1, 3)

    def inside(self, points: Array) -> NDArray[np.bool_]:
        """Return which points (N, 3) are in the body; lower faces of a voxel count, upper ones do not."""
        voxel = np.floor(points / self._edges)
        within = ((voxel >= 0) & (voxel < self._values.shape)).all(axis=1)
        filled = np.zeros(len(points), bool)
        filled[within] = self._values[tuple(voxel[within].astype(np.int64).T)]
        return filled

    def distance(self, points: Array) -> Array:
        """Return the signed distances (N,) [m] of points (N, 3)."""
        from scipy.ndimage import map_coordinates

        voxels = points / self._edges - 0.5  # centres have whole numbers
        local = voxels - self._extent[0] + _AIR
        near = ((local >= 0) & (local <= np.array(self._field.shape) - 1)).all(axis=1)
        distance = np.empty(len(voxels))
        distance[near] = map_coordinates(self._field, local[near].T, order=1)
        if not near.all():
            nearest = self._shell.query(points[~near])[1]
            distance[~near] = self._to_cuboid(self._shell.data[nearest] - points[~near])
        return distance

    @cached_property
    def _extent(self) -> tuple[Index, Index]:
        """First voxel of the body and one past the last along each axis, (3,) each."""
        filled = np.argwhere(self._values)
        return filled.min(axis=0), filled.max(axis=0) + 1

    @cached_property
    def _field(self) -> Array:
        """Signed distances at the voxel centres of the body's extent, with `_AIR` around it."""
        from scipy.ndimage import distance_transform_edt

        first, last = self._extent
        window = tuple(slice(low, high) for low, high in zip(first, last, strict=True))
        body = np.pad(self._values[window], _AIR)
        here = np.indices(body.shape)
        outside, inside = (
            self._to_cuboid(
                np.moveaxis(
                    distance_transform_edt(
                        kind, sampling=self._edges, return_distances=False, return_indices=True
                    )
                    - here,
                    0,
                    -1,
                )
                * self._edges
            )
            for kind in (~body, body)
        )
        return np.where(body, -inside, outside)

    @cached_property
    def _shell(self) -> Any:
        """Search tree of the centres [m] of the body's outer voxels."""
        from scipy.ndimage import binary_erosion
        from scipy.spatial import KDTree

        outer = self._values & ~binary_erosion(self._values)
        return KDTree((np.argwhere(outer) + 0.5) * self._edges)

    def _to_cuboid(self, offset: Array) -> Array:
        """Return the distance to a voxel whose centre is at `offset` (..., 3) [m]."""
        return np.asarray(np.linalg.norm(np.maximum(np.abs(offset) - self._edges / 2, 0), axis=-1))


def _padded(grey: Array) -> Array:
    """Return a field, negative in the body, padded by a voxel; bodies at its end reach to its faces."""
    padded = np.pad(grey, 1, mode="edge")
    around = np.pad(np.zeros(grey.shape, bool), 1, constant_values=True)
    return np.where(around, np.abs(padded), padded)


def _beside_surface(mask: NDArray[np.bool_], edges: Array) -> tuple[Array, Array]:
    """Return the centres (n, 3) [m] of voxels near those of the other kind, and -1 in the body, 1 outside."""
    from scipy.ndimage import binary_dilation, binary_erosion

    body, around = np.pad(mask, 2), np.ones((5, 5, 5), bool)
    beside = binary_dilation(body, around) & ~binary_erosion(body, around)
    return (np.argwhere(beside) - 1.5) * edges, np.where(body[beside], -1.0, 1.0)


def _contour(field: Array, edges: Array, pad: int) -> tuple[Array, Index]:
    """Return the surface where a field at voxel centres, with `pad` voxels around, changes its sign."""
    import igl

    places = np.stack(np.meshgrid(*(np.arange(count) for count in field.shape), indexing="ij"), axis=-1)
    points = np.ascontiguousarray(places.transpose(2, 1, 0, 3).reshape(-1, 3), np.float64)
    values = np.ascontiguousarray(field.transpose(2, 1, 0).ravel(), np.float64)
    vertices, faces, _ = igl.marching_cubes(values, points, *field.shape, 0.0)
    corners = vertices[faces]
    if np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0:
        faces = faces[:, ::-1]
    return (vertices - pad + 0.5) * edges, np.ascontiguousarray(faces)


def _smoothed(mask: NDArray[np.bool_], edges: Array, blur: float) -> tuple[Array, Array, int]:
    """Return the level set of a mask smoothed by `blur` [voxels], the edges, and the voxels around.

    The share p of a flat body after smoothing by s is Phi(-d / s) at a distance d from it. A curved surface
    moves inwards by s^2 times its mean curvature, which is added back.
    """
    from scipy.ndimage import gaussian_filter
    from scipy.special import ndtri

    longest = float(edges.max())
    sigmas = blur * longest / edges
    pad = math.ceil(3 * float(sigmas.max())) + 2
    share = gaussian_filter(np.pad(mask, pad).astype(np.float64), sigmas)
    level = -blur * longest * ndtri(np.clip(share, _LEAST, 1 - _LEAST))
    slopes = np.stack(np.gradient(level, *edges))
    normals = slopes / np.maximum(np.linalg.norm(slopes, axis=0), _LEAST)
    curvature = sum(np.gradient(normals[axis], edges[axis], axis=axis) for axis in range(3))
    moved = gaussian_filter((blur * longest) ** 2 / 2 * curvature, longest / edges)
    return level - np.clip(moved, -blur * longest, blur * longest), edges, pad


def _smoothest(mask: NDArray[np.bool_], edges: Array) -> tuple[Array, Array, int]:
    """Return the level set of a mask that is as smooth everywhere as its voxels allow; see `_smoothed`."""
    from scipy.ndimage import gaussian_filter, maximum_filter

    longest = float(edges.max())
    levels = [_smoothed(mask, edges, blur) for blur in _LEVELS]
    pad = levels[-1][2]
    sign = np.where(np.pad(mask, pad), -1.0, 1.0)
    total, rest = np.zeros(sign.shape), np.ones(sign.shape)
    for blur, (level, _, around) in zip(_LEVELS[::-1], levels[::-1], strict=True):
        level = np.pad(level, pad - around, mode="edge")
        missed = np.maximum(0, -sign * level).clip(max=2 * blur * longest)
        missed = maximum_filter(missed, 2 * math.ceil(2 * blur) + 1)
        weight = np.exp(-((missed / (_MISSED * longest)) ** 2)) if blur > _LEVELS[0] else np.ones(sign.shape)
        weight = gaussian_filter(weight, max(0.7, 0.7 * blur))
        total += rest * weight * np.clip(level, -3 * longest, 3 * longest)
        rest *= 1 - weight
    return total, edges, pad


def _sharpened(vertices: Array, faces: Index, edge: float) -> Array:
    """Return vertices (V, 3) whose triangles follow the normals of those around that are nearly parallel."""
    from scipy.spatial import KDTree

    count = len(faces)
    place = faces.ravel(), np.repeat(np.arange(count), 3)
    beside = csr_array(coo_array((np.ones(3 * count), place), (len(vertices), count)))
    number = np.asarray(beside.sum(axis=1)).ravel()[:, None]
    for _ in range(_ROUNDS):
        corners = vertices[faces]
        doubled = doubled_normals(corners)
        area = np.maximum(np.linalg.norm(doubled, axis=1), _LEAST * edge**2)
        middles, normals = corners.mean(axis=1), doubled / area[:, None]
        pairs = KDTree(middles).query_pairs(_REACH * _NEAR * edge, output_type="ndarray")
        near = _nearness(middles, pairs, edge)
        for _ in range(_AVERAGED):
            normals = _averaged(normals, area, near)
        square = (beside @ (normals[:, :, None] * normals[:, None]).reshape(count, 9)).reshape(-1, 3, 3)
        for _ in range(_MOVED):
            depth = (normals * vertices[faces].mean(axis=1)).sum(axis=1)
            pull = beside @ (normals * depth[:, None])
            vertices = vertices + (pull - (square @ vertices[:, :, None])[:, :, 0]) / number
    return vertices


def _nearness(middles: Array, pairs: Index, edge: float) -> csr_array:
    """Return the weights of pairs of triangles by distance, each pair once, in single precision."""
    one, other = pairs.T
    far = ((middles[one] - middles[other]) ** 2).sum(axis=1)
    weight = np.exp(-far / (2 * (_NEAR * edge) ** 2)).astype(np.float32)
    return csr_array(coo_array((weight, (one, other)), (len(middles),) * 2))


def _averaged(normals: Array, area: Array, near: csr_array) -> Array:
    """Return unit normals (F, 3): means of those around each, by area and by how parallel they are."""
    single = normals.astype(np.float32)
    rows = np.repeat(np.arange(len(normals)), np.diff(near.indptr))
    cosine = np.einsum("ij,ij->i", single[rows], single[near.indices])
    alike = near.data * np.exp((cosine - 1) / np.float32(_PARALLEL**2))
    weights = csr_array((alike, near.indices, near.indptr), near.shape)
    weighted = area[:, None] * normals
    mean = weighted + weights @ weighted + weights.T @ weighted
    return np.asarray(mean / np.linalg.norm(mean, axis=1, keepdims=True))


def _with_volume(vertices: Array, faces: Index, volume: float) -> tuple[Array, Index]:
    """Return a surface moved along its normals until it encloses a volume [m^3]."""
    for _ in range(_VOLUME_STEPS):
        corners = vertices[faces]
        doubled = doubled_normals(corners)
        missing = volume - np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
        if abs(missing) < _VOLUME_ERROR * volume:
            break
        area = np.linalg.norm(doubled, axis=1).sum() / 2
        normals = np.zeros_like(vertices)
        np.add.at(normals, faces.ravel(), np.repeat(doubled, 3, axis=0))
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        vertices = vertices + normals / np.where(length > 0, length, 1) * (missing / area)
    return vertices, faces
