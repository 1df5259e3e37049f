"""Pistons against closed forms, in float64."""

import math

import numpy as np
import pytest
import torch
from exact_fields import WAVELENGTH, K, piston_directivity
from scipy.special import j0, struve

from autdtorch import analytic
from autdtorch.analytic.green import green

PISTON = 5e-3


def test_piston_on_its_axis_is_the_closed_form_near_and_far():
    z = torch.tensor([0.0, 1e-4, 5e-3, 0.1, 3.0, 1e3], dtype=torch.float64)
    points = torch.stack([z, 0 * z, 0 * z], dim=1)
    field = analytic.piston_field(points, [[0.0, 0.0, 0.0]], K, PISTON, (2.0, 0.0, 0.0))[:, 0]
    # (e^{ik sqrt(z^2 + a^2)} - e^{ikz}) / (2 pi i k a^2) as a product, which does not cancel far away
    path = torch.hypot(z, 0 * z + PISTON) + z
    amplitude = torch.sinc(K * PISTON**2 / path / (2 * math.pi)) / (2 * math.pi * path)
    # Rounding of k z = 7e5 at the farthest.
    assert torch.allclose(field, amplitude * torch.exp(0.5j * K * path), rtol=1e-9, atol=0)
    # Fresnel's phase k a^2 / 4z = 5e-6 is left at 1 km.
    assert abs(field[-1] / green(points[-1:], [[0.0, 0.0, 0.0]], K) - 1) < 1e-5


@pytest.mark.parametrize("reach", [0.1, 3.7, 30.0])
def test_piston_far_away_is_its_directivity(reach):
    """At 1e5 a^2 / wavelength and 1e4 wavelengths, Fresnel's phase and the 1 / (k r) terms are below 1e-4."""
    radius = reach / K
    distance = 1e4 * WAVELENGTH * max(1, reach**2)
    angle = torch.linspace(1e-3, math.pi / 2, 9, dtype=torch.float64)
    points = distance * torch.stack([torch.sin(angle), 0 * angle, torch.cos(angle)], dim=1)
    field = analytic.piston_field(points, [[0.0, 0.0, 0.0]], K, radius, (0.0, 0.0, 1.0))
    ratio = (field / green(points, [[0.0, 0.0, 0.0]], K))[:, 0]
    assert (ratio - piston_directivity(angle, reach)).abs().max() < 1e-4


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
