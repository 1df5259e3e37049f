"""Radiation force and torque: against series of spheres, and integrals of the stress around bodies."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from benchmarks.force import series
from scipy.special import sph_harm_y, spherical_jn, spherical_yn
from small_scenes import assert_slopes, relative_error

import autdtorch as at
from autdtorch.analytic.spherical_waves import sphere_rule

AIR = at.Medium(density=1.2, sound_speed=340.0)
FREQUENCY = 40e3
WAVENUMBER = 2 * math.pi * FREQUENCY / AIR.sound_speed
ARRAY = at.TransducerArray.grid((2, 3), 10e-3, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), radius=0)
DRIVE = torch.polar(torch.linspace(0.4, 1, 6).double(), 1.3 * torch.arange(6).double() ** 2)
MATERIALS = {
    "rigid": {"rigid": True},
    "EPS": {"density": 29.0, "sound_speed": 900.0},
    "water": {"density": 1000.0, "sound_speed": 1480.0},
    "absorbing": {"density": 5.0, "sound_speed": 600.0, "absorption": 300.0},
}


def sphere(center: tuple[float, float, float], radius: float, material: str = "rigid", error: float = 1e-8):
    return at.TMatrix.of(at.Sphere(center, radius, **MATERIALS[material]), AIR, FREQUENCY, error=error)


def with_slopes(
    field: Callable[[torch.Tensor], torch.Tensor], points: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """The field (P,) at points (P, 3), and its gradient (P, 3)."""
    points = points.clone().requires_grad_(True)
    values = field(points)
    parts = [
        torch.autograd.grad(each.sum(), points, retain_graph=True)[0] for each in (values.real, values.imag)
    ]
    return values.detach(), torch.complex(*parts)


def by_surface(
    bodies: at.TMatrix | at.TMatrixCluster,
    drive: torch.Tensor,
    center: torch.Tensor,
    radius: float,
    array: at.TransducerArray = ARRAY,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Force and torque about the centre, from the field and its gradient on a sphere around it."""
    normals, areas = sphere_rule(20)
    pressure, slopes = with_slopes(
        lambda points: bodies.transfer_matrix(array, points) @ drive, center + radius * normals
    )
    density, speed = AIR.density, AIR.sound_speed
    velocity = slopes / (2j * math.pi * FREQUENCY * density)
    energy = pressure.abs() ** 2 / (4 * density * speed**2) - density / 4 * velocity.abs().square().sum(dim=1)
    normal = (velocity * normals).sum(dim=1)
    flux = energy[:, None] * normals + density / 2 * (velocity * normal.conj()[:, None]).real
    force = -(radius**2) * areas[:, None] * flux
    return force.sum(dim=0), radius * torch.linalg.cross(normals, force).sum(dim=0)


def far_away(*directions: tuple[float, float, float], distance: float = 1e6) -> at.TransducerArray:
    """Transducers so far away that each sends a plane wave of 1 Pa to the origin."""
    places = -distance * torch.tensor(directions).double()
    return at.TransducerArray(places, [0.0, 0.0, 1.0], source_strength=distance, radius=0)


def energy_density() -> float:
    """The mean energy density [J/m^3] of a plane wave of 1 Pa."""
    return 1 / (2 * AIR.density * AIR.sound_speed**2)


SIZES = (0.05, 0.3, 1.0, 2.5, 8.0)
ALONG_Z = (0.0, 0.0, 1.0)


@pytest.mark.parametrize("material", ["rigid", "EPS", "water", "absorbing"])
def test_the_force_of_plane_and_standing_waves_is_the_series(material):
    """Hasegawa and Yosioka (1969), and Hasegawa (1979): radiation force functions of a sphere."""
    for size in SIZES:
        radius = size / WAVENUMBER
        body = sphere((0.0, 0.0, 0.0), radius, material)
        coefficient = body.matrix.diagonal().numpy()[[n * n for n in range(body.degree + 1)]]
        plane, standing = series(coefficient, size)
        scale, setting = math.pi * radius**2 * energy_density(), {"medium": AIR}
        # so far that the fall of 1 / r, whose force is of a lower power of ka, does not count
        one = at.radiation_force(body, torch.ones(1) + 0j, array=far_away(ALONG_Z, distance=1e10), **setting)
        assert one[2].item() == pytest.approx(scale * plane, rel=1e-6, abs=0)
        two = far_away(ALONG_Z, (0.0, 0.0, -1.0))  # cos(kz + 0.4)
        drive = torch.tensor([np.exp(0.4j), np.exp(-0.4j)]) / 2
        force = at.radiation_force(body, drive, array=two, **setting)
        assert force[2].item() == pytest.approx(scale * standing * math.sin(0.8), rel=1e-6, abs=0)
        for each in (one, force):
            assert each[:2].abs().max() < 1e-6 * each.norm()


@pytest.mark.parametrize(("material", "size"), [("water", 0.3), ("rigid", 1.0), ("EPS", 4.0)])
def test_the_force_of_a_focused_wave_is_the_series(material, size):
    """Silva (2011), doi:10.1121/1.3652894, with beam shape coefficients by quadrature over two spheres."""
    array = at.TransducerArray.grid((6, 6), 9e-3, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), radius=0)
    center, radius = (40e-3, 3e-3, -2e-3), size / WAVENUMBER
    drive = at.drive_from_phases(at.focus_phases(array.positions, (43e-3, 0.0, 1e-3), WAVENUMBER))
    body, setting = sphere(center, radius, material), {"array": array, "medium": AIR}
    degree = np.arange(math.ceil(size) + 12)
    scattered = by_mie(degree, size, material)
    normals, areas = sphere_rule(40)
    radii = np.array([1.0, 1.25]) * max(radius, 2 / WAVENUMBER)
    inner = spherical_jn(degree[:, None], WAVENUMBER * radii)
    expected = []
    for axes in (np.roll(np.eye(3), turn, axis=0) for turn in (2, 1, 0)):  # z is x, y and z of the scene
        directions = normals.numpy() @ axes
        polar, azimuth = np.arccos(normals[:, 2].numpy()), np.arctan2(*normals[:, [1, 0]].numpy().T)
        shells = []
        for shell in radii:
            places = np.array(center) + shell * directions
            distance = np.linalg.norm(places[:, None] - array.positions.numpy(), axis=-1)
            shells.append(np.exp(1j * WAVENUMBER * distance) / distance @ drive.numpy())
        weighted = float(array.source_strength) * areas.numpy() * np.stack(shells)
        total = 0.0
        for m in range(-degree[-1], degree[-1] + 1):
            n = degree[abs(m) :]
            waves = np.stack([sph_harm_y(each, m, polar, azimuth) for each in n]).conj()
            beam = ((weighted @ waves.T).T * inner[n]).sum(axis=1) / (inner[n] ** 2).sum(axis=1)
            one, two = scattered[n[:-1]].conj(), scattered[n[1:]]
            steps = np.sqrt(((n[:-1] + 1) ** 2 - m * m) / ((2 * n[:-1] + 1) * (2 * n[:-1] + 3)))
            total += (1j * steps * (one + two + 2 * one * two) * beam[:-1].conj() * beam[1:]).sum().real
        expected.append(total / WAVENUMBER**2 * energy_density())
    force = at.radiation_force(body, drive, **setting)
    assert relative_error(force, torch.tensor(expected)) < 1e-6  # 1e-8 is left of the waves


def by_mie(n: np.ndarray, size: float, material: str) -> np.ndarray:
    """Scattered over incoming coefficients of a sphere of size ka (Anderson 1950)."""
    regular, slope = spherical_jn(n, size), spherical_jn(n, size, derivative=True)
    outgoing = regular + 1j * spherical_yn(n, size)
    outgoing_slope = slope + 1j * spherical_yn(n, size, derivative=True)
    if material == "rigid":
        return -slope / outgoing_slope
    density, speed = (MATERIALS[material][name] for name in ("density", "sound_speed"))
    inside = size * AIR.sound_speed / speed
    within, within_slope = spherical_jn(n, inside), spherical_jn(n, inside, derivative=True)
    ratio = AIR.density * AIR.sound_speed / (density * speed)
    top = slope * within - ratio * regular * within_slope
    return -top / (outgoing_slope * within - ratio * outgoing * within_slope)


def test_a_body_takes_up_the_stress_around_it():
    """Off axis, beside another sphere, before a plane, of discs: 1e-8 is left of the waves by default."""
    body = sphere((30e-3, 4e-3, -3e-3), 5e-3, "absorbing")
    other = sphere((36e-3, -7e-3, 2e-3), 6e-3)
    wall = at.Reflector((42.5e-3, 0, 0), (-1.0, 0.0, 0.0))
    discs = replace(ARRAY, radius=4.5e-3)
    for bodies, array in (
        (body, ARRAY),
        (at.TMatrixCluster([body, other]), ARRAY),
        (at.TMatrixCluster([body, other], [wall]), discs),
    ):
        expected, torque = by_surface(bodies, DRIVE, body.center, 5.5e-3, array)
        setting = {"array": array, "medium": AIR}
        # places of images agree to fewer digits than those of waves
        assert relative_error(at.radiation_force(bodies, DRIVE, **setting), expected) < 1e-5
        assert relative_error(at.radiation_torque(bodies, DRIVE, **setting), torque) < 1e-5


@pytest.fixture(scope="module")
def cube() -> at.TMatrix:
    box = at.Box(center=(30e-3, 2e-3, -1e-3), size=(6e-3, 6e-3, 4e-3), rigid=True)
    return at.TMatrix.of(box, AIR, FREQUENCY, spacing=1.5e-3, error=1e-2)


def test_a_turned_body_takes_up_the_stress_around_it(cube):
    turned = cube.moved((1e-3, 0, 0), (0.4, 0.2, -0.5))
    expected, torque = by_surface(turned, DRIVE, turned.center, 7e-3)
    assert relative_error(at.radiation_force(turned, DRIVE, array=ARRAY, medium=AIR), expected) < 1e-6
    assert relative_error(at.radiation_torque(turned, DRIVE, array=ARRAY, medium=AIR), torque) < 1e-6
    assert torque.norm() > 1e-4 * expected.norm() / WAVENUMBER  # a box does turn


def test_regular_waves_one_degree_above_the_outgoing_ones_push():
    """The dipole of a small sphere in the quadrupole of the field gives most of its force."""
    place, other = (30e-3, 4e-3, -3e-3), sphere((36e-3, -7e-3, 2e-3), 6e-3)
    setting = {"array": ARRAY, "medium": AIR}
    for material in ("rigid", "EPS", "absorbing"):
        coarse, fine = (sphere(place, 0.03 / WAVENUMBER, material, error) for error in (0.1, 1e-8))
        assert coarse.degree == 1
        expected = at.radiation_force(fine, DRIVE, **setting)
        # the quadrupole of the sphere, left out, is smaller by (ka)^2
        assert relative_error(at.radiation_force(coarse, DRIVE, **setting), expected) < 2e-3
        pairs = [at.TMatrixCluster([other, each]) for each in (coarse, fine)]
        for moved in ((0, 0, 0), torch.tensor([[1e-3, 0, 0], [0, 2e-3, 1e-3]])):  # the latter joined once
            forces = [at.radiation_force(pair.moved(moved), DRIVE, 1, **setting) for pair in pairs]
            assert relative_error(*forces) < 2e-3


def test_torque_does_not_depend_on_the_handedness_of_axes():
    body = sphere((30e-3, 4e-3, -3e-3), 5e-3, "absorbing")
    mirrored = replace(body, axes=body.axes * torch.tensor([1.0, -1.0, 1.0]).double())
    torques = [at.radiation_torque(each, DRIVE, array=ARRAY, medium=AIR) for each in (body, mirrored)]
    assert relative_error(*torques) < 1e-9


def test_a_propagator_and_bodies_give_the_forces_of_hermitian_matrices():
    spheres = [
        at.Sphere((30e-3, 4e-3, -3e-3), 5e-3, rigid=True),
        at.Sphere((36e-3, -7e-3, 2e-3), 6e-3, **MATERIALS["EPS"]),
    ]
    panel = at.Reflector.behind(ARRAY)
    scene = at.Scene(ARRAY, AIR, FREQUENCY, [(60e-3, 0, 0)], spheres, reflectors=[panel])
    propagator = at.make_propagator(scene, "tmatrix")
    drives = torch.stack([DRIVE, DRIVE.conj(), 0 * DRIVE])
    for body in range(2):
        force = at.radiation_force(propagator, drives, body)
        matrices = at.force_matrices(propagator, body)
        assert matrices.shape == (3, 6, 6)
        assert torch.equal(matrices, matrices.mH)
        products = torch.einsum("rm,imn,rn->ri", drives.conj(), matrices, drives)
        assert relative_error(products, force) < 1e-9
        assert not force[2].any()
        alone = at.radiation_force(propagator.bodies, DRIVE, body, array=ARRAY, medium=AIR)
        assert relative_error(force[0], alone) < 1e-9


def test_many_poses_at_once_are_each_on_its_own(cube):
    offsets = torch.tensor([[0.0, 0, 0], [1e-3, -2e-3, 0], [0, 0, 1e-3]])
    other = cube.moved((0, 25e-3, 0))
    setting = {"array": ARRAY, "medium": AIR}
    drives = torch.stack([DRIVE, DRIVE.conj()])[:, None]
    cluster = at.TMatrixCluster([cube.moved(offsets, (0.1, 0.2, 0.3)), other])
    as_one = at.TMatrixCluster([cube, other]).moved(offsets, (0.1, 0.2, 0.3))
    for many in (cluster, as_one):
        force = at.radiation_force(many, drives, 1, **setting)
        torque, matrices = at.radiation_torque(many, DRIVE, **setting), at.force_matrices(many, 1, **setting)
        assert force.shape == (2, 3, 3)
        for number in range(3):
            pair = [each.in_poses((3,)).some_poses(number, 1) for each in many.bodies]
            pair = at.TMatrixCluster([replace(e, center=e.center[0], axes=e.axes[0]) for e in pair])
            for row, drive in enumerate(drives[:, 0]):
                alone = at.radiation_force(pair, drive, 1, **setting)
                assert relative_error(force[row, number], alone) < 1e-9
            assert relative_error(matrices[number], at.force_matrices(pair, 1, **setting)) < 1e-9
            assert relative_error(torque[number], at.radiation_torque(pair, DRIVE, **setting)) < 1e-9


def test_gradients_by_pose_and_drive_are_those_of_finite_differences(cube):
    other = cube.moved((0, 25e-3, 0))
    setting = {"array": replace(ARRAY, radius=4.5e-3), "medium": AIR}

    def push(pose: torch.Tensor) -> torch.Tensor:
        cluster = at.TMatrixCluster([cube.moved(pose[:3], pose[3:]), other])
        return (
            1e9 * at.radiation_force(cluster, DRIVE, 0, **setting) @ torch.tensor([1.0, 2.0, -1.0]).double()
        )

    pose = torch.tensor([1e-3, 0.5e-3, -1e-3, 0.2, 0.1, -0.3], dtype=torch.float64)
    assert_slopes(push, pose, steps=[1e-6] * 3 + [1e-4] * 3)
    drive = DRIVE.clone().requires_grad_(True)
    cluster = at.TMatrixCluster([cube, other])
    (slope,) = torch.autograd.grad(at.radiation_force(cluster, drive, **setting)[0], drive)
    assert relative_error(slope, 2 * at.force_matrices(cluster, **setting)[0] @ DRIVE) < 1e-9


def test_the_stress_on_a_surface_around_a_body_is_the_force_on_it():
    body = at.Sphere((30e-3, 4e-3, -3e-3), 4e-3, **MATERIALS["EPS"])
    scene = at.Scene(ARRAY, AIR, FREQUENCY, [(60e-3, 0, 0)], [body])
    propagator, drives = (
        at.make_propagator(scene, "tmatrix", tolerance=1e-7),
        torch.stack([DRIVE, -1j * DRIVE]),
    )
    normals, areas = sphere_rule(12)
    points = torch.tensor(body.center).double() + 6.2e-3 * normals
    stress = at.radiation_stress(propagator, drives, points, 2 * normals)
    force = at.radiation_force(propagator, DRIVE)
    # by waves up to the 13th degree at the nodes around each point
    assert relative_error(6.2e-3**2 * torch.einsum("p,rpc->rc", areas, stress), force.expand(2, 3)) < 1e-6


@pytest.mark.filterwarnings("ignore::autdtorch.ScaleWarning")  # of sources far away
def test_the_momentum_through_a_plane_is_that_through_others():
    """Of a plane wave, the energy density; of a beam, as much at each distance."""
    scene = at.Scene(far_away((0.0, 0.6, 0.8)), AIR, FREQUENCY, [(0, 0, 0)])
    free, one = at.make_propagator(scene, "free_space"), torch.ones(1, dtype=torch.complex128)
    stress = at.radiation_stress(free, one, [[0.0, 0.0, 0.0]], (0.0, 0.0, -1.0))[0]
    expected = energy_density() * 0.8 * torch.tensor([0.0, 0.6, 0.8]).double()
    assert relative_error(stress, expected) < 1e-6
    array = at.TransducerArray.grid((6, 6), 6e-3, (0, 0, 0), (0, 0, 1.0), radius=2.5e-3)
    free = at.make_propagator(at.Scene(array, AIR, FREQUENCY, [(0, 0, 0.03)]), "free_space")
    focus = at.drive_from_phases(at.focus_phases(array.positions, (0, 0, 0.03), WAVENUMBER))
    planes = [at.Plane((0, 0, z), (0, 0, 1), (0.12, 0.12)).points(5e-3) for z in (0.02, 0.03)]
    near, far = (at.radiation_stress(free, focus, each, (0, 0, -1))[..., 2].sum().item() for each in planes)
    assert near == pytest.approx(far, rel=0.05)  # planes of finite size miss the edge of the beam


def test_second_derivatives_by_the_pose_are_differences_of_first_ones(cube):
    def push(pose: torch.Tensor) -> torch.Tensor:
        force = at.radiation_force(cube.moved(pose[:3], pose[3:]), DRIVE, array=ARRAY, medium=AIR)
        return force @ torch.tensor([1.0, 2.0, -1.0]).double()

    pose, change = torch.linspace(-1e-3, 1e-3, 6).double(), torch.linspace(-1e-6, 1e-6, 6).double()

    def slope(pose: torch.Tensor) -> torch.Tensor:
        return torch.autograd.grad(push(pose), pose, create_graph=True)[0]

    pose.requires_grad_(True)
    (second,) = torch.autograd.grad(slope(pose) @ change, pose)
    ends = [slope(pose + sign * change) for sign in (0.5, -0.5)]
    assert relative_error(second, (ends[0] - ends[1]).detach()) < 1e-5  # rounding of the difference


def test_bad_input_is_named():
    body = sphere((30e-3, 4e-3, -3e-3), 5e-3)
    setting = {"array": ARRAY, "medium": AIR}
    with pytest.raises(ValueError, match=r"body: 1; must be in 0 to 0"):
        at.radiation_force(body, DRIVE, 1, **setting)
    with pytest.raises(ValueError, match="array: None; must be a TransducerArray"):
        at.radiation_force(body, DRIVE, medium=AIR)
    with pytest.raises(ValueError, match=r"drive: shape \(2, 6\) beside poses \(3,\); leading dimensions"):
        at.radiation_force(body.moved(torch.zeros(3, 3)), torch.stack([DRIVE, DRIVE]), **setting)
    with pytest.raises(ValueError, match=r"drive: shape \(5,\); must be \(\.\.\., 6\)"):
        at.radiation_torque(body, DRIVE[:5], **setting)
    scene = at.Scene(ARRAY, AIR, FREQUENCY, [(60e-3, 0, 0)], [at.Sphere((30e-3, 0, 0), 5e-3, rigid=True)])
    with pytest.raises(ValueError, match=r"medium: .*; must be left out"):
        at.force_matrices(at.make_propagator(scene, "tmatrix"), medium=AIR)
    with pytest.raises(ValueError, match=r"bodies: .*; must be"):
        at.radiation_force(at.make_propagator(scene, "free_space"), DRIVE)
