"""Sampling exact fields, and their derivatives, to hold them against the equations that define them.

Derivatives are taken by one-sided finite differences of second order, over steps of STEP = 1e-3 / k. Their
truncation error is (k STEP)^2 / 3 = 3e-7 of k |p| in a plane wave, and more where the field varies faster:
1e-5 leaves room for that. Rounding is 1e-12.
"""

import math

from autdtorch.analytic.green import green

WAVELENGTH = 8.5e-3
K = 2 * math.pi / WAVELENGTH
STEP = 1e-3 / K
SLOPE_TOLERANCE = 1e-5

FLUIDS = [(77.0, 1.0), (2.5, 0.6), (0.1, 3.0)]  # density ratio, speed ratio
ABSORBING = [(1.4 + 0.9j, 0.7 - 0.23j), (2.5, 0.6 - 0.02j), (9 + 4j, 1.5 - 0.6j)]  # the first is foam


def sampled(field, points):
    """`field` of points (A, B, 3), as (A, B, M)."""
    return field(points.reshape(-1, 3)).reshape(*points.shape[:2], -1)


def slope(values):
    """d/dx at the first of three samples STEP apart, along dimension 1."""
    return (-3 * values[:, 0] + 4 * values[:, 1] - values[:, 2]) / (2 * STEP)


def relative(difference, points, sources):
    """The largest |difference| over the direct wave."""
    return float((difference / green(points, sources, K)).abs().max())
