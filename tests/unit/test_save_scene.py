"""A scene that is saved is the scene that is loaded, and so are the lines of Python that make it."""

import math
import runpy

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import autdtorch as at
from autdtorch.io.scene_sections import scene_lines, write_files

COORDINATE = st.floats(0.02, 0.06)
PLACE = st.tuples(COORDINATE, COORDINATE, COORDINATE)
ANGLES = st.tuples(*[st.floats(-math.pi, math.pi)] * 3)
MATERIAL = st.sampled_from([{"rigid": True}, {"density": 100.0, "sound_speed": 340.0}])
TETRAHEDRON = (
    torch.tensor([[0, 0, 0], [5e-3, 0, 0], [0, 5e-3, 0], [0, 0, 5e-3]], dtype=torch.float64),
    torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
)
OBSTACLES = st.one_of(
    st.builds(
        lambda place, turn, fluid: at.Box(place, (4e-3, 6e-3, 5e-3), turn, **fluid), PLACE, ANGLES, MATERIAL
    ),
    st.builds(lambda place, fluid: at.Sphere(place, 3e-3, **fluid), PLACE, MATERIAL),
    st.builds(
        lambda place, axis, fluid: at.Cylinder(place, 2e-3, 7e-3, axis, **fluid),
        PLACE, st.sampled_from([(1, 0, 0), (1, 2, 3)]), MATERIAL,
    ),
    st.builds(
        lambda place, turn, fluid: at.Mesh.from_surface(TETRAHEDRON, 1.0, place, turn, **fluid),
        PLACE, ANGLES, MATERIAL,
    ),
    st.builds(
        lambda place, smooth, fluid: at.VoxelMask(
            np.eye(3, dtype=bool)[:, :, None], (1e-3, 2e-3, 1e-3), place, smooth=smooth, **fluid
        ),
        PLACE, st.booleans(), MATERIAL,
    ),
)  # fmt: skip


def scene_with(obstacle, plane):
    array = at.TransducerArray.grid((2, 2), 10e-3, (1e-3, 40e-3, 40e-3), source_strength=0.3, radius=4e-3)
    points = at.circle_points((90e-3, 40e-3, 40e-3), 20e-3, 3, (1, 0, 0))
    sheet = at.Plane((90e-3, 40e-3, 40e-3), (1, 1, 0), (30e-3, 40e-3)) if plane else None
    return at.Scene(array, at.Medium.air(31.0), 40e3, points, (obstacle,), sheet, name="a: b")


def require_equal(found, wanted):
    for name in ("positions", "normals"):
        assert torch.equal(getattr(found.array, name), getattr(wanted.array, name))
    assert torch.equal(found.control_points, wanted.control_points)
    for name in ("medium", "frequency", "domain", "observation_plane", "name", "obstacles"):
        assert getattr(found, name) == getattr(wanted, name)
    assert (found.array.source_strength, found.array.radius) == (
        wanted.array.source_strength,
        wanted.array.radius,
    )


@given(OBSTACLES, st.booleans())
@settings(max_examples=40, deadline=None)
def test_a_saved_scene_is_the_one_that_is_loaded(tmp_path_factory, obstacle, plane):
    scene = scene_with(obstacle, plane)
    path = tmp_path_factory.mktemp("saved") / "scene.yaml"
    at.save_scene(path, scene)
    require_equal(at.load_scene(path), scene)


@given(OBSTACLES, st.booleans(), st.lists(st.floats(0, 6), min_size=4, max_size=4), st.floats(0, 1))
@settings(max_examples=20, deadline=None)
def test_lines_of_python_make_scene_and_drive(tmp_path_factory, obstacle, plane, phases, amplitude):
    scene = scene_with(obstacle, plane)
    drive = at.drive_from_phases(torch.tensor(phases, dtype=torch.float64), amplitude)
    folder = tmp_path_factory.mktemp("lines")
    write_files(scene, folder / "scene")
    made = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        exec(scene_lines(scene, drive, "scene"), made)
    require_equal(made["scene"], scene)
    torch.testing.assert_close(made["drive"], drive, rtol=0, atol=1e-14)


def test_a_saved_mesh_keeps_its_coordinates_and_pose(tmp_path):
    vertices, faces = TETRAHEDRON
    mesh = at.Mesh.from_surface((1e3 * vertices, faces), 1e-3, (40e-3,) * 3, (0.0, 0.3, 1.0), rigid=True)
    at.save_scene(tmp_path / "scene.yaml", scene_with(mesh, plane=False))
    (found,) = at.load_scene(tmp_path / "scene.yaml").obstacles
    assert (found.scale, found.offset, found.rotation) == (mesh.scale, mesh.offset, mesh.rotation)
    assert torch.equal(found.vertices, mesh.vertices)


def test_a_file_of_the_lines_finds_its_meshes_from_anywhere(tmp_path, monkeypatch):
    mesh = at.Mesh.from_surface(TETRAHEDRON, 1.0, (40e-3,) * 3, rigid=True)
    scene = scene_with(mesh, plane=False)
    write_files(scene, tmp_path / "scene")
    file = tmp_path / "lines.py"
    file.write_text(scene_lines(scene, torch.ones(4, dtype=torch.complex128), "scene", beside=True), "utf-8")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    require_equal(runpy.run_path(str(file))["scene"], scene)


def test_an_obstacle_of_ones_own_is_refused(tmp_path):
    class Own(at.Sphere):
        pass

    scene = scene_with(Own((40e-3, 40e-3, 40e-3), 3e-3, rigid=True), plane=False)
    with pytest.raises(ValueError, match=r"obstacles\[0\].*Own"):
        at.save_scene(tmp_path / "scene.yaml", scene)
    assert not list(tmp_path.iterdir())
