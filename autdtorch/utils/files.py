"""Folders that are made, files that are written whole or not at all, errors that name them, and locks."""

from __future__ import annotations

import contextlib
import os
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

PARTIAL = ".partial"  # suffix of a file that is being written
ABANDONED = 3600.0  # age [s] after which a killed writer's partial file is removed; writing takes seconds


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Add the path to an `OSError` that has none, such as the error of a full disk."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(path)
        raise


def in_folder(path: Path) -> Path:
    """Return the path of a file that is to be written, after making its folder if that is missing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary name to write a file under, and rename it to `path` when it is complete.

    Readers find the old file or the new one, never a part of it, also if several processes write it at once.
    The folder is made if it is missing. The partial files that killed writers left in the folder are removed.
    """
    partial = path.with_name(f"{path.name}.{uuid.uuid4().hex}{PARTIAL}")
    with naming(path):
        _remove_abandoned(in_folder(path).parent)
        try:
            yield partial
            with partial.open("rb+") as file:
                os.fsync(file.fileno())  # or a power failure could leave the name without the content
            partial.replace(path)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise


def replace_file(path: Path, content: bytes) -> None:
    """Write a file as `replacing` does."""
    with replacing(path) as partial:
        partial.write_bytes(content)


def _remove_abandoned(folder: Path) -> None:
    for path in folder.glob(f"?*.{'[0-9a-f]' * 32}{PARTIAL}"):
        with contextlib.suppress(OSError):  # another process removes it too, or another user owns it
            if time.time() - path.lstat().st_mtime > ABANDONED:
                path.unlink()


@contextlib.contextmanager
def held(lock: FileLock, refusal: Exception) -> Iterator[None]:
    """Hold a lock, acquired at once, or raise `refusal`; the system frees it however the process ends."""
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise refusal from error
    try:
        yield
    finally:
        lock.release()
