"""Methods from the sections of a config, which name a class or function and give its settings."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Collection, Mapping
from typing import Any, cast

from autdtorch.methods.base import Method
from autdtorch.methods.catalogue import METHODS
from autdtorch.study.run import StudyMethod
from autdtorch.utils.trusted import TARGET, load_trusted
from autdtorch.utils.validation import require_known

_NO_SETTINGS = ("objective", "trials", "seed", "score")  # the first three are the study's to give


def load_method(where: str, section: Mapping[str, Any], modules: Collection[Any]) -> StudyMethod:
    """Make the method that a section names by `_target_`, with the section's settings.

    A config file may have written the section. It can name the methods of autdtorch, and the functions and
    subclasses of `Method` of the trusted `modules`.
    """
    if TARGET not in section:
        raise ValueError(f"{where}: no _target_; must name a method such as autdtorch.gabs")
    target = _target(f"{where}.{TARGET}", section[TARGET], modules)
    settings = {key: value for key, value in section.items() if key != TARGET}
    require_known(where, settings, parameters(target, but=_NO_SETTINGS))
    try:
        if isinstance(target, type):
            return cast(Method, target(**settings))
        method = functools.partial(target, **settings)
        signature = inspect.signature(method)
        given = [key for key in ("trials", "seed") if key in signature.parameters]
        signature.bind("objective", **dict.fromkeys(given))
    except TypeError as error:
        accepted = "must take an objective, its settings, and trials and seed if it has random choices"
        raise ValueError(f"{where}: {section[TARGET]!r}; {error}; {accepted}") from error
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from error
    return method


def _target(where: str, target: object, modules: Collection[Any]) -> Callable[..., Any]:
    """Return the class of a method, or a function of one's own."""
    module, _, name = str(target).rpartition(".")
    ours = METHODS | {method.__name__: method for method in METHODS.values()}
    if module == "autdtorch" and name in ours:
        return ours[name]
    found = load_trusted(where, target, modules, ", ".join(f"autdtorch.{method}" for method in METHODS))
    if isinstance(found, type) and not issubclass(found, Method):
        raise ValueError(f"{where}: {target!r}; must be a function or a subclass of autdtorch.Method")
    return found


def parameters(function: Callable[..., Any], but: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the function's parameters, without those in `but`."""
    return tuple(name for name in inspect.signature(function).parameters if name not in but)
