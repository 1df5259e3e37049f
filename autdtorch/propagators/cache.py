"""Matrices that took long to compute, kept on disk under a digest of all that decides them.

A file is written beside its place and then renamed: whoever reads finds nothing or all of it, whatever other
processes do and whenever one is killed. Its first line is a checksum of its name, its shape and the rest.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import math
import os
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

logger = logging.getLogger(__name__)

SUFFIX = ".matrix"
PARTIAL = ".partial"

ABANDONED = 3600.0
"""Age [s] from which on the partial file of a writer that was killed is removed; writing takes seconds."""


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
            self._remove_abandoned()
            with _partial_file(path) as file:
                file.write(_with_checksum(digest, matrix.shape, body))
        except OSError as error:
            logger.warning("%s cannot be written (%s): not kept", path, error.strerror)

    def _path(self, digest: str) -> Path:
        return self.folder / f"{digest}{SUFFIX}"

    def _remove_abandoned(self) -> None:
        for path in self.folder.glob(f"*{PARTIAL}"):
            with contextlib.suppress(OSError):  # another process removes it as well, or it is another user's
                if time.time() - path.stat().st_mtime > ABANDONED:
                    path.unlink()


def _bytes_of(shape: tuple[int, ...]) -> int:
    """Of a matrix and its number."""
    return np.dtype(np.complex128).itemsize * (math.prod(shape) + 1)


def _with_checksum(digest: str, shape: tuple[int, ...], body: bytes) -> bytes:
    named = f"{digest} {shape}\n".encode()
    return hashlib.sha256(named + body).hexdigest().encode() + b"\n" + body


@contextlib.contextmanager
def _partial_file(path: Path) -> Iterator[BinaryIO]:
    """A file of this process alone, which takes its place when it is complete and is removed otherwise."""
    partial = path.with_name(f"{path.stem}-{uuid.uuid4().hex}{PARTIAL}")
    try:
        with partial.open("xb") as file:
            yield file
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
