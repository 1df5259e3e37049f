"""Scenes, the planes and circles in them, and their air, against published tables."""

import cmath
import copy
import dataclasses
import io
import math
import pickle

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from small_scenes import small_scene

from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.geometry import Plane, circle_points, plane_basis, polyline_points, sphere_points
from autdtorch.scene.medium import Medium, vapour_fraction
from autdtorch.scene.obstacles import Box, Mesh, Sphere
from autdtorch.scene.scene import OverlapWarning, ScaleWarning, Scene

AIR = Medium(density=1.293, sound_speed=340.0)


def paper_scene(**changes):
    arguments = {
        "array": TransducerArray.grid((4, 4), pitch=10e-3, center=(1e-3, 50e-3, 50e-3)),
        "medium": AIR,
        "frequency": 40e3,
        "control_points": circle_points((80e-3, 50e-3, 50e-3), 30e-3, 4, (1, 0, 0)),
    }
    return Scene(**arguments | changes)


def cube(x, y, z, edge):
    center = (1e-3 * x, 1e-3 * y, 1e-3 * z)
    return Box(center=center, size=(1e-3 * edge,) * 3, density=100.0, sound_speed=340.0)


def test_waves_follow_from_frequency_and_medium_and_attenuation_is_in_nepers():
    scene = paper_scene(medium=Medium(density=1.293, sound_speed=340.0, absorption=40.0))
    assert abs(cmath.exp(1j * scene.complex_wavenumber * 0.5)) == pytest.approx(
        10 ** (-0.5 * 40 / 20), rel=1e-13
    )
    assert scene.complex_wavenumber.real == scene.wavenumber
    assert paper_scene().attenuation == 0
    assert (scene.wavelength, scene.angular_frequency) == pytest.approx(
        (8.5e-3, 2 * math.pi * 40e3), rel=1e-15
    )
    assert scene.wavenumber * scene.wavelength == pytest.approx(2 * math.pi, rel=1e-15)


def test_box_is_half_open():
    box = Box(center=(0.5, 0.5, 0.5), size=(1, 1, 1), rigid=True)
    points = torch.tensor(
        [[0.0, 0.0, 0.0], [1.0, 0.5, 0.5], [0.5, 0.5, 1.0], [0.5, 0.5, 0.5], [-0.1, 0.5, 0.5]]
    )
    assert box.contains(points).tolist() == [True, False, False, True, False]
    assert box.contains(points.reshape(5, 1, 3)).shape == (5, 1)
    assert box.contains(points, margin=0.2).all()
    assert (box.lower, box.upper) == ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))


def test_obstacles_may_touch_and_those_of_one_material_overlap():
    stepped = (cube(41, 60, 40, 10), cube(41, 50, 50, 10), cube(41, 40, 60, 10))
    assert paper_scene(obstacles=stepped).obstacles == stepped
    for rounding in (0.0, 1e-9, -1e-9):  # mm
        in_a_row = (cube(41, 50, 50, 16), cube(30 + rounding, 50, 50, 6))
        assert paper_scene(obstacles=in_a_row).obstacles == in_a_row
    paper_scene(obstacles=[ball(40, 8, 100.0), ball(45, 8, 100.0)])
    paper_scene(obstacles=[ball(40, 5, 100.0), ball(50, 5, 50.0)])
    # 0.4 mm apart, though the bounding boxes overlap
    diagonal = Sphere((46e-3, 56e-3, 56e-3), 5e-3, rigid=True)
    paper_scene(obstacles=[ball(40, 5, 100.0), diagonal])


def ball(x, radius, density):
    return Sphere((1e-3 * x, 50e-3, 50e-3), 1e-3 * radius, density=density, sound_speed=340.0)


def test_overlapping_obstacles_of_different_materials_are_named():
    with pytest.warns(
        OverlapWarning, match=r"^Scene\.obstacles: 2 overlaps 0, 3 overlaps 0, 3 overlaps 2, of"
    ) as caught:
        paper_scene(obstacles=[ball(40, 8, 100.0), ball(60, 8, 50.0), ball(45, 8, 50.0), ball(43, 2, 10.0)])
    assert len(caught) == 1  # and not 2 with 1, which are of one material
    assert caught[0].filename == __file__


def test_a_mesh_in_centimetres_is_no_wall():
    """A body of 1.6 cm by 10 cm, 3.3 cm from the array: in m, a wall of 10 m at 3.3 m."""
    surface = Box((4.1, 5, 5), (1.6, 10, 10), rigid=True).surface()
    assert paper_scene(obstacles=[Mesh.from_surface(surface, 1e-2, rigid=True)])
    with pytest.warns(ScaleWarning, match=r"obstacles\[0\]: Mesh of .*, 1e-2 for centimetres"):
        paper_scene(obstacles=[Mesh.from_surface(surface, rigid=True)], domain=None)


def test_a_mesh_in_millimetres_is_told_how_to_scale_it():
    surface = Sphere((50.0, 50.0, 50.0), 8.0, rigid=True).surface()
    assert paper_scene(obstacles=[Mesh.from_surface(surface, 1e-3, rigid=True)])
    with pytest.warns(ScaleWarning, match=r"^Scene\.obstacles\[0\]: .*scale=1e-3") as caught:
        paper_scene(obstacles=[Mesh.from_surface(surface, rigid=True)])
    assert caught[0].filename == __file__
    for offset, domain in (((-50.0,) * 3, None), ((0.0,) * 3, ((0, 0, 0), (0.1, 0.1, 0.1)))):
        with pytest.raises(ValueError, match=r"^Scene\..*scale=1e-3"):
            paper_scene(obstacles=[Mesh.from_surface(surface, 1.0, offset, rigid=True)], domain=domain)


def test_obstacles_may_reach_beyond_the_domain():
    domain = ((0.0, 0.0, 0.0), (0.1, 0.1, 0.1))
    wall = Box((90e-3, 50e-3, 50e-3), (10e-3, 1.0, 1.0), rigid=True)
    assert paper_scene(obstacles=[wall], domain=domain).domain == domain
    lower, upper = paper_scene(obstacles=[wall]).domain
    assert (lower[1], upper[2]) == pytest.approx((-0.45 - 17e-3, 0.55 + 17e-3))


def test_the_domain_holds_everything_and_may_be_given():
    plane = Plane(center=(80e-3, 50e-3, 50e-3), normal=(1, 0, 0), size=(200e-3, 20e-3))
    array = TransducerArray.grid((4, 8), pitch=10e-3, center=(1e-3, 50e-3, 50e-3), radius=5e-3)
    scene = paper_scene(array=array, obstacles=[cube(120, 50, 50, 10)], observation_plane=plane)
    margin = 2 * 8.5e-3
    lower, upper = scene.domain
    assert lower == pytest.approx((1e-3 - margin, -50e-3 - margin, 10e-3 - margin), rel=1e-12)
    assert upper == pytest.approx((125e-3 + margin, 150e-3 + margin, 90e-3 + margin), rel=1e-12)
    assert all(type(entry) is float for entry in lower + upper)
    domain = ((1e-3, 0.0, 0.0), (80e-3, 100e-3, 100e-3))  # array and control points lie on its faces
    assert paper_scene(domain=domain).domain == domain
    assert paper_scene(domain=np.array(domain)).domain == domain


def test_a_scene_is_frozen_with_its_own_copies_checked_when_changed_and_pickled():
    scene = paper_scene(obstacles=[cube(41, 50, 50, 10)])
    with pytest.raises(dataclasses.FrozenInstanceError):
        scene.frequency = 20e3
    assert dataclasses.replace(scene, frequency=20e3).wavelength == pytest.approx(17e-3, rel=1e-15)
    with pytest.raises(ValueError, match="in or on obstacle 0"):
        dataclasses.replace(scene, control_points=[(41e-3, 50e-3, 50e-3)])
    plane = Plane(center=(80e-3, 50e-3, 50e-3), normal=(1, 0, 0), size=(0.1, 0.1))
    points = torch.tensor([[80e-3, 50e-3, 50e-3]], dtype=torch.float64)
    array = TransducerArray.grid((4, 4), 10e-3, (1e-3, 50e-3, 50e-3), (1, 2, 3), 2.0, 4e-3)
    scene = paper_scene(
        array=array, control_points=points, obstacles=[cube(41, 50, 50, 10)], observation_plane=plane
    )
    points += 1.0  # the scene has its own copy
    assert scene.control_points.tolist() == [[80e-3, 50e-3, 50e-3]]
    copy = pickle.loads(pickle.dumps(scene))
    assert copy.equals(scene)
    assert copy.name == scene.name


ATMOSPHERE = 101325.0


def midband(nominal: float) -> float:
    """Exact frequency of a third-octave band: the tables name 7943 Hz 8 kHz."""
    return 10 ** (round(10 * math.log10(nominal)) / 10)


# ISO 9613-1:1993, Table 1 [dB/km], given to three digits
@pytest.mark.parametrize(
    ("temperature", "humidity", "frequency", "tabulated"),
    [
        *((-20, 10, 50, 0.589), (20, 15, 6300, 175), (20, 80, 50, 0.0501)),
        *((20, 80, 1000, 5.15), (20, 80, 10000, 105), (20, 50, 10000, 159)),
    ],
)
def test_absorption_is_that_of_the_table(temperature, humidity, frequency, tabulated):
    computed = 1e3 * Medium.air(temperature, humidity, ATMOSPHERE, midband(frequency)).absorption
    assert computed == pytest.approx(tabulated, rel=5e-3)


# ISO 9613-2:1996, Table 2 [dB/km], octaves from 63 Hz to 8 kHz, given to one digit after the point
@pytest.mark.parametrize(
    ("temperature", "humidity", "tabulated"),
    [
        (10, 70, (0.1, 0.4, 1.0, 1.9, 3.7, 9.7, 32.8, 117)),
        (20, 70, (0.1, 0.3, 1.1, 2.8, 5.0, 9.0, 22.9, 76.6)),
        (15, 20, (0.3, 0.6, 1.2, 2.7, 8.2, 28.2, 88.8, 202)),
    ],
)
def test_absorption_in_octaves(temperature: float, humidity: float, tabulated: tuple[float, ...]) -> None:
    octaves = [midband(1000 * 2**n) for n in range(-4, 4)]
    computed = [1e3 * Medium.air(temperature, humidity, ATMOSPHERE, f).absorption for f in octaves]
    # half a unit of the last digit printed: 0.05 dB/km, from 100 on 0.5 dB/km
    assert computed == pytest.approx(tabulated, abs=0.055, rel=2.5e-3)


def test_far_above_the_relaxations_absorption_is_classical() -> None:
    """Viscosity, heat and rotation absorb in proportion to f^2/p: 1.84e-11 Np/m per Hz^2 at one atmosphere.

    In dry air the relaxations are over at some 10 Hz: beyond, they add a constant, 1 mdB/m to 40 dB/m here.
    """
    for pressure in (ATMOSPHERE, 2 / 3 * ATMOSPHERE):
        classical = 8.686 * 1.84e-11 * 5e5**2 * ATMOSPHERE / pressure
        relaxing = Medium.air(20, 0, pressure, 5e5).absorption - classical
        assert 0 < relaxing < 1e-4 * classical


def test_density_sound_speed_vapour_and_absorption_of_data_sheets() -> None:
    # measured: 331.45 m/s with 0.03 % of CO2 (Cramer 1993), of which a real gas makes 0.13 m/s
    assert Medium.air(0, 0).sound_speed == pytest.approx(331.45, rel=5e-4)
    # ISO 9613-1 and every handbook: 343.2 m/s and 1.204 kg/m^3 at 20 deg C
    dry = Medium.air(20, 0)
    assert (dry.density, dry.sound_speed) == pytest.approx((1.204, 343.2), rel=2e-4)
    # the zero-frequency formula of Cramer 1993, a real gas with 0.04 % of CO2
    for humidity, speed in ((50, 343.987), (0, 343.359)):
        assert Medium.air(20, humidity).sound_speed == pytest.approx(speed, rel=5e-4)
    # saturation pressures of handbooks, which the fit of ISO 9613-1 meets to 0.2 %
    for temperature, saturation in ((0, 611), (20, 2339), (50, 12350)):
        found = ATMOSPHERE * vapour_fraction(temperature, 100, ATMOSPHERE)
        assert found == pytest.approx(saturation, rel=2e-3)
    assert Medium.air().absorption == pytest.approx(1.3, abs=0.05)


# Unit vectors are products of a few roundings of numbers up to 1.
ROUNDING = 1e-14

vectors = hnp.arrays(float, 3, elements=st.floats(-2, 2))


@st.composite
def normals(draw):
    normal = draw(vectors)
    assume(np.linalg.norm(normal) > 1e-6)
    return normal


@pytest.mark.parametrize(
    ("normal", "u", "v"),
    [
        ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
        ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
        ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    ],
)
def test_axes_give_the_following_axes(normal, u, v):
    found_u, found_v = plane_basis(normal)
    assert found_u.tolist() == list(u)
    assert found_v.tolist() == list(v)


@given(normal=normals())
def test_basis_is_orthonormal_and_right_handed(normal):
    u, v = plane_basis(normal)
    n = torch.from_numpy(normal / np.linalg.norm(normal))
    torch.testing.assert_close(torch.linalg.cross(u, v), n, rtol=0, atol=ROUNDING)
    basis = torch.stack([u, v, n])
    torch.testing.assert_close(basis @ basis.T, torch.eye(3).double(), rtol=0, atol=ROUNDING)


@given(
    center=vectors,
    radius=st.floats(1e-3, 1),
    count=st.integers(1, 12),
    normal=normals(),
    angle=st.floats(-6, 6),
)
def test_circle_points_are_even_on_the_circle_and_in_its_plane(center, radius, count, normal, angle):
    offsets = circle_points(center, radius, count, normal, angle) - torch.from_numpy(center)
    n = torch.from_numpy(normal / np.linalg.norm(normal))
    assert offsets.shape == (count, 3)
    radii = torch.full((count,), radius, dtype=torch.float64)
    torch.testing.assert_close(offsets.norm(dim=-1), radii, rtol=0, atol=ROUNDING)
    torch.testing.assert_close(offsets @ n, torch.zeros(count).double(), rtol=0, atol=ROUNDING)
    neighbour = offsets.roll(-1, dims=0)
    cosine = (offsets * neighbour).sum(dim=-1) / radius**2
    # Offsets are differences of coordinates up to 2 m: relative to the least radius of 1 mm, 1e-12.
    even = torch.full((count,), math.cos(2 * math.pi / count), dtype=torch.float64)
    torch.testing.assert_close(cosine, even, rtol=0, atol=1e-11)


def test_circle_goes_from_u_towards_v():
    points = circle_points((80e-3, 50e-3, 50e-3), 30e-3, 4, (1, 0, 0))
    expected = [[80, 80, 50], [80, 50, 80], [80, 20, 50], [80, 50, 20]]
    # Decimal millimetres are not exact in binary, nor is cos(pi / 2) zero.
    torch.testing.assert_close(1e3 * points, torch.tensor(expected).double(), rtol=1e-14, atol=0)
    quarter = circle_points((80e-3, 50e-3, 50e-3), 30e-3, 4, (1, 0, 0), angle=math.pi / 2)
    torch.testing.assert_close(quarter, points.roll(-1, dims=0), rtol=0, atol=ROUNDING)


def test_plane_points_are_the_centres_of_its_cells_and_corners_span_its_size():
    plane = Plane(center=(80e-3, 50e-3, 50e-3), normal=(1, 0, 0), size=(40e-3, 20e-3))
    points = 1e3 * plane.points(spacing=10e-3)
    assert points.shape == (4, 2, 3)
    torch.testing.assert_close(points[:, 0, 1], torch.tensor([35, 45, 55, 65]).double(), rtol=1e-14, atol=0)
    torch.testing.assert_close(points[0, :, 2], torch.tensor([45, 55]).double(), rtol=1e-14, atol=0)
    assert (points[..., 0] == 80).all()
    corners = Plane(center=(0.5, 0.5, 0.0), normal=(0, 0, 2), size=(1.0, 0.5)).corners
    assert corners.tolist() == [[0.0, 0.25, 0.0], [0.0, 0.75, 0.0], [1.0, 0.25, 0.0], [1.0, 0.75, 0.0]]
    assert Plane([0, 0, 0], [2, 0, 0], [1, 1]) == Plane((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0))


@given(normal=normals(), center=vectors, spacing=st.floats(0.03, 1))
def test_plane_points_fill_the_plane_symmetrically(normal, center, spacing):
    plane = Plane(center, normal, size=(0.3, 0.1))
    points = plane.points(spacing)
    assert points.shape[:2] == (max(1, round(0.3 / spacing)), max(1, round(0.1 / spacing)))
    torch.testing.assert_close(points.mean(dim=(0, 1)), torch.from_numpy(center), rtol=0, atol=ROUNDING)
    u, v = plane.basis
    offsets = points - torch.from_numpy(center)
    assert (offsets @ u).abs().max() < 0.15
    assert (offsets @ v).abs().max() < 0.05


@pytest.mark.parametrize("name", ["positions", "normals", "control_points"])
def test_numpy_takes_the_coordinates_of_a_scene_as_its_own(name):
    """PyTorch's tensors make NumPy 2 warn, and warnings are errors here."""
    scene = small_scene()
    tensor = scene.control_points if name == "control_points" else getattr(scene.array, name)
    for array, shared in (
        (np.array(tensor), False),
        (np.array(tensor, copy=False), True),
        (np.asarray(tensor), True),
        (np.array(tensor, dtype=np.float32), False),
    ):
        assert np.array_equal(array, tensor.numpy().astype(array.dtype))
        assert np.shares_memory(array, tensor.numpy()) is shared
    with pytest.raises(ValueError, match="copy"):
        np.array(tensor, dtype=np.float32, copy=False)
    assert type(tensor + 0) is torch.Tensor
    for other in (copy.deepcopy(tensor), pickle.loads(pickle.dumps(tensor)), stored(tensor)):
        assert torch.equal(other, tensor)
        assert not np.shares_memory(other.numpy(), tensor.numpy())


def stored(tensor):
    file = io.BytesIO()
    torch.save(tensor, file)
    file.seek(0)
    return torch.load(file)


@pytest.mark.parametrize("count", [1, 2, 7, 200])
def test_sphere_points_are_even_on_the_sphere(count):
    offsets = sphere_points((1e-2, 2e-2, 3e-2), 5e-3, count) - torch.tensor(
        [1e-2, 2e-2, 3e-2], dtype=torch.float64
    )
    assert offsets.norm(dim=1).tolist() == pytest.approx([5e-3] * count, rel=1e-12)
    if count == 200:
        # A hexagonal lattice of as many points has distances of 1.07 times the root of the area of each.
        apart = torch.pdist(offsets).min() / (5e-3 * math.sqrt(4 * math.pi / count))
        assert 0.8 < apart < 1.08
        assert offsets.mean(dim=0).norm() < 0.01 * 5e-3


@pytest.mark.parametrize(("closed", "count"), [(True, 7), (False, 2), (False, 60), (True, 1)])
def test_points_of_a_polyline_are_at_equal_distances_along_its_lines(closed, count):
    corners = torch.tensor([[0, 0, 0], [3, 0, 0], [3, 4, 0], [3, 4, 0]], dtype=torch.float64)
    points = polyline_points(corners, count, closed)
    length = 12.0 if closed else 7.0
    steps = count if closed else count - 1
    expected = [_along(corners, length * number / steps) for number in range(count)]
    torch.testing.assert_close(points, torch.stack(expected), rtol=0, atol=1e-12)
    assert points[0].equal(corners[0])
    assert closed or points[-1].equal(corners[-1])


def _along(corners: torch.Tensor, way: float) -> torch.Tensor:
    """The point after a way along the lines, by walking."""
    for start, end in zip(corners, [*corners[1:], corners[0]], strict=True):
        length = float((end - start).norm())
        if way <= length and length:
            return start + way / length * (end - start)
        way -= length
    return corners[0]
