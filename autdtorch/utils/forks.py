"""Forks of a process, while its other threads compute.

The new process has a copy of every lock, and only the thread that forked. A lock that another thread held
stays held in it, and whoever acquires it waits forever.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any, Protocol

from autdtorch.utils.signals import send_again


class _Lock(Protocol):
    def acquire(self) -> Any: ...

    def release(self) -> Any: ...


class _Fork(threading.local):
    """A fork of this thread."""

    def __init__(self) -> None:
        self.held: list[_Lock] = []
        self.handlers: dict[int, Any] = {}  # of signals, which wait
        self.signals: list[int] = []  # that came meanwhile


_locks: list[_Lock] = []
_fork = _Fork()


def hold_at_fork(lock: _Lock) -> None:
    """Let every fork wait for a reentrant lock, and release it in both processes.

    Locks are acquired in the reverse order of these calls: name the lock first that a thread acquires last.
    Signals wait until the fork is done: what Python's handlers raise before it would be dropped.
    """
    _locks.append(lock)


def in_forked(function: Callable[[], object]) -> None:
    """Call a function in every new process, before anything else runs there."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=function)


def _hold() -> None:
    if threading.current_thread() is threading.main_thread():  # which alone runs handlers
        for number in signal.valid_signals():
            if callable(handler := signal.getsignal(number)):
                _fork.handlers[number] = handler
                signal.signal(number, _note)
    for lock in reversed(_locks):
        lock.acquire()
        _fork.held.append(lock)


def _note(number: int, frame: FrameType | None) -> None:
    _fork.signals.append(number)


def _let_go() -> None:
    while _fork.held:
        _fork.held.pop().release()
    while _fork.handlers:
        signal.signal(*_fork.handlers.popitem())


def _let_go_in_parent() -> None:
    _let_go()
    while _fork.signals:
        send_again(_fork.signals.pop())


def _let_go_in_child() -> None:
    _fork.signals.clear()  # sent to the parent
    _let_go()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_hold, after_in_parent=_let_go_in_parent, after_in_child=_let_go_in_child)
