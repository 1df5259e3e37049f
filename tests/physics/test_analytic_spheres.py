"""Point sources at spheres: boundary conditions, reciprocity and limits; all in float64."""

import math
from functools import partial

import pytest
import torch
from exact_fields import ABSORBING, FLUIDS, SLOPE_TOLERANCE, STEP, K, relative, sampled, slope

from autdtorch import analytic
from autdtorch.analytic.green import green

CENTER = (0.01, -0.02, 0.005)
RADIUS = 0.01
SOURCES = torch.tensor([[0.01, -0.02, 0.035], [-0.001, -0.031, 0.001]], dtype=torch.float64)
OUTSIDE = torch.tensor([[0.024, -0.02, 0.0], [0.0, 0.01, 0.05], [0.01, -0.0302, 0.005]], dtype=torch.float64)


def on_sphere(distances, radius=RADIUS):
    """Points at several distances from the centre along three directions: (direction, distance, 3)."""
    directions = torch.nn.functional.normalize(
        torch.tensor([[0.1, 0.2, 1.0], [-1.0, -0.9, 0.2], [0.3, 1.0, -1.0]], dtype=torch.float64)
    )
    return directions.new_tensor(CENTER) + directions.new_tensor(distances)[:, None] * directions[:, None]


BALL = {"wavenumber": K, "center": CENTER, "radius": RADIUS}
rigid_sphere, soft_sphere = (partial(each, **BALL) for each in (analytic.rigid_sphere, analytic.soft_sphere))


def fluid_sphere(density_ratio, speed_ratio):
    return partial(analytic.fluid_sphere, **BALL, density_ratio=density_ratio, speed_ratio=speed_ratio)


def impedance_sphere(impedance):
    return partial(analytic.impedance_sphere, **BALL, impedance=impedance)


def test_pressure_on_a_soft_sphere_and_normal_velocity_on_a_rigid_one_are_zero():
    points = on_sphere([RADIUS]).reshape(-1, 3)
    # Rounding of some 40 terms.
    assert relative(soft_sphere(points, SOURCES), points, SOURCES) < 1e-12
    field = sampled(
        lambda points: rigid_sphere(points, SOURCES), on_sphere([RADIUS, RADIUS + STEP, RADIUS + 2 * STEP])
    )
    incident = sampled(lambda points: green(points, SOURCES, K), on_sphere([RADIUS]))[:, 0]
    assert ((slope(field) / (K * incident)).abs() < SLOPE_TOLERANCE).all()


def test_rigid_sphere_of_ka_60_holds_a_hundredth_of_its_radius_off():
    """The boundary condition right below a source, where 4,000 orders count.

    The field varies on a scale of 0.01 R = 0.6 / k there, some 5 times faster than a plane wave: truncation
    is 5^3 * 3e-7 = 4e-5.
    """
    radius = 60 / K
    source = [[CENTER[0], CENTER[1], CENTER[2] + 1.01 * radius]]
    heights = torch.tensor([1.0, 1.0 + 1e-3 / 60, 1.0 + 2e-3 / 60], dtype=torch.float64) * radius
    points = heights.new_tensor(CENTER) + heights[:, None] * torch.tensor(
        [0.0, 0.0, 1.0], dtype=torch.float64
    )
    field = analytic.rigid_sphere(points, source, K, CENTER, radius)
    assert abs(slope(field[None])) / (K * abs(field[0])) < 1e-4
    # The field nearly doubles, as at a plane; the curvature adds an error of 0.01 radii.
    assert abs(field[0] / green(points[:1], source, K) - 2) < 0.02


@pytest.mark.parametrize("fluid", [*FLUIDS, *ABSORBING])
def test_pressure_and_normal_velocity_are_continuous_on_a_fluid_sphere(fluid):
    def field(points):
        return fluid_sphere(*fluid)(points, SOURCES)

    outside = sampled(field, on_sphere([RADIUS, RADIUS + STEP, RADIUS + 2 * STEP]))
    inside = sampled(field, on_sphere([RADIUS - 1e-8, RADIUS - 1e-8 - STEP, RADIUS - 1e-8 - 2 * STEP]))
    density_ratio, speed_ratio = fluid
    scale = outside[:, 0].abs().max()
    # Points 1e-8 m apart: k 1e-8 = 7e-6 at most, over the ratio of speeds or of densities.
    assert (outside[:, 0] - inside[:, 0]).abs().max() < 1e-4 * scale
    jump = slope(outside) + slope(inside) / density_ratio
    steepest = max(1 / abs(speed_ratio), 1) ** 3 * max(1 / abs(density_ratio), 1)
    assert jump.abs().max() < 10 * SLOPE_TOLERANCE * steepest * K * scale


@pytest.mark.parametrize("impedance", [1.5 + 1j, 0.3 - 2j])
def test_velocity_into_a_sphere_is_pressure_over_impedance(impedance):
    points = on_sphere([RADIUS, RADIUS + STEP, RADIUS + 2 * STEP])
    field = sampled(lambda points: impedance_sphere(impedance)(points, SOURCES), points)
    scale = field[:, 0].abs().max()
    steepest = max(1, 1 / abs(impedance)) ** 2
    assert (slope(field) / K + 1j * field[:, 0] / impedance).abs().max() < SLOPE_TOLERANCE * steepest * scale


def test_impedance_sphere_is_rigid_soft_or_a_fluid_without_waves_along_it():
    rigid = impedance_sphere(1e12)(OUTSIDE, SOURCES) - rigid_sphere(OUTSIDE, SOURCES)
    assert relative(rigid, OUTSIDE, SOURCES) < 1e-10  # first order in 1 / impedance
    soft = impedance_sphere(1e-9)(OUTSIDE, SOURCES) - soft_sphere(OUTSIDE, SOURCES)
    assert relative(soft, OUTSIDE, SOURCES) < 1e-7
    # In a slow fluid all waves go straight inwards, and none comes back that absorbs: 1 / (k_1 a)^2 = 1e-6.
    slow = 0.01 - 0.004j
    locally = impedance_sphere(200 * slow)(OUTSIDE, SOURCES) - fluid_sphere(200, slow)(OUTSIDE, SOURCES)
    assert relative(locally, OUTSIDE, SOURCES) < 1e-3  # 1 / (k_1 a), curvature


@pytest.mark.parametrize("scattered", [False, True])
def test_fluid_sphere_becomes_rigid_or_soft_with_its_density(scattered):
    heavy = fluid_sphere(1e9, 1.3)(OUTSIDE, SOURCES, scattered=scattered)
    # First order in the ratio, times the admittance of the inside, some 10 off its resonances.
    rigid = rigid_sphere(OUTSIDE, SOURCES, scattered=scattered)
    assert relative(heavy - rigid, OUTSIDE, SOURCES) < 1e-7
    light = fluid_sphere(1e-9, 1.3)(OUTSIDE, SOURCES, scattered=scattered)
    assert relative(light - soft_sphere(OUTSIDE, SOURCES, scattered=scattered), OUTSIDE, SOURCES) < 1e-7


def test_sphere_of_the_medium_is_not_there():
    inside = on_sphere([0.0, 0.3 * RADIUS, 0.99 * RADIUS]).reshape(-1, 3)
    for points in (inside, OUTSIDE):
        # Rounding of some 40 terms.
        assert relative(fluid_sphere(1, 1)(points, SOURCES, scattered=True), points, SOURCES) < 1e-12


@pytest.mark.parametrize(
    "sphere",
    [
        rigid_sphere,
        soft_sphere,
        impedance_sphere(1.5 + 1j),
        *(fluid_sphere(*fluid) for fluid in [*FLUIDS, *ABSORBING]),
    ],
)
def test_spheres_are_reciprocal_and_split_into_incident_and_scattered(sphere):
    field = sphere(OUTSIDE, SOURCES)
    # Rounding.
    assert torch.allclose(field, sphere(SOURCES, OUTSIDE).T, rtol=1e-12, atol=0)
    whole = sphere(OUTSIDE, SOURCES, scattered=True) + green(OUTSIDE, SOURCES, K)
    assert torch.allclose(field, whole, rtol=1e-12, atol=0)


@pytest.mark.parametrize("density_ratio", [5.0, 0.2])
@pytest.mark.parametrize("speed_ratio", [0.5, 2.0])
def test_small_sphere_scatters_by_compressibility_and_density(density_ratio, speed_ratio):
    """Rayleigh's limit (Morse & Ingard, chapter 8), next order (k_1 a)^2 =
    1.6e-5 times a contrast of 20, and far from all, 1 / kr = 1e-4.
    """
    radius, distance = 2e-3 / K, 1e4 / K
    source = [[0.0, 0.0, distance]]
    angle = torch.linspace(0, math.pi, 7, dtype=torch.float64)
    points = distance * torch.stack([torch.sin(angle), 0 * angle, -torch.cos(angle)], dim=1)
    points[-1, 2] -= 1 / K  # not on the source
    arguments = points, source, K, (0.0, 0.0, 0.0), radius
    wave = analytic.fluid_sphere(*arguments, density_ratio, speed_ratio, scattered=True)[:, 0]
    scale = 4 * math.pi * green([[0.0, 0.0, 0.0]], source, K) * green(points, [[0.0, 0.0, 0.0]], K)
    amplitude = wave / (K**2 * radius**3 * scale[:, 0])
    monopole = (1 / (density_ratio * speed_ratio**2) - 1) / 3
    dipole = (density_ratio - 1) / (2 * density_ratio + 1)
    assert (amplitude - (monopole + dipole * torch.cos(angle))).abs().max() < 1e-3
    rigid = analytic.rigid_sphere(*arguments, scattered=True)[:, 0] / (K**2 * radius**3 * scale[:, 0])
    assert (rigid - (torch.cos(angle) / 2 - 1 / 3)).abs().max() < 1e-3


def test_large_sphere_is_a_plane_but_for_its_curvature():
    source, points = [[0.0, 0.0, 8e-3]], [[4e-3, 0.0, 6e-3], [0.0, 0.0, 1e-3]]
    flat = analytic.rigid_plane(points, source, K, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    near, far = (
        relative(analytic.rigid_sphere(points, source, K, (0, 0, -radius), radius) - flat, points, source)
        for radius in (0.1, 0.4)
    )
    # First order in 1 / R: a quarter of the difference at 4 times the radius, up to (8 mm / 0.1 m)^2.
    assert far == pytest.approx(near / 4, rel=0.1)
    assert far < 0.1


@pytest.mark.parametrize(
    ("ratios", "message"),
    [
        ((1.0 - 0.1j, 1.0), "density_ratio: .* imaginary part >= 0"),
        ((1.0, 1.0 + 0.1j), "speed_ratio: .* imaginary part <= 0"),
        ((1.0 + 0.5j, 1.0), "speed_ratio: 1.0; .* imaginary part <= 0; it is"),
        ((-1.0, 1.0), "density_ratio: -1.0; must be finite and > 0"),
    ],
)
def test_fluids_that_add_energy_are_refused(ratios, message):
    with pytest.raises(ValueError, match=message):
        analytic.step_coefficients(0.0, *ratios)
    with pytest.raises(ValueError, match=message):
        fluid_sphere(*ratios)(OUTSIDE, SOURCES)


def test_points_and_sources_that_no_series_reaches_are_refused():
    with pytest.raises(ValueError, match=r"1e-05 m off the sphere.*0.001 m or more"):
        analytic.rigid_sphere([[0, 0, 1 + 1e-5]], [[0, 0, 1 + 1e-5]], 1.0, (0, 0, 0), 1.0, scattered=True)
