"""Transducers of different strength and size: columns scale with the strength, and a radius directs."""

import cmath
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scenes import AIR, CUBE, relative_error, small_scene

from autdtorch.analytic.green import free_space_matrix, piston_directivity
from autdtorch.fdtd.kernels.cpu_waves import superposition
from autdtorch.propagators import differentiable_field, make_propagator
from autdtorch.scene.arrays import TransducerArray, apertures_of, radii_of, strengths_of
from autdtorch.scene.obstacles import Sphere
from autdtorch.scene.scene import Scene

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
        # As for a single disc: the rule is good to 1e-6.
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
        # Far discs have a pattern, which is good to 3e-5; all columns are compared at one distance.
        assert relative_error(found[:, column], alike[:, column]) < 3e-4


def test_far_discs_of_unequal_radii_are_the_sums_of_their_nodes():
    """As sources and, by reciprocity, as receivers."""
    nodes = apertures_of(with_array(1.0, RADII).array)
    far = 0.4 + 0.1 * torch.rand((70, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert nodes.far_from(far, WAVENUMBER).all()
    amplitude = torch.tensor([[1.0], [2.0], [-1.0], [1j]], dtype=torch.complex128)
    each = (amplitude * nodes.weights).reshape(-1, 1)
    summed = superposition(far, nodes.positions.reshape(-1, 3), each, WAVENUMBER)
    assert relative_error(superposition(far, nodes.discs, amplitude, WAVENUMBER), summed) < 3e-5
    received = superposition(nodes.discs, far, torch.ones((70, 1), dtype=torch.complex128), WAVENUMBER)
    at_nodes = superposition(
        nodes.positions.reshape(-1, 3), far, torch.ones((70, 1), dtype=torch.complex128), WAVENUMBER
    )
    means = at_nodes.reshape(4, -1) @ nodes.weights.to(torch.complex128)
    assert relative_error(received[:, 0], means) < 3e-5


@settings(max_examples=20)
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
    assert relative_error(free_space_matrix(points, joined, WAVENUMBER), both) < 1e-14
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
