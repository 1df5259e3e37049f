"""The versions behind a result: this package's source and the numerical packages."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
from functools import lru_cache
from pathlib import Path

_PACKAGES = ("torch", "numpy", "scipy", "libigl", "numba")
_OPTIONAL_PACKAGES = ("triton",)


@lru_cache(maxsize=1)
def source_digest() -> str:
    """Return the SHA-256 of the package's source, which changes with any edit."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        digest.update(f"{source.relative_to(package).as_posix()}\n".encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()


def package_versions() -> dict[str, str]:
    """Return the versions of the numerical packages; optional packages count if they are installed."""
    versions = {package: importlib.metadata.version(package) for package in _PACKAGES}
    for package in _OPTIONAL_PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    return versions
