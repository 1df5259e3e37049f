"""Methods from the sections of a config, which name a function and give its settings."""

from __future__ import annotations

import functools
import importlib
import inspect
import os
import sys
from collections.abc import Callable, Collection, Mapping
from types import ModuleType
from typing import Any, TypeAlias, cast

import autdtorch
from autdtorch.methods import METHOD_LABELS
from autdtorch.utils.validation import require_known

Method: TypeAlias = "functools.partial[Any]"

TARGET = "_target_"
"""The key that names the function."""

_NO_SETTINGS = ("objective", "trials", "seed", "score")  # the first three are the study's to give


def load_method(where: str, section: Mapping[str, Any], modules: Collection[Any]) -> Method:
    """Bind the function that a section names by `_target_` to the section's settings.

    Args:
        where: name of the section, for messages.
        section: a config file may have written it.
        modules: that the user trusts; a section can name their functions, and the methods of autdtorch.

    Raises:
        ValueError: no such function, an unknown setting, or one that is missing.
    """
    if TARGET not in section:
        raise ValueError(f"{where}: no _target_; must name a function such as autdtorch.gabs")
    function = _function(f"{where}.{TARGET}", section[TARGET], modules)
    settings = {key: value for key, value in section.items() if key != TARGET}
    require_known(where, settings, parameters(function, but=_NO_SETTINGS))
    method = functools.partial(function, **settings)
    signature = inspect.signature(method)
    given = [key for key in ("trials", "seed") if key in signature.parameters]
    try:
        signature.bind("objective", **dict.fromkeys(given))
    except TypeError as error:
        raise ValueError(
            f"{where}: {section[TARGET]!r}; {error}; must take an objective, the method's settings, "
            "and trials and seed if it has random choices"
        ) from error
    return method


def _function(where: str, target: object, modules: Collection[Any]) -> Callable[..., Any]:
    module, _, name = str(target).rpartition(".")
    if module == "autdtorch" and name in METHOD_LABELS:
        return cast(Callable[..., Any], getattr(autdtorch, name))
    if module not in modules:
        ours = ", ".join(f"autdtorch.{method}" for method in METHOD_LABELS)
        accepted = "or a function of a module that the command line names, as modules=MODULE"
        raise ValueError(f"{where}: {target!r}; must be one of {ours}, {accepted}")
    if not all(map(str.isidentifier, [*module.split("."), name])):
        raise ValueError(
            f"{where}: {target!r}; must be a module and a function, as in package.module.function"
        )
    function = getattr(_imported(where, target, module), name, None)
    # A function that the module imports is not one that the user trusts.
    if not inspect.isfunction(function) or not f"{function.__module__}.".startswith(f"{module}."):
        raise ValueError(f"{where}: {target!r}; must be a function that {module} defines")
    return function


def _imported(where: str, target: object, module: str) -> ModuleType:
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # where a module of one's own is looked for, behind what is installed
    try:
        return importlib.import_module(module)
    except (Exception, SystemExit) as error:  # whatever a module of one's own raises
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(f"{where}: {target!r}; {module} cannot be imported ({reason})") from error


def parameters(function: Callable[..., Any], but: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the function's parameters, without those in `but`."""
    return tuple(name for name in inspect.signature(function).parameters if name not in but)
