"""Forks of a process, while its other threads compute.

The new process has a copy of every lock, and only the thread that forked. A lock that another thread held
stays held in it, and whoever acquires it waits forever.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, Protocol


class _Lock(Protocol):
    def acquire(self) -> Any: ...

    def release(self) -> Any: ...


def hold_at_fork(lock: _Lock) -> None:
    """Let every fork wait for a reentrant lock, and release it in both processes.

    Locks are acquired in the reverse order of these calls: name the lock first that a thread acquires last.
    """
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(before=lock.acquire, after_in_parent=lock.release, after_in_child=lock.release)


def in_forked(function: Callable[[], object]) -> None:
    """Call a function in every new process, before anything else runs there."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=function)
