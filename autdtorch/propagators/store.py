"""Results that are kept in memory and, if there is one, in a folder, each up to a limit.

A store makes a call quicker, never different: the key of a result is a digest of everything that affects it.
The first line of a file is a checksum of its name, its shape and its content.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar

import numpy as np
import torch

from autdtorch.utils.array_types import AnyArray, ComplexArray
from autdtorch.utils.digest import digest_of, package_versions, source_digest
from autdtorch.utils.files import path_of, replace_file
from autdtorch.utils.validation import invalid, positive

logger = logging.getLogger(__name__)

SUFFIX = ".matrix"
CACHE_VARIABLE = "AUTDTORCH_CACHE_DIR"
LIMIT_VARIABLE = "AUTDTORCH_CACHE_GB"
MOST_BYTES = 1_000_000_000
"""Limit of a store's memory, and by default of its folder [bytes]: Huygens amplitudes of 256 transducers take
300 MB."""

_OVERRUN = 1 / 64
"""Part of its limit by which a folder exceeds it on average: it is listed once for so many bytes, since a
folder of 10,000 matrices takes 0.1 s."""

_IN_USE = 86400.0
"""Time [s] after which a removed matrix is taken for one of an earlier study."""


class StoredResult(Protocol):
    """A result of a known size."""

    @property
    def nbytes(self) -> int:
        """Memory [bytes]."""
        ...


ResultT = TypeVar("ResultT", bound=StoredResult)


class Store:
    """Results by key. Those used last are kept; matrices with a few numbers are also saved in a folder.

    Attributes:
        folder: made with the first matrix; None for memory alone.
    """

    def __init__(
        self, folder: Path | None = None, most_bytes: int = MOST_BYTES, most_saved: int = MOST_BYTES
    ) -> None:
        """Start with none; nothing is read or made here.

        A result of more than `most_bytes` is not kept, and one of more than `most_saved` not in the folder.
        """
        self.folder, self._most_bytes, self._most_saved = folder, most_bytes, most_saved
        self._results: dict[str, Any] = {}
        self._told_of_limit = False

    @property
    def nbytes(self) -> int:
        """Memory of all results [bytes]."""
        return sum(result.nbytes for result in list(self._results.values()))  # other threads add some

    def get(self, key: str, make: Callable[[], ResultT]) -> ResultT:
        """Return the result of a key, which is not to be changed; `make` it if it is not in memory."""
        result: ResultT | None = self._results.pop(key, None)
        if result is None:
            with torch.inference_mode(False), torch.no_grad():  # later calls may need gradients
                result = make()
        if result.nbytes <= self._most_bytes:
            self._results[key] = result
        for oldest in list(self._results):
            if self.nbytes <= self._most_bytes:
                break
            self._results.pop(oldest, None)
        return result

    def forget(self) -> None:
        """Keep no result in memory, such as before a measurement of time."""
        self._results.clear()

    def load(self, key: str, shape: tuple[int, ...], count: int) -> tuple[ComplexArray, list[float]] | None:
        """Return a saved matrix and its `count` numbers; None if there is none, or a damaged or other one."""
        if self.folder is None:
            return None
        path = self.folder / f"{key}{SUFFIX}"
        try:
            content = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            logger.warning("%s cannot be read (%s): computing again", path, error.strerror)
            return None
        body = content.partition(b"\n")[2]
        if content != _with_checksum(key, shape, body):
            logger.warning("%s is damaged (its checksum is wrong): computing again", path)
            return None
        whole = len(body) == np.dtype(np.complex128).itemsize * (np.prod(shape, dtype=int) + count)
        values = np.frombuffer(body, np.complex128) if whole else np.array([np.nan])
        if not np.isfinite(values).all():
            logger.warning("%s holds no finite matrix of shape %s: computing again", path, shape)
            return None
        with contextlib.suppress(OSError):  # a folder of another user
            os.utime(path)
        return values[:-count].reshape(shape).copy(), values[-count:].real.tolist()

    def save(self, key: str, matrix: AnyArray, *numbers: float) -> None:
        """Save a matrix and its numbers; a file that cannot be written is logged and left out.

        Files that were used longest ago are removed, as far as the folder exceeds its limit.
        """
        if self.folder is None:
            return
        body = np.append(matrix, numbers).astype(np.complex128).tobytes()
        if len(body) > self._most_saved:
            return
        path, content = self.folder / f"{key}{SUFFIX}", _with_checksum(key, matrix.shape, body)
        try:
            replace_file(path, content)
        except OSError as error:
            logger.warning("%s cannot be written (%s): not kept", path, error.strerror)
        share = int(content[:8], 16) / 16**8  # of the checksum, as good as random
        if share * self._most_saved * _OVERRUN <= len(content):
            self._remove_oldest(self.folder)

    def _remove_oldest(self, folder: Path) -> None:
        """Remove the matrices of the folder that were used longest ago, until the rest is within the limit.

        Log, once, if some are in use: a study that is repeated would need them first.
        """
        matrices = []
        for path in folder.glob(f"*{SUFFIX}"):
            with contextlib.suppress(OSError):  # another process removes it too
                status = path.stat()
                matrices.append((status.st_mtime_ns, status.st_size, path))
        total, in_use = sum(size for _, size, _ in matrices), time.time_ns() - 1e9 * _IN_USE
        for used, size, path in sorted(matrices):
            if total <= self._most_saved:
                break
            if used > in_use and not self._told_of_limit:
                self._told_of_limit = True
                full = f"its limit of {self._most_saved / 1e9:g} GB is less than what was used within a day"
                again = "results that no longer fit are computed again"
                logger.warning("%s is full: %s; %s; %s=10 allows 10 GB", folder, full, again, LIMIT_VARIABLE)
            with contextlib.suppress(OSError):  # or another user owns it
                path.unlink()
                total -= size


BODIES = Store(most_bytes=MOST_BYTES // 4)
"""BODIES: assembled boxes and T-matrices, which a body has in any scene and at any place."""


def key_of(*parts: object) -> str:
    """Return a digest of parts, of this package's source and of the versions of others.

    What has no digest, such as an obstacle of the user's with a function in a field, gets a new key.
    """
    try:
        return digest_of(source_digest(), package_versions(), *parts)
    except TypeError as error:
        logger.info("results are not found again: %s", error)
        return uuid.uuid4().hex


def store_in(folder: str | os.PathLike[str] | Literal[False] | None) -> Store:
    """Return a store in a folder, by default the one that `CACHE_VARIABLE` names; in memory for False."""
    name = "cache"
    if folder is None:
        name, folder = CACHE_VARIABLE, os.environ.get(CACHE_VARIABLE) or False
    if folder is False:
        return Store()
    path = path_of(name, folder, "a folder, or False")
    there = next(
        part for part in (path, *path.absolute().parents) if os.path.lexists(part) or part.parent == part
    )
    if not os.path.isdir(there) or (there != path and not os.access(there, os.W_OK | os.X_OK)):
        accepted = f"must be a folder, or one that can be made, but {there} is no folder to write in"
        raise invalid(name, str(path), accepted)
    return Store(path, most_saved=_saved_limit())


def _saved_limit() -> int:
    """Return the limit of a folder [bytes], by default `MOST_BYTES`."""
    text = os.environ.get(LIMIT_VARIABLE) or str(MOST_BYTES / 1e9)
    try:
        return round(1e9 * positive(LIMIT_VARIABLE, float(text), "GB"))
    except (ValueError, OverflowError):
        raise invalid(LIMIT_VARIABLE, text, "must be a number > 0, such as 10", "GB") from None


def _with_checksum(key: str, shape: tuple[int, ...], body: bytes) -> bytes:
    named = f"{key} {shape}\n".encode()
    return hashlib.sha256(named + body).hexdigest().encode() + b"\n" + body
