"""The least squares of the frames of one pulse of sound."""

from __future__ import annotations

import math

import numpy as np
from scipy.sparse.linalg import LinearOperator, cg

from autdtorch.hardware.camera.screen import Cosines, Screen, decay_of, rise_of
from autdtorch.utils.array_types import AnyArray, Array
from autdtorch.utils.text import counted
from autdtorch.utils.validation import invalid

_RATES = 48  # of decay, that stand for those of all cosines
_RANK = 1e-3  # smallest singular value of the combinations of frames, by the largest
_CONVERGED, _ITERATIONS = 0.03, 300  # of conjugate gradients: rms residual, relative to the noise in it
_ROUGH = 0.5  # of the coefficients by which the latency is found
_LATENCIES = np.linspace(-0.1, 0.4, 251)  # that are tried [s]
_CERTAIN = 0.02  # largest standard deviation of a latency [s]
_LEAST_NOISE = 1e-6  # [K]


class PulseFit:
    """The frames of one pulse, reduced to a few combinations, and the cosines of |p|^2 that fit them.

    Every pixel has a constant of its own, and every frame an offset common to its pixels: white, and with a
    drift. The combinations span what cosines of any rate of decay do over time, without constants. They are
    orthonormal, so that their noise is white; pixels that miss frames have a weight matrix.

    Attributes:
        noise: standard deviation of a pixel in a frame [K], by the frames alone.
        frames: number of frames.
    """

    def __init__(
        self,
        cosines: Cosines,
        screen: Screen,
        times: Array,
        values: Array,
        duration: float,
        drift: float,
        remaining: float,
    ) -> None:
        """Reduce the values (T, N) [K] of pixels, NaN for none, at times (T,) [s].

        The sound begins at time 0 and lasts for a duration [s]. The drift [K/s] of all pixels, and the heat
        that remains of earlier pulses at time 0 [K], are standard deviations.
        """
        self._cosines, self._screen, self._times, self._duration = cosines, screen, times, duration
        self.frames = len(times)
        decay = decay_of(screen, cosines.wavenumber)
        rates = np.geomspace(decay.min(), decay.max(), _RATES)[:, None]
        courses = [rise_of(screen, rates, times, duration), (times - times.mean())[None]]
        courses += [np.exp(-rates * times)] if remaining else []
        self._basis = _orthonormal(np.concatenate(courses).T)  # (T, R)
        valid = np.isfinite(values)
        self._full = valid.all(axis=0)
        if not self._full.any():
            raise invalid("images", "no pixel in all frames", "some must be finite and below saturation")
        self._reduce(np.where(valid, values, 0.0), valid)
        self._measure_noise(drift)
        self._courses = [np.moveaxis(rise_of(screen, decay[..., None], times, duration) @ self._basis, -1, 0)]
        self._prior = [self._strongest() ** 2 * cosines.spectrum]
        if remaining:
            self._courses.append(np.moveaxis(np.exp(-decay[..., None] * times) @ self._basis, -1, 0))
            self._prior.append(remaining**2 * cosines.spectrum)

    def _reduce(self, values: Array, valid: AnyArray) -> None:
        """Form the combinations (N, R) of frames without constants; weights (G, R, R) where frames miss."""
        count = np.maximum(valid.sum(axis=0), 1)
        self._values = np.where(valid, values - values.sum(axis=0) / count, 0.0)
        self._data = self._values.T @ self._basis
        self._gaps = np.flatnonzero(~self._full)
        self._weights = np.empty((len(self._gaps), *[self._basis.shape[1]] * 2))
        for weight, pixel in zip(self._weights, self._gaps, strict=True):
            seen = self._basis[valid[:, pixel]]
            weight[:] = seen.T @ (seen - (seen.mean(axis=0) if len(seen) else 0.0))

    def _measure_noise(self, drift: float) -> None:
        """Measure the noise of pixels, and of the offsets of frames, by what no combination holds."""
        values, freedom = self._values[:, self._full], self.frames - 1 - self._basis.shape[1]
        left = values - self._basis @ (self._basis.T @ values)
        common = left.mean(axis=1)
        squares = ((left - common[:, None]) ** 2).sum(axis=0)
        median = freedom * (1 - 2 / (9 * freedom)) ** 3  # of chi^2 (Wilson & Hilferty 1931)
        self.noise = max(math.sqrt(np.median(squares) / median), _LEAST_NOISE)
        jitter = max(float(common @ common) / freedom, self.noise**2 / len(squares))
        slope = self._basis.T @ (self._times - self._times.mean())
        self._offsets = jitter * np.eye(len(slope)) + drift**2 * np.outer(slope, slope)

    def _strongest(self) -> float:
        """Return the largest |p|^2 [Pa^2], roughly: twice the largest of pixels that do not conduct."""
        course, seen = self._courses[0][:, 0, 0], self._seen()
        well = seen > 0.1
        return max(2 * float(np.max(self._data[well] @ course / seen[well])) / float(course @ course), 1e-9)

    def solve(self, tolerance: float = _CONVERGED) -> Array:
        """Return the coefficients (Ku, Kv) of the cosines of |p|^2 [Pa^2]."""
        mask = self._cosines.spectrum > 0
        courses, prior = np.stack(self._courses), np.stack(self._prior)
        precision = self.noise**2 / np.where(mask, prior, 1.0)
        scale = mask[..., None, None] * self._scale(courses, precision)

        def fields_of(unknowns: Array) -> Array:
            return np.asarray(np.einsum("klgf,gkl->fkl", scale, unknowns.reshape(prior.shape)))

        def weighted(fields: Array) -> Array:
            return self._weighted(self._cosines.forward((courses * fields[:, None]).sum(axis=0)))

        def adjoint(residual: Array) -> Array:
            return np.asarray((courses * self._cosines.adjoint(self._without_offsets(residual))).sum(axis=1))

        def scaled(gradient: Array) -> Array:
            return np.asarray(np.einsum("klgf,fkl->gkl", scale, gradient).ravel())

        def normal(unknowns: Array) -> Array:
            fields = fields_of(unknowns)
            return scaled(adjoint(weighted(fields)) + precision * fields)

        right = scaled(adjoint(self._data))
        matrix = LinearOperator((len(right), len(right)), normal, dtype=np.float64)
        least = tolerance * self.noise * math.sqrt(len(right))
        solution, _ = cg(matrix, right, rtol=0.0, atol=least, maxiter=_ITERATIONS)
        self._fields = fields_of(solution)
        self._left = self._without_offsets(self._data - weighted(self._fields))
        return np.asarray(self._fields[0])

    def _weighted(self, images: Array) -> Array:
        """Return combinations (N, R), weighted where pixels miss frames."""
        weighted = np.array(images)
        weighted[self._gaps] = np.einsum("nrs,ns->nr", self._weights, weighted[self._gaps])
        return weighted

    def _without_offsets(self, weighted: Array) -> Array:
        """Return weighted combinations (N, R) less the offsets of frames that fit them best."""
        total = int(self._full.sum()) * np.eye(weighted.shape[1]) + self._weights.sum(axis=0)
        precision = total + self.noise**2 * np.linalg.inv(self._offsets)
        offsets = np.linalg.solve(precision, weighted.sum(axis=0))
        return weighted - self._weighted(np.broadcast_to(offsets, weighted.shape))

    def _scale(self, courses: Array, precision: Array) -> Array:
        """Return the inverse Cholesky factors (Ku, Kv, F, F) of the F unknowns of each cosine alone."""
        share = len(self._data) * self._cosines.blur**2 * float(np.mean(self._seen()))
        gram = share[..., None, None] * np.einsum("frkl,grkl->klfg", courses, courses)
        constant = np.eye(courses.shape[1]) / share[0, 0] + self._offsets / self.noise**2
        gram[0, 0] = courses[..., 0, 0] @ np.linalg.solve(constant, courses[..., 0, 0].T)
        diagonal = np.arange(len(precision))
        gram[..., diagonal, diagonal] += np.moveaxis(precision, 0, -1)
        return np.asarray(np.linalg.inv(np.linalg.cholesky(gram)))

    def misfit(self) -> float:
        """Return the root mean square of the combinations' residuals, in standard deviations of the noise."""
        information = self._information(1.0)
        unknowns = float((information / (1 + information)).sum())
        freedom = max(int(self._full.sum()) * self._basis.shape[1] - unknowns, 1.0)
        return math.sqrt(float((self._left[self._full] ** 2).sum()) / freedom) / self.noise

    def residuals(self) -> Array:
        """Return what the solution leaves (T, N) of pixels in all frames [K]."""
        model = (self._data - self._left)[self._full] @ self._basis.T
        return np.asarray(self._values[:, self._full] - model.T)

    def variance(self, counts: tuple[int, ...], length: float) -> tuple[Array, Array]:
        """Return the posterior variance (Nu, Nv) of |p|^2 [Pa^4] in cells of the plane, and their density.

        The density of valid pixels, by its mean, is smoothed over a length [m]. A place has
        the variance of a plane with its density throughout.
        """
        density = np.maximum(self._cosines.density(self._seen(), counts, length), 1e-6)
        steps = np.geomspace(density.min() * 0.99, density.max() * 1.01, 40)
        variances = [float((self._prior[0] / (1 + self._information(step))).sum()) for step in steps]
        course = self._courses[0][:, 0, 0]
        common = 1 / float(course @ np.linalg.solve(self._offsets, course))
        return common + np.exp(np.interp(np.log(density), np.log(steps), np.log(variances))), density

    def _information(self, density: float) -> Array:
        """Return the information (Ku, Kv) of the data on each cosine, relative to its prior."""
        gram = density * len(self._data) * self._cosines.blur**2 / self.noise**2
        weight = (self._courses[0] ** 2).sum(axis=0)
        if len(self._courses) > 1:  # what could also be heat that remains is no information
            both = (self._courses[0] * self._courses[1]).sum(axis=0)
            fades = (self._courses[1] ** 2).sum(axis=0)
            weight -= gram * self._prior[1] * both**2 / (gram * self._prior[1] * fades + 1)
        return np.asarray(gram * weight * self._prior[0])

    def _seen(self) -> Array:
        """Return the weight (N,) of each pixel: 1 with all frames, 0 without."""
        course, seen = self._courses[0][:, 0, 0], np.asarray(self._full, np.float64)
        seen[self._gaps] = self._weights @ course @ course / (course @ course)
        return seen

    def latency(self) -> tuple[float, float] | None:
        """Return the latency [s], and its part of the relative deviation of |p|^2; None if it is not seen.

        The pixels, weighted by their heat, are summed for one curve over time. Its scale and its latency are
        fitted together, with the heat that remains of earlier pulses.
        """
        heat = np.maximum(self._cosines.forward(self.solve(_ROUGH)), 0.0) * self._full
        weights = self._fields * self._cosines.adjoint(heat)
        decay = decay_of(self._screen, self._cosines.wavenumber).ravel()
        rates = np.geomspace(0.999 * decay.min(), 1.001 * decay.max(), 4 * _RATES)
        place = np.searchsorted(rates, decay)
        parts, *remains = (np.bincount(place, each.ravel(), len(rates)) for each in weights)
        curve = self._values @ heat
        faded = np.exp(-rates[:, None] * self._times)
        rest = [np.ones_like(self._times), *(np.asarray(each @ faded, np.float64) for each in remains)]

        def course(latency: float) -> Array:
            return np.asarray(
                parts @ rise_of(self._screen, rates[:, None], self._times - latency, self._duration)
            )

        def misfit(latency: float) -> float:
            columns = np.stack([course(latency), *rest], axis=1)
            left = curve - columns @ np.linalg.lstsq(columns, curve, rcond=None)[0]
            return float(left @ left)

        latencies = _LATENCIES[0.7 * self._times.max() > _LATENCIES]  # for frames in the rise
        misfits = [misfit(latency) for latency in latencies]
        best, step = int(np.argmin(misfits)), float(latencies[1] - latencies[0])
        if best in (0, len(misfits) - 1):
            return None
        below, at, above = misfits[best - 1 : best + 2]
        latency = float(latencies[best]) + 0.5 * step * (below - above) / (below + above - 2 * at)
        rise, change = course(latency), (course(latency + step) - course(latency - step)) / (2 * step)
        noise = self.noise**2 * float(heat @ heat)
        free = noise * _inverse_gram(rise, change, *rest)
        fixed = noise * _inverse_gram(rise, *rest)
        if free[1, 1] > _CERTAIN**2:
            return None
        return latency, math.sqrt(max(free[0, 0] - fixed[0, 0], 0.0))


def _orthonormal(courses: Array) -> Array:
    """Return an orthonormal basis (T, R) of courses over time (T, C), less their means."""
    centred = courses - courses.mean(axis=0)
    basis, sizes, _ = np.linalg.svd(centred / np.linalg.norm(centred, axis=0), full_matrices=False)
    rank = int((sizes > _RANK * sizes[0]).sum())
    if len(courses) < rank + 3:
        raise invalid("times", counted(len(courses), "frame"), f"must be at least {rank + 3} frames")
    return np.asarray(basis[:, :rank])


def _inverse_gram(*columns: Array) -> Array:
    table = np.stack(columns, axis=1)
    return np.asarray(np.linalg.inv(table.T @ table))
