"""Scenes from YAML files.

The keys of a section are the arguments of what it builds, so that the two cannot drift apart.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch

from autdtorch.io.array_file import load_array
from autdtorch.io.yaml_file import load_yaml, plain, unresolved
from autdtorch.scene.arrays import TransducerArray
from autdtorch.scene.geometry import Plane, circle_points
from autdtorch.scene.obstacles import Box, Cylinder, Mesh, Sphere, VoxelMask
from autdtorch.scene.scene import Medium, Scene
from autdtorch.utils.validation import (
    ArrayLike,
    Vector,
    finite_vector,
    hint,
    invalid,
    path_of,
    points_tensor,
    require_known,
)

Builder = Callable[..., Any]

_ARRAYS: dict[str, Builder] = {
    "grid": TransducerArray.grid,
    "positions": TransducerArray,
    "autd3": TransducerArray.autd3,
    "sonicsurface": TransducerArray.sonicsurface,
    "openmpd": TransducerArray.openmpd,
    "file": load_array,
}
_OBSTACLES: dict[str, Builder] = {
    "box": Box,
    "sphere": Sphere,
    "cylinder": Cylinder,
    "mesh": Mesh,
    "voxel_mask": VoxelMask.load,
}


def load_scene(source: str | os.PathLike[str] | Mapping[str, Any]) -> Scene:
    """Read a scene from a YAML file, or from a mapping of the same layout such as Hydra's `cfg.scene`.

    Args:
        source: path of the file, or the mapping. A value may be an interpolation of another key, `${key}`;
            resolvers such as `${oc.env:HOME}` are refused. A key without a value counts as left out. Paths
            in it start from the folder of the file; in a mapping, from the working directory.

    Returns:
        The scene.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not YAML, larger or deeper than a scene is, an unknown or missing key, or a value that is
            not accepted. The message names the file and the section.
    """
    where = "scene mapping" if isinstance(source, Mapping) else str(path_of("source", source))
    section = _mapping(where, _read(where, source))
    _check_keys(where, section, Scene)
    air = partial(Medium.air, frequency=section["frequency"])
    folder = Path() if isinstance(source, Mapping) else Path(source).parent
    parts = {key: _part(f"{where}: {key}", key, value, air, folder) for key, value in section.items()}
    scene: Scene = _build(where, parts, Scene)
    return scene


def _read(where: str, source: str | os.PathLike[str] | Mapping[str, Any]) -> object:
    """What the file or mapping holds, as plain Python containers."""
    from omegaconf import DictConfig, OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    try:
        config: Any = source  # a node of a larger configuration stays there, where its interpolations resolve
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


def _part(where: str, key: str, value: object, air: Builder, folder: Path) -> object:
    """The argument `key` of `Scene` from its `value`; `air` builds its air, and paths start from `folder`."""
    match key:
        case "medium":
            section = _mapping(where, value)
            return _build(where, section, air if section.keys() & _parameters(air).keys() else Medium)
        case "array":
            return _build_kind(where, _with_path(where, value, folder), _ARRAYS)
        case "obstacles":
            if not isinstance(value, list):
                raise invalid(where, value, "must be a list of obstacles")
            return [
                _build_kind(f"{where}[{index}]", _with_path(f"{where}[{index}]", entry, folder), _OBSTACLES)
                for index, entry in enumerate(value)
            ]
        case "control_points":
            return _build_kind(where, value, {"circle": circle_points, "points": _points})
        case "observation_plane":
            return _build(where, _mapping(where, value), Plane)
        case "domain":
            return _build(where, _mapping(where, value), _domain)
        case _:
            return value


def _with_path(where: str, value: object, folder: Path) -> dict[str, Any]:
    """The section, its `path` starting from `folder`."""
    section = _mapping(where, value)
    if isinstance(path := section.get("path"), str):
        section["path"] = str(folder / path)
    return section


def _points(positions: ArrayLike) -> torch.Tensor:
    return points_tensor("positions", positions)


def _domain(lower: ArrayLike, upper: ArrayLike) -> tuple[Vector, Vector]:
    return finite_vector("lower", lower), finite_vector("upper", upper)


def _build_kind(where: str, value: object, builders: Mapping[str, Builder]) -> Any:
    """Build with the one of `builders` that the key `type` names."""
    section = _mapping(where, value)
    kind = section.pop("type", None)
    if not isinstance(kind, str) or kind not in builders:
        raise invalid(f"{where}: type", kind, f"must be one of {', '.join(builders)}{hint(kind, builders)}")
    return _build(where, section, builders[kind])


def _build(where: str, section: dict[str, Any], builder: Builder) -> Any:
    _check_keys(where, section, builder)
    try:
        return builder(**section)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error


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
    """Arguments that a section gives: all but those that a `partial` has already."""
    given = builder.keywords if isinstance(builder, partial) else {}
    return {key: entry for key, entry in inspect.signature(builder).parameters.items() if key not in given}
