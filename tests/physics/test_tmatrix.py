"""The scattering operator: against exact series of spheres, the box solver, and finite differences."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from small_scenes import assert_slopes, matrix_of_sphere, relative_error

import autdtorch as at
from autdtorch.analytic.spherical_waves import outgoing_waves, sphere_coefficients
from autdtorch.propagators import make_propagator

AIR = at.Medium(density=1.2, sound_speed=340.0)
FREQUENCY = 40e3
WAVENUMBER = 2 * math.pi * FREQUENCY / AIR.sound_speed
ARRAY = at.TransducerArray.grid((2, 3), 10e-3, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), radius=0)
POINTS = torch.tensor([[60e-3, 0, 0], [50e-3, 12e-3, 5e-3], [30e-3, -4e-3, 15e-3]], dtype=torch.float64)
CENTER = (30e-3, 2e-3, -1e-3)
CUBE = at.Box(center=CENTER, size=(6e-3,) * 3, rigid=True)


@pytest.fixture(scope="module")
def cube() -> at.TMatrix:
    return at.TMatrix.of(CUBE, AIR, FREQUENCY, spacing=1.5e-3, error=1e-2)


MATERIALS = [
    {"rigid": True},
    {"density": 5.0, "sound_speed": 600.0},
    {"density": 5.0, "sound_speed": 600.0, "absorption": 300.0},
    at.porous(200e3, FREQUENCY, AIR),
    {"impedance": 1.5 + 1j},
]


@pytest.mark.parametrize("material", MATERIALS)
def test_a_sphere_in_closed_form_is_the_series(material):
    sphere = at.Sphere(center=CENTER, radius=8e-3, **material)
    operator = at.TMatrix.of(sphere, AIR, FREQUENCY, error=1e-8)
    exact = matrix_of_sphere(at.Scene(ARRAY, AIR, FREQUENCY, POINTS, [sphere]))
    # eight digits were asked for at the surface, and all points are outside
    assert relative_error(operator.transfer_matrix(ARRAY, POINTS), exact) < 1e-6
    assert operator.reciprocity < 1e-12
    scattering = (1 + 2 * operator.matrix.diagonal()).abs()
    assert scattering.max() < 1 + 1e-12  # passive
    if sphere.is_lossy:
        assert scattering.min() < 0.9
    else:
        assert operator.energy < 1e-12


@pytest.mark.filterwarnings("ignore::autdtorch.OverlapWarning")
def test_a_simulated_sphere_is_near_the_exact_one():
    sphere = at.Sphere(center=CENTER, radius=5e-3, rigid=True)
    exact = at.TMatrix.of(sphere, AIR, FREQUENCY, error=1e-2)
    twice = at.TMatrix.of([sphere, sphere], AIR, FREQUENCY, spacing=1e-3, error=1e-2)  # is simulated
    assert twice.degree >= exact.degree
    found, wanted = (one.transfer_matrix(ARRAY, POINTS) for one in (twice, exact))
    # 0.7 % was measured at 5 cells a radius
    assert relative_error(found, wanted) < 0.02


def test_the_operator_is_the_box_in_a_small_frame(cube):
    scene = at.Scene(ARRAY, AIR, frequency=FREQUENCY, control_points=POINTS, obstacles=[CUBE])
    box = make_propagator(scene, "box", 1.5e-3, cache=False).transfer_matrix()
    # two digits of waves; both have the same cells
    assert relative_error(cube.transfer_matrix(ARRAY, POINTS), box) < 5e-3
    assert cube.reciprocity < 0.02
    assert cube.energy < 0.02


def test_a_moved_body_is_the_array_and_points_moved_back(cube):
    offset, angles = torch.tensor([1e-3, -2e-3, 0.5e-3]).double(), (0.3, -0.2, 0.5)
    moved = cube.moved(offset, angles)
    turn, center = moved.axes, torch.tensor(CENTER, dtype=torch.float64)

    def back(places: torch.Tensor) -> torch.Tensor:
        return (places - center - offset) @ turn + center

    array = at.TransducerArray(back(ARRAY.positions), ARRAY.normals, ARRAY.source_strength, 0)
    expected = cube.transfer_matrix(array, back(POINTS))
    assert relative_error(moved.transfer_matrix(ARRAY, POINTS), expected) < 1e-10
    assert relative_error(cube.transfer_matrix(ARRAY, POINTS), expected) > 0.01  # it did move


@pytest.mark.parametrize("radius", [0.0, 4.5e-3])
@pytest.mark.parametrize("count", [2, 8])  # fewer and more points than transducers
def test_many_poses_at_once_are_each_on_its_own(cube, radius, count):
    array = replace(ARRAY, radius=radius)
    points = (POINTS[0] + 1e-3 * torch.arange(count, dtype=torch.float64)[:, None]).expand(2, 1, count, 3)
    offsets = torch.tensor([[0.0, 0, 0], [1e-3, -2e-3, 0], [0, 0, 1e-3]])
    other = cube.moved((0, 25e-3, 0))
    bodies = [cube.moved(offsets, (0.1, 0.2, 0.3)), other.moved(rotation_degrees=offsets * 1e4)]
    several = at.TMatrixCluster(bodies).transfer_matrix(array, points)
    assert several.shape == (2, 3, count, 6)
    for number, offset in enumerate(offsets):
        pair = [cube.moved(offset, (0.1, 0.2, 0.3)), other.moved(rotation_degrees=offset * 1e4)]
        alone = at.TMatrixCluster(pair).transfer_matrix(array, points[0, 0])
        assert relative_error(several[1, number], alone) < 1e-9  # powers of a series, chosen for all
    with pytest.raises(ValueError, match=r"offset: shape \(3, 3\) beside a rotation of \(2, 3\)"):
        cube.moved(offsets, torch.zeros(2, 3))
    with pytest.raises(ValueError, match=r"center: shape \(3, 3\); a file holds one pose"):
        bodies[0].save("cube.npz")


@pytest.mark.parametrize("count", [2, 8])  # fewer and more points than transducers
def test_bodies_that_move_as_one_are_those_placed_each(cube, count):
    points = POINTS[0] + 1e-3 * torch.arange(count, dtype=torch.float64)[:, None]
    still = at.TMatrixCluster([cube, cube.moved((0, 20e-3, 0), (0.3, 0, 0)), cube.moved((0, -15e-3, 3e-3))])
    moved = still.moved((1e-3, 2e-3, 0)).moved(rotation=[[0.0, 0, 0], [0.1, -0.2, 0.3]])
    each = at.TMatrixCluster(moved.bodies).transfer_matrix(ARRAY, points)
    assert relative_error(moved.transfer_matrix(ARRAY, points), each) < 1e-10  # rounding
    shape, other = (torch.cdist(*2 * [torch.stack([b.center for b in c.bodies], -2)]) for c in (still, moved))
    assert torch.allclose(shape, other, rtol=1e-12, atol=0)


@pytest.mark.parametrize("radius", [0.0, 4.5e-3])
def test_gradients_by_the_pose_are_those_of_finite_differences(cube, radius):
    array = replace(ARRAY, radius=radius)
    drive = torch.polar(torch.ones(6).double(), torch.arange(6).double())

    def weakest(pose: torch.Tensor) -> torch.Tensor:
        matrix = cube.moved(pose[:3], pose[3:]).transfer_matrix(array, POINTS)
        return (matrix @ drive).abs().amin()

    pose = torch.tensor([1e-3, 0.5e-3, -1e-3, 0.2, 0.1, -0.3], dtype=torch.float64)
    assert_slopes(weakest, pose, steps=[1e-6] * 3 + [1e-4] * 3)


def test_an_operator_comes_back_from_its_file(cube, tmp_path):
    moved = cube.moved((1e-3, 0, 0), (0, 0.1, 0))
    moved.save(tmp_path / "cube.npz")
    again = at.TMatrix.load(tmp_path / "cube.npz")
    assert torch.equal(again.transfer_matrix(ARRAY, POINTS), moved.transfer_matrix(ARRAY, POINTS))
    cube.moved(torch.zeros(3, dtype=torch.float64, requires_grad=True)).save(tmp_path / "varied.npz")
    assert torch.equal(at.TMatrix.load(tmp_path / "varied.npz").center, cube.center)
    np.savez(tmp_path / "other.npz", matrix=np.ones((2, 2)))
    with pytest.raises(ValueError, match=r"other.npz: no array center, axes"):
        at.TMatrix.load(tmp_path / "other.npz")


def test_bad_input_is_named(cube):
    with pytest.raises(ValueError, match=r"points: 0\.004.* m at the nearest; must be at least 0\.005196 m"):
        cube.transfer_matrix(ARRAY, [[30e-3, 2e-3, 3e-3]])
    with pytest.raises(ValueError, match=r"array.positions: .* must be at least"):
        cube.moved((-28e-3, 0, 0)).transfer_matrix(ARRAY, POINTS)
    with pytest.raises(ValueError, match=r"offset: shape \(2,\)"):
        cube.moved((0.0, 0.0))
    with pytest.raises(ValueError, match=r"offset: shape \(0, 3\); must be \(3,\), or \(..., 3\)"):
        cube.moved(torch.zeros(0, 3))
    poses = cube.moved(torch.zeros(5, 3))
    with pytest.raises(ValueError, match=r"points: shape \(3, 4, 3\) beside poses \(5,\); leading"):
        poses.transfer_matrix(ARRAY, torch.zeros(3, 4, 3))
    with pytest.raises(ValueError, match=r"offset: shape \(3, 3\) beside a .* and poses \(5,\)"):
        poses.moved(torch.zeros(3, 3))
    with pytest.raises(ValueError, match=r"bodies\[1\].center: shape \(3, 3\) beside \(5, 3\)"):
        at.TMatrixCluster([poses, cube.moved(torch.zeros(3, 3))])
    with pytest.raises(ValueError, match="obstacles"):
        at.TMatrix.of([], AIR, FREQUENCY)
    with pytest.raises(ValueError, match=r"error: 0; must be in 1e-08 to 0\.1"):
        at.TMatrix.of(CUBE, AIR, FREQUENCY, error=0)
    with pytest.raises(ValueError, match=r"bodies\[1\].center: .* apart.*; must be at least 0.01039 m"):
        at.TMatrixCluster([cube, cube.moved((5e-3, 0, 0))])
    with pytest.raises(ValueError, match=r"bodies\[1\].wavenumber"):
        at.TMatrixCluster([cube, at.TMatrix.of(SPHERES[2], AIR, 41e3)])
    with pytest.raises(ValueError, match=r"bodies: .*; must have at least one"):
        at.TMatrixCluster([])


@given(st.floats(0.01, 20), st.floats(0.1, 60), st.floats(0.05, 20))
def test_a_sphere_in_air_that_absorbs_needs_no_simulation(size, absorption, impedance):
    """One of this air scatters nothing; where waves inside are short and die out, it has an impedance."""
    air = at.Medium(1.2, 343.0, absorption)
    radius = size * 343.0 / (2 * math.pi * FREQUENCY)
    same = at.Sphere((0, 0, 0), radius, density=1.2, sound_speed=343.0, absorption=absorption)
    assert at.TMatrix.of(same, air, FREQUENCY).matrix.norm() < 1e-9  # rounding, as a resonance may amplify it
    speed = 343.0 / (2000 * (1 + 0.5j)) / max(1, 1 / size)  # at least 2000 rad of phase along a radius
    slower = 1 + 1j * absorption / 8.685889638 * 343.0 / (2 * math.pi * FREQUENCY)
    ratios = impedance / (speed / 343.0), speed / 343.0 * slower
    fluid = sphere_coefficients(6, size * slower, *ratios)
    surface = sphere_coefficients(6, size * slower, impedance=impedance * slower)
    assert np.abs(fluid - surface).max() < 0.01  # the curvature, of 1 / 2000, times slopes up to 7 / size


SPHERES = (
    at.Sphere(center=(30e-3, 8e-3, -1e-3), radius=6e-3, rigid=True),
    at.Sphere(center=(33e-3, -6e-3, 2e-3), radius=5e-3, rigid=True),
    at.Sphere(center=(45e-3, 3e-3, -3e-3), radius=6e-3, rigid=True),
)
OUTSIDE = torch.tensor([[70e-3, 0, 0], [60e-3, 12e-3, 5e-3], [35e-3, -4e-3, 25e-3]], dtype=torch.float64)


def collocated(spheres: tuple[at.Sphere, ...]) -> torch.Tensor:
    """The transfer matrix at `OUTSIDE` by outgoing waves whose normal velocity vanishes on all rigid spheres.

    Least squares over 900 points of each surface: no translation of waves, no coefficient of a sphere.
    """
    degree, normals = 16, at.sphere_points((0, 0, 0), 1.0, 900)
    centers = [torch.tensor(sphere.center, dtype=torch.float64) for sphere in spheres]
    sources = ARRAY.positions.as_subclass(torch.Tensor)

    def incident(points: torch.Tensor) -> torch.Tensor:
        distance = (points[:, None] - sources).norm(dim=-1)
        return ARRAY.source_strength * torch.exp(1j * WAVENUMBER * distance) / distance

    def outgoing(points: torch.Tensor) -> torch.Tensor:
        return torch.cat([outgoing_waves(degree, WAVENUMBER, points - center) for center in centers], dim=1)

    surfaces = [center + sphere.radius * normals for center, sphere in zip(centers, spheres, strict=True)]
    slopes = torch.cat([torch.func.jvp(outgoing, (points,), (normals,))[1] for points in surfaces])
    driven = torch.cat([torch.func.jvp(incident, (points,), (normals,))[1] for points in surfaces])
    size = slopes.norm(dim=0)
    found = torch.linalg.lstsq(slopes / size, -driven).solution / size[:, None]
    return incident(OUTSIDE) + outgoing(OUTSIDE) @ found


def test_spheres_scatter_one_another():
    bodies = [at.TMatrix.of(sphere, AIR, FREQUENCY, error=1e-5) for sphere in SPHERES]
    coupled = at.TMatrixCluster(bodies).transfer_matrix(ARRAY, OUTSIDE)
    # 2e-7 was measured
    assert relative_error(coupled, collocated(SPHERES)) < 1e-5
    # each as if alone
    alone = [body.transfer_matrix(ARRAY, OUTSIDE) for body in bodies]
    direct = 4 * math.pi * ARRAY.source_strength * at.green(OUTSIDE, ARRAY.positions, WAVENUMBER)
    assert relative_error(sum(alone) - 2 * direct, coupled) > 0.01
