"""A thermal camera without hardware: a screen that the sound heats, and the camera's files of it.

Written from the physics, not from `hardware.camera`, so that one checks the other: finite differences on a
screen larger than the view, a pinhole camera, and 16-bit files.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage, sparse

from autdtorch.hardware.camera.screen import Screen
from autdtorch.hardware.emulator.bench import EmulatedBench
from autdtorch.scene.geometry import Plane
from autdtorch.utils.files import path_of
from autdtorch.utils.validation import (
    integer_at_least,
    number_between,
    positive_integers,
    require_callable,
    require_kind,
)

_SPACING = 0.6e-3  # of the screen's grid [m]: 7 cells in the finest pattern of |p|^2 at 40 kHz
_MARGIN = 15e-3  # of the screen around the plane [m]
_PIXEL = 0.9e-3  # about [m]
_FRACTION = 0.9  # of the image that the plane fills
_DISTANCE = 0.5  # of the camera from the plane [m]
_ROLL = math.radians(2.0)
_BLUR = 0.5  # standard deviation of the optics [pixels]; its pixels integrate besides
_LAG = 10e-3  # time constant of an uncooled microbolometer [s]
_PATTERN = 0.2  # standard deviation of the pixels' constant offsets [K]
_DEAD = 2e-3  # share of the pixels
_ROOM = 22.0  # [degrees C]
_ZERO = 273.15  # [K] at 0 degrees C
_COUNT = 0.01  # [K] a count of the files: FLIR's "TLinear" of high resolution


class EmulatedCamera:
    """A camera that looks at a screen in a plane of an emulated bench, in the bench's own time.

    It leaves 16-bit NPY files in a folder, in hundredths of a kelvin. Attributes are the pixels `corners`
    (4, 2), column and row, of the plane's corners, and `drift` [K/s] and `present`, which may be changed.
    """

    def __init__(
        self,
        bench: EmulatedBench,
        matrix_of: Callable[[torch.Tensor], torch.Tensor],
        plane: Plane,
        folder: str | Path,
        screen: Screen | None = None,
        rate: float = 30.0,
        shape: tuple[int, int] | None = None,
        noise: float = 0.05,
        drift: float = 0.01,
        tilt: float = 15.0,
        seed: int = 0,
    ) -> None:
        """Set the camera up; it takes its first frame when the bench's time goes on.

        Args:
            bench: plays the drives.
            matrix_of: returns the transfer matrix (N, M) [Pa] of points (N, 3) [m], as of the bench.
            plane: the plane of the screen, which fills most of the image.
            folder: where the files appear.
            screen: true properties of the screen; by default the usual one.
            rate: of the frames [1/s].
            shape: rows and columns of the image; by default pixels of 0.9 mm, and a third more columns.
            noise: standard deviation of a pixel in a frame [K].
            drift: of the temperature that all pixels show [K/s].
            tilt: angle between the line of sight and the plane's normal [degrees].
            seed: of noise and dead pixels, >= 0.

        `ValueError` for an argument out of range.
        """
        require_kind("bench", bench, EmulatedBench)
        require_callable("matrix_of", matrix_of)
        require_kind("plane", plane, Plane)
        self._bench, self._folder = bench, path_of("folder", folder, "a folder")
        self._screen = Screen() if screen is None else screen
        require_kind("screen", self._screen, Screen)
        self._period = 1 / number_between("rate", rate, 1.0, 1000.0, "1/s")
        rows, columns = _shape(plane) if shape is None else positive_integers("shape", shape, 2)
        self._noise = number_between("noise", noise, 0.0, 10.0, "K")
        self.drift = number_between("drift", drift, -10.0, 10.0, "K/s")
        angle = math.radians(number_between("tilt", tilt, -60.0, 60.0, "degrees"))
        self._generator = np.random.default_rng(integer_at_least("seed", seed, 0))
        counts = [math.ceil((length + 2 * _MARGIN) / _SPACING) for length in plane.size]
        size = (counts[0] * _SPACING, counts[1] * _SPACING)
        points = Plane(plane.center, plane.normal, size).points(_SPACING)
        self._matrix = matrix_of(points.reshape(-1, 3)).to(torch.complex64)
        self._excess: NDArray[np.float32] = np.zeros(points.shape[:2], np.float32)  # [K]
        self._slope: NDArray[np.floating] = np.zeros_like(self._excess)  # [K/s]
        self._drive: torch.Tensor | None = None
        self._heating = np.zeros_like(self._excess)  # [K/s]
        self._view = _View(plane, (rows, columns), angle)
        self._samples = self._view.samples(self._excess.shape, _SPACING)
        self.corners = self._view.pixels(_corners(plane))
        self._offsets = _PATTERN * self._generator.standard_normal((rows, columns), np.float32)
        self._dead = self._generator.random((rows, columns)) < _DEAD
        self._number, self._time = 0, self.clock()
        self.present = True
        bench.bus.watchers.append(self._pass)

    def close(self) -> None:
        """Take no more frames."""
        self._bench.bus.watchers.remove(self._pass)

    def clock(self) -> float:
        """Return the time now on the bench [s], which the files bear."""
        return self._bench.bus.slept

    def _pass(self, seconds: float) -> None:
        """Let time pass up to now, with the drive that plays; take the frames that are due."""
        self._hear()
        now, seen = self.clock(), {}
        while (due := (self._number + 1) * self._period) <= now:
            self._heat(due - self._time)
            self._number += 1
            if self.present:
                seen[self._number] = self._excess - _LAG * self._slope
        self._heat(now - self._time)
        if seen:
            self._take(list(seen), np.stack([*seen.values()]))

    def _hear(self) -> None:
        """Find the heating of the drive that plays."""
        drive = self._bench.drive()
        if self._drive is not None and torch.equal(drive, self._drive):
            return
        self._drive = drive
        power = (self._matrix @ drive.to(torch.complex64)).abs().square().numpy()
        self._heating = np.asarray(self._screen.rate * power.reshape(self._excess.shape), np.float32)

    def _heat(self, seconds: float) -> None:
        """Step the screen by Heun's method, which is stable up to twice the longest step taken."""
        fastest = 8 * self._screen.diffusivity / _SPACING**2 + 1 / self._screen.loss_time
        count = math.ceil(seconds * fastest - 1e-9)
        for _ in range(count):
            step = seconds / count
            first = self._rate_of_change(self._excess)
            second = self._rate_of_change(self._excess + step * first)
            self._slope = (first + second) / 2
            self._excess += step * self._slope
        self._time += seconds

    def _rate_of_change(self, excess: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the heating, less the loss to the air and the flow between cells, none over the edges."""
        change = self._heating - excess / self._screen.loss_time
        conduction = self._screen.diffusivity / _SPACING**2
        along, across = conduction * np.diff(excess, axis=0), conduction * np.diff(excess, axis=1)
        change[:-1] += along
        change[1:] -= along
        change[:, :-1] += across
        change[:, 1:] -= across
        return change

    def _take(self, numbers: list[int], excess: NDArray[np.float32]) -> None:
        """Write the files of frames with their numbers, by the excess (T, U, V) [K] that they see."""
        shape = len(numbers), *self._offsets.shape
        columns = np.ascontiguousarray(excess.reshape(len(numbers), -1).T)
        seen = np.ascontiguousarray((self._samples @ columns).T).reshape(shape)
        times = self._period * np.array(numbers)
        degrees = ndimage.gaussian_filter(seen, _BLUR, axes=(1, 2))
        degrees += self._offsets
        degrees += (_ROOM + _ZERO + self.drift * times).astype(np.float32)[:, None, None]
        degrees += self._noise * self._generator.standard_normal(shape, np.float32)
        counts = np.rint(degrees / _COUNT).clip(0, 2**16 - 1).astype(np.uint16)
        counts[:, self._dead] = 2**15
        for number, time, image in zip(numbers, times, counts, strict=True):
            self._write(f"frame_{number:06d}.npy", time, image)

    def _write(self, name: str, time: float, counts: NDArray[np.uint16]) -> None:
        """Write the file of an image: under another name first, as a camera's program should.

        It is left out if the folder does not take it.
        """
        hidden = self._folder / f".{name}"
        with contextlib.suppress(OSError):
            np.save(hidden, counts)
            os.utime(hidden, (time, time))
            hidden.replace(self._folder / name)


class _View:
    """A pinhole camera in front of a plane: (u, v) [m] from the plane's centre to pixels (column, row)."""

    def __init__(self, plane: Plane, shape: tuple[int, int], tilt: float) -> None:
        self._shape = shape
        needed = max(plane.size[0] / shape[1], plane.size[1] / shape[0])
        self._scale = _DISTANCE * _FRACTION / needed  # pixels for a slope of 1
        # The axes of the camera in (u, v, normal): right, down, and towards it; rolled last.
        c, s = math.cos(_ROLL), math.sin(_ROLL)
        lean = [[math.cos(tilt), 0, -math.sin(tilt)], [0, -1, 0], [math.sin(tilt), 0, math.cos(tilt)]]
        self._axes = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ np.array(lean)

    def pixels(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return pixels (..., 2) of places (..., 2); the image and the plane have one centre."""
        seen = np.concatenate([places, np.zeros_like(places[..., :1])], axis=-1) @ self._axes.T
        middle = (np.array(self._shape[::-1]) - 1) / 2
        return np.asarray(middle + self._scale * seen[..., :2] / (_DISTANCE - seen[..., 2:]))

    def _places(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the places (..., 2) of pixels, where their rays meet the plane."""
        middle = (np.array(self._shape[::-1]) - 1) / 2
        slopes = (pixels - middle) / self._scale
        rays = np.concatenate([slopes, -np.ones_like(slopes[..., :1])], axis=-1) @ self._axes
        pinhole = _DISTANCE * self._axes[2]
        length = -pinhole[2] / rays[..., 2:]
        return np.asarray((pinhole + length * rays)[..., :2])

    def samples(self, counts: tuple[int, ...], spacing: float) -> sparse.csr_matrix:
        """Return the matrix from a grid of `counts` cells to the pixels, each the mean over its area."""
        rows, columns = self._shape
        number = np.arange(rows * columns)
        matrix = sparse.csr_matrix((rows * columns, counts[0] * counts[1]), dtype=np.float32)
        for down in (-0.25, 0.25):
            for right in (-0.25, 0.25):
                pixels = np.stack([number % columns + right, number // columns + down], axis=-1)
                matrix = matrix + _linear(self._places(pixels), counts, spacing) / 4
        return matrix.tocsr().astype(np.float32)


def _linear(places: NDArray[np.float64], counts: tuple[int, ...], spacing: float) -> sparse.csr_matrix:
    """Return the matrix of linear interpolation at places (N, 2) from their centre; constant outside."""
    at = np.clip(places / spacing + (np.array(counts) - 1) / 2, 0, np.array(counts) - 1.001)
    low, share = np.floor(at).astype(int), at - np.floor(at)
    rows, columns, weights = [], [], []
    for i in (0, 1):
        for j in (0, 1):
            rows.append(np.arange(len(places)))
            columns.append((low[:, 0] + i) * counts[1] + low[:, 1] + j)
            weights.append(np.abs(1 - i - share[:, 0]) * np.abs(1 - j - share[:, 1]))
    entries = np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_matrix(entries, shape=(len(places), counts[0] * counts[1]))


def _shape(plane: Plane) -> tuple[int, int]:
    rows = math.ceil(max(plane.size) / (_FRACTION * _PIXEL))
    return rows, math.ceil(4 * rows / 3)


def _corners(plane: Plane) -> NDArray[np.float64]:
    """Return the corners (4, 2) of a plane in its own axes, in the order of `Plane.corners`."""
    half = np.array(plane.size) / 2
    return np.array([(i * half[0], j * half[1]) for i in (-1, 1) for j in (-1, 1)])
