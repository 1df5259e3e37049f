"""Voxels as the cuboids that they are."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from autdtorch.scene.obstacles.primitives import BOX_TRIANGLES
from autdtorch.utils.array_types import Array, Index
from autdtorch.utils.cached import cached_property

_AIR = 2  # voxels of air around the body in the distance transform; points farther away use a search tree


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
