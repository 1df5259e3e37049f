"""The YAML files that Hydra composes a run from: ours, those of a trusted folder, and those from others.

Hydra runs what its settings name: launchers, callbacks, handlers of the log. A config from others
therefore cannot change them, neither by a key nor by its package or its defaults list.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any, TypeAlias

from hydra._internal.core_plugins import file_config_source
from hydra._internal.hydra import Hydra
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.object_type import ObjectType
from hydra.plugins.config_source import ConfigResult

from autdtorch.io.yaml_file import load_yaml, unresolved

_PACKAGE = Path(__file__).parents[1]
# A wheel carries the configs inside the package, a checkout beside it.
CONFIGS = next(folder / "configs" for folder in (_PACKAGE, _PACKAGE.parent) if (folder / "configs").is_dir())

GROUPS = sorted(folder.name for folder in CONFIGS.iterdir() if folder.is_dir())
"""GROUPS: folders of configs, of which a setting chooses one; some are not chosen by default."""

_UNLISTED = {"hardware": "base"}
"""Configs that are no options but what options of a group begin with."""

_Names: TypeAlias = list[str]  # in a class that has a method of this name

_TRUSTED = "hydra.searchpath in command-line"  # what Hydra calls a folder that this override adds

_NAME = r"[^\W_][\w.+-]*"
_OPTION = re.compile(rf"/?{_NAME}(/{_NAME})*(@(scenes|methods)\.[^\W_][\w+-]*)?")


class FileConfigSource(file_config_source.FileConfigSource):
    """A folder of YAML files: from others, unless it is ours or trusted.

    It is called like Hydra's class, which otherwise would be registered beside it in worker processes.
    """

    def load_config(self, config_path: str) -> ConfigResult:
        """Read a file; YAML from others must not change Hydra's settings."""
        path = os.path.realpath(os.path.join(self.path, self._normalize_file_name(config_path)))
        shown = os.path.relpath(path)
        config = load_yaml(shown)
        with open(path, encoding="utf-8") as file:
            header = self._get_header_dict(file.read(512))
        is_ours = self.path == str(CONFIGS)
        if is_ours and isinstance(config, Mapping) and "mode" in (config.get("hydra") or {}):  # see `_mode`
            raise ValueError(f"{shown}: hydra.mode; must be set on the command line, as hydra.mode=MULTIRUN")
        if not self._is_trusted():
            _require_harmless(shown, header["package"], unresolved(config, shown))
        if PurePosixPath(config_path).parts[:1] == ("scene",):
            _begin_paths(config, os.path.dirname(path))
        return ConfigResult(self.provider, self.full_path(), config, header)

    def list(self, config_path: str, results_filter: ObjectType | None) -> _Names:
        """Return the options in a folder."""
        names: _Names = super().list(config_path, results_filter)
        return [name for name in names if name != _UNLISTED.get(config_path)]

    def is_group(self, config_path: str) -> bool:
        """Return whether the source has such a folder."""
        return self._is_open(config_path) and super().is_group(config_path)

    def is_config(self, config_path: str) -> bool:
        """Return whether the source has such a file."""
        return self._is_open(config_path) and super().is_config(config_path)

    def _is_open(self, config_path: str) -> bool:
        return self._is_trusted() or PurePosixPath(config_path).parts[:1] != ("hydra",)

    def _is_trusted(self) -> bool:
        return self.path == str(CONFIGS) or self.provider == _TRUSTED


def register() -> None:
    """Have Hydra read files through `FileConfigSource` in this process, and find the mode by `_mode`."""
    SourcesRegistry.instance().types["file"] = FileConfigSource
    Hydra.get_mode = _mode  # type: ignore[assignment, method-assign]


_mode_of_settings = Hydra.get_mode


def _mode(hydra: Hydra, config_name: str | None, overrides: list[str]) -> Any:
    """Return the value of hydra.mode, for which Hydra would compose all settings once more.

    It is None unless an override sets it, or adds a trusted folder that may. Our files may not.
    """
    if any("hydra" in override for override in overrides):
        return _mode_of_settings(hydra, config_name, overrides)
    return None


def _begin_paths(config: Any, folder: str) -> None:
    """Begin the paths in a scene file with its folder, as `load_scene` does; others begin where one works."""
    from omegaconf import OmegaConf

    keys = range(len(config)) if OmegaConf.is_list(config) else list(config)
    for key in keys:
        if OmegaConf.is_missing(config, key) or OmegaConf.is_interpolation(config, key):
            continue
        if key == "path" and isinstance(config[key], str):
            config[key] = os.path.join(folder, config[key])
        elif OmegaConf.is_config(config[key]):
            _begin_paths(config[key], folder)


def _require_harmless(where: str, package: str | None, content: Any) -> None:
    if not isinstance(content, dict):
        raise ValueError(f"{where}: a list; must hold a mapping of keys to values")
    if package not in (None, "_global_"):
        raise ValueError(f"{where}: @package {package}; must be _global_ or left out")
    if "hydra" in content:
        raise ValueError(f"{where}: hydra; must be set on the command line, as hydra.KEY=VALUE")
    defaults = content.get("defaults")
    for entry in defaults if isinstance(defaults, list) else ():
        if not all(map(_is_harmless, _names(entry))):
            accepted = "must name configs such as two_cubes or /scene@scenes.NAME: two_cubes, none of Hydra's"
            raise ValueError(f"{where}: defaults: {entry!r}; {accepted}")


def _names(entry: Any) -> list[Any]:
    """Group and options of an entry of a defaults list."""
    if not isinstance(entry, dict):
        return [entry]
    groups = [re.sub(r"^((optional|override) )+", "", str(key)) for key in entry]
    options = [option if isinstance(option, list) else [option] for option in entry.values()]
    return groups + [name for option in options for name in option if name is not None]


def _is_harmless(name: Any) -> bool:
    if not isinstance(name, str):
        return False
    return name == "_self_" or (bool(_OPTION.fullmatch(name)) and "hydra" not in re.split("[/@.]", name))
