"""Hints in messages about names: the accepted name that is most like a wrong one."""

from __future__ import annotations

import difflib
import functools
import inspect
import re
import sys
import warnings
from collections.abc import Callable, Collection
from functools import partial
from typing import Any, TypeVar

import lazy_loader

Function = TypeVar("Function", bound=Callable[..., Any])

_UNEXPECTED = re.compile(r"got an unexpected keyword argument '(\w+)'")
_SUGGESTS = "_suggests"  # attribute of functions that are decorated by `suggesting`


def nearest_name(wrong: object, accepted: Collection[str]) -> str | None:
    """Return the accepted name most like `wrong`; None if none is alike."""
    if not isinstance(wrong, str):
        return None
    nearest = difflib.get_close_matches(wrong.casefold(), {name.casefold() for name in accepted})
    alike = [name for name in accepted if name.casefold() in nearest]  # some differ in capitals alone
    return max(alike, key=partial(_likeness, wrong), default=None)


def did_you_mean(wrong: object, accepted: Collection[str]) -> str:
    """Return a question for messages with the accepted name most like `wrong`; empty if none is alike."""
    name = nearest_name(wrong, accepted)
    return f" (did you mean {name!r}?)" if name else ""


def _likeness(wrong: str, name: str) -> float:
    """Return how alike two names are, first without and then with regard to capitals, 0 to 2."""
    pairs = (wrong.casefold(), name.casefold()), (wrong, name)
    return sum(difflib.SequenceMatcher(None, *pair).ratio() for pair in pairs)


def with_extra(extra: str) -> str:
    """Return for messages how an extra is installed, as docs/install.md has it."""
    return f"pip install -c constraints.txt '.[{extra}]' in the clone"


def suggesting(function: Function) -> Function:
    """Decorate a function or method: its error of an unknown keyword names the accepted ones.

    Python does so from 3.13 on, where one of them is alike. Public functions and classes are decorated by
    `lazy_names`.
    """

    @functools.wraps(function)
    def call(*arguments: Any, **keywords: Any) -> Any:
        try:
            return function(*arguments, **keywords)
        except TypeError as error:
            unexpected = _UNEXPECTED.search(str(error))
            names = [name for name in inspect.signature(function).parameters if name not in ("self", "cls")]
            # A wrong keyword of a call further in is not one of this call.
            if unexpected is None or unexpected[1] in names or unexpected[1] not in keywords:
                raise
            message = str(error).partition(". Did you mean")[0]
            hint = did_you_mean(unexpected[1], names) or f"; keywords: {', '.join(names)}"
            raise TypeError(message + hint) from None

    setattr(call, _SUGGESTS, True)
    return call  # type: ignore[return-value]


def renamed_keywords(**names: str) -> Callable[[Function], Function]:
    """Return a decorator of functions that still take keywords by old names, with a DeprecationWarning.

    Args:
        names: the new name of each old one.
    """

    def decorate(function: Function) -> Function:
        current = suggesting(function)

        @functools.wraps(current)
        def call(*arguments: Any, **keywords: Any) -> Any:
            for old, new in names.items():
                if old in keywords:
                    if new in keywords:
                        raise TypeError(f"{old}: has the new name {new}, which is given too")
                    warnings.warn(f"{old}= is now {new}=", DeprecationWarning, stacklevel=2)
                    keywords[new] = keywords.pop(old)
            return current(*arguments, **keywords)

        return call  # type: ignore[return-value]

    return decorate


def lazy_names(package: str, file: str) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package whose stub beside `file` lists its names.

    A name is imported when it is first used. Its function, or the constructor of its class, is `suggesting`.
    """
    load, names, public = lazy_loader.attach_stub(package, file)

    def attribute(name: str) -> object:
        try:
            value = load(name)
        except AttributeError as error:
            if name in public:
                raise
            missing = f"module {package!r} has no attribute {name!r}"
            raise AttributeError(missing + did_you_mean(name, public)) from error
        if inspect.isfunction(value) and not hasattr(value, _SUGGESTS):
            home, value = sys.modules[value.__module__], suggesting(value)
            setattr(home, value.__name__, value)  # where pickle looks for it
            setattr(sys.modules[package], name, value)
        elif inspect.isclass(value):
            kind: Any = value
            start = vars(kind).get("__init__")
            # `typing` makes the constructors of protocols, and needs them as they are.
            if getattr(start, "__module__", "") == kind.__module__ and not hasattr(start, _SUGGESTS):
                kind.__init__ = suggesting(start)
        return value

    return attribute, names, public
