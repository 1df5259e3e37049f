"""Scenes from YAML files.

The keys of a section are the arguments of the function or class that builds its part of the scene.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Collection, Mapping
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
from autdtorch.utils.trusted import TARGET, load_trusted
from autdtorch.utils.validation import (
    ArrayLike,
    Vector,
    finite_vector,
    invalid,
    members,
    path_of,
    points_tensor,
    require_known,
    require_one_of,
    within,
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


def load_scene(source: str | os.PathLike[str] | Mapping[str, Any], modules: Collection[str] = ()) -> Scene:
    """Read a scene from a YAML file, or from a mapping of the same layout such as Hydra's `cfg.scene`.

    An obstacle has a `type`, or the `_target_` of a class of the user's own, such as `mymodule.MyObstacle`.

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
    _check_keys(where, section, Scene)
    air = partial(Medium.air, frequency=section["frequency"])
    folder = Path() if isinstance(source, Mapping) else Path(source).parent
    parts = {
        key: _part(f"{where}: {key}", key, value, air, folder, trusted) for key, value in section.items()
    }
    scene: Scene = _build(where, parts, Scene)
    return scene


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
    match key:
        case "medium":
            section = _mapping(where, value)
            return _build(where, section, air if section.keys() & _parameters(air).keys() else Medium)
        case "array":
            return _build_kind(where, _with_path(where, value, folder), _ARRAYS)
        case "obstacles":
            if not isinstance(value, list):
                raise invalid(where, value, "must be a list of obstacles")
            places = [(f"{where}[{index}]", entry) for index, entry in enumerate(value)]
            return [_obstacle(place, _with_path(place, entry, folder), modules) for place, entry in places]
        case "control_points":
            return _build_kind(where, value, {"circle": circle_points, "points": _points})
        case "observation_plane":
            return _build(where, _mapping(where, value), Plane)
        case "domain":
            return _build(where, _mapping(where, value), _domain)
        case _:
            return value


def _obstacle(where: str, section: dict[str, Any], modules: tuple[str, ...]) -> Any:
    if TARGET not in section:
        return _build_kind(where, section, _OBSTACLES)
    builder = load_trusted(f"{where}.{TARGET}", section.pop(TARGET), modules)
    return _build(where, section, builder)


def _with_path(where: str, value: object, folder: Path) -> dict[str, Any]:
    """Return the section, with a `path` that starts from `folder`."""
    section = _mapping(where, value)
    if isinstance(path := section.get("path"), str):
        section["path"] = str(folder / path)
    return section


def _points(positions: ArrayLike) -> torch.Tensor:
    return points_tensor("positions", positions)


def _domain(lower: ArrayLike, upper: ArrayLike) -> tuple[Vector, Vector]:
    return finite_vector("lower", lower), finite_vector("upper", upper)


def _build_kind(where: str, value: object, builders: Mapping[str, Builder]) -> Any:
    """Build a part with the builder that the key `type` names."""
    section = _mapping(where, value)
    kind = section.pop("type", None)
    require_one_of(f"{where}: type", kind, builders)
    return _build(where, section, builders[kind])


def _build(where: str, section: dict[str, Any], builder: Builder) -> Any:
    _check_keys(where, section, builder)
    with within(where):
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
