"""The settings of a job as Hydra composed them: sections, scenes, solver, folders."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from autdtorch.io.yaml_file import plain
from autdtorch.utils.trusted import TARGET
from autdtorch.utils.validation import require_known

if TYPE_CHECKING:
    from autdtorch.scene.scene import Scene

_SETTINGS = ("scene", "method", "scenes", "methods", "hardware", "solver", "trials", "seed", "plane_spacing")
_PLACES = ("modules", "output")  # settings that change no result
_CALLS = (TARGET, "_args_", "_convert_", "_partial_", "_recursive_")  # keys by which Hydra calls functions
_TARGETS = re.compile(rf"(method|methods\.[^.]+|(scene|scenes\.[^.]+)\.obstacles\.\d+)\.{TARGET}")


def settings_of(config: DictConfig) -> tuple[dict[str, Any], list[Any], Any]:
    """Return checked settings without `modules` and `output`, and these two."""
    settings = plain(config, "settings")
    require_known("settings", settings, (*_SETTINGS, *_PLACES))
    require_no_calls(settings)
    modules, output = (settings.pop(key, None) for key in _PLACES)
    if modules and not is_given("modules"):
        raise ValueError(f"modules: {modules!r}; must be given on the command line, as modules=NAME")
    return settings, modules if isinstance(modules, list) else [modules], output


def section_of(settings: Mapping[str, Any], key: str) -> dict[str, Any]:
    """Return the section of a key, which must be there."""
    section = settings.get(key)
    if not isinstance(section, dict):
        raise ValueError(f"{key}: {section!r}; must be a mapping of keys to values")
    return section


def scene_of(where: str, section: Mapping[str, Any], modules: list[Any]) -> Scene:
    """Build the scene of a section named `where`; `modules` may define obstacles of one's own."""
    from autdtorch.io.scene_file import load_scene

    try:
        return load_scene(section, modules)
    except ValueError as error:
        raise ValueError(f"{where}: {str(error).removeprefix('scene mapping: ')}") from error


def solver_of(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of `make_propagator`."""
    from autdtorch.cli.method_section import parameters
    from autdtorch.propagators import make_propagator

    solver = section_of(settings, "solver")
    require_known("solver", solver, parameters(make_propagator, but=("scene",)))
    if isinstance(cache := solver.get("cache"), str):
        solver["cache"] = folder_of("solver.cache", cache)
    return solver


def folder_of(key: str, value: object) -> Path:
    """Return the folder of a setting; one from a config file must be below the working directory."""
    folder = Path(str(value))
    if not is_given(key) and (folder.is_absolute() or ".." in folder.parts or not folder.parts):
        accepted = f"must be below the working directory, or given on the command line, as {key}=FOLDER"
        raise ValueError(f"{key}: {value!r}; {accepted}")
    return folder


def is_given(key: str) -> bool:
    """Return whether the command line sets the key, rather than a config file."""
    return any(re.match(rf"\+*{re.escape(key)}=", override) for override in HydraConfig.get().overrides.task)


def require_no_calls(value: object, *path: str) -> None:
    """Refuse the keys by which Hydra calls functions, except the target of a method or obstacle."""
    if isinstance(value, list):
        value = dict(enumerate(value))
    for key, entry in value.items() if isinstance(value, dict) else ():
        place = (*path, str(key))
        if key in _CALLS and not _TARGETS.fullmatch(".".join(place)):
            accepted = "must not be given; only a method or an obstacle has a _target_"
            raise ValueError(f"{'.'.join(place)}: {entry!r}; {accepted}")
        require_no_calls(entry, *place)
