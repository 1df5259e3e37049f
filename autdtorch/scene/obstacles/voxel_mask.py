"""Bodies of voxels."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from autdtorch.scene.obstacles.base import Obstacle
from autdtorch.scene.obstacles.triangles import BOX_TRIANGLES
from autdtorch.utils.digest import digest_of
from autdtorch.utils.numpy_file import read_arrays
from autdtorch.utils.validation import Vector, finite_vector, invalid, is_dense, path_of, positive

_AIR = 2  # voxels of air around the body in the distance transform; points farther away use a search tree


@dataclass(frozen=True)
class VoxelMask(Obstacle):
    """A body made of cubic voxels, such as a segmented scan.

    The signed distance at a voxel centre is the distance to the cube of the nearest voxel of the other kind.
    Between centres it is interpolated: exact at flat faces, with an error of up to half a voxel at edges and
    corners and on the medial axis.

    Attributes:
        mask: (nx, ny, nz), bool, True in the body; a read-only copy.
        spacing: edge of a voxel [m], > 0.
        origin: corner of voxel (0, 0, 0) with the smallest coordinates (3,) [m]; voxel (i, j, k) has its
            centre at origin + spacing (i + 1/2, j + 1/2, k + 1/2).
        digest: of the mask; compared in place of it.

    Raises:
        ValueError: a mask that is not boolean, not (nx, ny, nz) or nowhere True; or another attribute that is
            not finite, has the wrong shape or is out of range; see also `Obstacle`.
    """

    mask: NDArray[np.bool_] = field(repr=False, compare=False)
    spacing: float
    origin: Vector = (0.0, 0.0, 0.0)
    digest: str = field(init=False)

    def __post_init__(self) -> None:
        """Check the attributes and copy the mask."""
        super().__post_init__()
        object.__setattr__(self, "mask", _checked_mask(self.mask))
        object.__setattr__(self, "spacing", positive("VoxelMask.spacing", self.spacing, "m"))
        object.__setattr__(self, "origin", finite_vector("VoxelMask.origin", self.origin))
        object.__setattr__(self, "digest", digest_of(self.mask)[:16])

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        spacing: float,
        origin: Vector = (0.0, 0.0, 0.0),
        *,
        density: float | None = None,
        sound_speed: float | None = None,
        rigid: bool = False,
    ) -> VoxelMask:
        """Read the mask from `path`, a .npy file or an .npz file with a single array.

        For the other arguments see `VoxelMask`, and for the material see `Obstacle`.

        Raises:
            ValueError: no such file, or no single array in it; see also `VoxelMask`.
        """
        mask = _read(path_of("VoxelMask.path", path))
        return cls(mask, spacing, origin, density=density, sound_speed=sound_speed, rigid=rigid)

    @property
    def lower(self) -> Vector:
        """Corner of the body's bounding box with the smallest coordinates (3,) [m]."""
        return self._corner(self._extent[0])

    @property
    def upper(self) -> Vector:
        """Corner of the body's bounding box with the largest coordinates (3,) [m]."""
        return self._corner(self._extent[1])

    def surface(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the faces between voxels of body and air; see `Obstacle.surface`."""
        mask = np.pad(self.mask, 1)
        corners = np.indices((2, 2, 2)).reshape(3, 8).T
        quads = []
        for side, triangles in enumerate(BOX_TRIANGLES.reshape(6, 2, 3).numpy()):
            axis, step = side // 2, 2 * (side % 2) - 1
            bare = np.argwhere(mask & ~np.roll(mask, -step, axis=axis)) - 1
            quads.append((bare[:, None, None, :] + corners[triangles]).reshape(-1, 3))
        nodes, index = np.unique(np.concatenate(quads), axis=0, return_inverse=True)
        vertices = np.array(self.origin) + self.spacing * nodes
        return torch.from_numpy(vertices), torch.from_numpy(index.reshape(-1, 3))

    @cached_property
    def _extent(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """First voxel of the body and one past the last along each axis, (3,) each."""
        filled = np.argwhere(self.mask)
        return filled.min(axis=0), filled.max(axis=0) + 1

    @cached_property
    def _field(self) -> NDArray[np.float64]:
        """Signed distances in voxels at the voxel centres of the body's extent, with `_AIR` around it."""
        from scipy.ndimage import distance_transform_edt

        first, last = self._extent
        window = tuple(slice(low, high) for low, high in zip(first, last, strict=True))
        body = np.pad(self.mask[window], _AIR)
        here = np.indices(body.shape)
        outside, inside = (
            _to_cube(distance_transform_edt(kind, return_distances=False, return_indices=True) - here, axis=0)
            for kind in (~body, body)
        )
        return np.where(body, -inside, outside)

    @cached_property
    def _shell(self) -> Any:
        """Search tree of the body's outer voxels."""
        from scipy.ndimage import binary_erosion
        from scipy.spatial import KDTree

        mask = self.mask
        return KDTree(np.argwhere(mask & ~binary_erosion(mask)))

    def _corner(self, voxel: NDArray[np.int64]) -> Vector:
        x, y, z = (low + self.spacing * int(count) for low, count in zip(self.origin, voxel, strict=True))
        return x, y, z

    def _voxels(self, points: torch.Tensor) -> NDArray[np.float64]:
        """Return positions (N, 3) in voxels; voxel centres have whole numbers."""
        return np.asarray(points.detach().cpu().numpy() - self.origin, np.float64) / self.spacing - 0.5

    def _inside(self, points: torch.Tensor, margin: float) -> torch.Tensor:
        """Count the lower faces of a voxel as inside and the upper faces as outside."""
        mask = self.mask
        voxel = np.floor(self._voxels(points) + 0.5)
        within = ((voxel >= 0) & (voxel < mask.shape)).all(axis=1)
        filled = np.zeros(len(points), bool)
        filled[within] = mask[tuple(voxel[within].astype(np.int64).T)]
        inside = torch.from_numpy(filled).to(points.device)
        return inside | (self._distance(points) < margin) if margin > 0 else inside

    def _distance(self, points: torch.Tensor) -> torch.Tensor:
        from scipy.ndimage import map_coordinates

        voxels = self._voxels(points)
        local = voxels - self._extent[0] + _AIR
        near = ((local >= 0) & (local <= np.array(self._field.shape) - 1)).all(axis=1)
        distance = np.empty(len(voxels))
        distance[near] = map_coordinates(self._field, local[near].T, order=1)
        if not near.all():
            nearest = self._shell.query(voxels[~near])[1]
            distance[~near] = _to_cube(self._shell.data[nearest] - voxels[~near], axis=1)
        return torch.from_numpy(self.spacing * distance).to(points)


def _to_cube(offset: NDArray[Any], axis: int) -> NDArray[np.float64]:
    """Return the distance to a unit cube whose centre is at `offset`; coordinates are along `axis`."""
    return np.asarray(np.linalg.norm(np.maximum(np.abs(offset) - 0.5, 0), axis=axis), np.float64)


def _checked_mask(given: object) -> NDArray[np.bool_]:
    if (
        not isinstance(given, torch.Tensor | np.ndarray)
        or given.dtype not in (torch.bool, np.bool_)
        or not is_dense(given)
        or given.ndim != 3
    ):
        raise invalid("VoxelMask.mask", given, "must be an array (nx, ny, nz) of booleans")
    mask = given.cpu().numpy() if isinstance(given, torch.Tensor) else given
    if not mask.any():
        raise ValueError(f"VoxelMask.mask: array of shape {mask.shape}; must be True somewhere")
    mask = np.array(mask)
    mask.flags.writeable = False
    return mask


def _read(path: Path) -> NDArray[Any]:
    try:
        arrays = list(read_arrays(path).values())
    except (OSError, ValueError) as error:
        raise invalid("VoxelMask.path", str(path), f"must be a .npy or .npz file ({error})") from error
    if len(arrays) != 1:
        raise invalid("VoxelMask.path", str(path), f"holds {len(arrays)} arrays, must hold a single one")
    return arrays[0]
