"""Errors in scene files and mappings name the place, the value and what is accepted."""

import copy
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from autdtorch.io.scene_file import load_scene

SCENES = Path(__file__).parents[2] / "configs" / "scene"
FLAT = {"type": "box", "center": [0, 0, 0], "size": [1, 1, 0], "rigid": True}


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("obstacels", [], "unknown key 'obstacels' (did you mean 'obstacles'?); allowed keys: array, medium"),
        ("array.pich", 1, "array: unknown key 'pich' (did you mean 'pitch'?); allowed keys: shape, pitch"),
        ("medium", ..., "scene mapping: missing key 'medium'; allowed keys"),
        ("array.pitch", ..., "scene mapping: array: missing key 'pitch'"),
        (
            "control_points.type",
            ...,
            "type: None; must be one of circle, sphere, plane, points",
        ),
        ("array.type", "gird", "array: type: 'gird'; must be one of grid, positions, autd3"),
        ("array.type", ["grid"], "array: type: ('grid',); must be one of"),
        ("medium", 340.0, "medium: 340.0; must be a mapping of keys to"),
        ("obstacles", {"type": "box"}, "obstacles: {'type': 'box'}; must be a list"),
        ("medium.density", "heavy", "medium: Medium.density: 'heavy'; must be a real number [kg/m^3]"),
        ("obstacles", [FLAT], "obstacles[0]: Box.size: (1, 1, 0) m; every entry must be finite and > 0"),
        ("frequency", -1, "scene mapping: Scene.frequency: -1 Hz; must be"),
        ("domain.lower", [0, 0], "domain: lower: (0, 0); must be 3 real numbers"),
        ("frequency", "${tone}", "Interpolation key 'tone' not found"),
        ("frequency", "???", "Missing mandatory value: frequency"),
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


def test_a_key_that_is_not_text_is_named():
    with pytest.raises(ValueError, match="scene mapping: unknown key '1'; allowed keys"):
        load_scene({1: 2})


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.yaml"):
        load_scene(tmp_path / "nowhere.yaml")


def test_loading_leaves_the_mapping_as_it_was():
    given = OmegaConf.to_container(OmegaConf.load(SCENES / "two_cubes.yaml"))
    before = copy.deepcopy(given)
    load_scene(given)
    assert given == before
