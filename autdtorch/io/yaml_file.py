"""YAML files from others: bounded in size, without functions and without environment variables."""

from __future__ import annotations

import importlib
import io
import os
import re
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from types import FunctionType
from typing import TYPE_CHECKING, Any, TypeAlias

from autdtorch.utils.files import require_file

if TYPE_CHECKING:
    from omegaconf import DictConfig, ListConfig

    Config: TypeAlias = DictConfig | ListConfig

_LARGEST = 2_000_000  # characters with aliases expanded, for which OmegaConf takes 50 MB and 5 s
_LEAST = 32  # characters counted for a key, value or collection, at least
_INTERPOLATION = 10_000  # characters counted for an interpolation, which takes OmegaConf 0.3 ms
_LONGEST = 10_000  # characters of one key or value
_DEEPEST = 32  # levels of nesting with aliases expanded
_SHOWN = 80  # characters of a refused text in messages

_ACCEPTED = (
    "must be valid YAML: a mapping without tags, "
    f"of at most {_LARGEST} characters and {_DEEPEST} levels with aliases expanded"
)

_REFERENCE = re.compile(r"\$\{[\w.\[\]]+\}")


@dataclass
class _Extent:
    """Size [characters] and depth of a YAML node with aliases expanded."""

    anchor: str | None
    size: int = _LEAST
    depth: int = 0

    def add(self, child: _Extent) -> None:
        self.size += child.size
        self.depth = max(self.depth, child.depth + 1)


def load_yaml(path: str | os.PathLike[str]) -> Config:
    """Read a YAML file with the checks of `parse_yaml`."""
    with require_file(path).open(encoding="utf-8") as file:
        try:
            text = file.read(_LARGEST + 1)
        except UnicodeDecodeError as error:
            raise ValueError(f"{os.fspath(path)}: {error}; must be valid YAML in UTF-8") from error
    return parse_yaml(text, os.fspath(path))


def parse_yaml(text: str, where: str) -> Config:
    """Read a mapping or list in YAML with OmegaConf, after checking the size with aliases expanded."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import MarkedYAMLError, YAMLError

    try:
        _require_bounded(text)
        config = OmegaConf.load(io.StringIO(text))
    except MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else 0
        raise ValueError(f"{where}, line {line}: {error.problem}; {_ACCEPTED}") from error
    except (YAMLError, OmegaConfBaseException, ValueError) as error:
        raise ValueError(f"{where}: {str(error).splitlines()[0]}; {_ACCEPTED}") from error
    return config


def unresolved(config: Config, where: str) -> Any:
    """Return a configuration as checked dictionaries and lists, with unresolved interpolations."""
    from omegaconf import OmegaConf

    return plain(OmegaConf.to_container(config, resolve=False), where)


def plain(value: Any, where: str) -> Any:
    """Return mappings, sequences and scalars as checked dictionaries and lists.

    A text may have no interpolation other than one whole `${key}`. Others could call a resolver, which reads
    the environment, or grow without limit. Interpolations of an OmegaConf node are resolved; check a node
    from others by `unresolved` before.
    """
    from omegaconf import OmegaConf

    left = _LARGEST

    def entry(node: Any, key: Any) -> Any:
        nonlocal left
        if OmegaConf.is_config(node) and OmegaConf.is_interpolation(node, key):
            left -= _INTERPOLATION
        return node[key]

    def checked(node: Any, *path: str) -> Any:
        nonlocal left
        left -= max(_LEAST, len(node) if isinstance(node, str) else 0)
        place = f"{where}: {'.'.join(path)[:_SHOWN]}"
        if left < 0 or len(path) > _DEEPEST:
            accepted = f"must be at most {_LARGEST} characters in {_DEEPEST} levels"
            raise ValueError(f"{place}: too large or too deep; {accepted}")
        if isinstance(node, Mapping):
            return {checked(key, *path): checked(entry(node, key), *path, str(key)) for key in node}
        if isinstance(node, Sequence) and not isinstance(node, str | bytes):
            return [checked(entry(node, index), *path, str(index)) for index in range(len(node))]
        if isinstance(node, str) and "${" in node and not _REFERENCE.fullmatch(node):
            accepted = "an interpolation must be a whole ${key}, without resolver"
            raise ValueError(f"{place}: {node[:_SHOWN]!r}; {accepted}")
        return node

    return checked(value)


def _require_bounded(text: str) -> None:
    """Check size and depth with aliases expanded, before anything is built from the text."""
    import yaml

    if len(text) > _LARGEST:
        raise ValueError("too large")
    named: dict[str | None, _Extent] = {}
    unfinished = [_Extent(None)]
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        match event:
            case yaml.CollectionStartEvent():
                unfinished.append(_Extent(event.anchor))
                named[event.anchor] = _Extent(None, size=_LARGEST + 1)  # an alias in itself
            case yaml.CollectionEndEvent():
                node = unfinished.pop()
                named[node.anchor] = node
                unfinished[-1].add(node)
            case yaml.ScalarEvent():
                named[event.anchor] = node = _Extent(event.anchor, max(_LEAST, len(event.value)))
                unfinished[-1].add(node)
            case yaml.AliasEvent() if event.anchor in named:
                unfinished[-1].add(named[event.anchor])
        if problem := _problem(event, len(unfinished) - 1, unfinished[-1]):
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=event.start_mark)


def _problem(event: Any, level: int, collection: _Extent) -> str:
    """Return the problem of an event in a collection at that level, or an empty text."""
    text = getattr(event, "value", "")
    if text and level == 0:  # OmegaConf would parse a text as YAML again
        return f"{text[:_SHOWN]!r} is not a mapping"
    if len(text) > _LONGEST:
        return f"a text of {len(text)} characters, more than {_LONGEST}"
    if (tag := getattr(event, "tag", None)) is not None:
        return f"tag {tag!r}"
    if collection.size > _LARGEST or level + collection.depth > _DEEPEST:
        return "too large or too deep"
    return ""


TARGET = "_target_"  # key that names the function or class


def load_trusted(where: str, target: object, modules: Collection[Any], ours: str = "") -> Callable[..., Any]:
    """Import a function or class, "package.module.name", that one of the trusted modules defines.

    `where` names the key in messages, which also list what autdtorch itself offers there, `ours`.
    """
    module, _, name = str(target).rpartition(".")
    if module not in modules:
        accepted = "in a module that the user names, as modules=MODULE"
        raise ValueError(f"{where}: {target!r}; must be {f'one of {ours}, or ' if ours else ''}{accepted}")
    if not all(map(str.isidentifier, [*module.split("."), name])):
        raise ValueError(f"{where}: {target!r}; must be a module and a name in it, as in package.module.name")
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # searched for the user's modules, after the installed packages
    try:
        named = getattr(importlib.import_module(module), name, None)
    except (Exception, SystemExit) as error:  # the user's module may raise anything
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(f"{where}: {target!r}; {module} cannot be imported ({reason})") from error
    # What the module merely imports is not trusted.
    if not isinstance(named, FunctionType | type) or not f"{named.__module__}.".startswith(f"{module}."):
        raise ValueError(f"{where}: {target!r}; must be a function or class that {module} defines")
    return named
