"""The thin screen in the plane of the foci, which the sound heats, and sums of cosines on it.

Such sums, in a rectangle around the plane, are seen by the pixels of a camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import dctn, idctn, next_fast_len
from scipy.sparse import csr_array

from autdtorch.hardware.camera.registration import Registration
from autdtorch.utils.array_types import AnyArray, Array
from autdtorch.utils.validation import invalid, number_between, positive

#: Heating of the mesh that `Screen` describes [K/(s Pa^2)], for pictures whose scale is not calibrated.
NOMINAL_HEATING = 1e-6
_IMPEDANCE = 413.0  # of air [Pa s/m]
_CAPACITY = 1.7e6  # of polyester [J/(m^3 K)]
_CONDUCTION = 2.4e-5  # of the screen and the air beside it, along the screen [W/K]; see `Screen`
_TRANSFER = 24.0  # to the air, of both sides [W/(m^2 K)]: radiation 6 and free convection 6 a side

_MARGIN = 0.4  # of the rectangle around the plane, in wavelengths: kinks at its edges go no further
_SPACING = 1 / 11  # of the grid between cosines and pixels, in wavelengths
_BEYOND = 1.1  # largest wavenumber relative to 2 k: the mirror images at the edges have kinks
_FLOOR = 1e-3  # of the spectrum beyond the wavenumbers of |p|^2, by its maximum


@dataclass(frozen=True)
class Screen:
    """A mesh or film whose temperature T follows dT/dt = D lap T - (T - T0) / tau + a |p|^2.

    Thermal images of a mesh show airborne ultrasound from about 1 kPa (Onishi et al., Phys. Rev. Applied 18,
    2022), and peaks to 2.5 % up to 4.25 kPa (Morgan, Cho & Subramanian, Commun. Eng. 4, 101, 2025). No
    constant of the default is taken from them: they are derived for a polyester mesh of 77 threads of 48 um
    per cm, as follows. `HeatInversion.fitted_screen` fits the first two to frames. A loss time that is wrong
    by a third changes |p| by 4 %, nearly the same in all pictures, a diffusivity by 0.5 %.

    - Heat capacity: 28 um of polyester on average, 47 J/(m^2 K).
    - Loss time: free convection and radiation on both sides, 24 W/(m^2 K), make 2 s.
    - Diffusivity: air conducts k |kappa| from a pattern of wavenumber kappa to each side, which at the
      finest of |p|^2 at 40 kHz (4.3 mm) is as much as D = 7e-7 m^2/s; less at longer ones, so 5e-7.
    - Heating: holes of 80 um in such a mesh resist the flow with 28 Pa s/m (Maa's micro-perforated plate
      at 40 kHz), which absorbs 6 % of the intensity |p|^2 / (2 rho c). That is 1.6e-6 K/(s Pa^2); the threads
      are taken to get two thirds.

    Attributes:
        diffusivity: D along the screen [m^2/s], > 0.
        loss_time: tau, time constant of the loss to the air [s], > 0.
        heating: a, by the square of the peak amplitude [K/(s Pa^2)], > 0; None if it is not calibrated, for
            pictures with an unknown scale, common to all pictures of the screen.

    Raises:
        ValueError: an attribute is not a finite number > 0.
    """

    diffusivity: float = 5e-7
    loss_time: float = 2.0
    heating: float | None = None

    def __post_init__(self) -> None:
        for name, unit in (("diffusivity", "m^2/s"), ("loss_time", "s"), ("heating", "K/(s Pa^2)")):
            if (value := getattr(self, name)) is not None or name != "heating":
                object.__setattr__(self, name, positive(f"Screen.{name}", value, unit))

    @classmethod
    def of_thickness(cls, thickness: float, absorbed: float = 0.04) -> Screen:
        """Return a polymer screen in air.

        Args:
            thickness: volume per area [m], > 0; a mesh has less than its threads' diameter.
            absorbed: share of the intensity that heats the screen, > 0 and up to 1.

        Raises:
            ValueError: an argument is out of range.
        """
        capacity = _CAPACITY * positive("thickness", thickness, "m")
        share = number_between("absorbed", positive("absorbed", absorbed), 0.0, 1.0)
        return cls(_CONDUCTION / capacity, capacity / _TRANSFER, share / (2 * _IMPEDANCE * capacity))

    def calibrated(self, pictured: float, measured: float) -> Screen:
        """Return the screen with the heating at which a pressure in a picture becomes a measured one.

        Args:
            pictured: magnitude at a place of a picture taken with this screen [Pa], > 0.
            measured: magnitude there, by a microphone for example [Pa], > 0.

        Raises:
            ValueError: an argument is not a finite number > 0.
        """
        ratio = positive("pictured", pictured, "Pa") / positive("measured", measured, "Pa")
        return replace(self, heating=self.rate * ratio**2)

    @property
    def rate(self) -> float:
        """The heating [K/(s Pa^2)]; a nominal value if it is not calibrated."""
        return NOMINAL_HEATING if self.heating is None else self.heating


def decay_of(screen: Screen, wavenumber: Array) -> Array:
    """Return the rate [1/s] at which patterns of wavenumbers [rad/m] decay."""
    return screen.diffusivity * wavenumber**2 + 1 / screen.loss_time


def rise_of(screen: Screen, decay: Array, times: Array, duration: float) -> Array:
    """Return the temperature (..., T) by |p|^2 [K/Pa^2] of patterns that decay at rates (..., 1) [1/s].

    The sound begins at time 0 [s] and lasts for a duration [s].
    """
    end = np.clip(times, 0.0, duration)
    return screen.rate * -np.expm1(-decay * end) / decay * np.exp(-decay * np.maximum(times - end, 0.0))


class Cosines:
    """The linear map from coefficients (Ku, Kv) of cosines, of mean square 1, to pixels (N,).

    The cosines have the wavenumbers of |p|^2, up to 2 k. They are summed on a grid by Fourier transforms, as
    coefficients of cubic B-splines, whose values in each pixel are a sparse matrix. That holds for any view
    of the camera, and includes its blur and the area of its pixels.

    Attributes:
        wavenumber: (Ku, Kv) [rad/m].
        spectrum: (Ku, Kv), of |p|^2 in a field of random waves; its sum is 1.
        blur: (Ku, Kv), mean damping by blur and area of the pixels.
        pixels: indices (N,) of the pixels, of a flat image, that see the rectangle.
    """

    def __init__(
        self, registration: Registration, shape: tuple[int, ...], wavelength: float, spread: float
    ) -> None:
        """Set the map up for images of a shape (H, W), blurred by a Gaussian with a spread [pixels]."""
        self._registration, self._plane = registration, np.asarray(registration.plane.size)
        self.shape, self._size = shape, self._plane + 2 * _MARGIN * wavelength
        self._cells = np.array(
            [next_fast_len(math.ceil(size / (_SPACING * wavelength)), True) for size in self._size]
        )
        largest = 4 * math.pi / wavelength
        modes = np.minimum(np.ceil(_BEYOND * largest * self._size / math.pi).astype(int), self._cells)
        along = [math.pi * np.arange(count) / size for count, size in zip(modes, self._size, strict=True)]
        self.wavenumber = np.hypot(along[0][:, None], along[1])
        spectrum = _overlap_of_discs(self.wavenumber / largest)
        self.spectrum = spectrum / spectrum.sum()
        damping = [
            (2 + np.cos(np.pi * np.arange(count) / cells)) / 3
            for count, cells in zip(modes, self._cells, strict=True)
        ]
        self._gain = math.sqrt(self._cells.prod()) / (damping[0][:, None] * damping[1])
        self.pixels, pitch = self._seen()
        self.blur = np.exp(-0.5 * (self.wavenumber * spread * pitch) ** 2)
        self._sampling = self._splines(spread)
        self._transposed = self._sampling.T.tocsr()

    def forward(self, coefficients: Array) -> Array:
        """Return the values (N, ...) of pixels for coefficients (..., Ku, Kv)."""
        grid = np.zeros((*coefficients.shape[:-2], *self._cells))
        grid[..., : self._gain.shape[0], : self._gain.shape[1]] = self._gain * coefficients
        splines = idctn(grid, axes=(-2, -1), norm="ortho", overwrite_x=True)
        return np.asarray(self._sampling @ splines.reshape(*grid.shape[:-2], -1).T)

    def adjoint(self, values: Array) -> Array:
        """Return the adjoint (..., Ku, Kv) of `forward` for values (N, ...)."""
        grid = np.ascontiguousarray((self._transposed @ values).T)
        cosines = dctn(grid.reshape(*grid.shape[:-1], *self._cells), axes=(-2, -1), norm="ortho")
        return np.asarray(self._gain * cosines[..., : self._gain.shape[0], : self._gain.shape[1]])

    def on_plane(self, coefficients: Array, counts: tuple[int, ...]) -> Array:
        """Return the sum of cosines in the cells (Nu, Nv) of the plane."""
        u, v = (
            _cosines(places, count)
            for places, count in zip(self._places(counts), coefficients.shape, strict=True)
        )
        return np.asarray(u @ coefficients @ v.T)

    def density(self, weights: Array, counts: tuple[int, ...], length: float) -> Array:
        """Return the weight (N,) of pixels around the cells (Nu, Nv) of the plane, by its mean.

        It is smoothed over a length [m], a standard deviation, by a sum of cosines.
        """
        smooth = self.adjoint(weights) / len(weights) * np.exp(-0.5 * (self.wavenumber * length) ** 2)
        return self.on_plane(smooth, counts)

    def _places(self, counts: tuple[int, ...]) -> list[Array]:
        """Return the places of cells of the plane, in parts of the rectangle, along each axis."""
        shares = self._plane / self._size
        return [
            ((np.arange(count) + 0.5) / count - 0.5) * share + 0.5
            for count, share in zip(counts, shares, strict=True)
        ]

    def _seen(self) -> tuple[AnyArray, float]:
        """Return the indices (N,) of the pixels, and the root of their mean area on the plane [m]."""
        rows, columns = np.divmod(np.arange(math.prod(self.shape)), self.shape[1])
        places = np.abs(self._registration.to_plane(np.stack([columns, rows], axis=-1).astype(np.float64)))
        inside = int((places < self._plane / 2).all(axis=1).sum())
        if inside == 0:
            raise invalid("shape", self.shape, "an image must show the plane; check the registration")
        return np.flatnonzero((places < self._size / 2).all(axis=1)), math.sqrt(self._plane.prod() / inside)

    def _splines(self, spread: float) -> csr_array:
        """Return the weights (N, Gu Gv) of the B-splines on the grid in each pixel.

        The Gaussian is summed at three by three places (Gauss-Hermite quadrature).
        """
        rows, columns = np.divmod(self.pixels, self.shape[1])
        nodes = [(-(3**0.5), 1 / 6), (0.0, 2 / 3), (3**0.5, 1 / 6)]
        row = np.repeat(np.arange(len(self.pixels)), 16)
        sampling = csr_array((len(self.pixels), int(self._cells.prod())))
        for (across, weight), (down, other) in ((first, second) for first in nodes for second in nodes):
            pixels = np.stack([columns + spread * across, rows + spread * down], axis=-1)
            position = (self._registration.to_plane(pixels) / self._size + 0.5) * self._cells - 0.5
            start = np.floor(position).astype(np.int64)
            index = start[..., None] + np.arange(-1, 3)
            index = np.where(index < 0, -1 - index, index)  # mirrored at the edges, as the cosines are
            last = self._cells[:, None] - 1
            index = np.clip(np.where(index > last, 2 * last + 1 - index, index), 0, last)
            splines = _bspline(position - start)
            entries = weight * other * splines[:, 0, :, None] * splines[:, 1, None, :]
            places = index[:, 0, :, None] * self._cells[1] + index[:, 1, None, :]
            # All entries at once would be several gigabytes for a camera of 640 x 480.
            sampling = sampling + csr_array((entries.ravel(), (row, places.ravel())), shape=sampling.shape)
        return sampling


def _overlap_of_discs(ratio: Array) -> Array:
    """Return the spectrum of the product of two fields of random waves, by wavenumbers in 2 k."""
    x = np.minimum(ratio, 1.0)
    overlap = (2 / math.pi) * (np.arccos(x) - x * np.sqrt(1 - x**2))
    return np.where(ratio <= _BEYOND, np.maximum(overlap, _FLOOR), 0.0)


def _cosines(places: Array, count: int) -> Array:
    """Return cosines (P, K) of mean square 1 at places in parts of the length."""
    table = math.sqrt(2) * np.cos(math.pi * places[:, None] * np.arange(count))
    table[:, 0] = 1.0
    return np.asarray(table)


def _bspline(x: Array) -> Array:
    """Return the four cubic B-splines (..., 4) at a distance x in [0, 1) past the second one."""
    y = 1 - x
    return np.stack([y**3 / 6, 2 / 3 - x**2 + x**3 / 2, 2 / 3 - y**2 + y**3 / 2, x**3 / 6], axis=-1)
