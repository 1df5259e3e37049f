"""Digests of values, to name what was computed from them."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np


def digest_of(*parts: object) -> str:
    """SHA-256 of values, to their last bit: numbers, text, arrays, tensors, and what is made up of these.

    Of a dataclass the fields that are compared count, and all arrays.

    Raises:
        TypeError: a value of another kind.
    """
    digest = hashlib.sha256()
    for part in parts:
        _add(digest, part)
    return digest.hexdigest()


def _add(digest: Any, part: Any) -> None:
    """Add a value, its kind and its length, so that no two different ones look the same."""
    if part is None or isinstance(part, str | bool | int | float):
        text = part.hex() if isinstance(part, float) else repr(part)
        digest.update(f"{type(part).__name__} {len(text)} {text}\n".encode())
    elif hasattr(part, "__array__"):
        array = np.ascontiguousarray(part)
        digest.update(f"array {array.dtype.str} {array.shape}\n".encode() + array.tobytes())
    elif dataclasses.is_dataclass(part):
        named = [(field, getattr(part, field.name)) for field in dataclasses.fields(part)]
        kept = {field.name: own for field, own in named if field.compare or hasattr(own, "__array__")}
        _add(digest, (type(part).__name__, kept))
    elif isinstance(part, Mapping):
        _add(digest, tuple(part.items()))
    elif isinstance(part, tuple | list):
        digest.update(f"sequence {len(part)}\n".encode())
        for entry in part:
            _add(digest, entry)
    else:
        raise TypeError(f"{type(part).__name__}: cannot be told by its content")
