"""The exact fields of `exact_planes` meet their equations, and agree where two of them solve one problem."""

import numpy as np
import pytest
import torch
from exact_fields import SLOPE_TOLERANCE, STEP, K
from exact_planes import Ball, Plane, corner, monopoles, pistons_in_panel, sphere_before_plane, waveguide

from autdtorch import analytic
from autdtorch.propagators.free_space import free_space_matrix
from autdtorch.scene.arrays import TransducerArray

RADIUS, SOURCE = 8e-3, np.array([[0.02, 0.01, 0.06]])
PLANE = Plane((0.002, 0.001, -0.003), (0.3, -0.5, 0.9))
BODIES = [{}, {"density_ratio": 2.5, "speed_ratio": 0.6 - 0.1j}, {"impedance": 1.5 + 1j}]
ROUNDING = 1e-12  # a thousand times what is measured


def apart(one, other):
    return float((one - other).abs().max() / other.abs().max())


def slope(field, start, direction):
    """d/dn over k p at a point (3,), by a one-sided difference."""
    samples = field(start + np.array(direction) * STEP * np.arange(3)[:, None]).numpy()[:, 0]
    return complex((-3 * samples[0] + 4 * samples[1] - samples[2]) / (2 * STEP) / samples[0] / K)


def ball_at(gap, **body):
    return Ball(tuple(np.array(PLANE.point) + (gap + RADIUS) * PLANE.axes[2]), RADIUS, **body)


def test_sphere_without_reflection_is_the_sphere_in_free_space():
    points = torch.tensor([[0.03, 0.01, 0.03], [0.0, -0.02, 0.02]], dtype=torch.float64)
    absent, where = Plane(reflection=0.0), ((0.0, 0.0, 0.01), RADIUS)
    rigid = sphere_before_plane(points, SOURCE, K, Ball(*where), absent)
    assert apart(rigid, analytic.rigid_sphere(points, SOURCE, K, *where)) < ROUNDING
    fluid = sphere_before_plane(points, SOURCE, K, Ball(*where, 2.5, 0.6), absent)
    assert apart(fluid, analytic.fluid_sphere(points, SOURCE, K, *where, 2.5, 0.6)) < 1e-11


@pytest.mark.parametrize("body", BODIES)
def test_sphere_close_to_a_plane_meets_all_conditions(body):
    ball = ball_at(0.5e-3, **body)

    def field(points, degree=50):
        return sphere_before_plane(points, SOURCE, K, ball, PLANE, degree)

    points = np.array([[0.03, 0.01, 0.03], [0.0, -0.02, 0.02]])
    assert apart(field(points), field(points, 70)) < 1e-9  # the promise is 1e-8
    if not body or "impedance" in body:
        outward = np.array([0.6, 0.0, -0.8])  # towards the plane
        expected = -1j / body["impedance"] if body else 0
        near = np.array(ball.center) + RADIUS * outward
        assert abs(slope(field, near, outward) - expected) < 10 * SLOPE_TOLERANCE  # it varies over the gap
    foot = PLANE.mirrored(np.array([ball.center]))[0] / 2 + np.array(ball.center) / 2
    assert abs(slope(field, foot + 3e-3 * PLANE.axes[0], PLANE.axes[2])) < 10 * SLOPE_TOLERANCE


def test_soft_plane_has_no_pressure():
    soft = Plane(PLANE.point, PLANE.normal, -1.0)
    on_it = np.array(PLANE.point) + np.array([[0.01], [-0.02]]) * PLANE.axes[:1]
    field = sphere_before_plane(on_it, SOURCE, K, ball_at(2e-3), soft)
    assert field.abs().max() < ROUNDING * abs(monopoles(on_it, SOURCE, K)).max()


def test_corner_of_three_planes_is_even_and_odd():
    planes = [Plane((0, 0, 0), (1, 0, 0)), Plane((0, 0, 0), (0, 1, 0), -1.0), Plane((0, 0, 0), (0, 0, 1))]
    rigid = corner(np.array([[0.0, 0.03, 0.02], [0.01, 0.0, 0.02]]), SOURCE, K, planes)
    assert rigid[1].abs().max() < ROUNDING * rigid[0].abs().max()
    assert abs(slope(lambda at: corner(at, SOURCE, K, planes), (0, 0.03, 0.02), (1, 0, 0))) < SLOPE_TOLERANCE


@pytest.mark.parametrize("reflection", [1.0, -1.0])
def test_modes_between_two_planes_are_the_sum_of_images(reflection):
    absorbing, height = K + 40j, 12e-3  # the image at a distance r counts e^(-40 r): 3 m are enough
    source, points = np.array([[0.0, 0.0, 4e-3]]), np.array([[0.01, 0.003, 2e-3], [0.03, 0.0, 11e-3]])
    images = np.zeros((2, 1), complex)
    for number in range(-150, 151):
        for sign, weight in ((1, 1.0), (-1, reflection)):
            place = np.array([[0.0, 0.0, 2 * number * height + sign * 4e-3]])
            images += weight * monopoles(points, place, absorbing)
    modes = waveguide(points, source, absorbing, height, reflection)
    assert apart(modes, torch.from_numpy(images)) < ROUNDING


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


def test_pistons_in_a_panel_are_twice_the_discs():
    array = TransducerArray.grid((2, 2), 10e-3, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), radius=4.5e-3)
    points = torch.tensor([[0.01, 0.0, 0.03], [0.0, 0.05, 0.2]], dtype=torch.float64)
    panel = pistons_in_panel(points, array, K, 4.5e-3)
    # A disc in the panel is its own image. The quadrature of discs is good to 1e-6 in the far field.
    assert apart(2 * free_space_matrix(points, array, K), panel) < 2e-6
