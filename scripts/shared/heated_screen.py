"""A heated screen before a camera by finite differences: frames to test the inversion of cosines against."""

import math

import numpy as np
import torch
from scipy.ndimage import zoom
from scipy.sparse import csr_array
from scipy.special import erf

import autdtorch as at
from autdtorch.hardware.camera.registration import Registration
from autdtorch.hardware.camera.screen import Screen

FREQUENCY, WAVELENGTH = 40e3, 343.0 / 40e3
_SPACING, _STEP = 0.8e-3, 2.5e-3  # of the finite differences [m], [s]
_FINER = 3  # cells of the camera in one of these: its bilinear weights blur
_MARGIN = 15e-3  # of the screen around the plane [m]
_BLUR = 0.5  # of images [pixels]


def pinhole(
    plane: at.Plane, shape: tuple[int, int], tilt: float = 0.0, pitch: float = 0.8e-3, roll: float = 0.1
) -> Registration:
    """Return the registration of a camera that looks at the centre of a plane.

    Args:
        plane: the plane.
        shape: of its images (H, W).
        tilt: of its axis from the normal [rad].
        pitch: of pixels in the middle of the plane [m].
        roll: about its axis [rad].
    """
    cos, sin, length = math.cos(tilt), math.sin(tilt), 1000.0  # focal length [pixels]
    tilted = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    rolled = np.array([[math.cos(roll), -math.sin(roll), 0], [math.sin(roll), math.cos(roll), 0], [0, 0, 1]])
    lens = np.array([[length, 0, shape[1] / 2 - 0.2], [0, length, shape[0] / 2 - 0.7], [0, 0, 1]])
    pose = np.column_stack([(tilted @ rolled)[:, :2], [0, 0, length * pitch]])
    return Registration(plane, lens @ pose)


class HeatedScreen:
    """A screen, larger than the plane, that a field heats, and a camera that sees it."""

    def __init__(self, registration: Registration, shape: tuple[int, int]) -> None:
        """Set up the grid, and the part of each cell in each pixel of images (H, W)."""
        plane = registration.plane
        self.counts = [round((size + 2 * _MARGIN) / _SPACING) for size in plane.size]
        self.screen, self.shape = Screen(heating=1e-6), shape
        large = at.Plane(plane.center, plane.normal, (self.counts[0] * _SPACING, self.counts[1] * _SPACING))
        self.points = large.points(_SPACING).reshape(-1, 3)
        rows, columns = np.divmod(np.arange(math.prod(shape)), shape[1])
        cells, spacing = _FINER * np.array(self.counts), _SPACING / _FINER
        offsets, weights = point_spread(_BLUR)
        entries: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        for dx, wx in zip(offsets, weights, strict=True):
            for dy, wy in zip(offsets, weights, strict=True):
                places = registration.to_plane(np.stack([columns + dx, rows + dy], axis=-1))
                position = places / spacing + cells / 2 - 0.5
                start = np.floor(position).astype(int)
                part = position - start
                inside = ((start >= 0) & (start < cells - 1)).all(axis=1)
                for du, dv in ((0, 0), (0, 1), (1, 0), (1, 1)):
                    share = wx * wy * (part[:, 0] if du else 1 - part[:, 0])
                    share = share * (part[:, 1] if dv else 1 - part[:, 1])
                    cell = (start[:, 0] + du) * cells[1] + start[:, 1] + dv
                    entries.append((share[inside], np.flatnonzero(inside), cell[inside]))
        share, pixel, cell = (np.concatenate(part) for part in zip(*entries, strict=True))
        self._sampling = csr_array((share, (pixel, cell)), shape=(len(rows), int(cells.prod())))

    def rises(self, pressure: torch.Tensor, times: np.ndarray, duration: float) -> np.ndarray:
        """Return the rise (T, H, W) [K] for magnitudes at `points` [Pa], that sound from time 0 [s]."""
        return self.images(self.temperatures(pressure, times, duration))

    def images(self, temperatures: np.ndarray) -> np.ndarray:
        """Return images (T, H, W) of temperatures (T, P) at `points`."""
        maps = temperatures.reshape(-1, *self.counts)
        fine = [zoom(heat, _FINER, order=3, mode="nearest", grid_mode=True).ravel() for heat in maps]
        return (self._sampling @ np.stack(fine, axis=1)).T.reshape(-1, *self.shape)

    def temperatures(self, pressure: torch.Tensor, times: np.ndarray, duration: float) -> np.ndarray:
        """Return the rise (T, P) [K] of the screen at `points`, as `rises` does for images."""
        source = self.screen.rate * pressure.abs().square().numpy().reshape(self.counts)
        temperature, rises, now = np.zeros(self.counts), [], 0.0
        for time in times:
            while now < time - 1e-12:
                end = duration if now < duration - 1e-12 else math.inf
                step = min(_STEP, time - now, end - now)
                loss = temperature / self.screen.loss_time
                change = self.screen.diffusivity * laplacian(temperature) - loss
                temperature = temperature + step * (change + (source if end < math.inf else 0.0))
                now += step
            rises.append(temperature.ravel())
        return np.stack(rises)


def laplacian(values: np.ndarray) -> np.ndarray:
    """Return the Laplacian, of fourth order, between insulated edges."""
    wide = np.pad(values, 2, mode="symmetric")
    rows, columns = wide[:, 2:-2], wide[2:-2]
    along = 16 * (rows[1:-3] + rows[3:-1]) - rows[:-4] - rows[4:]
    across = 16 * (columns[:, 1:-3] + columns[:, 3:-1]) - columns[:, :-4] - columns[:, 4:]
    return (along + across - 60 * values) / (12 * _SPACING**2)


def point_spread(blur: float) -> tuple[np.ndarray, np.ndarray]:
    """Return offsets [pixels] and weights of a Gaussian convolved with a pixel, along an axis."""
    offsets = np.linspace(-3 * blur - 0.5, 3 * blur + 0.5, 9)
    weights = erf((offsets + 0.5) / (2**0.5 * blur)) - erf((offsets - 0.5) / (2**0.5 * blur))
    return offsets, weights / weights.sum()


def focused_drive(array: at.TransducerArray, foci: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Return a drive (M,) with foci (P, 3) [m] of random phases in free space."""
    matrix = at.green(foci, array.positions, 2 * math.pi / WAVELENGTH)
    phases = 2 * math.pi * torch.rand(len(foci), generator=generator, dtype=torch.float64)
    drive = torch.polar(torch.ones_like(phases), phases) @ matrix.conj()
    return drive / drive.abs()


def magnitudes(array: at.TransducerArray, drive: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """Return |p| (P,) of monopoles in free space at points, for a source strength of 1 Pa m."""
    parts = points.split(8192)
    wavenumber = 2 * math.pi / WAVELENGTH
    return torch.cat([(at.green(part, array.positions, wavenumber) @ drive).abs() for part in parts])
