"""Point sources at planes and slabs: energy, boundary conditions and limits; all in float64."""

import math
from functools import partial

import pytest
import torch
from exact_fields import ABSORBING, FLUIDS, SLOPE_TOLERANCE, STEP, WAVELENGTH, K, relative, sampled, slope

from autdtorch import analytic
from autdtorch.analytic.green import green

ORIGIN = (0.002, 0.001, -0.003)
NORMAL = (0.3, -0.5, 0.9)
THICKNESS = 6e-3


def above_plane(heights, lateral=((0.0, 0.0), (0.01, -0.004), (0.1, 0.03))):
    """Points at several heights over ORIGIN and beside it: (place, height, 3)."""
    normal = torch.nn.functional.normalize(torch.tensor(NORMAL, dtype=torch.float64), dim=0)
    across = torch.linalg.cross(normal, torch.tensor([1.0, 0, 0]).double())
    first = torch.nn.functional.normalize(across, dim=0)
    second = torch.linalg.cross(normal, first)
    beside = torch.tensor(lateral, dtype=torch.float64) @ torch.stack([first, second])
    up = torch.tensor(heights, dtype=torch.float64)[:, None] * normal
    return torch.tensor(ORIGIN, dtype=torch.float64) + beside[:, None] + up


def fluid_half_space(density_ratio, speed_ratio):
    ratios = {"density_ratio": density_ratio, "speed_ratio": speed_ratio}
    return partial(analytic.fluid_half_space, wavenumber=K, origin=ORIGIN, normal=NORMAL, **ratios)


def fluid_slab(density_ratio, speed_ratio, thickness=THICKNESS):
    ratios = {"density_ratio": density_ratio, "speed_ratio": speed_ratio, "thickness": thickness}
    return partial(analytic.fluid_slab, wavenumber=K, origin=ORIGIN, normal=NORMAL, **ratios)


ANGLES = torch.linspace(0, 1.55, 32, dtype=torch.float64)


def coefficients(angle, *layering):
    ratios, thickness = layering[:2], layering[2:]
    if thickness:
        return analytic.slab_coefficients(angle, K, *thickness, *ratios)
    return analytic.step_coefficients(angle, *ratios)


@pytest.mark.parametrize(("density_ratio", "speed_ratio"), [*FLUIDS, (3.0, 4.3)])
def test_step_conserves_energy_and_reflects_all_beyond_the_critical_angle(density_ratio, speed_ratio):
    reflected, transmitted = coefficients(ANGLES, density_ratio, speed_ratio)
    sine = speed_ratio * torch.sin(ANGLES)
    cosine = torch.sqrt((1 - sine**2).clamp(min=0))
    flux = transmitted.abs() ** 2 * cosine / (density_ratio * speed_ratio * torch.cos(ANGLES))
    # Rounding, magnified where cos is small.
    assert torch.allclose(reflected.abs() ** 2 + flux, torch.ones_like(flux), rtol=0, atol=1e-12)
    assert torch.allclose(1 + reflected, transmitted, rtol=0, atol=1e-12)
    # At normal incidence only impedances count.
    ratio = density_ratio * speed_ratio
    assert reflected[0].item() == pytest.approx((ratio - 1) / (ratio + 1), abs=1e-12)


@pytest.mark.parametrize("fluid", [*FLUIDS, (3.0, 4.3), *ABSORBING])
def test_slab_conserves_or_absorbs_energy_and_sums_its_echoes(fluid):
    density_ratio, speed_ratio = fluid
    reflected, transmitted = coefficients(ANGLES, density_ratio, speed_ratio, THICKNESS)
    power = reflected.abs() ** 2 + transmitted.abs() ** 2
    # Rounding, magnified at resonances and where cos is small.
    lossless = torch.allclose(power, torch.ones_like(power), rtol=0, atol=1e-10)
    assert (power < 1).all() if fluid in ABSORBING else lossless
    inner = torch.sqrt(1 / speed_ratio**2 - torch.sin(ANGLES).to(torch.complex128) ** 2)
    outer = torch.cos(ANGLES)
    step = (density_ratio * outer - inner) / (density_ratio * outer + inner)
    assert torch.allclose(coefficients(ANGLES, density_ratio, speed_ratio)[0], step, rtol=0, atol=1e-12)
    pass_once = torch.exp(1j * K * inner * THICKNESS)
    echoes = 1 - step**2 * pass_once**2
    assert torch.allclose(transmitted, (1 - step**2) * pass_once / echoes, rtol=0, atol=1e-10)
    assert torch.allclose(reflected, step * (1 - pass_once**2) / echoes, rtol=0, atol=1e-10)


def test_thin_resistive_slab_is_the_impedance_of_its_backing():
    """A slab of a very slow absorbing fluid reflects as Z: (Z cos - 1) / (Z cos + 1), at all angles."""
    slow = 1e-4 - 0.5e-4j
    reflected, _ = coefficients(ANGLES, 2e4, slow, THICKNESS)
    impedance = 2e4 * slow * torch.cos(ANGLES)
    assert torch.allclose(reflected, (impedance - 1) / (impedance + 1), rtol=0, atol=1e-7)  # (c_1 / c)^2


def test_slabs_that_let_all_pass():
    reflected, transmitted = coefficients(ANGLES, 3.0, 2.0, 1e-12)
    # First order in k d = 7e-10, over cos of the last angle, 0.02.
    assert (reflected.abs() + (transmitted - 1).abs() < 1e-6).all()
    half_wave, through = coefficients(0.0, 3.0, 2.0, WAVELENGTH)
    assert abs(half_wave) < 1e-12  # rounding of sin(pi)
    assert abs(through + 1) < 1e-12
    critical = math.asin(0.5)
    at_critical, _ = coefficients(critical, 3.0, 2.0, THICKNESS)
    beside, _ = coefficients(critical + 1e-9, 3.0, 2.0, THICKNESS)
    # Smooth there: R depends on the square of the inner wavenumber, and k d = 4.
    assert abs(at_critical - beside) < 1e-7


def test_image_sources_meet_the_conditions_on_their_planes():
    sources = above_plane([0.004, 0.02])[0]
    points = above_plane([0, STEP, 2 * STEP])
    rigid = sampled(lambda points: analytic.rigid_plane(points, sources, K, ORIGIN, NORMAL), points)
    incident = sampled(lambda points: green(points, sources, K), above_plane([0]))[:, 0]
    assert ((slope(rigid) / (K * incident)).abs() < SLOPE_TOLERANCE).all()
    # Rounding of the heights, 1e-17 m, against 1e-3 m and more.
    assert ((rigid[:, 0] / incident - 2).abs() < 1e-11).all()
    soft = sampled(lambda points: analytic.soft_plane(points, sources, K, ORIGIN, NORMAL), above_plane([0]))
    assert ((soft[:, 0] / incident).abs() < 1e-11).all()


def faces(layer):
    return [0.0, -THICKNESS] if layer is fluid_slab else [0.0]


@pytest.mark.parametrize("fluid", [*FLUIDS, *ABSORBING])
@pytest.mark.parametrize("layer", [fluid_half_space, fluid_slab])
def test_pressure_and_normal_velocity_are_continuous_on_plane_faces(layer, fluid):
    density_ratio, speed_ratio = fluid
    sources = above_plane([0.004, 0.02])[0]

    def field(points):
        return layer(*fluid)(points, sources)

    gap = 1e-9
    for number, face in enumerate(faces(layer)):
        upper = sampled(field, above_plane([face + gap, face + gap + STEP, face + gap + 2 * STEP]))
        lower = sampled(field, above_plane([face - gap, face - gap - STEP, face - gap - 2 * STEP]))
        above, below = (1, density_ratio) if number == 0 else (density_ratio, 1)
        scale = upper.abs().amax(dim=(0, 1))
        # Slopes on either side of a gap of 2e-9 m are k |p| times the ratios at most: 1e-5 or so.
        assert ((upper[:, 0] - lower[:, 0]).abs() < 1e-4 * scale).all()
        jump = slope(upper) / above + slope(lower) / below
        steepest = max(1 / abs(speed_ratio), 1) ** 3 * max(1 / abs(density_ratio), 1)
        assert (jump.abs() < 10 * SLOPE_TOLERANCE * steepest * K * scale).all()


@pytest.mark.parametrize("layer", [fluid_half_space, fluid_slab])
def test_layers_of_the_medium_are_not_there_and_dense_or_light_ones_rigid_or_soft(layer):
    sources = above_plane([1e-3, 0.3])[0]
    points = above_plane([-0.2, -THICKNESS / 2, -1e-4, 0.0, 0.02]).reshape(-1, 3)
    # Behind the face the whole field is an integral, of which this is the error.
    assert relative(layer(1, 1)(points, sources, scattered=True), points, sources) < 1e-10
    sources = above_plane([1e-3, 0.02])[0]
    points = above_plane([0.0, 0.03]).reshape(-1, 3)
    image = analytic.rigid_plane(points, sources, K, ORIGIN, NORMAL, scattered=True)
    # First order in the ratio, times some 100 for the slab's resonances.
    assert relative(layer(1e9, 1.3)(points, sources, scattered=True) - image, points, sources) < 1e-6
    assert relative(layer(1e-9, 1.3)(points, sources, scattered=True) + image, points, sources) < 1e-6


@pytest.mark.parametrize(("density_ratio", "thickness"), [(77.0, THICKNESS), (77.0, 0.1), (0.05, 0.01)])
def test_slab_of_the_mediums_sound_speed_is_a_row_of_images(density_ratio, thickness):
    """Then a face reflects all angles alike, by r, and every echo is an image: no integral is needed.

    Both are resonant: echoes fall by r^2 = 0.95 (0.82), so 700 of them leave 1e-15.
    """
    sources = above_plane([1e-3, 0.02])[0]
    above = above_plane([0.0, 0.03]).reshape(-1, 3)
    below = above_plane([-thickness, -thickness - 0.02]).reshape(-1, 3)
    step = (density_ratio - 1) / (density_ratio + 1)
    normal = torch.nn.functional.normalize(torch.tensor(NORMAL, dtype=torch.float64), dim=0)
    images = sources - 2 * ((sources - normal.new_tensor(ORIGIN)) @ normal)[:, None] * normal
    reflected = step * green(above, images, K)
    transmitted = torch.zeros(len(below), len(sources), dtype=torch.complex128)
    for echo in range(700):
        echoed, way = (1 - step**2) * step ** (2 * echo), 2 * thickness * normal
        reflected -= step * echoed * green(above, images - (echo + 1) * way, K)
        transmitted += echoed * green(below, sources + echo * way, K)
    slab = fluid_slab(density_ratio, 1.0, thickness)
    assert relative(slab(above, sources, scattered=True) - reflected, above, sources) < 1e-10
    assert relative(slab(below, sources) - transmitted, below, sources) < 1e-10


@pytest.mark.parametrize("layer", [fluid_half_space, fluid_slab])
def test_far_away_the_reflected_wave_is_the_image_times_the_plane_wave_coefficient(layer):
    """Leading order of the integral (Brekhovskikh & Godin II, chapter 1): the next is some 10 / (k D)."""
    angle, length = 0.6, 7.0
    source = above_plane([length / 2 * math.cos(angle)])[0]
    point = above_plane([length / 2 * math.cos(angle)], [(length * math.sin(angle), 0.0)])[0]
    wave = layer(2.5, 0.6)(point, source, scattered=True)
    image = analytic.rigid_plane(point, source, K, ORIGIN, NORMAL, scattered=True)
    expected, _ = coefficients(angle, 2.5, 0.6, *([THICKNESS] if layer is fluid_slab else []))
    assert abs(wave / image - expected) < 10 / (K * length)


def test_field_behind_a_half_space_decays_beyond_the_critical_angle():
    """The source is far off, at 45 degrees; c_1 / c = 4.3 turns back all beyond 13 degrees.

    It decays as e^{-k depth sqrt(sin^2 - (c / c_1)^2)}, up to the curvature of the wave fronts, of order
    1 / (k D).
    """
    length = 7.0
    source = above_plane([length * math.sqrt(0.5)])[0]
    here, deeper = above_plane([-0.5e-3, -1.5e-3], [(length * math.sqrt(0.5), 0.0)])[0]
    field = fluid_half_space(2.0, 4.3)(torch.stack([here, deeper]), source)
    decay = math.exp(-K * 1e-3 * math.sqrt(0.5 - 1 / 4.3**2))
    assert abs(field[1] / field[0]) == pytest.approx(decay, rel=10 / (K * length))
