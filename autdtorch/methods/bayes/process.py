"""Gaussian process of one trial: zero mean, isotropic Matern 5/2 kernel, and noise.

The inverse W of the Cholesky factor of the correlations K + noise of the N points is updated by one row per
point, so that a step between fits costs O(N^2). y are the standardised scores, and k(x) the correlations of
the points with a point x. Then

    mean(x) = k(x)^T W^T W y,    variance(x) = s^2 (1 - |W k(x)|^2),    s^2 = |W y|^2 / N,

where s^2 is the most likely variance of the process. The compiled functions work on the arrays of one trial,
which therefore does not depend on other trials or on the number of threads.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from autdtorch.fdtd.kernels.compiled import entry

Vector = NDArray[np.float64]

#: Compiles a function of this folder.
compiled = entry(Path(__file__).parent)

LEAST_NOISE = 1e-6
"""Smallest noise: with less, rounding (1e-16 N / noise) shows in the posterior."""

_FIRST_NOISE = 1e-2
_LENGTH_SCALES = 1e-2, 1e3
_LEAST_VARIANCE = 1e-12
"""Smallest variance of the process, in variances of the scores, for scores that never change."""
_STARTS = np.array([1.0, 4.0, 16.0, 64.0])
"""Starts of the fit, in first length scales: with many phases there is a second, smooth optimum."""
_FIRST_STEP, _LAST_STEP = 0.7, 0.02
"""First and last step of the fit, in the logarithm of the hyperparameters."""


class Posterior(NamedTuple):
    """The posterior, as the compiled functions take it; arrays reach beyond the N points to its capacity.

    Attributes:
        circle: whether a phase is a point on the circle rather than a number.
        size: number of points N.
        features: of the points (F, capacity).
        factor: W (capacity, capacity), lower triangular.
        weights: W^T W y (capacity,).
        length_scale: of the kernel.
        scale: standard deviation s of the process.
        best: largest of the standardised scores.
    """

    circle: bool
    size: int
    features: Vector
    factor: Vector
    weights: Vector
    length_scale: float
    scale: float
    best: float


class Process:
    """A process that grows point by point; phases are given in turns, 0 to 1."""

    def __init__(self, dimensions: int, capacity: int, circle: bool, noise: float | None) -> None:
        """A process that knows nothing.

        Args:
            dimensions: number of phases D.
            capacity: largest number of points.
            circle: takes each phase as the point (cos, sin) of the circle: periodic. Otherwise as a number.
            noise: variance of the observations in variances of the process; None to fit it.
        """
        self.circle = circle
        self.noise_is_fitted = noise is None
        self.noise = _FIRST_NOISE if noise is None else noise
        self.length_scale = self._first_length_scale = math.sqrt(dimensions) / 5
        self.count = 0
        self._features = np.zeros((2 * dimensions if circle else dimensions, capacity))
        self._scores = np.zeros(capacity)
        self._factor = np.zeros((capacity, capacity))

    def add(self, points: Vector, scores: Vector) -> None:
        """Add points (B, D) with their scores (B,)."""
        for point, score in zip(points, scores, strict=True):
            self._scores[self.count] = score
            _append(
                self._features, self._factor, self.count, features_of(point, self.circle), self.length_scale,
                self.noise,
            )  # fmt: skip
            self.count += 1

    def forget(self) -> None:
        """Return to no points and to the first hyperparameters."""
        self.count = 0
        self.length_scale = self._first_length_scale
        if self.noise_is_fitted:
            self.noise = _FIRST_NOISE

    def fit(self) -> None:
        """Maximise the marginal likelihood over the length scale, and the noise where it is fitted."""
        first = np.array([self._first_length_scale, _FIRST_NOISE if self.noise_is_fitted else self.noise])
        warm = np.array([self.length_scale, self.noise])
        self.length_scale, self.noise = _fit(
            self._features, self.count, self._standard(), first, warm, self.noise_is_fitted
        )
        _invert(self._features, self.count, self.length_scale, self.noise, self._factor)

    def log_likelihood(self) -> float:
        """Logarithm of the marginal likelihood of the standardised scores, at the most likely variance."""
        squares = _squared_distances(self._features, self.count)
        return float(_log_likelihood(squares, self._standard(), self.length_scale, self.noise))

    def posterior(self) -> Posterior:
        """Return the posterior for `posterior` and the acquisition functions."""
        standard = self._standard()
        weights, explained = _weights(self._factor, standard)
        scale = math.sqrt(max(explained / self.count, _LEAST_VARIANCE))
        return Posterior(
            self.circle, self.count, self._features, self._factor, weights, self.length_scale, scale,
            standard.max(),
        )  # fmt: skip

    def _standard(self) -> Vector:
        """Scores (N,) of mean 0 and variance 1."""
        scores = self._scores[: self.count]
        # A score that never changes has no deviation to divide by.
        deviation = max(float(scores.std(ddof=1)), np.finfo(np.float64).tiny) if self.count > 1 else 1.0
        return np.asarray((scores - scores.mean()) / deviation)


@compiled
def features_of(point, circle):  # type: ignore[no-untyped-def]
    """Return the features of a point: its phases (D,) in turns, or their (cos, sin) (2 D,)."""
    if not circle:
        return point.copy()
    dimensions = len(point)
    features = np.empty(2 * dimensions)
    for d in range(dimensions):
        features[d] = math.cos(2 * math.pi * point[d])
        features[dimensions + d] = math.sin(2 * math.pi * point[d])
    return features


@compiled
def matern(square):  # type: ignore[no-untyped-def]
    """Kernel of the squared distance in length scales, and its derivative by that."""
    a = math.sqrt(5 * square)
    decay = math.exp(-a)
    return (1 + a + a * a / 3) * decay, -5 / 6 * (1 + a) * decay


@compiled
def add_rows(out, begin, end, factors, rows, first, last):  # type: ignore[no-untyped-def]
    """Add factors[k] rows[k] for k from first to last, in columns begin to end."""
    k = first
    while k + 4 <= last:  # four at once: fewer loads and stores of `out`
        a, b, c, d = factors[k], factors[k + 1], factors[k + 2], factors[k + 3]
        for j in range(begin, end):
            out[j] += a * rows[k, j] + b * rows[k + 1, j] + c * rows[k + 2, j] + d * rows[k + 3, j]
        k += 4
    while k < last:
        a = factors[k]
        for j in range(begin, end):
            out[j] += a * rows[k, j]
        k += 1


@compiled
def covariances(features, count, at, length_scale, kernel, slope):  # type: ignore[no-untyped-def]
    """Kernel (N,) between the points and features `at` (F,), and its derivative by the squared distance."""
    kernel[:count] = 0.0
    for f in range(len(at)):
        for n in range(count):
            kernel[n] += (at[f] - features[f, n]) ** 2
    scale = 1 / length_scale**2
    for n in range(count):
        kernel[n], slope[n] = matern(kernel[n] * scale)
        slope[n] *= scale


@compiled
def whiten(factor, count, kernel, out):  # type: ignore[no-untyped-def]
    """W k(x) (N,)."""
    for i in range(count):
        total = 0.0
        for j in range(i + 1):
            total += factor[i, j] * kernel[j]
        out[i] = total


@compiled
def _append(features, factor, count, at, length_scale, noise):  # type: ignore[no-untyped-def]
    """Add a point to the features and its row to W."""
    kernel, slope, white = np.empty(count), np.empty(count), np.empty(count)
    covariances(features, count, at, length_scale, kernel, slope)
    whiten(factor, count, kernel, white)
    left = 1 + noise
    for i in range(count):
        left -= white[i] * white[i]
    # Rounding may leave less than the noise of a point that is there already.
    root = math.sqrt(max(left, noise))
    row = factor[count]
    row[:count] = 0.0
    add_rows(row, 0, count, white, factor, 0, count)
    for j in range(count):
        row[j] /= -root
    row[count] = 1 / root
    features[:, count] = at


@compiled
def _weights(factor, standard):  # type: ignore[no-untyped-def]
    """W^T W y (capacity,) and |W y|^2, without BLAS: that rounds by where vectors lie in memory."""
    count = len(standard)
    white, weights, explained = np.empty(count), np.zeros(len(factor)), 0.0
    whiten(factor, count, standard, white)
    for i in range(count):
        explained += white[i] * white[i]
        for j in range(i + 1):
            weights[j] += white[i] * factor[i, j]
    return weights, explained


@compiled
def _squared_distances(features, count):  # type: ignore[no-untyped-def]
    """Between the points (N, N); above the diagonal only."""
    squares = np.zeros((count, count))
    for i in range(count):
        row = squares[i]
        for f in range(len(features)):
            for j in range(i + 1, count):
                row[j] += (features[f, i] - features[f, j]) ** 2
    return squares


@compiled
def _cholesky(squares, length_scale, noise):  # type: ignore[no-untyped-def]
    """R (N, N), upper triangular, with R^T R = K + noise."""
    count = len(squares)
    scale = 1 / length_scale**2
    root = np.zeros((count, count))
    column = np.empty(count)
    for i in range(count):
        row = root[i]
        row[i] = 1 + noise
        for j in range(i + 1, count):
            row[j], _ = matern(squares[i, j] * scale)
        for k in range(i):
            column[k] = -root[k, i]
        add_rows(row, i, count, column, root, 0, i)
        pivot = 1 / math.sqrt(max(row[i], LEAST_NOISE / 2))
        for j in range(i, count):
            row[j] *= pivot
    return root


@compiled
def _log_likelihood(squares, standard, length_scale, noise):  # type: ignore[no-untyped-def]
    root = _cholesky(squares, length_scale, noise)
    count = len(standard)
    left = standard.copy()
    total, explained = 0.0, 0.0
    for i in range(count):
        white = left[i] / root[i, i]
        for j in range(i + 1, count):
            left[j] -= white * root[i, j]
        explained += white * white
        total -= math.log(root[i, i])
    variance = max(explained / count, _LEAST_VARIANCE)
    return total - 0.5 * count * math.log(2 * math.pi * variance) - 0.5 * explained / variance


@compiled
def _fit(features, count, standard, first, warm, noise_is_fitted):  # type: ignore[no-untyped-def]
    """Compass search in the logarithms, from the best of the last hyperparameters and the first ones."""
    squares = _squared_distances(features, count)
    place = np.log(warm)
    highest = _log_likelihood(squares, standard, warm[0], warm[1])
    for start in _STARTS:
        value = _log_likelihood(squares, standard, start * first[0], first[1])
        if value > highest:
            place, highest = np.log(np.array([start * first[0], first[1]])), value
    lower, upper = (
        np.log(np.array([_LENGTH_SCALES[0], LEAST_NOISE])),
        np.log(np.array([_LENGTH_SCALES[1], 1.0])),
    )
    free = 2 if noise_is_fitted else 1
    step = _FIRST_STEP
    while step > _LAST_STEP:
        moved = False
        for axis in range(free):
            for sign in (1, -1):
                there = place.copy()
                there[axis] = min(max(place[axis] + sign * step, lower[axis]), upper[axis])
                value = _log_likelihood(squares, standard, math.exp(there[0]), math.exp(there[1]))
                if value > highest:
                    place, highest, moved = there, value, True
                    break
        if not moved:
            step /= 2
    return math.exp(place[0]), math.exp(place[1])


@compiled
def _invert(features, count, length_scale, noise, factor):  # type: ignore[no-untyped-def]
    """W = R^-T."""
    root = _cholesky(_squared_distances(features, count), length_scale, noise)
    column = np.empty(count)
    for i in range(count):
        row = factor[i]
        row[:i] = 0.0
        for k in range(i):
            column[k] = -root[k, i] / root[i, i]
        add_rows(row, 0, i, column, factor, 0, i)
        row[i] = 1 / root[i, i]
