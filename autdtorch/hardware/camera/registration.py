"""The registration of a camera: where each place of a plane is in its images."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field

import numpy as np
from scipy.ndimage import gaussian_filter, label, map_coordinates
from scipy.optimize import least_squares

from autdtorch.hardware.camera.picture import plane_coordinates
from autdtorch.scene.geometry import Plane
from autdtorch.utils.array_types import AnyArray, Array
from autdtorch.utils.validation import (
    ArrayLike,
    gappy_tensor,
    invalid,
    positive_integers,
    real_tensor,
    require_kind,
)

_LARGE_RESIDUAL = 0.5e-3  # [m]; 6 % of a wavelength at 40 kHz
_LARGEST_CONDITION = 1e12  # of a matrix
_LEAST_SPREAD = 1e-4  # of the equations of four marks in line, by those of a square: about 0


@dataclass(frozen=True, eq=False)
class Registration:
    """A homography between the coordinates (u, v) [m] of a plane, from its centre, and pixels (column, row).

    Pixel (0, 0) is the centre of the first pixel of the first row. A camera whose lens distorts needs
    undistorted images.

    Attributes:
        plane: the plane.
        matrix: (3, 3), from (u, v, 1) [m] to the pixel, up to a factor.
        residuals: distance (K,) [m] of each mark from where the homography puts it; 0 for four marks.
    """

    plane: Plane
    matrix: Array
    residuals: Array = field(default_factory=lambda: np.zeros(4))

    def __post_init__(self) -> None:
        require_kind("plane", self.plane, Plane)
        matrix = _array("matrix", self.matrix)
        if matrix.shape != (3, 3) or not _is_view(matrix, self.plane):
            accepted = "must be (3, 3), invertible, with all of the plane before the camera"
            raise ValueError(f"matrix: shape {matrix.shape}; {accepted}")
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "residuals", _array("residuals", self.residuals))

    @classmethod
    def of(cls, plane: Plane, pixels: ArrayLike, places: ArrayLike) -> Registration:
        """Return the registration by marks whose places are known.

        Args:
            plane: the plane.
            pixels: (K, 2), K >= 4, as (column, row), with fractions.
            places: (K, 3) [m], in the plane; no three of four in a line.

        Raises:
            ValueError: shapes that do not fit, places off the plane or too near to a line, or pixels that
                no camera sees in this order.
        """
        require_kind("plane", plane, Plane)
        seen, coordinates = _pairs("pixels", pixels), plane_coordinates(plane, places, "places")
        if seen.ndim != 2 or len(seen) < 4 or len(coordinates) != len(seen):
            accepted = f"must be (K, 2), K >= 4, one for each of {len(coordinates)} places"
            raise ValueError(f"pixels: shape {seen.shape}; {accepted}")
        matrix = _homography(coordinates, seen)
        if not _is_view(matrix, plane):
            accepted = "must be in the order of the places, and no three of four in a line"
            raise invalid("pixels", seen.round(2).tolist(), accepted)
        matrix = _refined(matrix, coordinates, seen)
        registration = cls(plane, matrix)
        residuals = np.linalg.norm(registration.to_plane(seen) - coordinates, axis=1)
        registration = cls(plane, matrix, residuals)
        if registration.residual > _LARGE_RESIDUAL:
            warnings.warn(
                f"registration: the marks are {1e3 * registration.residual:.2g} mm (rms) off the image of "
                f"a plane, the worst is mark {residuals.argmax()} with {1e3 * residuals.max():.2g} mm",
                stacklevel=2,
            )
        return registration

    @property
    def residual(self) -> float:
        """Root mean square error of a mark [m], by the residuals; 0 for four marks, which fit any camera."""
        free = len(self.residuals) - 4
        return math.sqrt(float((self.residuals**2).sum()) / free) if free > 0 else 0.0

    def to_pixels(self, coordinates: ArrayLike) -> Array:
        """Return the pixels (..., 2), as (column, row), of coordinates (..., 2) [m], or ValueError."""
        return _projected(self.matrix, _pairs("coordinates", coordinates))

    def to_plane(self, pixels: ArrayLike) -> Array:
        """Return the coordinates (..., 2) [m] of pixels (..., 2), as (column, row), or ValueError."""
        return _projected(np.linalg.inv(self.matrix), _pairs("pixels", pixels))

    def on_grid(self, image: ArrayLike, counts: tuple[int, ...]) -> Array:
        """Return an image (H, W) at the centres (Nu, Nv) of equal cells of the plane, NaN where unseen.

        Places next to a pixel that is NaN, or outside the image, are NaN. ValueError for other shapes.
        """
        values = gappy_tensor("image", image)
        if values.ndim != 2 or values.numel() == 0:
            raise ValueError(f"image: shape {tuple(values.shape)}; must be (H, W), with a pixel")
        counts = positive_integers("counts", counts, 2)
        along = [
            size * ((np.arange(n) + 0.5) / n - 0.5) for size, n in zip(self.plane.size, counts, strict=True)
        ]
        pixels = self.to_pixels(np.stack(np.meshgrid(*along, indexing="ij"), axis=-1))
        where = [pixels[..., 1], pixels[..., 0]]
        grid = map_coordinates(values.detach().cpu().numpy(), where, order=1, cval=np.nan)
        return np.asarray(grid, dtype=np.float64)


def registered_by_foci(plane: Plane, rises: ArrayLike, places: ArrayLike) -> Registration:
    """Return the registration by foci that the array played, one for each image.

    Args:
        plane: the plane.
        rises: K images (K, H, W) of the rise of temperature [K], each by one focus; NaN for a dead pixel.
        places: (K, 3) [m], where |p| is largest in the plane for each of the foci; K >= 4.

    Raises:
        ValueError: an image without a hot spot, or as for `Registration.of`.
    """
    images = gappy_tensor("rises", rises)
    if images.ndim != 3 or images.numel() == 0:
        raise ValueError(f"rises: shape {tuple(images.shape)}; must be (K, H, W), with a pixel")
    return Registration.of(
        plane, np.stack([hot_spot(image) for image in images.detach().cpu().numpy()]), places
    )


def hot_spot(rise: Array) -> Array:
    """Return the pixel (2,), as (column, row) with fractions, around which an image (H, W) is hottest.

    A Gaussian with free widths and tilt is fitted to the pixels above half the maximum.

    Raises:
        ValueError: nothing in the image stands out of its noise.
    """
    valid = np.isfinite(rise)
    smooth = gaussian_filter(np.where(valid, rise, 0.0), 1.5)
    share = gaussian_filter(valid.astype(np.float64), 1.5)
    smooth = np.where(share > 0.3, smooth / np.maximum(share, 0.3), -np.inf)
    row, column = divmod(int(smooth.argmax()), rise.shape[1])
    level = np.nanmedian(rise)
    spread = 1.5 * np.nanmedian(np.abs(rise - level))
    height = smooth[row, column] - level
    if not height > 4 * spread / 3:  # smoothing leaves about a fifth of the noise
        raise invalid("rises", float(height), f"must have a spot above their noise of {spread:.2g}", "K")
    spots, _ = label(smooth > level + height / 2)
    rows, columns = np.nonzero((spots == spots[row, column]) & valid)
    offset = np.stack([columns - column, rows - row])

    def misfit(unknowns: Array) -> Array:
        x, y, xx, xy, yy, top, base = unknowns
        du, dv = offset[0] - x, offset[1] - y
        model = base + top * np.exp(-0.5 * (xx * du**2 + 2 * xy * du * dv + yy * dv**2))
        return np.asarray(model - rise[rows, columns], dtype=np.float64)

    width = 2.4 * np.pi / max(len(rows), 1)
    start = np.array([0.0, 0.0, width, 0.0, width, height, level])
    fitted = least_squares(misfit, start, x_scale=[1.0, 1.0, width, width, width, height, height]).x
    return np.array([column + fitted[0], row + fitted[1]])


def _array(name: str, value: object) -> Array:
    array: Array = real_tensor(name, value).detach().cpu().numpy()
    return array


def _pairs(name: str, value: object) -> Array:
    pairs = _array(name, value)
    if pairs.ndim == 0 or pairs.shape[-1] != 2:
        raise ValueError(f"{name}: shape {pairs.shape}; must be (..., 2)")
    return pairs


def _projected(matrix: AnyArray, places: Array) -> Array:
    x, y = places[..., 0], places[..., 1]
    a, b, w = (row[0] * x + row[1] * y + row[2] for row in matrix)
    return np.stack([a / w, b / w], axis=-1)


def _is_view(matrix: Array, plane: Plane) -> bool:
    """Return true if a camera can see all of a plane by a homography (3, 3)."""
    u, v = np.asarray(plane.size) / 2
    depths = np.array([[-u, -v, 1], [-u, v, 1], [u, -v, 1], [u, v, 1]]) @ matrix[2]
    is_invertible = np.linalg.cond(matrix / np.abs(matrix).max()) <= _LARGEST_CONDITION
    return bool(is_invertible and (depths > 0).all() | (depths < 0).all())


def _normalised(places: Array) -> tuple[Array, Array]:
    """Return places (K, 2) around 0 with mean distance 1, and the matrix (3, 3) that makes them so."""
    center = places.mean(axis=0)
    scale = 1 / max(float(np.linalg.norm(places - center, axis=1).mean()), 1e-12)
    matrix = np.array([[scale, 0, -scale * center[0]], [0, scale, -scale * center[1]], [0, 0, 1.0]])
    return scale * (places - center), matrix


def _homography(coordinates: Array, pixels: Array) -> Array:
    """Return the homography (3, 3) by the direct linear transform (Hartley & Zisserman 2004, 4.1)."""
    (source, to_source), (image, to_image) = _normalised(coordinates), _normalised(pixels)
    ones, zeros = np.ones((len(source), 1)), np.zeros((len(source), 3))
    known = np.hstack([source, ones])
    equations = np.vstack(
        [np.hstack([known, zeros, -image[:, :1] * known]), np.hstack([zeros, known, -image[:, 1:] * known])]
    )
    _, values, rows = np.linalg.svd(equations)
    if values[7] < _LEAST_SPREAD * values[0]:
        raise invalid("places", "marks nearly in a line", "four of them must have no three in a line")
    matrix = np.linalg.inv(to_image) @ rows[-1].reshape(3, 3) @ to_source
    return np.asarray(matrix / matrix[2, 2])


def _refined(matrix: Array, coordinates: Array, pixels: Array) -> Array:
    """Return the homography (3, 3) with the least squared distance of pixels."""
    scale = np.abs(matrix).ravel()[:8] + 1e-9

    def misfit(entries: Array) -> Array:
        return (_projected(np.append(entries * scale, 1.0).reshape(3, 3), coordinates) - pixels).ravel()

    fitted = least_squares(misfit, matrix.ravel()[:8] / scale, xtol=1e-14, ftol=1e-14).x
    return np.append(fitted * scale, 1.0).reshape(3, 3)
