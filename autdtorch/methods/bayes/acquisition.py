"""Acquisition functions of a Gaussian process, and the point where one is largest."""

from __future__ import annotations

import math

import numpy as np

from autdtorch.methods.bayes.process import (
    Posterior,
    Vector,
    add_rows,
    compiled,
    covariances,
    features_of,
    matern,
    whiten,
)

_STARTS = 2  # The best candidates are climbed from,
_CLIMB_EVALUATIONS = 20  # with so many evaluations of the acquisition function each.
_BLOCK = 64
"""Candidates whose covariances are kept at a time: so many that they stay in the cache."""


def largest(process: Posterior, log: bool, candidates: Vector, lower: Vector, upper: Vector) -> Vector:
    """The point (D,) between `lower` and `upper` (D,) with the largest (log) expected improvement.

    Args:
        process: the process.
        log: whether the logarithm is compared and climbed.
        candidates: (C, D); compared first, then climbed from the best of them.
        lower: in turns; -inf on the circle.
        upper: in turns.
    """
    mean, deviation = posterior(process, candidates)
    values = _expected_improvements(mean, deviation, process.best, log)
    starts = candidates[np.argsort(-values, kind="stable")[:_STARTS]]
    climbed = [_climb(process, log, start, lower, upper) for start in starts]
    return np.asarray(max(climbed, key=lambda found: found[1])[0])


@compiled
def posterior(process, points):  # type: ignore[no-untyped-def]
    """Mean (C,) and standard deviation (C,) of the process, without noise, at points (C, D)."""
    total, count = len(points), process.size
    mean, deviation = np.empty(total), np.empty(total)
    scale = 1 / process.length_scale**2
    kernel, white = np.empty((count, _BLOCK)), np.empty(_BLOCK)
    at, square = np.zeros((len(process.features), _BLOCK)), np.empty(_BLOCK)
    for first in range(0, total, _BLOCK):
        width = min(_BLOCK, total - first)
        for c in range(width):
            at[:, c] = features_of(points[first + c], process.circle)
        block_mean, explained = np.zeros(_BLOCK), np.zeros(_BLOCK)
        for n in range(count):
            square[:] = 0.0
            for f in range(len(at)):
                for c in range(_BLOCK):
                    square[c] += (process.features[f, n] - at[f, c]) ** 2
            for c in range(_BLOCK):
                kernel[n, c], _ = matern(square[c] * scale)
                block_mean[c] += process.weights[n] * kernel[n, c]
        for i in range(count):
            white[:] = 0.0
            add_rows(white, 0, _BLOCK, process.factor[i], kernel, 0, i + 1)
            for c in range(_BLOCK):
                explained[c] += white[c] * white[c]
        for c in range(width):
            mean[first + c] = block_mean[c]
            deviation[first + c] = process.scale * _deviation(1 - explained[c])
    return mean, deviation


@compiled
def _deviation(variance):  # type: ignore[no-untyped-def]
    # Rounding may leave a variance below 0 at a point that is process.
    return math.sqrt(max(variance, 1e-12))


@compiled
def expected_improvement(mean, deviation, best):  # type: ignore[no-untyped-def]
    """E[max(f - best, 0)], and its derivatives by mean and deviation."""
    u = (mean - best) / deviation
    density, share = _normal(u)
    return deviation * (density + u * share), share, density


@compiled
def log_expected_improvement(mean, deviation, best):  # type: ignore[no-untyped-def]
    """Logarithm of the expected improvement, precise where that rounds to 0; its derivatives.

    At u = -t, with the ratio m = (1 - Phi(t)) / phi(t) of Mills: phi + u Phi = phi (1 - t m). Both m and
    1 - t m = m (1/m - t) follow from Laplace's continued fraction 1/m = t + 1/(t + 2/(t + ...)), in which
    nothing cancels.
    """
    u = (mean - best) / deviation
    if u > -10:
        density, share = _normal(u)
        gain = density + u * share
        return math.log(deviation * gain), share / (deviation * gain), density / (deviation * gain)
    rest = -u
    for term in range(20, 1, -1):
        rest = -u + term / rest
    rest = 1 / rest  # 1/m - t
    ratio = 1 / (rest - u)
    gain = ratio * rest  # (phi + u Phi) / phi
    value = math.log(deviation * gain) - 0.5 * u * u - 0.5 * math.log(2 * math.pi)
    return value, ratio / (deviation * gain), 1 / (deviation * gain)


@compiled
def _normal(u):  # type: ignore[no-untyped-def]
    """Density and distribution function of the standard normal distribution."""
    return math.exp(-0.5 * u * u) / math.sqrt(2 * math.pi), 0.5 * math.erfc(-u / math.sqrt(2))


@compiled
def _improvement(mean, deviation, best, log):  # type: ignore[no-untyped-def]
    if log:
        return log_expected_improvement(mean, deviation, best)
    return expected_improvement(mean, deviation, best)


@compiled
def _expected_improvements(mean, deviation, best, log):  # type: ignore[no-untyped-def]
    values = np.empty(len(mean))
    for c in range(len(mean)):
        values[c] = _improvement(mean[c], deviation[c], best, log)[0]
    return values


@compiled
def _value(process, log, point, gradient, room):  # type: ignore[no-untyped-def]
    """Acquisition function at a point (D,), its gradient written to `gradient` (D,)."""
    count, dimensions = process.size, len(point)
    kernel, slope, white, pull = room
    at = features_of(point, process.circle)
    covariances(process.features, count, at, process.length_scale, kernel, slope)
    whiten(process.factor, count, kernel, white)
    mean, explained = 0.0, 0.0
    for n in range(count):
        mean += process.weights[n] * kernel[n]
        explained += white[n] * white[n]
    deviation = process.scale * _deviation(1 - explained)
    value, by_mean, by_deviation = _improvement(mean, deviation, process.best, log)
    pull[:count] = 0.0
    for i in range(count):
        for j in range(i + 1):
            pull[j] += white[i] * process.factor[i, j]
    for n in range(count):
        by_kernel = by_mean * process.weights[n] - by_deviation * process.scale**2 / deviation * pull[n]
        pull[n] = 2 * slope[n] * by_kernel
    for f in range(len(at)):
        total = 0.0
        for n in range(count):
            total += pull[n] * (at[f] - process.features[f, n])
        if not process.circle:
            gradient[f] = total
        elif f < dimensions:
            gradient[f] = -2 * math.pi * at[dimensions + f] * total
        else:
            gradient[f - dimensions] += 2 * math.pi * at[f - dimensions] * total
    return value


@compiled
def _climb(process, log, start, lower, upper):  # type: ignore[no-untyped-def]
    """Spectral projected gradient (Birgin, Martinez and Raydan 2000): the best point (D,), and its value."""
    dimensions = len(start)
    room = (np.empty(process.size), np.empty(process.size), np.empty(process.size), np.empty(process.size))
    point, gradient = start.copy(), np.empty(dimensions)
    value = _value(process, log, point, gradient, room)
    norm = math.sqrt(np.sum(gradient * gradient))
    if norm == 0:
        return point, value
    reach = process.length_scale / (2 * math.pi) if process.circle else process.length_scale
    rate = 0.1 * reach / norm
    there, steeper, move = np.empty(dimensions), np.empty(dimensions), np.empty(dimensions)
    share = 0.0
    for _ in range(_CLIMB_EVALUATIONS):
        if share == 0:
            rise = 0.0
            for d in range(dimensions):
                move[d] = min(max(point[d] + rate * gradient[d], lower[d]), upper[d]) - point[d]
                rise += move[d] * gradient[d]
            if rise <= 0:
                break
            share = 1.0
        for d in range(dimensions):
            there[d] = point[d] + share * move[d]
        found = _value(process, log, there, steeper, room)
        if found < value + 1e-4 * share * rise:
            # The top of the parabola through what is known of the line.
            share *= min(max(-0.5 * share * rise / (found - value - share * rise), 0.1), 0.5)
            continue
        length, bend = 0.0, 0.0
        for d in range(dimensions):
            length += (share * move[d]) ** 2
            bend -= share * move[d] * (steeper[d] - gradient[d])
        rate = length / bend if bend > 0 else 4 * rate
        point[:], gradient[:], value, share = there, steeper, found, 0.0
    return point, value
