"""Locks that keep other processes from a file or a folder."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from filelock import FileLock, Timeout


@contextlib.contextmanager
def held(lock: FileLock, refusal: Exception) -> Iterator[None]:
    """Hold a lock for a while; the system frees it when the process ends, however it ends.

    Args:
        lock: taken at once or not at all.
        refusal: is raised if another process holds it.

    Raises:
        OSError: the lock's file cannot be written.
    """
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise refusal from error
    try:
        yield
    finally:
        lock.release()
