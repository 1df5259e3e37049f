"""Free-space fields: Green's function, discs, and transducers that differ in strength and size."""

import cmath
import math

import numpy as np
import pytest
import torch
from exact_fields import WAVELENGTH, K
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from small_scenes import AIR, CUBE, relative_error, small_scene

import autdtorch as at
from autdtorch.analytic.green import piston_directivity, piston_field, piston_on_axis
from autdtorch.propagators import differentiable_field, make_propagator
from autdtorch.propagators.free_space import free_space_matrix
from autdtorch.scene.arrays import TransducerArray, radii_of, strengths_of
from autdtorch.scene.obstacles import Sphere
from autdtorch.scene.scene import Scene
from autdtorch.utils.spatial import distances

PISTON = 5e-3
points = hnp.arrays(float, (5, 3), elements=st.floats(-0.1, 0.1))
ARRAY = at.TransducerArray.grid((4, 4), pitch=10e-3, center=(1e-3, 50e-3, 50e-3), source_strength=0.7)


def test_matrix_is_equation_2_term_by_term_and_falls_with_absorption():
    targets = [(80e-3, 50e-3, 50e-3), (80e-3, 20e-3, 50e-3), (33e-3, 1e-3, 99e-3)]
    matrix = free_space_matrix(targets, ARRAY, K)
    for row, target in zip(matrix.tolist(), targets, strict=True):
        for entry, source in zip(row, ARRAY.positions.tolist(), strict=True):
            r = math.dist(target, source)
            # Phases reach k r = 80 rad: 1e-14 of rounding.
            wave = cmath.exp(1j * K * r) / r  # outgoing, with e^{-i w t}
            assert cmath.isclose(entry, 0.7 * wave, rel_tol=1e-13)
            assert cmath.isclose(at.green([target], [source], K).item(), wave / (4 * math.pi), rel_tol=1e-13)
    targets, alpha = [(80e-3, 50e-3, 50e-3), (33e-3, 1e-3, 99e-3)], 4.6
    lossless = free_space_matrix(targets, ARRAY, K)
    path = distances(torch.tensor(targets, dtype=torch.float64), ARRAY.positions)
    lossy = free_space_matrix(targets, ARRAY, complex(K, alpha))
    torch.testing.assert_close(lossy, lossless * torch.exp(-alpha * path), rtol=1e-14, atol=0)


def around_a_disc(radius, normal, apart, over, generator):
    """Points at a distance from the rim, at all angles, and so far above the disc or below."""
    normal = torch.tensor(normal, dtype=torch.float64) / math.hypot(*normal)
    across = torch.linalg.cross(normal, torch.eye(3, dtype=torch.float64)[normal.abs().argmin()])
    across /= across.norm()
    turns = 2 * math.pi * torch.rand((20, 2, 1), generator=generator, dtype=torch.float64)
    radial = torch.cos(turns[:, 0]) * across + torch.sin(turns[:, 0]) * torch.linalg.cross(normal, across)
    beside = (radius + apart * torch.cos(turns[:, 1])) * radial + apart * torch.sin(turns[:, 1]) * normal
    inside = radius * torch.rand((20, 1), generator=generator, dtype=torch.float64) * radial + over * normal
    return torch.cat([beside, inside])


@given(
    size=st.floats(0.5, 40.0),
    normal=st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda n: math.hypot(*n) > 0.1),
    apart=st.floats(math.log(1e-4), math.log(100 * WAVELENGTH)).map(math.exp),
    seed=st.integers(0, 1000),
)
@settings(max_examples=6)
def test_a_disc_is_rayleighs_integral(size, normal, apart, seed):
    """At any k a, 0.1 mm off the rim or the disc and more, relative to the largest pressure so far off."""
    radius, place = size / K, torch.tensor([0.01, -0.02, 0.03], dtype=torch.float64)
    disc = at.TransducerArray(place[None], normal, source_strength=0.7, radius=radius)
    points = place + around_a_disc(radius, normal, apart, apart, torch.Generator().manual_seed(seed))
    exact = 4 * math.pi * 0.7 * piston_field(points, place[None], K, radius, normal)
    for some, pressure in zip(exact.chunk(2), free_space_matrix(points, disc, K).chunk(2), strict=True):
        # 1e-8 of a point of its strength is left out, next to a disc 4e-9 of the largest was measured
        tolerance = 1e-7 * some.abs().max() + 1e-8 / (radius + apart)
        assert (pressure - some).abs().max() < tolerance


@pytest.mark.parametrize("wavenumber", [complex(K), complex(K, 0.3)])
def test_a_disc_in_absorbing_air_is_the_mean_over_it(wavenumber):
    """Gauss quadrature in radius, trapezoids in angle: 1e-10 at half a radius from the disc."""
    radius = 4.5e-3
    nodes, weights = np.polynomial.legendre.leggauss(60)
    turns = 2 * math.pi * np.arange(120) / 120
    spokes = radius * np.sqrt((nodes + 1) / 2)
    grid = np.stack([np.outer(spokes, np.cos(turns)), np.outer(spokes, np.sin(turns))], axis=-1)
    grid = np.pad(grid.reshape(-1, 2), ((0, 0), (0, 1)))
    mean = torch.tensor(np.repeat(weights / 240, 120), dtype=torch.complex128)
    points = [[0.0, 0.0, 3e-3], [3e-3, 3e-3, -3e-3], [8e-3, 0.0, 0.0], [0.02, 0.03, 0.1]]
    disc = at.TransducerArray([[0, 0, 0]], (0, 0, 1), source_strength=1.0, radius=radius)
    exact = 4 * math.pi * at.green(points, grid, wavenumber) @ mean
    assert ((free_space_matrix(points, disc, wavenumber)[:, 0] - exact) / exact).abs().max() < 1e-7


def test_fields_of_discs_are_differentiable_by_points():
    """Backward, twice, and forward; on the axis, next to a rim and far away."""
    array = at.TransducerArray([[0, 0, 0], [0.02, 0, 0]], (0, 0, 1), 1.0, torch.tensor([6e-3, 4e-3]).double())
    points = torch.tensor([[0, 0, 2e-3], [7e-3, 1e-3, 1e-3], [0.03, 0.05, 0.1]], dtype=torch.float64)

    def field(points):
        return free_space_matrix(points, array, complex(K, 0.3))

    points.requires_grad_()
    assert torch.autograd.gradcheck(field, points, eps=1e-7, fast_mode=True)
    assert torch.autograd.gradgradcheck(field, points, eps=1e-7, fast_mode=True)
    moved = torch.randn((3, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    _, slope = torch.func.jvp(field, (points.detach(),), (moved,))
    step = 1e-7 * moved
    expected = (field(points.detach() + step) - field(points.detach() - step)) / 2e-7
    assert relative_error(slope, expected) < 1e-6
    assert torch.func.jacfwd(lambda at: field(at).abs())(points.detach()).shape == (3, 2, 3, 3)


@given(
    focus=hnp.arrays(float, 3, elements=st.floats(5e-3, 0.1)),
    phases=hnp.arrays(float, 16, elements=st.floats(0, 2 * math.pi)),
)
def test_equation_3_puts_every_contribution_in_phase_at_the_focus(focus, phases):
    row = free_space_matrix(focus[None], ARRAY, K)[0]
    limit = (0.7 / distances(torch.from_numpy(focus[None]), ARRAY.positions)).sum()
    focused = row @ at.drive_from_phases(at.focus_phases(ARRAY.positions, focus, K))
    # Phases reach k r = 130 rad: 3e-14 of rounding; the sum of S/r is real, so the phase of p is zero too.
    torch.testing.assert_close(focused, limit.to(torch.complex128), rtol=1e-13, atol=0)
    # No other phases do better.
    assert (row @ at.drive_from_phases(phases)).abs() <= limit * (1 + 1e-13)


def test_piston_on_its_axis_is_the_closed_form_near_and_far():
    z = torch.tensor([0.0, 1e-4, 5e-3, 0.1, 3.0, 1e3], dtype=torch.float64)
    points = torch.stack([z, 0 * z, 0 * z], dim=1)
    field = piston_field(points, [[0.0, 0.0, 0.0]], K, PISTON, (2.0, 0.0, 0.0))[:, 0]
    exact = piston_on_axis(z, K, PISTON)
    # Rounding of k z = 7e5 at the farthest.
    assert torch.allclose(field, exact, rtol=1e-9, atol=0)
    difference = torch.exp(1j * K * torch.hypot(z, 0 * z + PISTON)) - torch.exp(1j * K * z)
    # The difference of two waves loses digits far away, as 1 / z.
    assert torch.allclose(exact[:4], (difference / (2j * math.pi * K * PISTON**2))[:4], rtol=1e-10, atol=0)
    # Fresnel's phase k a^2 / 4z = 5e-6 is left at 1 km.
    assert abs(field[-1] / at.green(points[-1:], [[0.0, 0.0, 0.0]], K) - 1) < 1e-5


@pytest.mark.parametrize("reach", [0.1, 3.7, 30.0])
def test_piston_far_away_is_its_directivity(reach):
    """At 1e5 a^2 / wavelength and 1e4 wavelengths, Fresnel's phase and the 1 / (k r) terms are below 1e-4."""
    radius = reach / K
    distance = 1e4 * WAVELENGTH * max(1, reach**2)
    angle = torch.linspace(1e-3, math.pi / 2, 9, dtype=torch.float64)
    points = distance * torch.stack([torch.sin(angle), 0 * angle, torch.cos(angle)], dim=1)
    field = piston_field(points, [[0.0, 0.0, 0.0]], K, radius, (0.0, 0.0, 1.0))
    ratio = (field / at.green(points, [[0.0, 0.0, 0.0]], K))[:, 0]
    assert (ratio - piston_directivity(angle, K, radius)).abs().max() < 1e-4


WAVENUMBER = 2 * math.pi * 40e3 / 340.0
UNEQUAL = torch.tensor([0.5, 1.0, 1.0, 3.0], dtype=torch.float64)
RADII = torch.tensor([0.0, 2e-3, 4e-3, 2e-3], dtype=torch.float64)
BALL = Sphere(CUBE.center, 3e-3, rigid=True)
# The same runs are multiplied by other numbers: two roundings
ROUNDING = 1e-15


def with_array(strength, radius=0.0, obstacles=(BALL,)):
    base = small_scene(obstacles)
    array = TransducerArray(base.array.positions, (1, 0, 0), strength, radius)
    return Scene(array, AIR, 40e3, base.control_points, obstacles, domain=base.domain)


def matrix_of(scene, method, points=None):
    settings = {} if method in ("free_space", "tmatrix") else {"dtype": "float64", "cache": False}
    propagator = make_propagator(scene, method, **({"spacing": 1.3e-3} | settings))
    return propagator.transfer_matrix(points)


@pytest.mark.parametrize("method", ["free_space", "full", "box", "tmatrix"])
def test_a_strength_scales_its_column(method):
    obstacles = () if method == "free_space" else (BALL,)
    unit, found = (matrix_of(with_array(s, obstacles=obstacles), method) for s in (1.0, UNEQUAL))
    assert relative_error(found, unit * UNEQUAL) < ROUNDING


def test_kept_fields_of_unequal_transducers_are_those_of_drives():
    """Points that follow take sums of kept fields: first of drives, then of all transducers."""
    scene = with_array(UNEQUAL)
    propagator = make_propagator(scene, "box", 1.3e-3, tolerance=1e-5, dtype="float64", cache=False)
    drive = torch.polar(torch.ones(4, dtype=torch.float64), torch.arange(4, dtype=torch.float64))
    beyond = scene.control_points + torch.tensor([20e-3, 0.0, 0.0])
    by_drive = propagator.field(drive, beyond)
    matrix = propagator.transfer_matrix(torch.cat([beyond, beyond + 1e-3, beyond + 2e-3]))
    # Runs of single transducers and of a drive end at other distances from the steady state.
    assert relative_error(matrix[:3] @ drive, by_drive) < 1e-4
    equal = make_propagator(with_array(1.0), "box", 1.3e-3, tolerance=1e-5, dtype="float64", cache=False)
    equal.field(drive, beyond)
    expected = equal.transfer_matrix(torch.cat([beyond, beyond + 1e-3, beyond + 2e-3])) * UNEQUAL
    assert relative_error(matrix, expected) < ROUNDING


@pytest.mark.filterwarnings("ignore::autdtorch.SteadyStateWarning")
def test_the_differentiable_field_takes_strengths_as_amplitudes():
    drive = torch.tensor([1.0, 0.5j, -0.2, 0.1], dtype=torch.complex128)
    settings = {"spacing": 1.3e-3, "periods": 4, "dtype": "float64"}
    found = differentiable_field(with_array(UNEQUAL / 3, obstacles=()), drive, **settings)
    expected = differentiable_field(with_array(1.0, obstacles=()), drive * UNEQUAL / 3, **settings)
    assert relative_error(found, expected) < 1e-12


def piston(angle, radius):
    return float(piston_directivity([angle], WAVENUMBER, radius).real) if radius else 1.0


@settings(max_examples=30)
@given(st.lists(st.floats(0.0, 6.0), min_size=2, max_size=4), st.floats(0.0, math.pi))
def test_each_radius_has_the_directivity_of_its_piston(sizes, angle):
    """S e^{ikr}/r 2 J1(ka sin t)/(ka sin t), with ka of each transducer."""
    positions = [(0, 0.1 * number, 0) for number in range(len(sizes))]
    array = TransducerArray(positions, (1, 0, 0), 0.7, torch.tensor(sizes).double() / WAVENUMBER)
    distance = 1e5
    way = torch.tensor([math.cos(angle), 0, math.sin(angle)], dtype=torch.float64)
    for number, (place, radius) in enumerate(zip(array.positions, radii_of(array), strict=True)):
        pressure = complex(free_space_matrix((place + distance * way)[None], array, WAVENUMBER)[0, number])
        exact = 0.7 * piston(angle, float(radius))
        # Fresnel's phase and the 1 / kr terms are below 1e-7 there, the waves left out 1e-8
        assert abs(pressure * distance * cmath.exp(-1j * WAVENUMBER * distance) - exact) < 1e-6


@pytest.mark.parametrize("method", ["free_space", "box", "tmatrix"])
def test_each_radius_counts_as_in_an_array_of_its_own(method):
    """Columns are those of arrays whose transducers are all as large as this one, also far away."""
    obstacles = () if method == "free_space" else (BALL,)
    scene = with_array(1.0, RADII, obstacles)
    points = torch.cat([scene.control_points, scene.control_points + torch.tensor([0.3, 0.1, 0.0])])
    points = points[:3] if method == "tmatrix" else points
    found = matrix_of(scene, method, points)
    for column, radius in enumerate(RADII.tolist()):
        alike = matrix_of(with_array(1.0, radius, obstacles), method, points)
        # Boxes in double precision; a run's own convergence differs.
        assert relative_error(found[:, column], alike[:, column]) < 3e-4


def test_many_pairs_are_computed_as_few():
    """By compiled code, with images: a panel beside the array, a plane that absorbs."""
    scene = with_array(1.0, RADII)
    planes = [at.Reflector((0, 0, -0.1), (0, 0, 1)), at.Reflector((0, -0.2, 0), (0, 1, 0), 0.5)]
    scene = Scene(scene.array, AIR, 40e3, scene.control_points, reflectors=planes)
    many = 0.05 + 0.3 * torch.rand((9000, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    matrix = free_space_matrix(many, scene.array, scene.complex_wavenumber, scene.images)
    few = free_space_matrix(many[:50], scene.array, scene.complex_wavenumber, scene.images)
    assert relative_error(matrix[:50], few) < 1e-8


@given(
    st.lists(st.tuples(st.floats(1e-3, 1e3), st.floats(0, 4e-3)), min_size=1, max_size=5),
    st.lists(st.tuples(st.floats(1e-3, 1e3), st.floats(0, 4e-3)), min_size=1, max_size=5),
)
def test_joined_arrays_have_the_columns_of_both(first, second):
    boards = [
        TransducerArray([(0, 0.01 * n, z) for n in range(len(each))], (1, 0, 0), *zip(*each, strict=True))
        for each, z in ((first, 0.0), (second, 0.02))
    ]
    joined = boards[0] + boards[1]
    points = [(0.05, 0.01, 0.0), (0.08, 0.0, 0.03)]
    both = torch.cat([free_space_matrix(points, board, WAVENUMBER) for board in boards], dim=1)
    # the nearest point and disc decide how many waves are summed: up to 1e-8 is left out
    assert relative_error(free_space_matrix(points, joined, WAVENUMBER), both) < 2e-8
    assert torch.equal(strengths_of(joined), torch.cat([strengths_of(board) for board in boards]))
    assert torch.equal(radii_of(joined), torch.cat([radii_of(board) for board in boards]))


def test_discs_of_unequal_radii_may_touch_but_not_overlap():
    places = [(0, 0, 0), (0, 10e-3, 0), (0, 0, 30e-3)]
    TransducerArray(places, (1, 0, 0), radius=[7e-3, 3e-3, 0.0])
    with pytest.raises(ValueError, match=r"radius\[0\]: 0.007 m; .* transducer 1, 0.0031 m"):
        TransducerArray(places, (1, 0, 0), radius=[7e-3, 3.1e-3, 0.0])
    with pytest.raises(ValueError, match=r"radius\[0\].*transducer 1, 0 m"):
        TransducerArray(places, (1, 0, 0), radius=[11e-3, 0.0, 1e-3])


def test_arrays_have_their_own_copies_by_which_scenes_are_equal():
    assert with_array(UNEQUAL, RADII).equals(with_array(UNEQUAL.clone(), RADII.clone()))
    assert not with_array(UNEQUAL, RADII).equals(with_array(UNEQUAL, RADII.flip(0)))
    assert not with_array(UNEQUAL, RADII).equals(with_array(UNEQUAL.flip(0), RADII))
    assert not with_array(UNEQUAL).equals(with_array(1.0))
    strength, radius = UNEQUAL.clone(), RADII.clone()
    array = with_array(strength, radius).array
    strength[0], radius[0] = -1.0, 1.0
    assert torch.equal(strengths_of(array), UNEQUAL)
    assert torch.equal(radii_of(array), RADII)
