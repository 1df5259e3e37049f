"""The settings of a job as Hydra composed them: sections, scene, method, solver, folders."""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from autdtorch.io.readings_file import load_readings
from autdtorch.io.scene_file import load_scene
from autdtorch.io.yaml_file import TARGET, load_trusted, plain
from autdtorch.methods.base import Method
from autdtorch.methods.catalogue import METHODS
from autdtorch.objectives.readings import Readings
from autdtorch.propagators import make_propagator
from autdtorch.scene.scene import Scene
from autdtorch.study.study_method import StudyMethod
from autdtorch.utils.files import path_of
from autdtorch.utils.validation import invalid, require_known, within

_SETTINGS = (
    "scene",
    "method",
    "scenes",
    "methods",
    "goal",
    "hardware",
    "solver",
    "trials",
    "seed",
    "plane_spacing",
    "poses",
    "scenarios",
    "drive",
    "readings",
    "explore",
    "calibrate",
    "play",
    "path",
)
_PLACES = ("modules", "output")  # settings that change no result
_NOT_OF_METHODS = ("objective", "trials", "seed", "goal", "score")  # parameters that a study fills
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
    """Build the scene of a section named `where`; `modules` may define further obstacles."""
    try:
        return load_scene(section, modules)
    except ValueError as error:
        raise ValueError(f"{where}: {str(error).removeprefix('scene mapping: ')}") from error


def load_method(where: str, section: Mapping[str, Any], modules: Collection[Any]) -> StudyMethod:
    """Make the method that a section names by `_target_`, with the section's settings.

    A config file may have written the section. It can name the methods of autdtorch, and the functions and
    subclasses of `Method` of the trusted `modules`.
    """
    if TARGET not in section:
        raise ValueError(f"{where}: no _target_; must name a method such as autdtorch.gabs")
    target = _target(f"{where}.{TARGET}", section[TARGET], modules)
    settings = {key: value for key, value in section.items() if key != TARGET}
    require_known(where, settings, _parameters(target, but=_NOT_OF_METHODS))
    if not isinstance(target, type):
        method = functools.partial(target, **settings)
        signature = inspect.signature(method)
        passed = [key for key in ("trials", "seed", "goal", "score") if key in signature.parameters]
        try:
            signature.bind("objective", **dict.fromkeys(passed))
        except TypeError as error:
            accepted = "must take an objective, its settings, and trials and seed if it has random choices"
            raise ValueError(f"{where}: {section[TARGET]!r}; {error}; {accepted}") from error
        return method
    try:
        made: Method = target(**settings)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: {error}") from error
    return made


def _target(where: str, target: object, modules: Collection[Any]) -> Callable[..., Any]:
    """Return the class of a method, or a user's function."""
    module, _, name = str(target).rpartition(".")
    ours = METHODS | {method.__name__: method for method in METHODS.values()}
    if module == "autdtorch" and name in ours:
        return ours[name]
    loaded = load_trusted(where, target, modules, ", ".join(f"autdtorch.{method}" for method in METHODS))
    if isinstance(loaded, type) and not issubclass(loaded, Method):
        raise ValueError(f"{where}: {target!r}; must be a function or a subclass of autdtorch.Method")
    return loaded


def _parameters(function: Callable[..., Any], but: tuple[str, ...]) -> list[str]:
    return [name for name in inspect.signature(function).parameters if name not in but]


def solver_of(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of `make_propagator`."""
    solver = section_of(settings, "solver")
    require_known("solver", solver, _parameters(make_propagator, but=("scene",)))
    if isinstance(cache := solver.get("cache"), str):
        solver["cache"] = folder_of("solver.cache", cache)
    return solver


def folder_of(key: str, value: object) -> Path:
    """Return the folder of a setting; one from a config file must be below the working directory."""
    folder = Path(str(value))
    if not is_given(key) and (folder.is_absolute() or ".." in folder.parts or not folder.parts):
        accepted = f"must be below the working directory, or given on the command line, as {key}=FOLDER"
        raise ValueError(f"{key}: {value!r}; {accepted}")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{key}: {value!r} is a file; must be a folder, or a name that is free")
    return folder


def given_file(key: str, value: object) -> Path | None:
    """Return the path of a file to read, or None; it must be given on the command line."""
    if value is None:
        return None
    if not is_given(key):
        raise invalid(key, value, "must be given on the command line")
    return path_of(key, value)


def require_effective(command: str, effective: re.Pattern[str], accepted: str) -> None:
    """Refuse overrides of the command line that have no effect on a command."""
    for override in HydraConfig.get().overrides.task:
        if not effective.match(override):
            raise ValueError(f"{override}: has no effect on {command}; give {accepted}")


def given_readings(value: object, **settings: Any) -> Readings | None:
    """Return the readings of the file that the command line gives, or None.

    `settings` are those of `load_readings`.
    """
    if (file := given_file("readings", value)) is None:
        return None
    try:
        with within("readings"):
            return load_readings(file, **settings)
    except FileNotFoundError as error:
        raise ValueError(f"readings: {str(error).removeprefix('source: ')}") from error


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
