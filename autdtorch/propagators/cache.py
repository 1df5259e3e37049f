"""Matrices kept on disk under a digest of everything that affects them.

The first line of a file is a checksum of its name, its shape and its content.
"""

from __future__ import annotations

import hashlib
import logging
import os
from dataclasses import fields
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from autdtorch.propagators.plan import Plan
from autdtorch.utils.array_types import AnyArray, ComplexArray
from autdtorch.utils.digest import digest_of, package_versions, source_digest
from autdtorch.utils.files import replace_file
from autdtorch.utils.validation import invalid, path_of

logger = logging.getLogger(__name__)

SUFFIX = ".matrix"
CACHE_VARIABLE = "AUTDTORCH_CACHE_DIR"

_NO_EFFECT = ("control_points", "observation_plane", "name")
"""Scene fields that do not affect the pressure; left out of the key."""


class DiskCache:
    """A folder of complex matrices, each with a few numbers, under their digests.

    The folder is made with the first matrix.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        """Nothing is read or made here."""
        self.folder = Path(folder)

    def load(
        self, digest: str, shape: tuple[int, ...], numbers: int
    ) -> tuple[ComplexArray, list[float]] | None:
        """Return a saved matrix and its numbers; None if there is none, it is damaged or of another shape."""
        path = self._path(digest)
        try:
            content = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            logger.warning("%s cannot be read (%s): computing again", path, error.strerror)
            return None
        body = content.partition(b"\n")[2]
        if content != _with_checksum(digest, shape, body):
            logger.warning("%s is damaged (its checksum is wrong): computing again", path)
            return None
        whole = len(body) == np.dtype(np.complex128).itemsize * (np.prod(shape, dtype=int) + numbers)
        values = np.frombuffer(body, np.complex128) if whole else np.array([np.nan])
        if not np.isfinite(values).all():
            logger.warning("%s holds no finite matrix of shape %s: computing again", path, shape)
            return None
        return values[:-numbers].reshape(shape).copy(), values[-numbers:].real.tolist()

    def save(self, digest: str, matrix: AnyArray, *numbers: float) -> None:
        """Save a matrix and its numbers; a file that cannot be written is logged and left out."""
        body = np.append(matrix, numbers).astype(np.complex128).tobytes()
        path = self._path(digest)
        try:
            replace_file(path, _with_checksum(digest, matrix.shape, body))
        except OSError as error:
            logger.warning("%s cannot be written (%s): not kept", path, error.strerror)

    def _path(self, digest: str) -> Path:
        return self.folder / f"{digest}{SUFFIX}"


def disk_cache(folder: str | os.PathLike[str] | Literal[False] | None) -> DiskCache | None:
    """Return the cache in a folder, by default the folder that `CACHE_VARIABLE` names, or None."""
    name = "cache"
    if folder is None:
        name, folder = CACHE_VARIABLE, os.environ.get(CACHE_VARIABLE) or False
    if folder is False:
        return None
    path = path_of(name, folder, "a folder, or False")
    there = next(one for one in (path, *path.absolute().parents) if os.path.lexists(one) or one.parent == one)
    if not os.path.isdir(there) or (there != path and not os.access(there, os.W_OK | os.X_OK)):
        accepted = f"must be a folder, or one that can be made, but {there} is no folder to write in"
        raise invalid(name, str(path), accepted)
    return DiskCache(path)


def _with_checksum(digest: str, shape: tuple[int, ...], body: bytes) -> bytes:
    named = f"{digest} {shape}\n".encode()
    return hashlib.sha256(named + body).hexdigest().encode() + b"\n" + body


def cache_key(plan: Plan, points: torch.Tensor) -> str:
    """Return a digest of everything that affects the transfer matrix of points (P, 3) [m]."""
    scene = {entry.name: getattr(plan.scene, entry.name) for entry in fields(plan.scene)}
    settings = {entry.name: getattr(plan, entry.name) for entry in fields(plan)}
    settings |= {"scene": None, "region": None, "runs": None, "dtype": str(plan.dtype)}
    affecting = {name: part for name, part in scene.items() if name not in _NO_EFFECT}
    return digest_of(source_digest(), package_versions(), settings, affecting, points)
