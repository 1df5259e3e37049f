"""Digests of values and of the package's source, and versions of packages: the origin of a result."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import importlib.metadata
import inspect
import sys
import uuid
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

_PACKAGES = ("torch", "numpy", "scipy", "libigl", "numba", "triton")  # triton is optional


def digest_of(*parts: object) -> str:
    """Return the SHA-256 of values: numbers, text, arrays, tensors, and containers and dataclasses of these.

    Two values have the same digest only if they agree to the last bit. Of a dataclass, compared fields and
    arrays count, and the source code where the class is not autdtorch's.
    """
    digest = hashlib.sha256()
    for part in parts:
        _add(digest, part)
    return digest.hexdigest()


@lru_cache(maxsize=1)
def source_digest() -> str:
    """Return the SHA-256 of the package's source, which changes with any edit."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        digest.update(f"{source.relative_to(package).as_posix()}\n".encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()


@lru_cache
def package_versions(*more: str) -> dict[str, str]:
    """Return the versions of the numerical packages that are installed, and of others by name."""
    versions = {}
    for package in (*_PACKAGES, *more):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    return versions


def _add(digest: Any, part: Any) -> None:
    """Add a value with its kind and length, so that different values give different input."""
    if part is None or isinstance(part, str | bool | int | float | complex):
        text = part.hex() if isinstance(part, float) else repr(part)  # of complex numbers exact too
        digest.update(f"{type(part).__name__} {len(text)} {text}\n".encode())
    elif hasattr(part, "__array__"):
        array = np.ascontiguousarray(part)
        digest.update(f"array {array.dtype.str} {array.shape}\n".encode() + array.tobytes())
    elif dataclasses.is_dataclass(part) and "__dataclass_fields__" in vars(type(part)):
        named = [(field, getattr(part, field.name)) for field in dataclasses.fields(part)]
        compared = {
            field.name: value for field, value in named if field.compare or hasattr(value, "__array__")
        }
        _add(digest, (type(part).__name__, _source_of(type(part)), compared))
    elif isinstance(part, Mapping):
        _add(digest, tuple(part.items()))
    elif isinstance(part, tuple | list):
        digest.update(f"sequence {len(part)}\n".encode())
        for entry in part:
            _add(digest, entry)
    else:
        raise TypeError(f"{type(part).__name__}: has no digest")


def _source_of(kind: type) -> str:
    """Return the source of a user's class or of its module, or a new text where the source is unknown."""
    if kind.__module__.partition(".")[0] == __package__.partition(".")[0]:
        return ""  # the digest of the package's source covers it
    for owner in (sys.modules.get(kind.__module__), kind):
        with contextlib.suppress(OSError, TypeError):
            return inspect.getsource(owner)  # type: ignore[arg-type]
    return uuid.uuid4().hex
