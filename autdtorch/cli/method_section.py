"""Methods from the sections of a config, which name a function and give its settings."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Collection, Mapping
from typing import Any, TypeAlias, cast

import autdtorch
from autdtorch.methods import METHOD_LABELS
from autdtorch.utils.trusted import TARGET, load_trusted
from autdtorch.utils.validation import require_known

Method: TypeAlias = "functools.partial[Any]"

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
    ours = ", ".join(f"autdtorch.{method}" for method in METHOD_LABELS)
    return load_trusted(where, target, modules, ours)


def parameters(function: Callable[..., Any], but: tuple[str, ...]) -> tuple[str, ...]:
    """Names of the function's parameters, without those in `but`."""
    return tuple(name for name in inspect.signature(function).parameters if name not in but)
