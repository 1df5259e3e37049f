"""The exact fields of `exact_planes` meet their equations, and agree where two of them solve one problem."""

import numpy as np
import pytest
import torch
from exact_fields import SLOPE_TOLERANCE, STEP, K
from exact_planes import (
    Ball,
    Plane,
    corner,
    impedance_plane,
    monopoles,
    pistons_in_panel,
    sphere_before_plane,
    waveguide,
)

from autdtorch import analytic
from autdtorch.analytic.green import free_space_matrix
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


@pytest.mark.parametrize("impedance", [1.5 + 1j, 5 - 3j, 0.3 + 0.1j, 20 + 10j])
def test_impedance_plane_meets_its_condition(impedance):
    def field(points):
        return impedance_plane(points, SOURCE, K, PLANE, impedance)

    start = np.array(PLANE.point) + 0.01 * PLANE.axes[0]
    expected = -1j / impedance  # b times as steep
    assert abs(slope(field, start, PLANE.axes[2]) - expected) < SLOPE_TOLERANCE * max(1, abs(expected)) ** 3


def test_impedance_plane_between_rigid_and_matched():
    points = np.array(PLANE.point) + np.array([[0.05, 0.0, 0.02]]) @ PLANE.axes
    rigid = analytic.rigid_plane(points, SOURCE, K, PLANE.point, PLANE.normal)
    assert apart(impedance_plane(points, SOURCE, K, PLANE, 1e9), rigid) < 1e-7  # k r / impedance
    # Far away a plane wave at the angle of incidence is reflected by (cos - b) / (cos + b).
    above = np.array(PLANE.point) + np.array([[3.0, 0.0, 4.0]]) @ PLANE.axes
    high = np.array(PLANE.point) + np.array([[-3.0, 0.0, 4.0]]) @ PLANE.axes
    reflected = impedance_plane(above, high, K, PLANE, 2 + 1j) - torch.from_numpy(monopoles(above, high, K))
    image = torch.from_numpy(monopoles(above, PLANE.mirrored(high), K))
    expected = (0.8 - 1 / (2 + 1j)) / (0.8 + 1 / (2 + 1j))
    assert abs(complex(reflected / image) - expected) < 1 / (K * 10)  # next order in 1 / (k R)


def test_pistons_in_a_panel_are_twice_the_discs():
    array = TransducerArray.grid((2, 2), 10e-3, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), radius=4.5e-3)
    points = torch.tensor([[0.01, 0.0, 0.03], [0.0, 0.05, 0.2]], dtype=torch.float64)
    panel = pistons_in_panel(points, array, K, 4.5e-3)
    # A disc in the panel is its own image. The quadrature of discs is good to 1e-6 in the far field.
    assert apart(2 * free_space_matrix(points, array, K), panel) < 2e-6
