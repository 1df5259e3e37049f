"""Planes with an impedance, between rigid and soft ones, and as half-spaces of slow fluids."""

import numpy as np
import pytest
import torch
from exact_fields import SLOPE_TOLERANCE, STEP, K
from exact_planes import Plane, corner, monopoles

from autdtorch import analytic

SOURCE = np.array([[0.02, 0.01, 0.06]])
PLANE = Plane((0.002, 0.001, -0.003), (0.3, -0.5, 0.9))


def apart(one, other):
    return float((one - other).abs().max() / other.abs().max())


def slope(field, start, direction):
    """d/dn over k p at a point (3,), by a one-sided difference."""
    samples = field(start + np.array(direction) * STEP * np.arange(3)[:, None]).numpy()[:, 0]
    return complex((-3 * samples[0] + 4 * samples[1] - samples[2]) / (2 * STEP) / samples[0] / K)


IMPEDANCES = [1.5 + 1j, 5 - 3j, 0.3 + 0.1j, 0.01 - 0.01j, 0.1 + 2j, -2j, 100 + 0j]


def before_impedance(points, impedance, sources=SOURCE, **options):
    return analytic.impedance_plane(points, sources, K, PLANE.point, PLANE.normal, impedance, **options)


@pytest.mark.parametrize("impedance", IMPEDANCES)
def test_impedance_plane_meets_its_condition(impedance):
    on_plane = np.array(PLANE.point) + 0.02 * PLANE.axes[:1]
    for sources in (SOURCE, on_plane):
        for place in (0.01, -0.3):  # near, and far along the plane
            start = np.array(PLANE.point) + place * PLANE.axes[1]
            here = slope(lambda at: before_impedance(at, impedance, sources), start, PLANE.axes[2])  # noqa: B023
            steepest = max(1, 1 / abs(impedance)) ** 3
            assert abs(here + 1j / impedance) < SLOPE_TOLERANCE * steepest


def test_impedance_plane_between_rigid_and_soft():
    points = np.array(PLANE.point) + np.array([[0.05, 0.0, 0.02], [0.0, 0.3, 0.0]]) @ PLANE.axes
    plane = SOURCE, K, PLANE.point, PLANE.normal
    # k r / impedance
    assert apart(before_impedance(points, 1e9), analytic.rigid_plane(points, *plane)) < 1e-6
    soft = analytic.soft_plane(points[:1], *plane)
    assert apart(before_impedance(points[:1], 1e-9), soft) < 1e-7
    # Far away a plane wave at the angle of incidence is reflected by (cos - b) / (cos + b).
    above = np.array(PLANE.point) + np.array([[3.0, 0.0, 4.0]]) @ PLANE.axes
    high = np.array(PLANE.point) + np.array([[-3.0, 0.0, 4.0]]) @ PLANE.axes
    for impedance in IMPEDANCES:
        reflected = before_impedance(above, impedance, high, scattered=True)
        image = torch.from_numpy(monopoles(above, PLANE.mirrored(high), K))
        expected = (0.8 * impedance - 1) / (0.8 * impedance + 1)
        assert abs(complex(reflected / image) - expected) < 10 / (K * 10)  # next order in 1 / (k R)


def test_impedance_plane_is_a_half_space_of_a_very_slow_fluid():
    points = np.array(PLANE.point) + np.array([[0.05, 0.0, 0.02], [0.02, 0.01, 0.005]]) @ PLANE.axes
    speed = 1e-3 - 0.4e-3j
    slow = analytic.fluid_half_space(points, SOURCE, K, PLANE.point, PLANE.normal, 2000.0, speed)
    assert apart(before_impedance(points, 2000.0 * speed), slow) < 1e-5  # (c_1 / c)^2


def test_a_constant_reflection_factor_is_an_approximation():
    """The factor of the normal serves walls that the sound meets head on, and not those that it passes along.

    `python scripts/benchmark.py reflection` has a table.
    """
    points = np.array([[0.0, 0.0, 0.12], [0.02, -0.01, 0.16]])
    sources = np.array([[x, y, 0.0] for x in (-0.07, 0.0, 0.07) for y in (-0.05, 0.05)])
    factor = (5 - 1) / (5 + 1)
    errors = []
    for plane in (Plane((0, 0, 0.3), (0, 0, -1), factor), Plane((-0.095, 0, 0), (1, 0, 0), factor)):
        exact = analytic.impedance_plane(points, sources, K, plane.point, plane.normal, 5.0)
        errors.append(float((corner(points, sources, K, [plane]) - exact).norm() / exact.norm()))
    assert errors[0] < 0.01 < 0.03 < errors[1] < 0.2
