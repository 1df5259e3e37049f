"""What is wrong with a scene file or mapping must be clear from the message: where, and what is accepted."""

import copy
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from autdtorch.io.scene_file import load_scene

SCENES = Path(__file__).parents[2] / "configs" / "scene"


def from_yaml(remove=None, **changes):
    """Load the paper's three cubes after setting keys (`array__pitch` is `array.pitch`) or removing one."""
    config = OmegaConf.load(SCENES / "three_cubes.yaml")
    for key, value in changes.items():
        OmegaConf.update(config, key.replace("__", "."), value, merge=False, force_add=True)
    if remove is not None:
        section, _, key = remove.rpartition(".")
        del (OmegaConf.select(config, section) if section else config)[key]
    return load_scene(config)


WRONG = {
    "unknown key": (
        lambda: from_yaml(obstacels=[]),
        "scene mapping: unknown key 'obstacels' (did you mean 'obstacles'?); allowed keys: array, medium",
    ),
    "unknown key in a section": (
        lambda: from_yaml(array__pich=1e-2),
        "scene mapping: array: unknown key 'pich' (did you mean 'pitch'?); allowed keys: shape, pitch",
    ),
    "key not text": (lambda: load_scene({1: 2}), "scene mapping: unknown key '1'; allowed keys"),
    "missing key": (lambda: from_yaml(remove="medium"), "scene mapping: missing key 'medium'; allowed keys"),
    "missing key in a section": (lambda: from_yaml(remove="array.pitch"), "array: missing key 'pitch'"),
    "missing type": (
        lambda: from_yaml(remove="control_points.type"),
        "scene mapping: control_points: type: None; must be one of circle, points",
    ),
    "unknown type": (
        lambda: from_yaml(array__type="gird"),
        "scene mapping: array: type: 'gird'; must be one of grid, positions, autd3, sonicsurface, openmpd, "
        "file (did you mean 'grid'?)",
    ),
    "type a list": (lambda: from_yaml(array__type=["grid"]), "array: type: ('grid',); must be one of"),
    "section not a mapping": (lambda: from_yaml(medium=340.0), "medium: 340.0; must be a mapping of keys to"),
    "obstacles a mapping": (
        lambda: from_yaml(obstacles={"type": "box"}),
        "obstacles: {'type': 'box'}; must be a list",
    ),
    "number in quotes": (
        lambda: from_yaml(medium__density="heavy"),
        "scene mapping: medium: Medium.density: 'heavy'; must be a real number [kg/m^3]",
    ),
    "value of a list entry": (
        lambda: from_yaml(obstacles=[{"type": "box", "center": [0, 0, 0], "size": [1, 1, 0], "rigid": True}]),
        "scene mapping: obstacles[0]: Box.size: (1, 1, 0) m; every entry must be finite and > 0",
    ),
    "value of the whole": (lambda: from_yaml(frequency=-1), "scene mapping: Scene.frequency: -1 Hz; must be"),
    "domain of a file": (
        lambda: from_yaml(domain__lower=[0, 0]),
        "domain: lower: (0, 0); must be 3 real numbers",
    ),
    "interpolation to nowhere": (
        lambda: from_yaml(frequency="${tone}"),
        "Interpolation key 'tone' not found",
    ),
    "mandatory value": (lambda: from_yaml(frequency="???"), "Missing mandatory value: frequency"),
}


@pytest.mark.parametrize(("call", "message"), WRONG.values(), ids=WRONG.keys())
def test_a_wrong_entry_is_named(call, message):
    with pytest.raises(ValueError) as caught:  # noqa: PT011  (compared as plain text below)
        call()
    assert message in str(caught.value)


FILES = {
    "syntax": ("name: x\nfrequency: [40e3,\nmedium: }\n", ", line 3: "),
    "key twice": ("name: x\nname: y\n", ", line 2: found duplicate key name"),
    "a list": ("- 1\n- 2\n", ": (1, 2); must be a mapping of keys to values"),
    "a number": ("40e3\n", ", line 1: '40e3' is not a mapping"),
    "empty": ("", ": missing key 'array'; allowed keys"),
    "not text": (b"\xff\xfe\xff", "must be valid YAML in UTF-8"),
}


@pytest.mark.parametrize(("content", "message"), FILES.values(), ids=FILES.keys())
def test_wrong_file_is_named(tmp_path, content, message):
    path = tmp_path / "mine.yaml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ValueError) as caught:  # noqa: PT011  (compared as plain text below)
        load_scene(path)
    assert str(caught.value).startswith(str(path))
    assert message in str(caught.value)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.yaml"):
        load_scene(tmp_path / "nowhere.yaml")


def test_loading_leaves_the_mapping_as_it_was():
    given = OmegaConf.to_container(OmegaConf.load(SCENES / "two_cubes.yaml"))
    before = copy.deepcopy(given)
    load_scene(given)
    assert given == before
