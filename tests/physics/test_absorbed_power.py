"""Power that obstacles and reflectors absorb: exact values, and the flow through a surface around a body."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import spherical_jn, spherical_yn

import autdtorch as at
from autdtorch.analytic.spherical_waves import sphere_coefficients

AIR = at.Medium(1.2, 343.0)
FREQUENCY = 40e3
FLOOR = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
BALL = at.Sphere((0.0, 0.0, 25e-3), 5e-3, density=2.0, sound_speed=300.0, absorption=300.0)
BLOCK = at.Box((16e-3, 0.0, 25e-3), (8e-3, 8e-3, 5e-3), impedance=2.0)
POINTS = [[0.0, 0.0, 45e-3]]


def scene_of(array, obstacles=(), reflectors=()):
    """A scene with one control point."""
    return at.Scene(array, AIR, FREQUENCY, POINTS, obstacles, reflectors=reflectors)


def monopole(place=(5e-3, 2e-3, 12e-3)):
    """One point transducer of strength 1 Pa m."""
    return at.TransducerArray([place], (0.0, 0.0, 1.0), source_strength=1.0, radius=0)


def unit(count):
    """The drive of all transducers in phase."""
    return torch.ones(count, dtype=torch.complex128)


@pytest.mark.parametrize("reflection", [0.8, 0.3, -0.5, 0.0])
def test_a_plane_absorbs_its_share_of_half_the_power_of_a_monopole(reflection):
    """A monopole S e^{ikr}/r sends pi S^2 / (rho c) to either side; quadrature alone, 1e-10."""
    propagator = at.make_propagator(scene_of(monopole(), reflectors=[at.Reflector(*FLOOR, reflection)]))
    power = propagator.absorbed_power(unit(1))
    exact = (1 - reflection**2) * math.pi / (AIR.density * AIR.sound_speed)
    assert power.obstacles.shape == (0,)
    assert float(power.reflectors[0]) == pytest.approx(exact, rel=1e-10)


def test_a_plane_beside_a_rigid_one_absorbs_what_the_image_sends_too():
    """Far from the corner the two monopoles interfere: their power by the sinc of their distance."""
    wall = at.Reflector((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    reflectors = [at.Reflector(*FLOOR, 0.5), wall]
    propagator = at.make_propagator(scene_of(monopole((3e-3, 0.0, 12e-3)), reflectors=reflectors))
    power = propagator.absorbed_power(unit(1)).reflectors
    apart = 2 * math.pi * FREQUENCY / AIR.sound_speed * 6e-3
    # two coherent monopoles side by side send the same power up and down
    exact = 0.75 * math.pi / (AIR.density * AIR.sound_speed) * 2 * (1 + math.sin(apart) / apart)
    assert float(power[0]) == pytest.approx(exact, rel=1e-10)
    assert float(power[1]) == 0


@pytest.mark.parametrize("reflection", [None, 0.5])
def test_power_is_what_flows_through_a_sphere_around_the_body(reflection):
    """The flow into a sphere of 14 mm, by pressures 0.02 mm inside and outside.

    On a grid both are equal, but for the kernels of points: these are good to 0.03 % of the flow in and out,
    which is eight times as large. Next to its image the body counts as scatterer again and again.
    """
    reflectors = [] if reflection is None else [at.Reflector(*FLOOR, reflection)]
    matched = at.Sphere(BALL.center, 5e-3, impedance=1.0)
    scene = scene_of(monopole((25e-3, 10e-3, 10e-3)), [matched], reflectors)
    propagator = at.make_propagator(scene, "box", 1.5e-3, tolerance=1e-4)
    power = propagator.absorbed_power(unit(1)).obstacles
    directions = at.sphere_points((0.0, 0.0, 0.0), 1.0, 600)
    half, radius = 0.02e-3, 14e-3
    center = torch.tensor(BALL.center, dtype=torch.float64)
    low, high = (propagator.field(unit(1), center + (radius + step) * directions) for step in (-half, half))
    velocity = (high - low) / (2 * half) / (1j * scene.angular_frequency * AIR.density)
    flow = -0.5 * ((low + high).conj() / 2 * velocity).real.mean() * 4 * np.pi * radius**2
    assert float(power[0]) == pytest.approx(float(flow), rel=3e-3 if reflection is None else 1e-2)


def power_by_series(ball, source):
    """The power [W] that a sphere absorbs of a monopole of strength 1 Pa m, by its partial waves.

    Of incoming d_l h2_l, all but |1 + 2 T_l|^2 is absorbed; d_l = 4 pi k h_l(ks) Y_lm / 2.
    """
    wavenumber, orders = 2 * math.pi * FREQUENCY / AIR.sound_speed, np.arange(25)
    ratios = {"impedance": ball.impedance}
    if (fluid := ball.fluid_at(FREQUENCY)) is not None:
        ratios = {"density_ratio": fluid[0] / AIR.density, "speed_ratio": fluid[1] / AIR.sound_speed}
    waves = sphere_coefficients(24, wavenumber * ball.radius, **ratios)
    reach = wavenumber * math.dist(ball.center, source)
    incoming = np.abs(spherical_jn(orders, reach) + 1j * spherical_yn(orders, reach)) ** 2
    absorbed = (2 * orders + 1) * incoming * (1 - np.abs(1 + 2 * waves) ** 2)
    return absorbed.sum() * math.pi / (2 * AIR.density * AIR.sound_speed)


@pytest.mark.parametrize(
    ("material", "tolerance"),
    [
        (at.porous(200e3, FREQUENCY, AIR), 0.01),
        ({"density": 2.0, "sound_speed": 300.0, "absorption": 300.0}, 0.01),
        ({"impedance": 2.0}, 0.01),
    ],
)
def test_spheres_absorb_the_power_of_their_series(material, tolerance):
    source = 5e-3, 2e-3, 2e-3
    ball = at.Sphere(BALL.center, 5e-3, **material)
    power = at.make_propagator(scene_of(monopole(source), [ball]), "box", 1e-3).absorbed_power(unit(1))
    assert float(power.obstacles[0]) == pytest.approx(power_by_series(ball, source), rel=tolerance)


@settings(deadline=None, max_examples=10)
@given(
    radius=st.floats(1e-3, 8e-3),
    density=st.floats(0.5, 1000),
    sound_speed=st.floats(200, 600),
    absorption=st.floats(10, 300),
)
def test_t_matrices_of_spheres_absorb_the_power_of_their_series(radius, density, sound_speed, absorption):
    """However dense they are; waves are left out at 1e-6."""
    material = {"density": density, "sound_speed": sound_speed, "absorption": absorption}
    ball, source = at.Sphere(BALL.center, radius, **material), (5e-3, 2e-3, 2e-3)
    propagator = at.make_propagator(scene_of(monopole(source), [ball]), "tmatrix", tolerance=1e-6)
    power = propagator.absorbed_power(unit(1)).obstacles[0]
    assert float(power) == pytest.approx(power_by_series(ball, source), rel=1e-4)


def test_bodies_absorb_nothing_of_what_the_air_beside_them_does():
    """T-matrices of spheres are exact beside others, before a plane and in air that absorbs; cells of 1.3 mm:
    3 %."""
    balls = [BALL, at.Sphere((-14e-3, 0.0, 25e-3), 4e-3, impedance=1.5 + 0.5j)]
    air = replace(AIR, absorption=20.0)
    scene = replace(scene_of(monopole(), balls, [at.Reflector(*FLOOR)]), medium=air)
    exact, grid = (
        at.make_propagator(scene, method, 1.3e-3).absorbed_power(unit(1)).obstacles
        for method in ("tmatrix", "box")
    )
    assert torch.allclose(exact, grid, rtol=0.03, atol=0)


def test_a_body_taken_as_rigid_still_absorbs():
    """Tissue is rigid to 0.3 %; for the power that it absorbs, 1e-4 of foam's, its material is simulated.

    10 % at 0.5 mm (6 % measured): the pressure inside a body that is 3,600 times as stiff as air.
    """
    tissue = at.Sphere(BALL.center, 5e-3, density=1000.0, sound_speed=1500.0, absorption=200.0)
    source = 5e-3, 2e-3, 2e-3
    propagator = at.make_propagator(scene_of(monopole(source), [tissue]), "box", 0.5e-3, tolerance=1e-2)
    assert propagator.plan.region.bodies[0].fluid is None
    power = propagator.absorbed_power(unit(1))
    assert float(power.obstacles[0]) == pytest.approx(power_by_series(tissue, source), rel=0.1)


def test_power_of_a_second_call_is_the_first():
    """Stored runs serve both: a body taken as rigid for the field, and the radiation to a plane."""
    tissue = at.Sphere(BALL.center, 3e-3, density=1000.0, sound_speed=1500.0, absorption=200.0)
    scene = scene_of(monopole(), [tissue], [at.Reflector(*FLOOR, 0.5)])
    propagator = at.make_propagator(scene, "box", 2e-3, tolerance=1e-2)
    first, second = (propagator.absorbed_power(unit(1)) for _ in range(2))
    assert torch.equal(first.obstacles, second.obstacles)
    assert torch.equal(first.reflectors, second.reflectors)
    assert float(first.reflectors[0]) > 0


def test_box_and_domain_absorb_alike_and_what_is_rigid_absorbs_nothing():
    """Two grids of 1.8 mm: 2 %, the error of either for small bodies; 1 % measured."""
    rigid = at.Sphere((-14e-3, 0.0, 25e-3), 4e-3, rigid=True)
    scene = scene_of(monopole(), [BALL, BLOCK, rigid], [at.Reflector(*FLOOR)])
    box, full = (
        at.make_propagator(scene, method, 1.8e-3).absorbed_power(unit(1)) for method in ("box", "full")
    )
    np.testing.assert_allclose(box.obstacles[:2], full.obstacles[:2], rtol=2e-2)
    assert float(box.obstacles[2]) == float(full.obstacles[2]) == 0


@pytest.mark.parametrize(
    ("core", "least"),
    [
        (at.Sphere(BALL.center, 3e-3, density=2.0, sound_speed=300.0, absorption=300.0), 0.85),
        (at.Sphere(BALL.center, 3e-3, impedance=2.0), 0.97),
        (at.Box(BALL.center, (4e-3,) * 3, impedance=2.0), 0.97),
    ],
    ids=["fluid", "surface", "surface along the grid"],
)
@pytest.mark.filterwarnings("ignore:.*overlaps")
def test_a_core_in_a_fluid_that_hardly_absorbs_absorbs_nearly_all(core, least):
    """Cells that a fluid's face cuts, a tenth, count for either side of it."""
    shell = at.Sphere(BALL.center, 5e-3, density=2.0, sound_speed=300.0, absorption=1e-2)
    outer, inner = (
        at.make_propagator(scene_of(monopole(), [shell, core]), "box", 1e-3)
        .absorbed_power(unit(1))
        .obstacles.tolist()
    )
    assert inner > least * (outer + inner)
    assert outer > 0


def test_power_of_several_drives_is_quadratic_and_silence_absorbs_nothing():
    """Half the amplitude is a quarter of the power: single precision of a run, 1e-4."""
    propagator = at.make_propagator(scene_of(monopole(), [BALL]), "box", 2e-3)
    drives = torch.tensor([[[1.0 + 0j], [0.5j]], [[0.0], [1.0j]]])
    power = propagator.absorbed_power(drives).obstacles[..., 0]
    assert power.shape == (2, 2)
    expected = float(power[0, 0]) * np.array([[1, 0.25], [0, 1]])
    np.testing.assert_allclose(power, expected, rtol=1e-4)


@pytest.mark.parametrize("reflections", [(0.5j,), (0.5, 0.5)])
def test_power_that_is_not_known_is_refused(reflections):
    """A complex factor, and planes that face each other."""
    planes = [FLOOR, ((0.0, 0.0, 60e-3), (0.0, 0.0, -1.0))]
    reflectors = [at.Reflector(*plane, each) for plane, each in zip(planes, reflections, strict=False)]
    propagator = at.make_propagator(scene_of(monopole(), reflectors=reflectors))
    with pytest.raises(ValueError, match=r"reflectors\[0\]"):
        propagator.absorbed_power(unit(1))
