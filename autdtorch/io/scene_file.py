"""Scenes from YAML files, and as YAML or Python.

The keys of a section are the arguments of the function or class that builds its part of the scene.
"""

from __future__ import annotations

import inspect
import operator
import os
import pprint
from collections import ChainMap
from collections.abc import Callable, Collection, Mapping
from dataclasses import fields
from functools import partial, reduce
from pathlib import Path
from typing import Any

import torch
import yaml

from autdtorch.io.array_file import load_array
from autdtorch.io.yaml_file import TARGET, load_trusted, load_yaml, plain, unresolved
from autdtorch.scene.arrays import FORMS, recipes_of
from autdtorch.scene.drive import amplitudes_of, drive_from_phases, phases_of
from autdtorch.scene.geometry import Plane, circle_points, sphere_points
from autdtorch.scene.medium import porous
from autdtorch.scene.obstacles import KINDS, Obstacle
from autdtorch.scene.reflectors import Reflector
from autdtorch.scene.scene import Medium, Scene
from autdtorch.utils.files import path_of, replace_file
from autdtorch.utils.units import warned_within
from autdtorch.utils.validation import (
    finite_vector,
    invalid,
    members,
    points_tensor,
    require_kind,
    require_known,
    require_one_of,
    within,
)

Builder = Callable[..., Any]

_TYPES: dict[str, Mapping[str, Builder]] = {  # builders by the key `type` of a section
    "array": ChainMap({"file": load_array}, FORMS),
    "control_points": {
        "circle": circle_points,
        "sphere": sphere_points,
        "plane": lambda center, normal, size, spacing: (
            Plane(center, normal, size).points(spacing).flatten(0, 1)
        ),
        "points": lambda positions: points_tensor("positions", positions),
    },
    "obstacle": KINDS,
}
_JOINED: dict[str, tuple[str, Builder]] = {  # an example of an entry, and how a list of entries is joined
    "array": ("{type: autd3, center: [0, 0, 0]}", partial(reduce, operator.add)),
    "control_points": ("{type: points, positions: [...]}", torch.cat),
}
_COMPLEX = ("density", "sound_speed", "impedance", "reflection")  # keys of numbers such as 1.5+0.2j, a text
_BUILDERS: dict[str, Builder] = {  # of sections without `type`
    "observation_plane": Plane,
    "domain": lambda lower, upper: (finite_vector("lower", lower), finite_vector("upper", upper)),
}


def load_scene(source: str | os.PathLike[str] | Mapping[str, Any], modules: Collection[str] = ()) -> Scene:
    """Read a scene from a YAML file, or from a mapping of the same layout such as Hydra's `cfg.scene`.

    Control points and array are a section each, or a list of sections, whose points or transducers follow one
    another. An array of any type may have a `phase` [rad], which `TransducerArray.calibrated` adds.
    An obstacle has a `type`, or the `_target_` of a user's class, such as `mymodule.MyObstacle`. Its complex
    numbers are written as in `impedance: 1.5+0.2j`. Its section `porous`, `{flow_resistivity: 200e3}`, is the
    material that `porous` returns for the scene's frequency and medium.
    A reflector has `point`, `normal` and `reflection`, the arguments of `Reflector`, or is `{type: panel}`,
    the panel that the array stands in (`Reflector.behind`).
    The section `pose`, with the keys `offset` and `rotation`, or `rotation_degrees`, moves all obstacles as
    one body; see `Scene.moved`.

    Args:
        source: path of the file, or the mapping. A value may be an interpolation of another key, `${key}`;
            resolvers such as `${oc.env:HOME}` are refused. A key without a value counts as left out. Paths
            in a file start from its folder; paths in a mapping, from the working directory.
        modules: names of the trusted modules, whose obstacles the scene may name by `_target_`.

    Returns:
        The scene.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not YAML, larger or deeper than a scene is, an unknown or missing key, or a bad value. The
            message names the file and the section.
    """
    where = "scene mapping" if isinstance(source, Mapping) else str(path_of("source", source))
    trusted = members("modules", modules, str)
    section = _mapping(where, _read(where, source))
    pose = section.pop("pose", {})
    _check_keys(where, section, Scene)
    air = partial(Medium.air, frequency=section["frequency"])
    folder = Path() if isinstance(source, Mapping) else Path(source).parent
    medium: Any = _part(f"{where}: medium", "medium", section["medium"], air, folder, trusted)
    foam = partial(porous, frequency=section["frequency"], medium=medium)
    if isinstance(obstacles := section.get("obstacles"), list):
        places = [(f"{where}: obstacles[{index}]", entry) for index, entry in enumerate(obstacles)]
        section["obstacles"] = [_with_material(place, entry, foam) for place, entry in places]
    reflectors = section.pop("reflectors", [])
    parts = {
        key: medium if key == "medium" else _part(f"{where}: {key}", key, value, air, folder, trusted)
        for key, value in section.items()
    }
    parts["reflectors"] = _reflectors(f"{where}: reflectors", reflectors, parts["array"])
    scene: Scene = _build(where, parts, Scene)
    return _build(f"{where}: pose", _mapping(f"{where}: pose", pose), scene.moved) if pose else scene


def _read(where: str, source: str | os.PathLike[str] | Mapping[str, Any]) -> object:
    """Return the content of a file or mapping as plain Python containers."""
    from omegaconf import DictConfig, OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    try:
        config: Any = source  # the node of a larger configuration is not copied: its interpolations need it
        if not isinstance(source, Mapping):
            config = load_yaml(source)
        elif not isinstance(source, DictConfig):
            config = OmegaConf.create(plain(source, where))
        unresolved(config, where)
        return plain(config, where)
    except (OmegaConfBaseException, TypeError) as error:  # TypeError: a key that no dictionary takes
        key = getattr(error, "full_key", None)
        place = f"{where}: {key}" if key else where
        reason = str(error).partition("\n    full_key:")[0]
        accepted = "must be a number, text, list or mapping with keys of text, or the ${key} of one"
        raise ValueError(" ".join(f"{place}: {reason}; {accepted}".split())) from error


def _part(
    where: str, key: str, value: object, air: Builder, folder: Path, modules: tuple[str, ...]
) -> object:
    """Build one argument of `Scene`; `air` makes a medium of air, and paths start from `folder`."""
    if key == "obstacles":
        if not isinstance(value, list):
            raise invalid(where, value, "must be a list of obstacles")
        places = [(f"{where}[{index}]", entry) for index, entry in enumerate(value)]
        return [_part(place, "obstacle", entry, air, folder, modules) for place, entry in places]
    if key in _JOINED and isinstance(value, list):
        if not value or not all(isinstance(entry, dict) for entry in value):
            example, _ = _JOINED[key]
            raise invalid(where, value, f"must be a mapping such as {example}, or a list of these")
        groups = [(f"{where}[{index}]", entry) for index, entry in enumerate(value)]
        parts = [_part(place, key, entry, air, folder, modules) for place, entry in groups]
        with within(where):
            return _JOINED[key][1](parts)
    if key not in ("medium", *_TYPES, *_BUILDERS):
        return value
    section = _mapping(where, value)
    if isinstance(path := section.get("path"), str):
        section["path"] = str(folder / path)
    if key == "medium":
        builder = Medium if not section or section.keys() & _parameters(Medium).keys() else air
    elif key in _BUILDERS:
        builder = _BUILDERS[key]
    elif key == "obstacle" and TARGET in section:
        builder = load_trusted(f"{where}.{TARGET}", section.pop(TARGET), modules)
    else:
        kind = section.pop("type", None)
        require_one_of(f"{where}: type", kind, _TYPES[key])
        builder = KINDS[kind].maker() if key == "obstacle" else _TYPES[key][kind]
    phase = section.pop("phase", None) if key == "array" else None
    part = _build(where, section, builder)
    return part if phase is None else _build(where, {"phase": phase}, part.calibrated)


def _reflectors(where: str, value: object, array: Any) -> list[Reflector]:
    """Build the reflectors of a list of sections; a panel belongs to the array."""
    if not isinstance(value, list):
        raise invalid(where, value, "must be a list of reflectors, such as [{type: panel}]")
    builders: dict[str, Builder] = {"panel": partial(Reflector.behind, array=array), "plane": Reflector}
    reflectors = []
    for index, entry in enumerate(value):
        place = f"{where}[{index}]"
        section = _with_numbers(place, _mapping(place, entry))
        kind = section.pop("type", "plane")
        require_one_of(f"{place}: type", kind, builders)
        reflectors.append(_build(place, section, builders[kind]))
    return reflectors


def _with_material(where: str, section: object, foam: Builder) -> object:
    """Return the section of an obstacle with numbers in place of the section `porous` and of text."""
    if not isinstance(section, dict):
        return section
    section = _with_numbers(where, section)
    material = section.pop("porous", None)
    if material is None:
        return section
    place = f"{where}.porous"
    computed = _build(place, _mapping(place, material), foam)
    if both := [key for key in computed if section.get(key) is not None]:
        raise invalid(f"{where}.{both[0]}", section[both[0]], "must be absent beside porous, which sets it")
    return section | computed


def _with_numbers(where: str, section: Mapping[str, Any]) -> dict[str, Any]:
    """Return a section with complex numbers in place of their text."""
    section = dict(section)
    for key in _COMPLEX:
        if isinstance(text := section.get(key), str):
            try:
                section[key] = complex("".join(text.split()))
            except ValueError as error:
                raise invalid(f"{where}.{key}", text, "must be a number such as 1.5 or 1.5+0.2j") from error
    return section


def _build(where: str, section: dict[str, Any], builder: Builder) -> Any:
    _check_keys(where, section, builder)
    with within(where), warned_within(where):
        return builder(**section)


def _mapping(where: str, value: object) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise invalid(where, value, "must be a mapping of keys to values")
    return {str(key): entry for key, entry in value.items() if entry is not None}


def _check_keys(where: str, section: Mapping[str, object], builder: Builder) -> None:
    parameters = _parameters(builder)
    require_known(where, section, parameters)
    for key, parameter in parameters.items():
        if parameter.default is inspect.Parameter.empty and key not in section:
            raise ValueError(f"{where}: missing key {key!r}; allowed keys: {', '.join(parameters)}")


def _parameters(builder: Builder) -> dict[str, inspect.Parameter]:
    """Return the parameters that a section may give, without those that a `partial` binds."""
    bound = builder.keywords if isinstance(builder, partial) else {}
    return {key: entry for key, entry in inspect.signature(builder).parameters.items() if key not in bound}


class _Dumper(yaml.SafeDumper):  # type: ignore[misc]  # PyYAML has no types
    """The writer of YAML, to which complex numbers are texts such as 1.5+0.2j."""


_Dumper.add_representer(complex, lambda dumper, value: dumper.represent_str(str(value).strip("()")))


class _Code(str):
    """An expression in Python."""


def save_scene(path: str | os.PathLike[str], scene: Scene) -> None:
    """Write a scene to a YAML file that `load_scene` reads.

    Numbers keep their full precision. An array that was made by a method such as `TransducerArray.autd3`, or
    joined of such arrays, keeps that form. A mesh becomes an .obj file, a voxel mask an
    .npz file, beside the YAML file and with its name. Files that are there are replaced. A medium becomes its
    numbers, without `Medium.absorption_frequency`.

    Args:
        path: of the file, ``.yaml`` or ``.yml``.
        scene: the scene.

    Raises:
        ValueError: another suffix, or an obstacle of a user's class.
        OSError: the files cannot be written.
    """
    path = path_of("path", path, suffixes=(".yaml", ".yml"))
    require_kind("scene", scene, Scene)
    sections = scene_sections(scene, path.stem)
    write_files(scene, path.with_suffix(""))
    layout = {"sort_keys": False, "default_flow_style": None, "width": 110, "allow_unicode": True}
    text = yaml.dump(sections, Dumper=_Dumper, **layout)
    replace_file(path, text.encode())


def scene_sections(scene: Scene, name: str) -> dict[str, Any]:
    """Return the sections of a scene file called `name`, which may name files of `write_files`.

    Raises:
        ValueError: an obstacle of a user's class.
    """
    medium = scene.medium
    boards = [{"type": recipe.kind, **recipe.arguments} for recipe in recipes_of(scene.array)]
    sections: dict[str, Any] = {
        "name": scene.name,
        "frequency": scene.frequency,
        "medium": {field.name: getattr(medium, field.name) for field in fields(medium) if field.init},
        "array": boards[0] if len(boards) == 1 else boards,
        "obstacles": [
            _obstacle(obstacle, f"{name}_{number}", f"Scene.obstacles[{number}]")
            for number, obstacle in enumerate(scene.obstacles)
        ],
        "control_points": {"type": "points", "positions": scene.control_points.tolist()},
        "domain": dict(zip(("lower", "upper"), map(list, scene.domain), strict=True)),
    }
    if scene.observation_plane is not None:
        plane = scene.observation_plane
        sections["observation_plane"] = {
            field.name: list(getattr(plane, field.name)) for field in fields(Plane)
        }
    if scene.reflectors:
        sections["reflectors"] = [_reflector(reflector) for reflector in scene.reflectors]
    return sections


def write_files(scene: Scene, path: Path) -> None:
    """Write the meshes and masks of a scene, beside the scene file of this path without its suffix."""
    for number, obstacle in enumerate(scene.obstacles):
        obstacle.write_file(path.with_name(f"{path.name}_{number}"))


def _obstacle(obstacle: Obstacle, name: str, where: str) -> dict[str, Any]:
    """Return the section of an obstacle, whose file, if any, has a name."""
    types = {kind: name for name, kind in KINDS.items()}
    if type(obstacle) not in types:
        accepted = f"must be one of {', '.join(kind.__name__ for kind in types)} to be saved"
        raise invalid(where, type(obstacle).__name__, accepted)
    return {"type": types[type(obstacle)]} | obstacle.section(name)


def _reflector(reflector: Reflector) -> dict[str, Any]:
    section: dict[str, Any] = {"point": list(reflector.point), "normal": list(reflector.normal)}
    return section | ({} if reflector.reflection == 1 else {"reflection": reflector.reflection})


def scene_lines(scene: Scene, drive: torch.Tensor, name: str, beside: bool = False) -> str:
    """Return the lines of Python that make a scene and a drive (M,).

    Args:
        scene: the scene.
        drive: the drive.
        name: path, without suffix, of the scene file whose meshes and masks are read.
        beside: True for lines in a file, and a path from there; False for one from the working directory.

    Raises:
        ValueError: an obstacle of a user's class.
    """
    sections = scene_sections(scene, name)
    boards = sections["array"] if isinstance(sections["array"], list) else [sections["array"]]
    beside = beside and any("path" in section for section in sections["obstacles"])
    lines = ["from pathlib import Path", ""] if beside else []
    lines += ["import autdtorch as at", ""]
    arrays = ["array"] if len(boards) == 1 else [f"array_{number}" for number in range(len(boards))]
    for array, board in zip(arrays, boards, strict=True):
        phase = board.pop("phase", None)
        lines.append(_call(array, FORMS[board.pop("type")], board))
        if phase is not None:
            lines.append(f"{array} = {array}.calibrated(phase={_value(phase, 25 + 2 * len(array))})")
    if len(boards) > 1:
        lines.append(f"array = {' + '.join(arrays)}")
    obstacles = [f"obstacle_{number}" for number in range(len(scene.obstacles))]
    for obstacle, section in zip(obstacles, sections["obstacles"], strict=True):
        maker = KINDS[section.pop("type")].maker()
        if beside and "path" in section:
            section["path"] = _Code(f"Path(__file__).with_name({section['path']!r})")
        lines.append(_call(obstacle, maker, section))
    plane = "None"
    if scene.observation_plane is not None:
        plane = "plane"
        lines.append(_call(plane, Plane, sections["observation_plane"]))
    reflectors = [f"reflector_{number}" for number in range(len(scene.reflectors))]
    for reflector, section in zip(reflectors, sections.get("reflectors", ()), strict=True):
        lines.append(_call(reflector, Reflector, section))
    planes = f", reflectors=[{', '.join(reflectors)}]" if reflectors else ""
    lines.append(_call("medium", Medium, sections["medium"]))
    lines.append(f"points = {_value(sections['control_points']['positions'], 9)}")
    domain = [sections["domain"]["lower"], sections["domain"]["upper"]]
    lines.append(
        f"scene = at.Scene(\n    array, medium, {scene.frequency!r}, points, [{', '.join(obstacles)}], "
        f"{plane}, {domain!r}, name={scene.name!r}{planes}\n)"
    )
    values = {"phases": phases_of(drive).tolist()}
    amplitudes = amplitudes_of(drive).clamp(max=1.0)  # rounding may exceed 1
    if not torch.allclose(amplitudes, torch.ones_like(amplitudes), rtol=0, atol=1e-12):
        values["amplitudes"] = amplitudes.tolist()
    lines.append(_call("drive", drive_from_phases, values))
    return "\n".join(lines) + "\n"


def _call(name: str, function: Callable[..., Any], arguments: dict[str, Any]) -> str:
    """Return the line that calls a function of autdtorch, or another one after its import."""
    home, called = function.__module__, function.__qualname__
    before, place = ("", "at") if home.startswith("autdtorch.") else (f"import {home}\n", home)
    parts = "".join(f"    {key}={_value(value, 5 + len(key))},\n" for key, value in arguments.items())
    return f"{before}{name} = {place}.{called}(\n{parts})"


def _value(value: Any, indent: int) -> str:
    if isinstance(value, _Code):
        return value
    text = pprint.pformat(value, width=110 - indent, compact=True)
    return text.replace("\n", "\n" + " " * indent)
