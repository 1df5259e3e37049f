"""Functions and classes that config files name by `_target_`, from modules that the user, no file, names."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Collection
from types import FunctionType
from typing import Any

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
        found = getattr(importlib.import_module(module), name, None)
    except (Exception, SystemExit) as error:  # the user's module may raise anything
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(f"{where}: {target!r}; {module} cannot be imported ({reason})") from error
    # What the module merely imports is not trusted.
    if not isinstance(found, FunctionType | type) or not f"{found.__module__}.".startswith(f"{module}."):
        raise ValueError(f"{where}: {target!r}; must be a function or class that {module} defines")
    return found
