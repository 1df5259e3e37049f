"""What is wrong with the input must be clear from the message: the field, the value, what is accepted.

Values of a wrong kind are in test_any_input.py; these are out of range, or do not go together.
"""

import math
from collections import UserList, deque

import numpy as np
import pytest
import torch

from autdtorch.analytic.green import green
from autdtorch.propagators import make_propagator
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.drive import drive_from_phases, focus_phases, normalise, validate_drive
from autdtorch.scene.geometry import Plane, circle_points, plane_basis
from autdtorch.scene.obstacles import Box, Cylinder, Mesh, Sphere, VoxelMask
from autdtorch.scene.scene import Medium, Scene

NAN, INF = math.nan, math.inf


def medium(**changes):
    return Medium(**{"density": 1.293, "sound_speed": 340.0} | changes)


def box(**changes):
    material = {"density": 100.0, "sound_speed": 340.0}
    return Box(**{"center": (41e-3, 50e-3, 50e-3), "size": (10e-3,) * 3} | material | changes)


def cylinder(**changes):
    return Cylinder(**{"center": (0, 0, 0), "radius": 1e-3, "height": 1e-3, "rigid": True} | changes)


def voxels(mask, **changes):
    return VoxelMask(**{"mask": mask, "spacing": 1e-3, "rigid": True} | changes)


def grid(**changes):
    return TransducerArray.grid(**{"shape": (4, 4), "pitch": 10e-3, "center": (1e-3, 50e-3, 50e-3)} | changes)


def circle(**changes):
    arguments = {"center": (80e-3, 50e-3, 50e-3), "radius": 30e-3, "count": 4, "normal": (1, 0, 0)}
    return circle_points(**arguments | changes)


def plane(**changes):
    return Plane(**{"center": (80e-3, 50e-3, 50e-3), "normal": (1, 0, 0), "size": (0.1, 0.1)} | changes)


def scene(**changes):
    arguments = {"array": grid(), "medium": medium(), "frequency": 40e3, "control_points": circle()}
    return Scene(**arguments | changes)


WRONG = {
    # numbers
    "density negative": (lambda: medium(density=-1.2), "Medium.density: -1.2 kg/m^3; must be finite and > 0"),
    "frequency zero": (lambda: scene(frequency=0), "Scene.frequency: 0 Hz; must be finite and > 0"),
    # boxes
    "box size negative": (
        lambda: box(size=(0.01, -1, 0.01)),
        "Box.size: (0.01, -1, 0.01) m; every entry must be finite and > 0",
    ),
    "box size of two": (lambda: box(size=(0.01, 0.01)), "Box.size: (0.01, 0.01); must be 3 real numbers [m]"),
    "sphere radius": (
        lambda: Sphere((0, 0, 0), -1e-3, rigid=True),
        "Sphere.radius: -0.001 m; must be finite and > 0",
    ),
    "sphere without material": (lambda: Sphere((0, 0, 0), 1e-3), "Sphere.density: None; must have both"),
    "cylinder axis": (
        lambda: cylinder(axis=(0, 0, 0)),
        "Cylinder.axis: (0, 0, 0); must be a vector of finite",
    ),
    "mesh of another format": (
        lambda: Mesh("chair.step", rigid=True),
        "Mesh.path: 'chair.step'; must end in one of .stl, .obj, .ply",
    ),
    "mesh missing": (
        lambda: Mesh("no/such.stl", rigid=True),
        "Mesh.path: 'no/such.stl'; must be an existing file",
    ),
    "mesh scale": (lambda: Mesh("a.stl", scale=0, rigid=True), "Mesh.scale: 0; must be finite and > 0"),
    "mask flat": (
        lambda: voxels(np.ones((2, 2), bool)),
        "VoxelMask.mask: ([True, True], [True, True]); must be an array (nx, ny, nz) of booleans",
    ),
    "mask empty": (
        lambda: voxels(np.zeros((2, 3, 4), bool)),
        "VoxelMask.mask: array of shape (2, 3, 4); must be True somewhere",
    ),
    "mask spacing": (
        lambda: voxels(np.ones((1, 1, 1), bool), spacing=0),
        "VoxelMask.spacing: 0 m; must be finite and > 0",
    ),
    "mask file missing": (
        lambda: VoxelMask.load("no/such.npy", 1e-3, rigid=True),
        "VoxelMask.path: 'no/such.npy'; must be a .npy or .npz file (",
    ),
    "points of an obstacle": (lambda: box().contains([1.0, 2.0]), "points: shape (2,); must be (..., 3)"),
    "margin of an obstacle": (
        lambda: box().contains([0, 0, 0], margin=-1e-3),
        "margin: -0.001 m; must be finite and >= 0",
    ),
    "box rigid and material": (lambda: box(rigid=True), "Box.rigid: (100.0, 340.0); must have either"),
    "box neither": (lambda: box(density=None, sound_speed=None), "Box.density: None; must have both"),
    "box half a material": (lambda: box(sound_speed=None), "Box.sound_speed: None; must have both"),
    "box density negative": (
        lambda: box(density=-100.0),
        "Box.density: -100.0 kg/m^3; must be finite and > 0",
    ),
    "box contains wrong shape": (lambda: box().contains([[0, 0]]), "points: shape (1, 2); must be (..., 3)"),
    # arrays
    "array empty": (
        lambda: TransducerArray([], (1, 0, 0)),
        "TransducerArray.positions: shape (0,); must be (P, 3)",
    ),
    "array of plane points": (
        lambda: TransducerArray([[0, 0]], (1, 0, 0)),
        "positions: shape (1, 2); must be (P, 3)",
    ),
    "array duplicates": (
        lambda: TransducerArray([[0, 0, 0], [0, 1, 0], [0, 0, 1e-10]], (1, 0, 0)),
        "TransducerArray.positions: points 0 and 2 coincide at (0.0, 0.0, 0.0) m",
    ),
    "normal zero": (lambda: grid(normal=(0, 0, 0)), "normal: (0, 0, 0); must be a vector of finite length >"),
    "one normal zero": (
        lambda: TransducerArray([[0, 0, 0], [0, 1, 0]], [[1, 0, 0], [0, 0, 0]]),
        "TransducerArray.normals[1]: (0.0, 0.0, 0.0); must be a vector of finite length",
    ),
    "normals too few": (
        lambda: TransducerArray([[0, 0, 0], [0, 1, 0], [0, 2, 0]], [[1, 0, 0], [1, 0, 0]]),
        "TransducerArray.normals: shape (2, 3); must be (3,) or (3, 3)",
    ),
    "source strength zero": (
        lambda: grid(source_strength=0.0),
        "TransducerArray.source_strength: 0.0 Pa m; must be finite and > 0",
    ),
    "pitch zero": (lambda: grid(pitch=0), "pitch: 0 m; must be finite and > 0"),
    "grid of none": (lambda: grid(shape=(0, 4)), "shape[0]: 0; must be an integer >= 1"),
    "grid of one number": (lambda: grid(shape=4), "shape: 4; must be 2 integers >= 1"),
    "disc radius negative": (
        lambda: grid(radius=-1e-3),
        "TransducerArray.radius: -0.001 m; must be finite and >= 0",
    ),
    "discs that overlap": (
        lambda: grid(radius=5.1e-3),
        "TransducerArray.radius: 0.0051 m; must be at most 0.005 m, half the distance of neighbours",
    ),
    # air
    "absorption negative": (
        lambda: medium(absorption=-1),
        "Medium.absorption: -1 dB/m; must be finite and >= 0",
    ),
    "air too hot": (lambda: Medium.air(70.0), "temperature: 70.0 deg C; must be in -20 to 50"),
    "humidity as a share of more than all": (
        lambda: Medium.air(20.0, 120),
        "relative_humidity: 120 %; must be in 0 to 100",
    ),
    "pressure in hPa": (
        lambda: Medium.air(pressure=1013.25),
        "pressure: 1013.25 Pa; must be in 50000 to 200000",
    ),
    "frequency beyond the standard": (
        lambda: Medium.air(frequency=2e6),
        "frequency: 2000000.0 Hz; must be in 40.53 to 1.01325e+06",
    ),
    # geometry
    "radius negative": (lambda: circle(radius=-0.03), "radius: -0.03 m; must be finite and > 0"),
    "basis of four": (lambda: plane_basis((1, 0, 0, 0)), "normal: (1, 0, 0, 0); must be 3 real numbers"),
    "basis of nothing": (
        lambda: plane_basis((1e-12, 0, 0)),
        "normal: (1e-12, 0, 0); must be a vector of finite",
    ),
    "plane size zero": (
        lambda: plane(size=(0.1, 0)),
        "Plane.size: (0.1, 0) m; every entry must be finite and > 0",
    ),
    "plane spacing": (lambda: plane().points(-1e-3), "spacing: -0.001 m; must be finite and > 0"),
    # drives
    "amplitude above one": (
        lambda: drive_from_phases([0.0, 0.0], [0.5, 1.5]),
        "amplitudes: from 0.5 to 1.5; every entry must be in [0, 1]",
    ),
    "amplitudes of another shape": (
        lambda: drive_from_phases([0.0, 0.0], [1.0, 1.0, 1.0]),
        "amplitudes: shape (3,); must broadcast with phases, (2,)",
    ),
    "phases scalar": (lambda: drive_from_phases(1.0), "phases: shape (); must be (..., M)"),
    "drive too loud": (
        lambda: validate_drive([1.1j, 0], 2),
        "drive: amplitude 1.1; every |q| must be in [0, 1]",
    ),
    "drive of another array": (lambda: validate_drive([1j, 0], 16), "drive: shape (2,); must be (..., 16)"),
    "drive silent": (lambda: normalise([[1j, 0], [0j, 0]]), "drive: 0 for every transducer; at least one"),
    "drive without entries": (
        lambda: normalise(torch.zeros(3, 0) * 1j),
        "drive: shape (3, 0); must be (..., M)",
    ),
    "focus of two": (
        lambda: focus_phases([[0, 0, 0]], (1, 2), 1.0),
        "focus: (1, 2); must be 3 real numbers [m]",
    ),
    "wavenumber zero": (
        lambda: focus_phases([[0, 0, 0]], (1, 2, 3), 0.0),
        "wavenumber: 0.0 rad/m; must be finite",
    ),
    # free space
    "point on a source": (
        lambda: green([[0, 0, 1], [0, 0, 0]], [[0, 0, 0]], 1.0),
        "points[1]: (0.0, 0.0, 0.0) m; lies on source 0, must be at least 1e-09 m away",
    ),
    "waves that grow": (
        lambda: green([[0, 0, 1]], [[0, 0, 0]], 1 - 0.1j),
        "wavenumber.imag: -0.1 Np/m; must be finite and >= 0",
    ),
    # scenes
    "name empty": (lambda: scene(name=""), "Scene.name: ''; must be text of at least one character"),
    "one control point without a list": (
        lambda: scene(control_points=(80e-3, 50e-3, 50e-3)),
        "Scene.control_points: shape (3,); must be (P, 3) with P >= 1",
    ),
    "no control point": (
        lambda: scene(control_points=[]),
        "Scene.control_points: shape (0,); must be (P, 3)",
    ),
    "control points twice": (
        lambda: scene(control_points=[(0.08, 0.05, 0.05)] * 2),
        "Scene.control_points: points 0 and 1 coincide at (0.08, 0.05, 0.05) m",
    ),
    "control point on a transducer": (
        lambda: scene(array=grid(shape=(1, 1)), control_points=[(1e-3, 50e-3, 50e-3)]),
        "Scene.control_points[0]: (0.001, 0.05, 0.05) m; lies on transducer 0",
    ),
    "transducer in an obstacle": (
        lambda: scene(obstacles=[box(), box(center=(0.0, 35e-3, 35e-3))]),
        "Scene.array.positions[0]: (0.001, 0.035, 0.035) m; lies in or on obstacle 1",
    ),
    "disc in an obstacle": (
        lambda: scene(array=grid(radius=5e-3), obstacles=[box(center=(0.0, 26e-3, 35e-3))]),
        "Scene.array.nodes[0, ",
    ),
    "disc outside the domain": (
        lambda: scene(array=grid(radius=5e-3, normal=(0, 1, 0)), domain=((-15e-3, 0, 0), (0.1, 0.1, 0.1))),
        "Scene.array disc's lower edge[0]: (-0.019, 0.05, 0.03",
    ),
    "air that lets nothing through": (
        lambda: scene(medium=medium(absorption=400.0)),
        "Scene.medium.absorption: 400.0 dB/m; must be at most 352.9 dB/m, 3 dB per wavelength",
    ),
    "control point in an obstacle": (
        lambda: scene(obstacles=[box(center=(80e-3, 50e-3, 80e-3))]),
        "Scene.control_points[1]: (0.08, 0.05, 0.08) m; lies in or on obstacle 0",
    ),
    "control point on an obstacle": (
        lambda: scene(obstacles=[box()], control_points=[(46e-3, 50e-3, 50e-3)]),
        "must be outside it",
    ),
    "domain upside down": (
        lambda: scene(domain=((0, 0, 0), (0.1, 0.1, 0))),
        "Scene.domain: ((0.0, 0.0, 0.0), (0.1, 0.1, 0.0)) m; lower must be below upper on every axis",
    ),
    "domain of one corner": (lambda: scene(domain=(1, 1, 1)), "Scene.domain: (1, 1, 1); must be two corners"),
    "control point outside the domain": (
        lambda: scene(domain=((0, 0, 0), (0.1, 0.1, 0.07))),
        "Scene.control_points[1]: (0.08, 0.05, 0.08) m; must be inside the domain, (0.0, 0.0, 0.0) to",
    ),
    "transducer outside the domain": (
        lambda: scene(domain=((0.01, 0, 0), (0.1, 0.1, 0.1))),
        "Scene.array.positions[0]: (0.001, 0.035, 0.035) m; must be inside the domain",
    ),
    "obstacle outside the domain": (
        lambda: scene(domain=((0, 0, 0), (0.1, 0.1, 0.1)), obstacles=[box(center=(41e-3, 50e-3, 105e-3))]),
        "Scene.obstacles[0]: (0.036, 0.045, 0.1) to (0.046, 0.055, 0.11) m; must be at least partly inside",
    ),
    "observation plane outside the domain": (
        lambda: scene(domain=((0, 0, 0), (0.1, 0.1, 0.1)), observation_plane=plane(size=(0.1, 0.2))),
        "Scene.observation_plane corner[0]: (0.08, 0.0, -0.05) m; must be inside the domain",
    ),
}


@pytest.mark.parametrize(("call", "message"), WRONG.values(), ids=WRONG.keys())
def test_wrong_input_is_named(call, message):
    with pytest.raises(ValueError) as caught:  # noqa: PT011  (compared as plain text below)
        call()
    assert message in str(caught.value)


ONE_TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
MESHES = {
    "open.obj": (
        ONE_TRIANGLE,
        "3 of its 3 edges do not join two triangles of one orientation, must be watertight",
    ),
    "flat.obj": (ONE_TRIANGLE + "f 3 2 1\n", "must enclose a volume"),
    "twice.obj": (ONE_TRIANGLE + "f 1 2 3\n", "3 of its 3 edges do not join"),
    "no_vertex.obj": ("v 0 0 0\nv 1 0 0\nf 1 2 7\n", "must be a mesh file that holds triangles"),
    "empty.obj": ("", "must be a mesh file"),
    "far.obj": (
        "v 0 0 0\nv 1e200 0 0\nv 0 1e200 0\nv 0 0 1e200\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n",
        "must be a mesh file that holds triangles with finite vertices, none beyond 1e+100",
    ),
    "text.stl": ("hello", "must be a mesh file"),
    "text.ply": ("hello", "must be a mesh file"),
}


@pytest.mark.parametrize(("name", "content", "message"), [(name, *case) for name, case in MESHES.items()])
def test_what_is_no_watertight_mesh_is_refused(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(ValueError, match=r"^Mesh\.path: .*") as caught:
        Mesh(path, rigid=True)
    assert message in str(caught.value)


def test_what_is_no_mask_file_is_refused(tmp_path):
    path = tmp_path / "two.npz"
    np.savez(path, a=np.ones(1), b=np.ones(1))
    with pytest.raises(ValueError, match="holds 2 arrays, must hold a single one"):
        VoxelMask.load(path, 1e-3, rigid=True)
    path.write_bytes(b"PK\x03\x04 and then nothing")
    with pytest.raises(ValueError, match=r"VoxelMask\.path: .* must be a \.npy or \.npz file"):
        VoxelMask.load(path, 1e-3, rigid=True)


@pytest.mark.parametrize("kind", [deque, UserList, tuple])
def test_a_list_of_any_class_is_a_list(kind):
    assert circle(center=kind([80e-3, 50e-3, 50e-3])).equal(circle())


FAR = 1e200
ABSURD = {
    "domain": (
        lambda: scene(domain=((-FAR,) * 3, (FAR,) * 3)),
        "Scene.domain: (-1e+200, -1e+200, -1e+200) m; every coordinate must be in -1e+06 to 1e+06",
    ),
    "control point": (
        lambda: scene(control_points=[[FAR, 0, 0]]),
        "Scene.control_points: (1e+200, 0.0, 0.0) m; every coordinate",
    ),
    "transducer": (
        lambda: scene(array=grid(pitch=FAR)),
        "Scene.array.positions: (0.001, -1.5e+200, -1.5e+200) m; every coordinate",
    ),
    "plane": (
        lambda: scene(observation_plane=plane(size=(FAR, 0.1))),
        "Scene.observation_plane corner: (0.08, ",
    ),
    "large box": (
        lambda: scene(obstacles=[box(center=(FAR, 0, 0), size=(FAR,) * 3)]),
        "Scene.obstacles[0] corner: (5e+199, -5e+199, -5e+199) m; every coordinate",
    ),
    "box beyond floats": (
        lambda: scene(obstacles=[box(center=(1e308, 0, 0), size=(1.7e308,) * 3)]),
        "Scene.obstacles[0] corner: (",
    ),
    "far sphere": (
        lambda: scene(obstacles=[Sphere((0, FAR, 0), 1.0, rigid=True)]),
        "Scene.obstacles[0] corner: (-1.0, 1e+200, -1.0) m; every coordinate",
    ),
    "fast medium": (
        lambda: medium(sound_speed=FAR),
        "Medium.sound_speed: 1e+200 m/s; must be in 0.001 to 1e+06",
    ),
    "slow medium": (lambda: medium(sound_speed=1 / FAR), "Medium.sound_speed: 1e-200 m/s; must be in 0.001"),
    "fast box": (lambda: box(sound_speed=FAR), "Box.sound_speed: 1e+200 m/s; must be in 0.001 to 1e+06"),
    "heavy medium": (lambda: medium(density=FAR), "Medium.density: 1e+200 kg/m^3; must be in 1e-09 to 1e+09"),
    "light box": (lambda: box(density=1 / FAR), "Box.density: 1e-200 kg/m^3; must be in 1e-09 to 1e+09"),
    "high frequency": (lambda: scene(frequency=FAR), "Scene.frequency: 1e+200 Hz; must be in 0.001 to 1e+12"),
    "low frequency": (lambda: scene(frequency=1 / FAR), "Scene.frequency: 1e-200 Hz; must be in 0.001 to"),
    "fine cells": (
        lambda: make_propagator(scene(obstacles=[box()]), spacing=1 / FAR),
        "spacing: 1e-200 m; must be at least 1.7e-05 m",
    ),
}


@pytest.mark.parametrize(("call", "message"), ABSURD.values(), ids=ABSURD.keys())
def test_what_would_overflow_later_is_refused_where_it_comes_in(call, message):
    with pytest.raises(ValueError) as caught:  # noqa: PT011  (compared as plain text below)
        call()
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("method", ["box", "full"])
def test_the_largest_scene_is_refused_for_its_memory(method):
    far = 1e6
    wall = box(center=(0, 0, far / 2), size=(far, far, far - 2))
    wide = scene(domain=((-far,) * 3, (far,) * 3), obstacles=[wall])
    with pytest.raises(ValueError, match=r"^spacing: 0\.001 m; (needs about|gives) "):
        make_propagator(wide, method)
