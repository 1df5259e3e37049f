import cmath
import dataclasses
import math
import pickle

import numpy as np
import pytest
import torch

from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.geometry import Plane, circle_points
from autdtorch.scene.obstacles import Box, Mesh, Sphere
from autdtorch.scene.scene import Medium, OverlapWarning, ScaleWarning, Scene

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


def test_obstacles_may_touch_by_edge_or_by_face():
    stepped = (cube(41, 60, 40, 10), cube(41, 50, 50, 10), cube(41, 40, 60, 10))
    assert paper_scene(obstacles=stepped).obstacles == stepped
    for rounding in (0.0, 1e-9, -1e-9):  # mm
        in_a_row = (cube(41, 50, 50, 16), cube(30 + rounding, 50, 50, 6))
        assert paper_scene(obstacles=in_a_row).obstacles == in_a_row


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


def test_obstacles_of_one_material_may_overlap_and_those_of_two_may_touch():
    paper_scene(obstacles=[ball(40, 8, 100.0), ball(45, 8, 100.0)])
    paper_scene(obstacles=[ball(40, 5, 100.0), ball(50, 5, 50.0)])
    # 0.4 mm apart, though the bounding boxes overlap
    diagonal = Sphere((46e-3, 56e-3, 56e-3), 5e-3, rigid=True)
    paper_scene(obstacles=[ball(40, 5, 100.0), diagonal])


def test_obstacles_may_reach_beyond_the_domain():
    domain = ((0.0, 0.0, 0.0), (0.1, 0.1, 0.1))
    wall = Box((90e-3, 50e-3, 50e-3), (10e-3, 1.0, 1.0), rigid=True)
    assert paper_scene(obstacles=[wall], domain=domain).domain == domain
    lower, upper = paper_scene(obstacles=[wall]).domain
    assert (lower[1], upper[2]) == pytest.approx((-0.45 - 17e-3, 0.55 + 17e-3))


def test_default_domain_holds_everything_and_two_wavelengths_more():
    plane = Plane(center=(80e-3, 50e-3, 50e-3), normal=(1, 0, 0), size=(200e-3, 20e-3))
    array = TransducerArray.grid((4, 8), pitch=10e-3, center=(1e-3, 50e-3, 50e-3), radius=5e-3)
    scene = paper_scene(array=array, obstacles=[cube(120, 50, 50, 10)], observation_plane=plane)
    margin = 2 * 8.5e-3
    lower, upper = scene.domain
    assert lower == pytest.approx((1e-3 - margin, -50e-3 - margin, 10e-3 - margin), rel=1e-12)
    assert upper == pytest.approx((125e-3 + margin, 150e-3 + margin, 90e-3 + margin), rel=1e-12)
    assert all(type(entry) is float for entry in lower + upper)


def test_given_domain_is_kept_and_may_be_touched():
    domain = ((1e-3, 0.0, 0.0), (80e-3, 100e-3, 100e-3))  # array and control points lie on its faces
    assert paper_scene(domain=domain).domain == domain
    assert paper_scene(domain=np.array(domain)).domain == domain


def test_a_scene_is_frozen_and_its_changed_copy_is_checked():
    scene = paper_scene(obstacles=[cube(41, 50, 50, 10)])
    with pytest.raises(dataclasses.FrozenInstanceError):
        scene.frequency = 20e3
    assert dataclasses.replace(scene, frequency=20e3).wavelength == pytest.approx(17e-3, rel=1e-15)
    with pytest.raises(ValueError, match="in or on obstacle 0"):
        dataclasses.replace(scene, control_points=[(41e-3, 50e-3, 50e-3)])


def test_scene_keeps_its_own_copies_and_survives_pickling():
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
