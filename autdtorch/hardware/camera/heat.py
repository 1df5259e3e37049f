"""The pressure in a plane from frames of a screen that it heats.

The squared magnitude |p|^2 is a sum of cosines in a rectangle around the plane, with the wavenumbers up to
2 k that products of two waves have. The screen low-passes each cosine with a rate of its own
(`Screen.decay`), the camera blurs and samples the sum at its pixels, and adds to each pixel a constant and
white noise, and to each frame an offset. All that is linear. The frames are first reduced to a few
combinations of them, which hold all that cosines of any rate can do. Their weighted least squares, with a
prior of the cosines, are solved by conjugate gradients: pixels that are dead or saturated have no weight,
and nothing is filled in.

The prior has the variance of the strongest place at every place, much more than a field has on average. So
the relative bias of |p|^2 is at most about the square of its relative standard deviation.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.ndimage import gaussian_filter
from scipy.sparse import csr_array

from autdtorch.hardware.camera.picture import Picture
from autdtorch.hardware.camera.registration import Registration
from autdtorch.hardware.camera.screen import Screen
from autdtorch.utils.array_types import AnyArray, Array
from autdtorch.utils.text import counted
from autdtorch.utils.validation import invalid, not_negative, positive, positive_integers

_MARGIN = 1.0  # of the rectangle of cosines around the plane, in wavelengths
_SPACING = 1 / 11  # of the grid between cosines and pixels, in wavelengths
_BEYOND = 1.1  # largest wavenumber, in those of |p|^2: the mirror images at the edges have kinks
_FLOOR = 1e-3  # of the prior's spectrum beyond those of |p|^2
_RATES = 48  # among which those of the cosines are interpolated
_RANK = 1e-3  # smallest singular value of the combinations of frames, by the largest
_CONVERGED, _ITERATIONS = 1e-5, 300  # of conjugate gradients: residual norm by that of the right side
_LATENCIES = np.linspace(-0.1, 0.4, 251)  # that are tried [s]
_MISFIT = 1.3  # of the frames, in standard deviations, from which on it is told


class HeatInversion:
    """The linear map from |p|^2 in a plane to frames of a camera, and its inverse."""

    def __init__(
        self,
        registration: Registration,
        shape: tuple[int, int],
        counts: tuple[int, int],
        wavelength: float,
        screen: Screen | None = None,
        blur: float = 0.5,
    ) -> None:
        """Set up the cosines, and the part of each in each pixel.

        Args:
            registration: where the plane is in an image.
            shape: of an image (H, W).
            counts: cells (Nu, Nv) of the pictures.
            wavelength: of the sound in air [m].
            screen: the screen; None for the default one.
            blur: of the camera [pixels], standard deviation, beside that of the pixels' area.

        Raises:
            ValueError: an argument is out of range, or the image shows nothing of the plane.
        """
        self.registration, self.screen = registration, screen or Screen()
        self.shape = positive_integers("shape", shape, 2)
        self.counts = positive_integers("counts", counts, 2)
        self.wavelength = positive("wavelength", wavelength, "m")
        spread = math.hypot(not_negative("blur", blur, "pixels"), 12**-0.5)
        plane = registration.plane
        self._size = np.asarray(plane.size) + 2 * _MARGIN * wavelength
        cells = np.ceil(self._size / (_SPACING * wavelength)).astype(int)
        largest = 4 * math.pi / wavelength
        modes = np.minimum(np.ceil(_BEYOND * largest * self._size / math.pi).astype(int), cells)
        along = [math.pi * np.arange(n) / size for n, size in zip(modes, self._size, strict=True)]
        self._wavenumber = np.hypot(along[0][:, None], along[1])
        self._spectrum = _prior_spectrum(self._wavenumber / largest)
        self._grid = [
            _cosines((np.arange(n) + 0.5) / n, m) * (3 / (2 + np.cos(np.pi * np.arange(m) / n)))
            for n, m in zip(cells, modes, strict=True)
        ]
        self._out = [
            _cosines(((np.arange(n) + 0.5) / n - 0.5) * size / full + 0.5, m)
            for n, m, size, full in zip(self.counts, modes, plane.size, self._size, strict=True)
        ]
        self._pixels, pitch = self._seen()
        self._sampling = self._sampled(self._pixels, spread, cells)
        self._transposed = self._sampling.T.tocsr()
        self._blur = np.exp(-0.5 * (self._wavenumber * spread * pitch) ** 2)

    def frames(self, pressure: torch.Tensor, times: Array, duration: float) -> Array:
        """Return the rise (T, H, W) [K] in frames at times since the sound began; NaN around the plane.

        Args:
            pressure: magnitudes in the cells (Nu, Nv) [Pa]; the screen is silent around the plane.
            times: (T,) [s].
            duration: of the sound [s].
        """
        square = pressure.numpy() ** 2
        area = np.prod(np.asarray(self.registration.plane.size) / self._size) / square.size
        coefficients = area * (self._out[0].T @ square @ self._out[1]) * (self._spectrum > 0)
        rises = self.screen.rise(self.screen.decay(self._wavenumber)[..., None], times, duration)
        frames = np.full((len(times), *self.shape), np.nan)
        for frame, rise in zip(frames, np.moveaxis(rises, -1, 0), strict=True):
            frame.ravel()[self._pixels] = self._forward(coefficients * rise)
        return frames

    def picture(
        self,
        times: Array,
        images: Array,
        duration: float,
        *,
        latency: float | None = None,
        saturation: float = math.inf,
        drift: float = 0.02,
        remaining: float = 0.0,
    ) -> Picture:
        """Return the picture of the sound that begins at time 0.

        Args:
            times: of the frames (T,) [s], some of them before 0; the times after the sound help, too.
            images: (T, H, W) [degC or K]; NaN where a pixel says nothing.
            duration: of the sound [s].
            latency: time after which the frames show the screen [s]; None to find it.
            saturation: temperature from which on a pixel says nothing.
            drift: of all pixels together [K/s], standard deviation.
            remaining: of earlier sounds' heat at time 0 [K], standard deviation.

        Raises:
            ValueError: shapes that do not fit, too few frames, or none before the sound.
        """
        times, values = self._checked(times, images, saturation)
        duration = positive("duration", duration, "s")
        offset = 0.0 if latency is None else latency
        fit = _Fit(self, times - offset, values, duration, drift, remaining)
        doubts, lost = [], 0.0
        if latency is None:
            shift, lost, certain = fit.latency()
            if certain:
                offset = shift
                fit = _Fit(self, times - offset, values, duration, drift, remaining)
            else:
                doubts.append("the latency of the frames is not seen, and taken as 0 s")
        coefficients = fit.solve()
        square = self._out[0] @ coefficients @ self._out[1].T
        misfit = fit.misfit()
        if misfit > _MISFIT:
            doubts.append(f"the frames differ from a heated screen by {misfit:.3g} times their noise")
        density = fit.density()
        if unseen := float(np.mean(density < 0.1 * np.median(density))):
            doubts.append(f"{100 * unseen:.2g} % of the plane is not seen")
        deviation = np.hypot(max(1.0, misfit) * np.sqrt(fit.variance(density)), lost * square)
        pressure, spread = magnitudes(square, deviation)
        return Picture(
            self.registration.plane,
            torch.from_numpy(pressure),
            torch.from_numpy(spread),
            self.screen.heating is None,
            len(times),
            offset,
            tuple(doubts),
        )

    def _checked(self, times: Array, images: Array, saturation: float) -> tuple[Array, Array]:
        """Return the times (T,) and the values (T, N) of the pixels that see the plane, NaN without one."""
        times, images = np.asarray(times, dtype=np.float64), np.asarray(images, dtype=np.float64)
        if images.shape != (len(times), *self.shape):
            raise ValueError(f"images: shape {images.shape}; must be {(len(times), *self.shape)}")
        before = int((times <= 0).sum())
        if before == 0 or before == len(times):
            raise invalid("times", times, "must have frames before and after 0, when the sound begins", "s")
        values = images.reshape(len(times), -1)[:, self._pixels]
        return times, np.where(values < saturation, values, np.nan)

    def _seen(self) -> tuple[AnyArray, float]:
        """Return the indices (N,) of the pixels in the rectangle, and the root of their mean area [m]."""
        rows, columns = np.divmod(np.arange(math.prod(self.shape)), self.shape[1])
        pixels = np.stack([columns, rows], axis=-1).astype(np.float64)
        places = np.abs(self.registration.to_plane(pixels))
        indices = np.flatnonzero((places < self._size / 2).all(axis=1))
        inside = int((places[indices] < np.asarray(self.registration.plane.size) / 2).all(axis=1).sum())
        if inside == 0:
            raise invalid("shape", self.shape, "an image must show the plane; check the registration")
        return indices, math.sqrt(math.prod(self.registration.plane.size) / inside)

    def _sampled(self, indices: AnyArray, spread: float, cells: AnyArray) -> csr_array:
        """Return the weights (N, Gu Gv) of cubic B-splines on the grid in each pixel, blurred.

        The point spread, a Gaussian, is summed at three by three places (Gauss and Hermite).
        """
        rows, columns = np.divmod(indices, self.shape[1])
        weights, places, taps = [], [], (-1, 0, 1, 2)
        for du, wu in ((-(3**0.5), 1 / 6), (0.0, 2 / 3), (3**0.5, 1 / 6)):
            for dv, wv in ((-(3**0.5), 1 / 6), (0.0, 2 / 3), (3**0.5, 1 / 6)):
                pixels = np.stack([columns + spread * du, rows + spread * dv], axis=-1)
                position = (self.registration.to_plane(pixels) / self._size + 0.5) * cells - 0.5
                start = np.floor(position).astype(np.int64)
                splines = _bspline(position - start)  # (N, 2, 4)
                index = start[..., None] + np.array(taps)
                limit = cells[:, None]
                index = np.where(index < 0, -1 - index, index)
                index = np.clip(np.where(index >= limit, 2 * limit - 1 - index, index), 0, limit - 1)
                weights.append(wu * wv * splines[:, 0, :, None] * splines[:, 1, None, :])
                places.append(index[:, 0, :, None] * cells[1] + index[:, 1, None, :])
        row = np.repeat(np.tile(np.arange(len(indices)), 9), 16)
        entries = np.concatenate(weights).ravel(), (row, np.concatenate(places).ravel())
        return csr_array(entries, shape=(len(indices), int(cells.prod())))

    def _forward(self, coefficients: Array) -> Array:
        """Return the values (N,) of the pixels of a sum of cosines."""
        return np.asarray(self._sampling @ (self._grid[0] @ coefficients @ self._grid[1].T).ravel())

    def _adjoint(self, values: Array) -> Array:
        """Return the adjoint of `_forward`."""
        grid = (self._transposed @ values).reshape(len(self._grid[0]), len(self._grid[1]))
        return np.asarray(self._grid[0].T @ grid @ self._grid[1])


class _Fit:
    """The least squares of the frames of one sound."""

    def __init__(
        self,
        heat: HeatInversion,
        times: Array,
        values: Array,
        duration: float,
        drift: float,
        remaining: float,
    ) -> None:
        """Reduce the frames to combinations of them, with weights of the pixels."""
        self.heat, self.times, self.duration = heat, times, duration
        decay = heat.screen.decay(heat._wavenumber)[..., None]
        rates = np.geomspace(decay.min(), decay.max(), _RATES)[:, None]
        curves = [*heat.screen.rise(rates, times, duration) / heat.screen.rate, times - times.mean()]
        if remaining:
            curves += [*np.exp(-rates * times)]
        table = np.stack(curves, axis=1)
        table = table - table.mean(axis=0)
        basis, sizes, _ = np.linalg.svd(table / np.linalg.norm(table, axis=0), full_matrices=False)
        self.basis = basis[:, sizes > _RANK * sizes[0]]  # (T, R)
        rank = self.basis.shape[1]
        if len(times) < rank + 3:
            raise invalid("times", counted(len(times), "frame"), f"must be at least {rank + 3} frames")
        valid = np.isfinite(values)
        self.values = np.where(valid, values - _column_means(values, valid), 0.0)
        count = np.maximum(valid.sum(axis=0), 1)
        mean = (valid.T @ self.basis) / count[:, None]  # (N, R)
        products = (self.basis[:, :, None] * self.basis[:, None, :]).reshape(len(times), -1)
        self.weights = (valid.T @ products).reshape(-1, rank, rank)
        self.weights -= count[:, None, None] * mean[:, :, None] * mean[:, None, :]
        self.data = self.values.T @ self.basis - self.values.sum(axis=0)[:, None] * mean
        self.full = valid.all(axis=0)
        if not self.full.any():
            raise invalid("images", "no pixel in all frames", "some must be finite and below saturation")
        self.rises = np.moveaxis(heat.screen.rise(decay, times, duration) @ self.basis, -1, 0)  # (R, Ku, Kv)
        self.fades = np.moveaxis(np.exp(-decay * times) @ self.basis, -1, 0) if remaining else None
        left = self.values[:, self.full] - self.basis @ (self.basis.T @ self.values[:, self.full])
        freedom = len(times) - 1 - rank
        self.noise = math.sqrt(np.median((left**2).sum(axis=0)) / freedom / (1 - 2 / (9 * freedom)) ** 3)
        self.noise = max(self.noise, 1e-9)
        # The offset of a frame: white beyond the pixels' noise, and a drift.
        common = left.mean(axis=1)
        jitter = max(float(common @ common) / freedom, self.noise**2 / self.full.sum())
        slope = self.basis.T @ (times - times.mean())
        self.offsets = jitter * np.eye(rank) + drift**2 * np.outer(slope, slope)
        spectrum = heat._spectrum / heat._spectrum.sum()
        self.prior = self._strongest() ** 2 * spectrum
        self.prior_fades = remaining**2 * spectrum

    def _strongest(self) -> float:
        """Return the largest |p|^2, roughly [Pa^2]: twice the largest in pixels that do not conduct."""
        curve = self.rises[:, 0, 0]
        weight = self.weights @ curve @ curve
        seen = weight > 0.1 * weight.max()
        return 2 * float(np.max(self.data[seen] @ curve / weight[seen]))

    def solve(self, tolerance: float = _CONVERGED) -> Array:
        """Return the coefficients (Ku, Kv) of the cosines of |p|^2 [Pa^2]."""
        heat, variance = self.heat, self.noise**2
        mask = heat._spectrum > 0
        precision = np.where(mask, variance / np.where(mask, self.prior, 1.0), 0.0)
        offset_precision = variance * np.linalg.inv(self.offsets)
        share = len(heat._pixels) * heat._blur**2 * float(np.mean(self._seen_share()))
        scale = np.sqrt(np.where(mask, 1 / (share * (self.rises**2).sum(axis=0) + precision), 0.0))
        blocks = [(self.rises, precision, scale)]
        if self.fades is not None:
            precise = np.where(mask, variance / np.where(mask, self.prior_fades, 1.0), 0.0)
            scale = np.sqrt(np.where(mask, 1 / (share * (self.fades**2).sum(axis=0) + precise), 0.0))
            blocks.append((self.fades, precise, scale))
        offset_scale = 1 / np.sqrt(len(heat._pixels) + np.diag(offset_precision))
        size = mask.size

        def parts(unknowns: Array) -> tuple[list[Array], Array]:
            fields = [
                unknowns[n * size : (n + 1) * size].reshape(mask.shape) * block[2]
                for n, block in enumerate(blocks)
            ]
            return fields, unknowns[len(blocks) * size :] * offset_scale

        def forward(fields: list[Array], offset: Array) -> Array:
            images = [
                heat._forward(sum(block[0][r] * field for block, field in zip(blocks, fields, strict=True)))
                for r in range(len(offset))
            ]
            return np.stack(images, axis=1) + offset

        def adjoint(residual: Array) -> list[Array]:
            images = np.stack([heat._adjoint(column) for column in np.ascontiguousarray(residual.T)])
            return [block[2] * (block[0] * images).sum(axis=0) for block in blocks]

        def joined(fields: list[Array], offset: Array) -> Array:
            return np.concatenate([*(field.ravel() for field in fields), offset])

        def normal(unknowns: Array) -> Array:
            fields, offset = parts(unknowns)
            weighted = np.einsum("nrs,ns->nr", self.weights, forward(fields, offset))
            extra = [block[2] * block[1] * field for block, field in zip(blocks, fields, strict=True)]
            back = [one + two for one, two in zip(adjoint(weighted), extra, strict=True)]
            return joined(back, offset_scale * (weighted.sum(axis=0) + offset_precision @ offset))

        right = joined(adjoint(self.data), offset_scale * self.data.sum(axis=0))
        solution, self.iterations = _conjugate_gradients(normal, right, tolerance)
        fields, offset = parts(solution)
        self.left = self.data - np.einsum("nrs,ns->nr", self.weights, forward(fields, offset))
        self.coefficients = fields[0]
        return fields[0]

    def misfit(self) -> float:
        """Return the root mean square of the residual of the combinations, by that of the noise."""
        unknowns = float((1 / (1 + self.noise**2 / np.maximum(self._information(), 1e-300))).sum())
        freedom = max(self.full.sum() * self.basis.shape[1] - unknowns, 1.0)
        return math.sqrt(float((self.left[self.full] ** 2).sum()) / freedom) / self.noise

    def _information(self, density: float = 1.0) -> Array:
        """Return the weight (Ku, Kv) of the data on each cosine, by that of its prior, times the noise^2."""
        gram = density * len(self.heat._pixels) * self.heat._blur**2
        rises = (self.rises**2).sum(axis=0)
        if self.fades is not None:  # what fades could explain says nothing of rises
            both, fades = (self.rises * self.fades).sum(axis=0), (self.fades**2).sum(axis=0)
            rises = rises - gram * both**2 / (
                gram * fades + self.noise**2 / np.maximum(self.prior_fades, 1e-300)
            )
        return np.asarray(gram * rises * self.prior)

    def _seen_share(self) -> Array:
        """Return the weight (N,) of each pixel, 1 in all frames and 0 in none."""
        curve = self.rises[:, 0, 0]
        return np.asarray(self.weights @ curve @ curve / (curve @ curve))

    def density(self) -> Array:
        """Return the density (Nu, Nv) of pixels around each cell, by their mean density."""
        heat = self.heat
        cells = len(heat._grid[0]), len(heat._grid[1])
        grid = (heat._transposed @ self._seen_share()).reshape(cells) * (math.prod(cells) / len(heat._pixels))
        smooth = gaussian_filter(grid, 0.2 / _SPACING)
        indices = [
            np.clip(((np.arange(n) + 0.5) / n - 0.5) * size / full * m + m / 2, 0, m - 1).astype(int)
            for n, m, size, full in zip(
                heat.counts, cells, heat.registration.plane.size, heat._size, strict=True
            )
        ]
        return np.asarray(smooth[np.ix_(*indices)])

    def variance(self, density: Array) -> Array:
        """Return the posterior variance (Nu, Nv) of |p|^2 [Pa^4] by the density of pixels."""
        densities = np.geomspace(1e-4, max(density.max(), 1e-3) * 1.01, 40)
        variances = [
            float((self.prior / (1 + self._information(one) / self.noise**2)).sum()) for one in densities
        ]
        curve = self.rises[:, 0, 0]
        common = float(curve @ self.offsets @ curve) / float(curve @ curve) ** 2
        return common + np.exp(
            np.interp(np.log(np.maximum(density, 1e-4)), np.log(densities), np.log(variances))
        )

    def latency(self) -> tuple[float, float, bool]:
        """Return the latency [s], its part in the relative deviation of |p|^2, and if it is seen."""
        heat = self.heat
        coefficients = self.solve(1e-2)
        hot = heat._forward(coefficients * heat._blur) * self.full
        hot = np.maximum(hot, 0.0)
        weights = coefficients * heat._adjoint(hot)
        heated = self.values @ hot
        decay = heat.screen.decay(heat._wavenumber)[weights != 0][:, None]
        parts = weights[weights != 0]
        rates = np.geomspace(decay.min() * 0.999, decay.max() * 1.001, 4 * _RATES)
        bins = np.bincount(np.searchsorted(rates, decay[:, 0]), weights=parts, minlength=len(rates))

        def curve(latency: float) -> Array:
            return np.asarray(bins @ heat.screen.rise(rates[:, None], self.times - latency, self.duration))

        ones = np.ones_like(self.times)

        def misfit(latency: float) -> float:
            columns = np.stack([curve(latency), ones], axis=1)
            left = heated - columns @ np.linalg.lstsq(columns, heated, rcond=None)[0]
            return float(left @ left)

        misfits = np.array([misfit(latency) for latency in _LATENCIES])
        best = int(misfits.argmin())
        if best in (0, len(misfits) - 1):
            return 0.0, 0.0, False
        below, at, above = misfits[best - 1 : best + 2]
        step = float(_LATENCIES[1] - _LATENCIES[0])
        latency = float(_LATENCIES[best]) + 0.5 * step * (below - above) / max(below + above - 2 * at, 1e-300)
        change = (curve(latency + step) - curve(latency - step)) / (2 * step)
        rise = curve(latency)
        noise = self.noise**2 * float(hot @ hot)
        free = np.linalg.inv(_gram(np.stack([rise, change, ones], axis=1)))
        fixed = np.linalg.inv(_gram(np.stack([rise, ones], axis=1)))
        certain = bool(noise * free[1, 1] < 0.02**2)
        return latency, math.sqrt(max(noise * (free[0, 0] - fixed[0, 0]), 0.0)), certain


def magnitudes(square: Array, deviation: Array) -> tuple[Array, Array]:
    """Return magnitudes and deviations from squares that noise may make negative.

    The maximum of the posterior of |p|, and its curvature, where a priori all complex pressures are as
    likely (Sivia & David, Acta Cryst. A50, 703, 1994). Far above the noise it is the root of the square.
    """
    peak = 0.5 * (square + np.sqrt(square**2 + 2 * deviation**2))
    peak = np.maximum(peak, 1e-300)
    curvature = 1 / peak + 2 * (3 * peak - square) / np.maximum(deviation, 1e-300) ** 2
    return np.sqrt(peak), curvature**-0.5


def _prior_spectrum(ratio: Array) -> Array:
    """Return the spectrum of |p|^2 of random waves by wavenumbers, in 2 k: two discs that overlap."""
    x = np.minimum(ratio, 1.0)
    disc = (2 / math.pi) * (np.arccos(x) - x * np.sqrt(1 - x**2))
    return np.where(ratio <= _BEYOND, np.maximum(disc, _FLOOR), 0.0)


def _cosines(places: Array, count: int) -> Array:
    """Return cosines (P, K) at places in parts of the length, of mean square 1."""
    table = np.sqrt(2) * np.cos(math.pi * places[:, None] * np.arange(count))
    table[:, 0] = 1.0
    return np.asarray(table)


def _bspline(x: Array) -> Array:
    """Return the four cubic B-splines (..., 4) at a distance x in [0, 1) past the second one."""
    y = 1 - x
    return np.stack([y**3 / 6, 2 / 3 - x**2 + x**3 / 2, 2 / 3 - y**2 + y**3 / 2, x**3 / 6], axis=-1)


def _column_means(values: Array, valid: AnyArray) -> Array:
    return np.asarray(np.where(valid, values, 0.0).sum(axis=0) / np.maximum(valid.sum(axis=0), 1))


def _gram(columns: Array) -> Array:
    return np.asarray(columns.T @ columns)


def _conjugate_gradients(normal, right: Array, tolerance: float) -> tuple[Array, int]:  # type: ignore[no-untyped-def]
    """Return the solution of normal(x) = right, and the number of iterations."""
    x, residual = np.zeros_like(right), right.copy()
    direction, square = residual.copy(), float(residual @ residual)
    goal = tolerance**2 * square
    for iteration in range(_ITERATIONS):
        if square <= goal:
            return x, iteration
        image = normal(direction)
        step = square / float(direction @ image)
        x += step * direction
        residual -= step * image
        square, before = float(residual @ residual), square
        direction = residual + (square / before) * direction
    return x, _ITERATIONS
