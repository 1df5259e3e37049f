"""Matrices that took long to compute, kept on disk under a digest of all that decides them.

The first line of a file is a checksum of its name, its shape and the rest.
"""

from __future__ import annotations

import hashlib
import logging
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from autdtorch.utils.files import replace_file

logger = logging.getLogger(__name__)

SUFFIX = ".matrix"


class DiskCache:
    """A folder of complex matrices, each with one number, under their digests.

    Attributes:
        folder: where they are.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        """Make the folder if need be.

        Raises:
            OSError: it cannot be made.
        """
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)

    def load(self, digest: str, shape: tuple[int, ...]) -> tuple[NDArray[np.complex128], float] | None:
        """Return what `save` was given, or None: nothing is there, or it is damaged or of another shape."""
        path = self._path(digest)
        try:
            content = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            logger.warning("%s cannot be read (%s): computing again", path, error.strerror)
            return None
        _, _, body = content.partition(b"\n")
        if content != _with_checksum(digest, shape, body):
            logger.warning("%s is damaged (its checksum is wrong): computing again", path)
            return None
        values = np.frombuffer(body, np.complex128) if len(body) == _bytes_of(shape) else None
        if values is None or not np.isfinite(values).all():
            logger.warning("%s holds no finite matrix of shape %s: computing again", path, shape)
            return None
        return values[:-1].reshape(shape).copy(), float(values[-1].real)

    def save(self, digest: str, matrix: NDArray[Any], number: float) -> None:
        """Keep a matrix and a number. What cannot be written is left out, and logged."""
        body = np.append(matrix, number).astype(np.complex128).tobytes()
        path = self._path(digest)
        try:
            replace_file(path, _with_checksum(digest, matrix.shape, body))
        except OSError as error:
            logger.warning("%s cannot be written (%s): not kept", path, error.strerror)

    def _path(self, digest: str) -> Path:
        return self.folder / f"{digest}{SUFFIX}"


def _bytes_of(shape: tuple[int, ...]) -> int:
    """Of a matrix and its number."""
    return np.dtype(np.complex128).itemsize * (math.prod(shape) + 1)


def _with_checksum(digest: str, shape: tuple[int, ...], body: bytes) -> bytes:
    named = f"{digest} {shape}\n".encode()
    return hashlib.sha256(named + body).hexdigest().encode() + b"\n" + body
