"""Point sources at planes, slabs and spheres: energy, boundary conditions and limits; all in float64."""

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


@pytest.mark.parametrize(("density_ratio", "speed_ratio"), [*FLUIDS, (3.0, 4.3)])
def test_slab_conserves_energy_and_sums_its_echoes(density_ratio, speed_ratio):
    reflected, transmitted = coefficients(ANGLES, density_ratio, speed_ratio, THICKNESS)
    power = reflected.abs() ** 2 + transmitted.abs() ** 2
    # Rounding, magnified at resonances and where cos is small.
    assert torch.allclose(power, torch.ones_like(power), rtol=0, atol=1e-10)
    step, _ = coefficients(ANGLES, density_ratio, speed_ratio)
    inner = K * torch.sqrt(1 / speed_ratio**2 - torch.sin(ANGLES).to(torch.complex128) ** 2)
    pass_once = torch.exp(1j * inner * THICKNESS)
    echoes = 1 - step**2 * pass_once**2
    assert torch.allclose(transmitted, (1 - step**2) * pass_once / echoes, rtol=0, atol=1e-10)
    assert torch.allclose(reflected, step * (1 - pass_once**2) / echoes, rtol=0, atol=1e-10)


@pytest.mark.parametrize(("density_ratio", "speed_ratio"), ABSORBING)
def test_absorbing_slabs_absorb_and_sum_their_echoes(density_ratio, speed_ratio):
    reflected, transmitted = coefficients(ANGLES, density_ratio, speed_ratio, THICKNESS)
    assert (reflected.abs() ** 2 + transmitted.abs() ** 2 < 1).all()
    outer = torch.cos(ANGLES)
    inner = torch.sqrt(1 / speed_ratio**2 - torch.sin(ANGLES).to(torch.complex128) ** 2)
    step = (density_ratio * outer - inner) / (density_ratio * outer + inner)
    # Rounding, magnified where cos is small.
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
@pytest.mark.parametrize("fluid", [*FLUIDS, (3.0, 0.5), *ABSORBING])
def test_layers_are_reciprocal(layer, fluid):
    first = above_plane([1e-3, 0.02])[0]
    second = above_plane([5e-4, 0.03])[1:].reshape(-1, 3)
    forth, back = layer(*fluid)(first, second), layer(*fluid)(second, first)
    assert relative(forth - back.T, first, second) < 1e-10


def test_slab_is_reciprocal_from_front_to_back():
    """Seen from behind, the slab is itself with its normal turned."""
    front, back = above_plane([0.01, 0.002])[0], above_plane([-0.01, -0.03])[1]
    behind = above_plane([-THICKNESS])[0, 0].tolist()
    turned = tuple(-entry for entry in NORMAL)
    there = fluid_slab(77, 1)(back, front)
    here = analytic.fluid_slab(front, back, K, behind, turned, THICKNESS, 77, 1)
    assert relative(there - here.T, back, front) < 1e-10


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


def test_points_and_sources_that_no_series_reaches_are_refused():
    with pytest.raises(ValueError, match=r"1e-05 m off the sphere.*0.001 m or more"):
        analytic.rigid_sphere([[0, 0, 1 + 1e-5]], [[0, 0, 1 + 1e-5]], 1.0, (0, 0, 0), 1.0, scattered=True)
