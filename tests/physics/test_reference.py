"""Pistons against closed forms, and what the exact solutions refuse; all in float64."""

import math

import numpy as np
import pytest
import torch
from exact_fields import WAVELENGTH, K
from scipy.special import j0, struve

import autdtorch as at
from autdtorch import analytic
from autdtorch.analytic.green import green

PISTON = 5e-3
POINTS, SOURCES = [[0.02, 0.0, 0.0], [0.0, 0.01, 0.05]], [[0.0, 0.0, 0.03]]
ORIGIN = (0.0, 0.0, 0.0)
UP = (0.0, 0.0, 1.0)


def test_reference_is_reached_from_the_package():
    assert at.analytic.rigid_sphere is analytic.rigid_sphere
    assert at.analytic.green is green


def test_piston_on_its_axis_is_the_closed_form_near_and_far():
    z = torch.tensor([0.0, 1e-4, 5e-3, 0.1, 3.0, 1e3], dtype=torch.float64)
    points = torch.stack([z, 0 * z, 0 * z], dim=1)
    field = analytic.piston_field(points, [[0.0, 0.0, 0.0]], K, PISTON, (2.0, 0.0, 0.0))[:, 0]
    exact = analytic.piston_on_axis(z, K, PISTON)
    # Rounding of k z = 7e5 at the farthest.
    assert torch.allclose(field, exact, rtol=1e-9, atol=0)
    # Fresnel's phase k a^2 / 4z = 5e-6 is left at 1 km.
    assert abs(exact[-1] / green(points[-1:], [[0.0, 0.0, 0.0]], K) - 1) < 1e-5
    difference = (torch.exp(1j * K * torch.hypot(z, 0 * z + PISTON)) - torch.exp(1j * K * z)) / (
        2j * math.pi * K * PISTON**2
    )
    # The difference of two waves loses digits far away, as 1 / z.
    assert torch.allclose(exact[:4], difference[:4], rtol=1e-10, atol=0)


@pytest.mark.parametrize("reach", [0.1, 3.7, 30.0])
def test_piston_far_away_is_its_directivity(reach):
    """At 1e5 a^2 / wavelength and 1e4 wavelengths, Fresnel's phase and the 1 / (k r) terms are below 1e-4."""
    radius = reach / K
    distance = 1e4 * WAVELENGTH * max(1, reach**2)
    angle = torch.linspace(0, math.pi / 2, 9, dtype=torch.float64)
    points = distance * torch.stack([torch.sin(angle), 0 * angle, torch.cos(angle)], dim=1)
    field = analytic.piston_field(points, [[0.0, 0.0, 0.0]], K, radius, (0.0, 0.0, 1.0))
    ratio = (field / green(points, [[0.0, 0.0, 0.0]], K))[:, 0]
    assert (ratio - analytic.piston_directivity(angle, K, radius)).abs().max() < 1e-4


def test_piston_near_is_the_sum_over_its_disc():
    """Gauss quadrature in radius and trapezoids in angle: exponential at points a radius off the disc."""
    nodes, weights = np.polynomial.legendre.leggauss(40)
    rho, rho_weights = PISTON * (nodes + 1) / 2, PISTON * weights / 2
    phi = np.arange(120) * 2 * math.pi / 120
    grid = np.stack(
        [
            np.outer(rho, np.cos(phi)).ravel(),
            np.outer(rho, np.sin(phi)).ravel(),
            np.zeros(rho.size * phi.size),
        ],
        axis=1,
    )
    area = torch.tensor(np.repeat(rho * rho_weights, phi.size) * 2 * math.pi / phi.size)
    points = [[0.3 * PISTON, 0.0, PISTON], [0.0, PISTON, -PISTON], [2.5 * PISTON, 0.0, 0.0]]
    expected = green(points, grid, K) @ area.to(torch.complex128) / (math.pi * PISTON**2)
    field = analytic.piston_field(points, [[0.0, 0.0, 0.0]], K, PISTON, (0.0, 0.0, 1.0))
    assert torch.allclose(field[:, 0], expected, rtol=1e-10, atol=0)


def test_piston_on_its_rim_is_the_closed_form():
    """The disc is seen over half a turn: chords 2 a cos phi give a Bessel and a Struve function."""
    reach = 2 * K * PISTON
    chords = j0(reach) + 1j * struve(0, reach) - 1
    expected = chords / (4j * math.pi * K * PISTON**2)
    point = torch.tensor([[PISTON, 0.0, 0.0]], dtype=torch.float64)
    field = analytic.piston_field(point, [[0.0, 0.0, 0.0]], K, PISTON, (0.0, 0.0, 1.0))
    # Rounding.
    assert abs(field[0, 0] / expected - 1) < 1e-10


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: analytic.rigid_sphere([ORIGIN], SOURCES, K, ORIGIN, 0.01), r"points\[0\].*at least 0.01 m"),
        (
            lambda: analytic.rigid_sphere(POINTS, [ORIGIN], K, ORIGIN, 0.01),
            r"sources\[0\].*must be at least",
        ),
        (lambda: analytic.rigid_sphere(SOURCES, SOURCES, K, ORIGIN, 0.01), r"points\[0\].*lies on source 0"),
        (lambda: analytic.soft_sphere(POINTS, SOURCES, K, ORIGIN, -1.0), "radius: -1.0 m; must be"),
        (
            lambda: analytic.fluid_sphere(POINTS, SOURCES, K, ORIGIN, 0.01, 0.0, 1.0),
            "density_ratio: 0.0; must be",
        ),
        (
            lambda: analytic.fluid_sphere(POINTS, SOURCES, K, ORIGIN, 0.01, 1.0, math.inf),
            "speed_ratio: inf; must",
        ),
        (
            lambda: analytic.rigid_plane([[0, 0, -1e-3]], SOURCES, K, ORIGIN, UP),
            r"points\[0\].*-0.001 m in front",
        ),
        (lambda: analytic.soft_plane(POINTS, [[0, 0, -1.0]], K, ORIGIN, UP), r"sources\[0\].*-1 m in front"),
        (
            lambda: analytic.fluid_half_space(POINTS, [ORIGIN], K, ORIGIN, UP, 2.0, 1.0),
            r"sources\[0\].*0 m in front",
        ),
        (
            lambda: analytic.fluid_slab(POINTS, SOURCES, K, ORIGIN, UP, 0.0, 2.0, 1.0),
            "thickness: 0.0 m; must be",
        ),
        (
            lambda: analytic.step_coefficients([0.1, 1.6], 2.0, 1.0),
            r"angle: \(0.1, 1.6\) rad; .*\[0, pi/2\)",
        ),
        (lambda: analytic.piston_on_axis([-0.1], K, PISTON), "distance: .*must be >= 0"),
        (lambda: analytic.piston_field(POINTS, SOURCES, K, PISTON, ORIGIN), "normal: .*length"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()
