"""Texts, paths, keys, functions and objects of a class."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

from autdtorch.utils.validation.values import invalid

_NAME = re.compile(r"(?!\.+$)[\w.+-]+")
_LONGEST_NAME = 100  # bytes


def require_name(field: str, name: object) -> None:
    """Check a name that becomes part of the names of files and HDF5 groups."""
    if not isinstance(name, str) or not _NAME.fullmatch(name) or len(name.encode()) > _LONGEST_NAME:
        accepted = "a name must be text of letters, digits and _ . + -, not of dots alone"
        raise invalid(field, name, f"{accepted}, with at most {_LONGEST_NAME} bytes")


def path_of(name: str, value: object, what: str = "a file") -> Path:
    """Return `value` as the path of `what`, which need not exist."""
    text = os.fspath(value) if isinstance(value, str | os.PathLike) else None
    if not isinstance(text, str) or not text or "\0" in text:
        raise invalid(name, value, f"must be the path of {what}")
    return Path(text)


def require_one_of(name: str, value: object, accepted: Iterable[str]) -> None:
    """Check that `value` is one of the accepted texts."""
    accepted = tuple(accepted)
    if not isinstance(value, str) or value not in accepted:
        raise invalid(name, value, f"must be one of {', '.join(accepted)}")


def require_known(where: str, given: Iterable[Any], allowed: Collection[str], what: str = "key") -> None:
    """Refuse keys that are not allowed."""
    for key in given:
        if key not in allowed:
            found = f"unknown {what} {key!r}{hint(key, allowed)}"
            raise ValueError(f"{where}: {found}; allowed {what}s: {', '.join(allowed)}")


def hint(given: object, allowed: Iterable[str]) -> str:
    """Return a question for messages with the allowed text most like `given`; empty if none is alike."""
    nearest = difflib.get_close_matches(str(given), list(allowed), n=1)
    return f" (did you mean {nearest[0]!r}?)" if nearest else ""


def require_kind(name: str, value: object, kind: type) -> None:
    """Check that `value` is an instance of a class or protocol."""
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        raise invalid(name, value, f"must be {article} {kind.__name__}")


def members(name: str, value: object, kind: type) -> tuple[Any, ...]:
    """Return the entries of an iterable, all instances of a class, as a tuple."""
    accepted = f"must be a sequence, each entry of class {kind.__name__}"
    if isinstance(value, str | bytes):
        raise invalid(name, value, accepted)
    try:
        entries: tuple[Any, ...] = tuple(value)  # type: ignore[arg-type]
    except Exception as error:  # of a class of the user's own, too
        raise invalid(name, value, accepted) from error
    for index, entry in enumerate(entries):
        require_kind(f"{name}[{index}]", entry, kind)
    return entries


def require_callable(name: str, value: object) -> None:
    """Check that `value` can be called."""
    if not callable(value):
        raise invalid(name, value, "must be a function")
