"""Scenes as sections of a scene file, to be written as YAML or as Python."""

from __future__ import annotations

import os
import pprint
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch
import yaml

from autdtorch.scene.arrays import FORMS, recipes_of
from autdtorch.scene.drive import amplitudes_of, drive_from_phases, phases_of
from autdtorch.scene.geometry import Plane
from autdtorch.scene.obstacles import KINDS, Obstacle
from autdtorch.scene.scene import Medium, Scene
from autdtorch.utils.files import replace_file
from autdtorch.utils.validation import invalid, path_of, require_kind


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
    text = yaml.safe_dump(sections, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True)
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
            _obstacle(one, f"{name}_{number}", f"Scene.obstacles[{number}]")
            for number, one in enumerate(scene.obstacles)
        ],
        "control_points": {"type": "points", "positions": scene.control_points.tolist()},
        "domain": dict(zip(("lower", "upper"), map(list, scene.domain), strict=True)),
    }
    if scene.observation_plane is not None:
        plane = scene.observation_plane
        sections["observation_plane"] = {
            field.name: list(getattr(plane, field.name)) for field in fields(Plane)
        }
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
        lines.append(_call(array, FORMS[board.pop("type")], board))
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
    lines.append(_call("medium", Medium, sections["medium"]))
    lines.append(f"points = {_value(sections['control_points']['positions'], 9)}")
    domain = [sections["domain"]["lower"], sections["domain"]["upper"]]
    lines.append(
        f"scene = at.Scene(\n    array, medium, {scene.frequency!r}, points, [{', '.join(obstacles)}], "
        f"{plane}, {domain!r}, name={scene.name!r}\n)"
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
