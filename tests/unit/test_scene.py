"""Scenes and their air, whose absorption is that of published tables."""

import cmath
import dataclasses
import math
import pickle

import numpy as np
import pytest
import torch

from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.geometry import Plane, circle_points
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
    """What is left rises as f^2/p: viscosity, heat and rotation, 1.84e-11 Np/m per Hz^2 at one atmosphere.

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
