"""Hints in messages about names: the accepted name that is most like a wrong one."""

from __future__ import annotations

import difflib
import functools
import inspect
import re
from collections.abc import Callable, Collection
from typing import Any, TypeVar

import lazy_loader

Named = TypeVar("Named", bound=Callable[..., Any])

_UNEXPECTED = re.compile(r"got an unexpected keyword argument '(\w+)'")


def did_you_mean(given: object, accepted: Collection[str]) -> str:
    """Return a question for messages with the accepted name most like `given`; empty if none is alike."""
    names = {name.casefold(): name for name in accepted}
    nearest = difflib.get_close_matches(given.casefold(), names, n=1) if isinstance(given, str) else []
    return f" (did you mean {names[nearest[0]]!r}?)" if nearest else ""


def with_extra(extra: str) -> str:
    """Return for messages how an extra is installed, as docs/install.md has it."""
    return f"pip install -c constraints.txt '.[{extra}]' in the clone"


def suggesting(function: Named) -> Named:
    """Decorate a function, or a class, whose error of an unknown keyword then names the accepted ones.

    Python does so from 3.13 on, where one of them is alike.
    """
    if isinstance(function, type):
        kind: Any = function
        kind.__init__ = suggesting(kind.__init__)
        return function

    @functools.wraps(function)
    def call(*arguments: Any, **keywords: Any) -> Any:
        try:
            return function(*arguments, **keywords)
        except TypeError as error:
            unexpected = _UNEXPECTED.search(str(error))
            within = error.__traceback__ is not None and error.__traceback__.tb_next is not None
            if within or unexpected is None:  # not of this call
                raise
            names = [name for name in inspect.signature(function).parameters if name not in ("self", "cls")]
            message = str(error).partition(". Did you mean")[0]
            hint = did_you_mean(unexpected[1], names) or f"; keywords: {', '.join(names)}"
            raise TypeError(message + hint) from None

    return call  # type: ignore[return-value]


def lazy_names(package: str, file: str) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package whose stub beside `file` lists its names.

    A name is imported when it is first used.
    """
    load, names, public = lazy_loader.attach_stub(package, file)

    def attribute(name: str) -> object:
        try:
            return load(name)
        except AttributeError as error:
            if name in public:
                raise
            missing = f"module {package!r} has no attribute {name!r}"
            raise AttributeError(missing + did_you_mean(name, public)) from error

    return attribute, names, public
