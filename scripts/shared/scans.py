"""Public scans of planes above arrays with heights (github upnalab/usarrayheightmod, MIT), and their poses.

A scan has magnitudes in counts, without phase. Its place, size and orientation were not recorded.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import least_squares
from scipy.signal import correlate

import autdtorch as at
from autdtorch.propagators import FreeSpacePropagator

PATTERNS = "A", "Star", "12"
MARK = "measurements"
"""Folder of a clone."""

FREQUENCY, SOUND_SPEED, DENSITY = 40e3, 340.0, 1.2
WAVENUMBER = 2 * np.pi * FREQUENCY / SOUND_SPEED
RADIUS = 4.5e-3
"""Radius of a transducer [m]: half the aperture in the files."""
SIZE, DISTANCES = 0.175, (0.15, 0.16)
"""Nominal width of a scan, and distances of its plane [m]."""

REACH = 20e-3  # largest shift that is sought first [m]
COARSE = 2  # pixels of a step of this search
STRIDE = 6  # of the fitted pixels along both axes
STEPS = 30  # of the fit at most; those with wrong emitters do not end
UNITS = np.array([1e-3, 1e-3, 1e-3, 1e-2, 1e-2, 1e-3])  # of a pose and a radius in the fit


@dataclass(frozen=True)
class Pose:
    """The place of a scan, and the radius of the discs.

    Attributes:
        values: shift along x and y, distance [m], relative size, turn [rad], radius [m].
        quarters: quarter turns of the image before.
        flipped: whether its columns are reversed then.
    """

    values: tuple[float, ...]
    quarters: int
    flipped: bool

    @property
    def radius(self) -> float:
        """Radius of the discs [m]."""
        return self.values[5]

    def oriented(self, image: np.ndarray) -> np.ndarray:
        """Return the image with its axes along y and x of the array."""
        turned = np.rot90(image, self.quarters)
        return turned[:, ::-1] if self.flipped else turned

    def points(self, pixels: int) -> np.ndarray:
        """Return the places (pixels^2, 3) [m] of the oriented image."""
        x, y, z, size, turn, _ = self.values
        cos, sin = np.cos(turn), np.sin(turn)
        flat = (1 + size) * _square(pixels, SIZE) @ np.array([[cos, sin], [-sin, cos]])
        return np.column_stack((flat + np.array([x, y]), np.full(len(flat), z)))


@dataclass(frozen=True)
class Scan:
    """A scan (n, n) [counts], and the positions (M, 3) [m] of the transducers, which are all in phase."""

    name: str
    image: np.ndarray
    emitters: np.ndarray

    @property
    def fitted(self) -> np.ndarray:
        """The oriented image's pixels (n^2,), bool, that poses are fitted to; the others are held back."""
        mask = np.zeros(self.image.shape, bool)
        mask[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE] = True
        return mask.ravel()

    def pose(self, radius: float, fit_radius: bool = False) -> Pose:
        """Return the pose that fits best: of all orientations and shifts, then by least squares."""
        starts = [max(self._shifts(z, radius), key=lambda pair: pair[0])[1] for z in DISTANCES]
        fits = [self._refined(start, 6 if fit_radius else 5) for start in starts]
        return min(fits, key=lambda fit: fit[0])[1]

    def correlation(self, pose: Pose) -> float:
        """Return the correlation of far fields and readings at the pixels held back."""
        held = ~self.fitted
        field = far_field(self.emitters, pose.points(len(self.image))[held], pose.radius)
        return float(np.corrcoef(field, pose.oriented(self.image).ravel()[held])[0, 1])

    def _shifts(self, z: float, radius: float) -> Iterator[tuple[float, Pose]]:
        """Yield the correlation of the best shift of each orientation, and its pose."""
        image = self.image[::COARSE, ::COARSE]
        step = COARSE * SIZE / (len(self.image) - 1)
        margin = round(REACH / step)
        pixels = len(image) + 2 * margin
        plane = np.column_stack((_square(pixels, step * (pixels - 1)), np.full(pixels**2, z)))
        field = far_field(self.emitters, plane, radius).reshape(pixels, pixels)
        mean, power = (correlate(each, np.ones(image.shape), "valid") for each in (field, field**2))
        spread = np.sqrt(power - mean**2 / image.size)
        for quarters in range(4):
            for flipped in (False, True):
                pose = Pose((0, 0, z, 0, 0, radius), quarters, flipped)
                seen = pose.oriented(image) - image.mean()
                likeness = correlate(field, seen, "valid") / (spread * np.linalg.norm(seen))
                row, column = np.unravel_index(likeness.argmax(), likeness.shape)
                x, y = (step * (place - margin) for place in (column, row))
                yield float(likeness.max()), replace(pose, values=(x, y, z, 0, 0, radius))

    def _refined(self, start: Pose, free: int) -> tuple[float, Pose]:
        """Return the misfit and the pose of a fit of the first `free` values, with a free gain."""
        fitted, pixels = self.fitted, len(self.image)
        read = start.oriented(self.image).ravel()[fitted]
        read /= np.linalg.norm(read)

        def pose(steps: np.ndarray) -> Pose:
            values = np.array(start.values)
            values[:free] = UNITS[:free] * steps
            return replace(start, values=tuple(values.tolist()))

        def residual(steps: np.ndarray) -> np.ndarray:
            there = pose(steps)
            field = far_field(self.emitters, there.points(pixels)[fitted], there.radius)
            return (field @ read) / (field @ field) * field - read

        best = least_squares(residual, np.array(start.values)[:free] / UNITS[:free], max_nfev=STEPS)
        return float(best.cost), pose(best.x)


def load_scans(path: Path) -> list[Scan]:
    """Return the scans of a clone, or of a compact npz file of it."""
    if path.suffix == ".npz":
        with np.load(path) as data:
            pairs = ((data[f"scan_{name}"].astype(float), data[f"emitters_{name}"]) for name in PATTERNS)
            return [Scan(name, *pair) for name, pair in zip(PATTERNS, pairs, strict=True)]
    folder = path / MARK
    return [
        Scan(
            name,
            np.loadtxt(folder / "ExperimentalData_HeightMod" / f"HeightMod_{name}.csv", delimiter=","),
            np.loadtxt(folder / "Simulations" / f"heightMod_{name}.csv", delimiter=",", usecols=(0, 1, 2)),
        )
        for name in PATTERNS
    ]


def far_field(emitters: np.ndarray, points: np.ndarray, radius: float) -> np.ndarray:
    """Return magnitudes (P,) of discs in phase at points (P, 3), relative, by their far field."""
    away = torch.from_numpy(points)[:, None] - torch.from_numpy(emitters)
    distance = away.norm(dim=-1)
    angle = (away[..., 2] / distance).acos()
    directivity = at.analytic.piston_directivity(angle, WAVENUMBER, radius) if radius else 1.0
    field = (directivity / distance * torch.exp(1j * WAVENUMBER * distance)).sum(dim=1)
    return field.abs().numpy()


def propagator(emitters: np.ndarray, points: np.ndarray, radius: float) -> FreeSpacePropagator:
    """Return the free-space propagator of discs, or of points if the radius is 0, to points (P, 3)."""
    array = at.TransducerArray(emitters, (0, 0, 1), radius=radius)
    return FreeSpacePropagator(at.Scene(array, at.Medium(DENSITY, SOUND_SPEED), FREQUENCY, points))


def _square(pixels: int, width: float) -> np.ndarray:
    """Return places (pixels^2, 2) of a square around 0, x fastest."""
    along = width * np.linspace(-0.5, 0.5, pixels)
    return np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
