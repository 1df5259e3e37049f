"""Scenes that are saved, loaded and written as Python; a new shape or array is one entry."""

import dataclasses
import functools
import math
import operator
import runpy
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

import autdtorch as at
from autdtorch.io.scene_file import scene_lines, write_files
from autdtorch.scene.arrays import FORMS, flat_array, radii_of, recipes_of, strengths_of
from autdtorch.scene.geometry import rotation_matrix
from autdtorch.scene.obstacles import KINDS
from autdtorch.scene.obstacles.moving import circumscribed
from autdtorch.scene.obstacles.primitives import revolved

COORDINATE = st.floats(0.02, 0.06)
PLACE = st.tuples(COORDINATE, COORDINATE, COORDINATE)
POSE = ("scale", "offset", "rotation")
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
        lambda scale, *pose, fluid: at.Mesh.from_surface(
            (TETRAHEDRON[0] / scale, TETRAHEDRON[1]), scale, *pose, **fluid
        ),
        st.sampled_from([1.0, 1e-3]), PLACE, ANGLES, fluid=MATERIAL,
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


NORMAL = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda n: math.hypot(*n) > 0.1)
ANGLE = st.floats(-4, 4)
STRENGTHS = st.lists(st.floats(0.1, 9), min_size=4, max_size=4)
RADII = st.lists(st.floats(0, 4e-3), min_size=4, max_size=4)
# Functions that make an array around (x, 0, 0), so that several can be put side by side
PLAIN_BOARDS = st.one_of(
    st.builds(
        lambda normal, angle, strength, radius: (
            lambda x: at.TransducerArray.grid((2, 2), 9e-3, (x, 0, 0), normal, strength, radius, angle)
        ),
        NORMAL, ANGLE, STRENGTHS | st.just(2.0), RADII | st.sampled_from([None, 3e-3]),
    ),
    st.builds(
        lambda heights, normal, strength, radius: (
            lambda x: at.TransducerArray(
                [(x + 0.02 * n, 0, height) for n, height in enumerate(heights)], normal, strength, radius
            )
        ),
        st.lists(COORDINATE, min_size=4, max_size=4), NORMAL, STRENGTHS, RADII,
    ),
    st.builds(
        lambda kind, normal, angle: (
            lambda x: getattr(at.TransducerArray, kind)((x, 0, 0), normal, angle, radius=None)
        ),
        st.sampled_from(["autd3", "sonicsurface", "openmpd"]), NORMAL, ANGLE,
    ),
)  # fmt: skip


def calibrated(board, phase, spread):
    def make(x):
        array = board(x)
        ramp = torch.linspace(0, 1, len(array), dtype=torch.float64)
        return array.calibrated(1 + 0.1 * spread * ramp, phase + spread * ramp)

    return make


BOARDS = PLAIN_BOARDS | st.builds(calibrated, PLAIN_BOARDS, st.floats(-3, 3), st.sampled_from([0.0, 0.7]))


def kinds_in(path):
    section = yaml.safe_load(path.read_text("utf-8"))["array"]
    return [board["type"] for board in (section if isinstance(section, list) else [section])]


@pytest.mark.filterwarnings("ignore::autdtorch.utils.units.ScaleWarning")  # boards face all ways
@given(st.lists(BOARDS, min_size=1, max_size=3))
def test_arrays_keep_their_form_and_their_bits(tmp_path_factory, boards):
    array = functools.reduce(operator.add, [board(0.5 * number) for number, board in enumerate(boards)])
    scene = at.Scene(array, at.Medium.air(20.0), 40e3, [(0.03, 0.01, 3.0)])
    path = tmp_path_factory.mktemp("arrays") / "scene.yaml"
    at.save_scene(path, scene)
    require_equal(at.load_scene(path), scene)
    made = {}
    exec(scene_lines(scene, torch.ones(len(array), dtype=torch.complex128), "scene"), made)
    require_equal(made["scene"], scene)
    assert kinds_in(path) == [recipe.kind for board in boards for recipe in recipes_of(board(0.0))]


def test_a_scene_file_joins_boards_in_their_order(tmp_path):
    (tmp_path / "scene.yaml").write_text("""
frequency: 40e3
medium: {density: 1.2, sound_speed: 343.0}
array:
- {type: openmpd, center: [0, 0, 0.12], normal: [0, 0, -1], angle: 3.14159}
- {type: openmpd, center: [0, 0, -0.12], normal: [0, 0, 1]}
- {type: grid, shape: [1, 2], pitch: 10e-3, center: [0.2, 0, 0], normal: [-1, 0, 1], angle: 0.3,
   source_strength: [1.0, 2.0], radius: [0, 4e-3]}
control_points: {type: points, positions: [[0, 0, 0.01]]}
""")
    scene = at.load_scene(tmp_path / "scene.yaml")
    assert (scene.array.positions[:256, 2] == 0.12).all()
    assert (scene.array.positions[256:512, 2] == -0.12).all()
    assert strengths_of(scene.array)[-3:].tolist() == [3.4, 1.0, 2.0]
    assert radii_of(scene.array)[-3:].tolist() == [4.5e-3, 0.0, 4e-3]
    at.save_scene(tmp_path / "saved.yaml", scene)
    assert kinds_in(tmp_path / "saved.yaml") == ["openmpd", "openmpd", "grid"]
    drive = torch.ones(514, dtype=torch.complex128)
    with pytest.raises(ValueError, match="514 transducers; must be a multiple of 256 for openmpd"):
        at.save_drive(tmp_path / "drive.npz", drive, scene.array, "openmpd")
    boards = at.TransducerArray.openmpd((0, 0, 0)) + at.TransducerArray.openmpd((0.1, 0, 0))
    at.save_drive(tmp_path / "drive.npz", drive[:512] * 1j, boards, "openmpd")
    assert at.load_drive(tmp_path / "drive.npz").shape == (512,)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        ("[]", r"scene.yaml: array: .*; must be a mapping such as {type: autd3"),
        ("[autd3]", r"scene.yaml: array: .*'autd3'.*; must be a mapping such as {type: autd3"),
        ("[{type: autd3, center: [0, 0, 0]}, {type: autd, center: [0, 0, 0]}]", r"array\[1\]: type: 'autd'"),
        ("[{type: autd3, center: [0, 0, 0]}, {type: autd3, center: [0, 0, 0]}]", r"array: .* coincide"),
    ],
)
def test_what_is_wrong_with_boards_is_said(tmp_path, array, message):
    (tmp_path / "scene.yaml").write_text(f"""
frequency: 40e3
medium: {{density: 1.2, sound_speed: 343.0}}
array: {array}
control_points: {{type: points, positions: [[0, 0, 0.1]]}}
""")
    with pytest.raises(ValueError, match=message):
        at.load_scene(tmp_path / "scene.yaml")


def require_equal(loaded, saved):
    assert loaded.equals(saved)
    assert loaded.name == saved.name


@given(OBSTACLES, st.booleans())
@settings(max_examples=20)
def test_a_saved_scene_is_the_one_that_is_loaded(tmp_path_factory, obstacle, plane):
    scene = scene_with(obstacle, plane)
    path = tmp_path_factory.mktemp("saved") / "scene.yaml"
    at.save_scene(path, scene)
    loaded = at.load_scene(path)
    require_equal(loaded, scene)
    if isinstance(obstacle, at.Mesh):
        assert all(getattr(loaded.obstacles[0], name) == getattr(obstacle, name) for name in POSE)


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


def test_the_frequency_of_air_is_no_part_of_a_saved_or_replaced_medium(tmp_path):
    """Media that differ in this frequency alone are equal, and files have no frequency."""
    air = at.Medium.air()
    scene = dataclasses.replace(
        scene_with(at.Sphere((0.04, 0.04, 0.04), 3e-3, rigid=True), plane=False), medium=air
    )
    at.save_scene(tmp_path / "scene.yaml", scene)
    loaded = at.load_scene(tmp_path / "scene.yaml").medium
    assert (air.absorption_frequency, loaded.absorption_frequency) == (40e3, None)
    assert (loaded, hash(loaded)) == (air, hash(air))
    assert dataclasses.replace(air, absorption=1.0).absorption_frequency is None


FACTORS = st.sampled_from([1.0, -1.0, 0.3, -0.2 + 0.5j])


@given(NORMAL, st.lists(FACTORS, min_size=1, max_size=3))
@settings(max_examples=20, deadline=None)
def test_reflectors_are_saved_and_written_as_python_to_the_bit(tmp_path_factory, normal, factors):
    tilted = at.TransducerArray.grid((2, 2), 10e-3, (0.02, 0.01, -0.03), normal, radius=4e-3)
    panel = at.Reflector.behind(tilted, factors[0])
    middle, front = (torch.tensor(each, dtype=torch.float64) for each in (panel.point, panel.normal))
    across = torch.linalg.svd(front[None]).Vh[1:]  # two directions at right angles in the panel
    planes = [panel] + [
        at.Reflector(middle - 0.05 * each, each, factor)
        for each, factor in zip(across, factors[1:], strict=False)
    ]
    scene = at.Scene(tilted, at.Medium.air(20.0), 40e3, [middle + 0.06 * front], reflectors=planes)
    path = tmp_path_factory.mktemp("reflectors") / "scene.yaml"
    at.save_scene(path, scene)
    require_equal(at.load_scene(path), scene)
    made = {}
    exec(scene_lines(scene, torch.ones(4, dtype=torch.complex128), "scene"), made)
    require_equal(made["scene"], scene)


SCENE = """
frequency: 40e3
medium: {density: 1.2, sound_speed: 343.0}
array: {type: ring, count: 6, width: 30e-3, center: [0, 0, 0]}
control_points: {type: points, positions: [[45e-3, 0, 0], [45e-3, 6e-3, 0]]}
obstacles:
  - {type: cone, tip: [14e-3, 0, 0], axis: [1, 0, 0.2], radius: 7e-3, height: 12e-3, rigid: true}
"""


@dataclass(frozen=True)
class Cone(at.Obstacle):
    """A circular cone, from its tip along its axis."""

    position_field: ClassVar[str] = "tip"
    orientation_field: ClassVar[str | None] = "axis"

    tip: tuple[float, float, float]
    axis: tuple[float, float, float]
    radius: float
    height: float

    def __post_init__(self):
        super().__post_init__()
        object.__setattr__(self, "tip", tuple(self.tip))
        object.__setattr__(self, "axis", tuple(entry / math.hypot(*self.axis) for entry in self.axis))

    @property
    def _ends(self):
        disc = [self.radius * math.sqrt(1 - entry**2) for entry in self.axis]
        base = [place + self.height * entry for place, entry in zip(self.tip, self.axis, strict=True)]
        return list(zip(self.tip, base, disc, strict=True))

    @property
    def lower(self):
        return tuple(min(tip, base - disc) for tip, base, disc in self._ends)

    @property
    def upper(self):
        return tuple(max(tip, base + disc) for tip, base, disc in self._ends)

    def surface(self):
        profile = torch.tensor([(0.0, 0.0), (self.radius, self.height), (0.0, self.height)])
        return revolved(profile.double(), self.tip, self.axis)

    def _distance(self, points):
        inner, axis = points - points.new_tensor(self.tip), points.new_tensor(self.axis)
        along = inner @ axis
        across = torch.linalg.vector_norm(inner - along[:, None] * axis, dim=1)
        place, rim = torch.stack((across, along), 1), points.new_tensor((self.radius, self.height))
        side = (place @ rim / (rim @ rim)).clamp(0, 1)[:, None] * rim
        base = torch.stack((across.clamp(max=self.radius), torch.full_like(along, self.height)), 1)
        distance = torch.minimum((place - side).norm(dim=1), (place - base).norm(dim=1))
        inside = (along < self.height) & (across * self.height < along * self.radius)
        return torch.where(inside, -distance, distance)


def ring(count, width, center, normal=(1.0, 0.0, 0.0), angle=0.0, source_strength=1.0, radius=None):
    turns = 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    places = width / 2 * torch.stack((turns.cos(), turns.sin()), dim=1)
    return flat_array(
        "ring", places, center, normal, angle, source_strength, radius, count=count, width=width
    )


@pytest.fixture
def scene(tmp_path, monkeypatch):
    monkeypatch.setitem(KINDS, "cone", Cone)
    monkeypatch.setitem(FORMS, "ring", ring)
    (tmp_path / "scene.yaml").write_text(SCENE)
    return at.load_scene(tmp_path / "scene.yaml")


def test_they_are_loaded_saved_and_written_as_python(scene, tmp_path):
    assert type(scene.obstacles[0]) is Cone
    assert len(scene.array) == 6
    at.save_scene(tmp_path / "saved.yaml", scene)
    assert at.load_scene(tmp_path / "saved.yaml").equals(scene)
    text = (tmp_path / "saved.yaml").read_text()
    assert "type: cone" in text
    assert "type: ring" in text
    names = {}
    exec(scene_lines(scene, torch.ones(6, dtype=torch.complex128), "scene"), names)
    assert names["scene"].equals(scene)


def test_the_shape_moves_and_turns(scene):
    (cone,) = scene.obstacles
    offset, angles = (1e-3, 2e-3, 0.0), (0.3, -0.2, 0.5)
    (moved,) = scene.moved(offset, angles).obstacles
    points = 20e-3 * torch.rand(50, 3, dtype=torch.float64)
    center, _ = circumscribed((cone,))
    there = center + (points - center) @ rotation_matrix(angles).T + torch.tensor(offset)
    torch.testing.assert_close(moved.signed_distance(there), cone.signed_distance(points), rtol=0, atol=1e-9)
    assert not torch.allclose(moved.signed_distance(points), cone.signed_distance(points), rtol=0, atol=1e-4)


def test_the_shape_scatters_as_its_mesh_does(scene):
    (cone,) = scene.obstacles
    mesh = at.Mesh.from_surface(cone.surface(), rigid=True)
    cones, meshes, nothing = (
        at.make_propagator(replace(scene, obstacles=bodies, domain=None), spacing=1.5e-3).transfer_matrix()
        for bodies in ([cone], [mesh], [])
    )
    assert (cones - nothing).abs().max() > 0.2 * nothing.abs().max()
    # 5.7 cells to a wavelength, where the surfaces of a shape and of its mesh differ by 1 %
    assert (cones - meshes).abs().max() < 0.03 * cones.abs().max()
