"""Bodies of voxels."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray

from autdtorch.scene.obstacles.base import Obstacle
from autdtorch.scene.obstacles.voxel_surface import ThinError, VoxelCubes, VoxelSurface
from autdtorch.utils.array_types import Array, is_dense, triple
from autdtorch.utils.digest import digest_of
from autdtorch.utils.files import path_of, read_arrays, write_arrays
from autdtorch.utils.hints import suggesting
from autdtorch.utils.process import cached_property
from autdtorch.utils.validation import (
    Vector,
    boolean,
    finite_number,
    finite_vector,
    invalid,
    positive,
    positive_entries,
)

logger = logging.getLogger(__name__)

_MOST_UNEQUAL = 20  # Ratio of a voxel's edges: smoothing over the longest takes so many of the shortest
# Distance [voxels] by which the faces of cuboids may be off where the body is smooth
_UNCERTAIN_CUBES = 0.3


@dataclass(frozen=True)
class VoxelMask(Obstacle):
    """A body of voxels, such as a segmented scan.

    Voxels are samples of a smooth body, which has flat faces and edges where the voxels show some, and their
    volume (`voxel_surface.py`). Errors of fields include the `uncertainty` of its surface. With
    `smooth=False` the body is the union of the voxels.

    Attributes:
        mask: (nx, ny, nz): booleans, True in the body; or whole numbers, 0 outside and one other inside; or
            grey values with a `level`. A read-only copy.
        spacing: edge of a voxel [m], > 0; or the edges along x, y and z (3,).
        origin: corner of voxel (0, 0, 0) with the smallest coordinates (3,) [m]; voxel (i, j, k) has its
            centre at origin + spacing (i + 1/2, j + 1/2, k + 1/2).
        level: grey value at the surface; the body is above it. None: the values are a mask.
        smooth: whether voxels are samples of a smooth body, or cuboids.
        digest: of the mask; compared in place of it.

    Raises:
        ValueError: values that are no mask and have no level, are not (nx, ny, nz) or nowhere in the body;
            `smooth=False` with a level; or another attribute that is not finite, has the wrong shape or is
            out of range; see also `Obstacle`.
    """

    position_field: ClassVar[str] = "origin"
    unit_question: ClassVar[str] = "is its spacing in m, 1 mm as 1e-3?"

    mask: NDArray[Any] = field(repr=False, compare=False)
    spacing: float | Vector
    origin: Vector = (0.0, 0.0, 0.0)
    level: float | None = None
    smooth: bool = True
    digest: str = field(init=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "spacing", _checked_spacing(self.spacing))
        object.__setattr__(self, "origin", finite_vector("VoxelMask.origin", self.origin))
        object.__setattr__(self, "smooth", boolean("VoxelMask.smooth", self.smooth))
        if self.level is not None:
            object.__setattr__(self, "level", finite_number("VoxelMask.level", self.level))
            if not self.smooth:
                raise invalid("VoxelMask.smooth", False, "must be True with a level")
        values = _checked_mask(self.mask) if self.level is None else _checked_grey(self.mask, self.level)
        values.flags.writeable = False
        object.__setattr__(self, "mask", values)
        object.__setattr__(self, "digest", digest_of(self.mask)[:16])

    @classmethod
    @suggesting
    def load(
        cls,
        path: str | os.PathLike[str],
        spacing: float | Vector,
        origin: Vector = (0.0, 0.0, 0.0),
        level: float | None = None,
        smooth: bool = True,
        *,
        density: complex | None = None,
        sound_speed: complex | None = None,
        rigid: bool = False,
        absorption: float = 0.0,
        impedance: complex | None = None,
    ) -> VoxelMask:
        """Read the voxels from `path`, a .npy file or an .npz file with a single array.

        For the other arguments see `VoxelMask`, and for the material see `Obstacle`.

        Raises:
            ValueError: no such file, or no single array in it; see also `VoxelMask`.
        """
        values = _read(path_of("VoxelMask.path", path))
        material: dict[str, Any] = {"density": density, "sound_speed": sound_speed, "rigid": rigid}
        material |= {"absorption": absorption, "impedance": impedance}
        return cls(values, spacing, origin, level, smooth, **material)

    @classmethod
    @suggesting
    def from_image(
        cls,
        image: Any,
        name: str | None = None,
        level: float | None = None,
        smooth: bool = True,
        *,
        scale: float = 1.0,
        density: complex | None = None,
        sound_speed: complex | None = None,
        rigid: bool = False,
        absorption: float = 0.0,
        impedance: complex | None = None,
    ) -> VoxelMask:
        """Make a body of a PyVista `ImageData`, from the values of its cells or, without any, of its points.

        A value at a point stands for the voxel around it. Spacing and origin of the image count, times
        `scale`, metres per unit of the image: 1e-3 for one in millimetres. `name` selects the array, by
        default the active one. For the other arguments see `VoxelMask`, and for the material see `Obstacle`.

        Raises:
            ValueError: no image, no such array, or an array without one number for each voxel; see also
                `VoxelMask`.
        """
        values, spacing, origin = _image_values(image, name)
        scale = positive("VoxelMask.scale", scale)
        edges, lower = (tuple(scale * length for length in each) for each in (spacing, origin))
        material: dict[str, Any] = {"density": density, "sound_speed": sound_speed, "rigid": rigid}
        material |= {"absorption": absorption, "impedance": impedance}
        return cls(values, edges, lower, level, smooth, **material)

    @property
    def uncertainty(self) -> float:
        """Distance [m] by which the surface may be off (rms), as it lies somewhere between voxels."""
        return self._body.uncertainty

    @property
    def lower(self) -> Vector:
        """Lower corner of the body's bounding box (3,) [m]."""
        return self._in_scene(self._body.bounds[0])

    @property
    def upper(self) -> Vector:
        """Upper corner of the body's bounding box (3,) [m]."""
        return self._in_scene(self._body.bounds[1])

    def surface(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the surface, of cubes the faces between voxels of body and air; see `Obstacle.surface`."""
        vertices, triangles = self._body.surface()
        return torch.from_numpy(vertices + self.origin), torch.from_numpy(triangles)

    def filled(self) -> Self:
        """Return the body without its cavities; see `Obstacle.filled`."""
        from scipy.ndimage import binary_fill_holes

        body = self.mask if self.level is None else self.mask > self.level
        holes = binary_fill_holes(body) & ~body
        return replace(self, mask=np.where(holes, self.mask[body].max(), self.mask)) if holes.any() else self

    def at(self, position: Vector) -> Self:
        """Return the obstacle with another origin (3,) [m]; both share their body."""
        copy = super().at(position)
        vars(copy)["_body"] = self._body
        return copy

    @classmethod
    def maker(cls) -> Callable[..., VoxelMask]:
        """Return `load`: a scene file has the path of the voxels; see `Obstacle.maker`."""
        return cls.load

    def section(self, name: str) -> dict[str, Any]:
        """Return the section, with the path of `write_file`; see `Obstacle.section`."""
        return {"path": f"{name}.npz"} | super().section(name)

    def write_file(self, path: Path) -> None:
        """Write the mask to an .npz file; see `Obstacle.write_file`."""
        write_arrays(path.with_name(f"{path.name}.npz"), {"mask": self.mask})

    @cached_property
    def _body(self) -> VoxelSurface | VoxelCubes:
        edges = np.broadcast_to(np.array(self.spacing, np.float64), 3)
        if not self.smooth:
            return VoxelCubes(self.mask, edges)
        try:
            body = VoxelSurface(self.mask, edges, self.level)
        except ThinError:
            logger.warning("a body of %d voxels is too thin to be smooth: taken as cuboids", self.mask.sum())
            return VoxelCubes(self.mask, edges, _UNCERTAIN_CUBES * float(edges.max()))
        if body.lost:
            logger.warning("%d voxels are too small to be smooth: left out of a body, or filled", body.lost)
        return body

    def _in_scene(self, corner: Array) -> Vector:
        return triple(float(low + place) for low, place in zip(self.origin, corner, strict=True))

    def _from_origin(self, points: torch.Tensor) -> Array:
        return np.asarray(points.detach().cpu().numpy() - self.origin, np.float64)

    def _inside(self, points: torch.Tensor, margin: float) -> torch.Tensor:
        inside = torch.from_numpy(self._body.inside(self._from_origin(points))).to(points.device)
        return inside | (self._distance(points) < margin) if margin > 0 else inside

    def _distance(self, points: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(self._body.distance(self._from_origin(points))).to(points)


def _checked_spacing(spacing: object) -> float | Vector:
    if not isinstance(spacing, list | tuple) and getattr(spacing, "ndim", 0) != 1:
        return positive("VoxelMask.spacing", spacing, "m")
    x, y, z = positive_entries("VoxelMask.spacing", spacing, 3)
    if max(x, y, z) > _MOST_UNEQUAL * min(x, y, z):
        accepted = f"edges must be within a factor of {_MOST_UNEQUAL} of each other; resample the voxels"
        raise invalid("VoxelMask.spacing", (x, y, z), accepted, "m")
    return x if x == y == z else (x, y, z)


def _checked_values(mask: object, accepted: str) -> NDArray[Any]:
    """Return a copy of an array (nx, ny, nz) of real numbers or booleans."""
    if not isinstance(mask, torch.Tensor | np.ndarray) or not is_dense(mask) or mask.ndim != 3:
        raise invalid("VoxelMask.mask", mask, accepted)
    values = mask.cpu().numpy() if isinstance(mask, torch.Tensor) else mask
    if values.dtype.kind not in "buif" or not np.isfinite(values).all():
        raise invalid("VoxelMask.mask", mask, accepted)
    return np.array(values)


def _checked_mask(mask: object) -> NDArray[np.bool_]:
    values = _checked_values(mask, "must be an array (nx, ny, nz) of booleans or of whole numbers")
    if values.dtype != np.bool_:
        numbers = np.unique(values)
        if values.dtype.kind not in "ui" or len(numbers) > 2 or (len(numbers) == 2 and numbers[0] != 0):
            accepted = "must be booleans, or whole numbers that are 0 and one other; grey values need a level"
            raise ValueError(f"VoxelMask.mask: {values.dtype} array with {len(numbers)} values; {accepted}")
    if not values.any():
        raise ValueError(f"VoxelMask.mask: array of shape {values.shape}; must be True somewhere")
    return np.asarray(values != 0)


def _checked_grey(mask: object, level: float) -> NDArray[np.float64]:
    values = _checked_values(mask, "must be an array (nx, ny, nz) of real numbers").astype(np.float64)
    if not (values > level).any():
        raise invalid("VoxelMask.level", level, f"must be below the largest grey value, {values.max():g}")
    return values


def _image_values(image: Any, name: str | None) -> tuple[NDArray[Any], Any, Any]:
    """Return the values of an image (nx, ny, nz), its spacing (3,), and its first voxel's corner (3,)."""
    try:
        counts, spacing, origin = image.dimensions, image.spacing, image.origin
        cells, points = image.cell_data, image.point_data
    except AttributeError as error:
        raise invalid("image", type(image).__name__, "must be a PyVista ImageData") from error
    if name is not None and not isinstance(name, str):
        raise invalid("name", name, "must be that of an array of the image, or None")
    of_cells = name in cells if name is not None else len(cells) > 0
    data = cells if of_cells else points
    key = name if name is not None else data.active_scalars_name or next(iter(data.keys()), None)
    if key is None or key not in data:
        known = ", ".join([*cells.keys(), *points.keys()]) or "none"
        raise invalid("name", name, f"must be an array of the image; it has {known}")
    shape = tuple(max(count - 1, 1) for count in counts) if of_cells else tuple(counts)
    values = np.asarray(data[key])
    if values.shape != (math.prod(shape),):
        raise ValueError(f"name: array {key!r} of shape {values.shape}; must have one number for each voxel")
    corner = [low - (0 if of_cells else edge / 2) for low, edge in zip(origin, spacing, strict=True)]
    return values.reshape(shape, order="F"), spacing, corner


def _read(path: Path) -> NDArray[Any]:
    try:
        arrays = list(read_arrays(path).values())
    except (OSError, ValueError) as error:
        raise invalid("VoxelMask.path", str(path), f"must be a .npy or .npz file ({error})") from error
    if len(arrays) != 1:
        raise invalid("VoxelMask.path", str(path), f"holds {len(arrays)} arrays, must hold a single one")
    return arrays[0]
