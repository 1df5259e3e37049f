"""Scenes from YAML files and mappings; errors name the place, the value and what is accepted."""

import copy
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from small_scenes import CORNER

from autdtorch.io.scene_file import load_scene
from autdtorch.scene.geometry import sphere_points
from autdtorch.scene.obstacles import Box, Cylinder, Mesh, Sphere, VoxelMask
from autdtorch.scene.reflectors import Reflector
from autdtorch.scene.scene import Medium

SCENES = Path(__file__).parents[2] / "configs" / "scene"

SMALL = """
frequency: 40e3
medium: {density: 1.293, sound_speed: 340.0, absorption: 1.3}
array: {type: positions, positions: [[0, 0, 0], [0, 10e-3, 0]], normals: [1, 0, 0], source_strength: 2.0,
  radius: 5e-3}
control_points: {type: points, positions: [[80e-3, 0, 0]]}
"""


def paper_cube(x, y, z, edge):
    center = (1e-3 * x, 1e-3 * y, 1e-3 * z)
    return pytest.approx((*center, 1e-3 * edge, 100.0, 340.0), rel=1e-15)


@pytest.mark.parametrize(
    ("name", "cubes"),
    [
        ("homogeneous", []),
        ("three_cubes", [(41, 60, 40, 10), (41, 50, 50, 10), (41, 40, 60, 10)]),
        ("two_cubes", [(41, 50, 50, 16), (30, 50, 50, 6)]),
    ],
)
def test_paper_scenes(name, cubes):
    scene = load_scene(SCENES / f"{name}.yaml")
    assert scene.name == name
    assert (scene.frequency, scene.medium.density, scene.medium.sound_speed) == (40e3, 1.293, 340.0)
    found = [(*box.center, box.size[0], box.density, box.sound_speed) for box in scene.obstacles]
    assert found == [paper_cube(*given) for given in cubes]
    assert all(len(set(box.size)) == 1 for box in scene.obstacles)
    assert scene.domain == ((0.0, 0.0, 0.0), (0.1, 0.1, 0.1))
    assert scene.observation_plane.points(1e-3).shape == (100, 100, 3)
    # Decimal millimetres are not exact in binary.
    assert len(scene.array) == 16
    middle = torch.tensor([1, 50, 50]).double()
    torch.testing.assert_close(1e3 * scene.array.positions.mean(dim=0), middle, rtol=1e-14, atol=0)
    foci = torch.tensor([[80, 80, 50], [80, 50, 80], [80, 20, 50], [80, 50, 20]]).double()
    torch.testing.assert_close(1e3 * scene.control_points, foci, rtol=1e-14, atol=0)


def test_positions_points_and_defaults(tmp_path):
    path = tmp_path / "small.yaml"
    path.write_text(SMALL + "obstacles:\nobservation_plane: null\n")  # keys without a value count as left out
    scene = load_scene(path)
    assert scene.array.positions.tolist() == [[0.0, 0.0, 0.0], [0.0, 10e-3, 0.0]]
    assert (scene.array.source_strength, scene.array.radius, scene.medium.absorption) == (2.0, 5e-3, 1.3)
    assert scene.control_points.tolist() == [[80e-3, 0.0, 0.0]]
    assert (scene.obstacles, scene.observation_plane, scene.name) == ((), None, "scene")


def test_a_mapping_a_node_and_the_file_give_the_same_scene_and_stay_as_they_were():
    config = OmegaConf.load(SCENES / "two_cubes.yaml")
    plain = OmegaConf.to_container(config)
    expected = load_scene(SCENES / "two_cubes.yaml").obstacles
    assert load_scene(plain).obstacles == load_scene(config).obstacles == expected
    given = OmegaConf.to_container(OmegaConf.load(SCENES / "two_cubes.yaml"))
    before = copy.deepcopy(given)
    load_scene(given)
    assert given == before


def test_air_and_interpolations_follow_the_frequency():
    config = OmegaConf.create(SMALL)
    config.frequency, config.medium = 25e3, {"temperature": 25.0, "relative_humidity": 40}
    assert load_scene(config).medium == Medium.air(25.0, 40.0, frequency=25e3)
    config = OmegaConf.create({"tone": 25e3, "scene": OmegaConf.create(SMALL)})
    config.scene.frequency = "${tone}"
    assert load_scene(config.scene).frequency == 25e3


def test_obstacles_of_every_type_with_files_beside_the_scene(tmp_path):
    mask = np.ones((2, 3, 4), bool)
    np.save(tmp_path / "mask.npy", mask)
    (tmp_path / "shapes").mkdir()
    (tmp_path / "shapes" / "corner.obj").write_text(CORNER)
    path = tmp_path / "scene.yaml"
    path.write_text(
        SMALL
        + """
obstacles:
  - {type: box, center: [20e-3, 0, 0], size: [5e-3, 5e-3, 5e-3], rotation: [0, 0, 0.5], rigid: true}
  - {type: sphere, center: [30e-3, 0, 0], radius: 3e-3, density: 100.0, sound_speed: 340.0}
  - {type: cylinder, center: [40e-3, 0, 0], radius: 3e-3, height: 9e-3, axis: [0, 1, 1], rigid: true}
  - {type: mesh, path: shapes/corner.obj, scale: 5e-3, offset: [50e-3, 0, 0], rigid: true}
  - {type: voxel_mask, path: mask.npy, spacing: 1e-3, origin: [60e-3, 0, 0], rigid: true}
"""
    )
    assert load_scene(path).obstacles == (
        Box((20e-3, 0, 0), (5e-3,) * 3, rotation=(0, 0, 0.5), rigid=True),
        Sphere((30e-3, 0, 0), 3e-3, density=100.0, sound_speed=340.0),
        Cylinder((40e-3, 0, 0), 3e-3, 9e-3, axis=(0, 1, 1), rigid=True),
        Mesh(tmp_path / "shapes" / "corner.obj", scale=5e-3, offset=(50e-3, 0, 0), rigid=True),
        VoxelMask(mask, 1e-3, origin=(60e-3, 0, 0), rigid=True),
    )


def test_path_in_a_mapping_starts_from_the_working_directory(tmp_path, monkeypatch):
    np.save(tmp_path / "mask.npy", np.ones((2, 3, 4), bool))
    monkeypatch.chdir(tmp_path)
    obstacle = {"type": "voxel_mask", "path": "mask.npy", "spacing": 1e-3, "smooth": False, "rigid": True}
    scene = load_scene({**OmegaConf.create(SMALL), "obstacles": [obstacle | {"origin": [0.06, 0, 0]}]})
    (found,) = scene.obstacles
    assert found.upper == pytest.approx((62e-3, 3e-3, 4e-3))


OWN = """
from dataclasses import dataclass
from pathlib import Path
from autdtorch import Obstacle, Sphere

@dataclass(frozen=True)
class Ball(Sphere):
    path: str = ""

def ball(radius):
    return Ball((40e-3, 0.0, 0.0), radius, rigid=True)

class Other:
    def __init__(self): pass
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Load the small scene with one obstacle from a module of the user's own."""
    (tmp_path / "own_obstacles.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "scene.yaml"

    def load(obstacle, modules=("own_obstacles",)):
        path.write_text(f"{SMALL}obstacles: [{{_target_: {obstacle}}}]\n")
        return load_scene(path, modules).obstacles

    return load


def test_an_obstacle_of_ones_own_is_named_by_target(own, tmp_path):
    (found,) = own("own_obstacles.Ball, center: [40e-3, 0, 0], radius: 3e-3, rigid: true, path: a.csv")
    assert (type(found).__name__, found.center) == ("Ball", (40e-3, 0, 0))
    assert found.path == str(tmp_path / "a.csv")
    assert own("own_obstacles.ball, radius: 3e-3")[0].radius == 3e-3


@pytest.mark.parametrize(
    ("target", "modules", "message"),
    [
        ("own_obstacles.ball, radius: 1", (), "must be in a module that the user names, as modules=MODULE"),
        ("own_obstacles.ball, radius: 1", "own_obstacles", "modules: 'own_obstacles'; must be a sequence"),
        ("pathlib.Path", ("own_obstacles",), r"obstacles\[0\]._target_: 'pathlib.Path'; must be in a module"),
        ("own_obstacles.Path", ("own_obstacles",), "must be a function or class that own_obstacles defines"),
        ("own_obstacles.Other", ("own_obstacles",), r"Scene.obstacles\[0\]: .* must be an Obstacle"),
        ("own_obstacles.ball", ("own_obstacles",), r"obstacles\[0\]: missing key 'radius'"),
        ("own_obstacles.ball, radius: -1", ("own_obstacles",), "Sphere.radius: -1 m; must be finite and > 0"),
        ("nowhere.Ball", ("nowhere",), "nowhere cannot be imported .*No module named 'nowhere'"),
    ],
)
def test_what_is_not_an_obstacle_of_a_trusted_module_is_refused(own, target, modules, message):
    with pytest.raises(ValueError, match=message):
        own(target, modules)


def test_control_points_of_several_groups_follow_one_another(tmp_path):
    path = tmp_path / "groups.yaml"
    groups = """control_points:
  - {type: points, positions: [[80e-3, 0, 0]]}
  - {type: sphere, center: [60e-3, 0, 0], radius: 3e-3, count: 5}
  - {type: plane, center: [90e-3, 0, 0], normal: [1, 0, 0], size: [4e-3, 6e-3], spacing: 2e-3}
"""
    path.write_text(SMALL.replace(SMALL[SMALL.index("control_points") :], groups))
    points = load_scene(path).control_points
    assert points.shape == (1 + 5 + 6, 3)
    assert points[0].tolist() == [80e-3, 0, 0]
    assert torch.equal(points[1:6], sphere_points((60e-3, 0, 0), 3e-3, 5))
    assert points[6:, 0].tolist() == pytest.approx([90e-3] * 6)


SIDE = {"point": [0, 0, 0], "normal": [0, 1, 0], "reflection": 0.9}


def test_reflectors_are_planes_or_the_panel_of_the_array():
    section = OmegaConf.to_container(OmegaConf.load(SCENES / "sphere.yaml"))
    table = {"point": [0, 0, 0], "normal": [0, 0, 2], "reflection": " 0.5 + 0.25j"}
    scene = load_scene(section | {"reflectors": [{"type": "panel"}, table, {"type": "plane", **SIDE}]})
    panel, below, beside = scene.reflectors
    assert panel == Reflector.behind(scene.array)
    assert below == Reflector((0, 0, 0), (0, 0, 1), 0.5 + 0.25j)
    assert beside == Reflector(**SIDE)
    assert len(scene.images) == 8
    assert load_scene(section | {"reflectors": None}).reflectors == ()


def test_scenes_read_in_threads_leave_warnings_as_they_were():
    """Each section has its place in front of its warnings, which threads must not mix up."""
    box = {"type": "box", "center": [0.05, 0, 0], "size": [0.01] * 3, "rigid": True}
    section = {
        "array": {"type": "grid", "shape": [2, 2], "pitch": 10e-3, "center": [0, 0, 0], "normal": [1, 0, 0]},
        "medium": {"density": 1.2, "sound_speed": 343.0}, "frequency": 40e3,
        "control_points": {"type": "points", "positions": [[0.1, 0, 0]]},
        "obstacles": [box | {"rotation": [0, 0, 45.0]}],
    }  # fmt: skip
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(load_scene, [section] * 40))
        warnings.warn("still told", UserWarning, stacklevel=1)
    told = [str(one.message) for one in caught]
    assert told.pop() == "still told"
    assert len(told) == 40
    assert all("obstacles[0]" in one for one in told)


TABLE = {"point": [0, 0, 0], "normal": [1, 0, 0]}
FLAT = {"type": "box", "center": [0, 0, 0], "size": [1, 1, 0], "rigid": True}


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("obstacels", [], "unknown key 'obstacels' (did you mean 'obstacles'?); allowed keys: array, medium"),
        ("array.pich", 1, "array: unknown key 'pich' (did you mean 'pitch'?); allowed keys: shape, pitch"),
        ("medium", {"temprature": 20}, "medium: unknown key 'temprature' (did you mean 'temperature'?)"),
        ("medium", ..., "scene mapping: missing key 'medium'; allowed keys"),
        ("array.pitch", ..., "scene mapping: array: missing key 'pitch'"),
        ("control_points.type", ..., "type: None; must be one of circle, sphere, plane, points"),
        ("array.type", "gird", "array: type: 'gird'; must be one of grid, positions, autd3"),
        ("array.type", ["grid"], "array: type: ('grid',); must be one of"),
        ("medium", 340.0, "medium: 340.0; must be a mapping of keys to"),
        ("obstacles", {"type": "box"}, "obstacles: {'type': 'box'}; must be a list"),
        ("medium.density", "heavy", "medium: Medium.density: 'heavy'; must be a real number [kg/m^3]"),
        ("obstacles", [FLAT], "obstacles[0]: Box.size: (1, 1, 0) m; every entry must be finite and > 0"),
        ("frequency", -1, "scene mapping: Scene.frequency: -1 Hz; must be"),
        ("domain.lower", [0, 0], "domain: lower: (0, 0); must be 3 real numbers"),
        (
            "reflectors",
            {"type": "panel"},
            "reflectors: {'type': 'panel'}; must be a list of reflectors, such as [",
        ),
        ("reflectors", ["panel"], "reflectors[0]: 'panel'; must be a mapping of keys to"),
        ("reflectors", [{"type": "wall"}], "reflectors[0]: type: 'wall'; must be one of panel, plane"),
        ("reflectors", [{"point": [0, 0, 0]}], "reflectors[0]: missing key 'normal'; allowed keys: point"),
        ("reflectors", [TABLE | {"reflexion": 1}], "key 'reflexion' (did you mean 'reflection'?); allowed"),
        ("reflectors", [TABLE | {"reflection": 1.5}], "reflectors[0]: Reflector.reflection: 1.5; its magn"),
        ("reflectors", [TABLE | {"reflection": "half"}], "[0].reflection: 'half'; must be a number such as"),
        (
            "reflectors",
            [{"type": "panel", "point": [0, 0, 0]}],
            "unknown key 'point'; allowed keys: reflection",
        ),
        ("reflectors", [TABLE | {"point": [0.2, 0, 0]}], "behind reflector 0, must be in front of it"),
    ],
)
def test_a_wrong_entry_is_named(key, value, message):
    config = OmegaConf.load(SCENES / "three_cubes.yaml")
    if value is ...:
        section, _, name = key.rpartition(".")
        del (OmegaConf.select(config, section) if section else config)[name]
    else:
        OmegaConf.update(config, key, value, merge=False, force_add=True)
    with pytest.raises(ValueError, match=r"^scene mapping: ") as caught:
        load_scene(config)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"name: x\nfrequency: [40e3,\nmedium: }\n", ", line 3: "),
        (b"name: x\nname: y\n", ", line 2: found duplicate key name"),
        (b"- 1\n- 2\n", ": (1, 2); must be a mapping of keys to values"),
        (b"40e3\n", ", line 1: '40e3' is not a mapping"),
        (b"", ": missing key 'array'; allowed keys"),
        (b"\xff\xfe\xff", "must be valid YAML in UTF-8"),
    ],
)
def test_a_wrong_file_is_named(tmp_path, content, message):
    path = tmp_path / "mine.yaml"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"mine\.yaml") as caught:
        load_scene(path)
    assert message in str(caught.value)


def test_wrong_keys_and_missing_files_are_named(tmp_path):
    with pytest.raises(ValueError, match="scene mapping: unknown key '1'; allowed keys"):
        load_scene({1: 2})
    with pytest.raises(FileNotFoundError, match=r"nowhere\.yaml"):
        load_scene(tmp_path / "nowhere.yaml")
