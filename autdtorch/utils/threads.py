"""The number of threads, and work spread over them.

Threads live for one call. None is left behind that would spin while it waits, or be missing after a fork.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from typing import TypeVar

import torch

T = TypeVar("T")
R = TypeVar("R")

_given: ContextVar[int | None] = ContextVar("threads", default=None)


class _Outside:
    """PyTorch's number of threads outside `one_torch_thread`, where several threads may be at once."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._threads = self._inside = 0

    def threads(self) -> int:
        """Return PyTorch's threads, or what they were before anyone entered."""
        with self._lock:
            return self._threads if self._inside else torch.get_num_threads()

    def enter(self) -> int:
        """Have one thread from now on; returns how many this thread had."""
        with self._lock:
            before = torch.get_num_threads()
            if not self._inside:
                self._threads = before
            self._inside += 1
            torch.set_num_threads(1)
            return before

    def leave(self, before: int) -> None:
        """Have as many as before; the last to leave also restores what new threads will have."""
        with self._lock:
            self._inside -= 1
            torch.set_num_threads(before if self._inside else self._threads)

    def begin_forked(self) -> None:
        """Have one thread in a child process, also after leaving what its parent had entered."""
        # PyTorch's threads do not survive a fork: a forked process would wait for them without end.
        self._lock, self._threads = threading.Lock(), 1
        torch.set_num_threads(1)


_outside = _Outside()

if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_outside.begin_forked)


def thread_count() -> int:
    """Return the number of threads that work may be spread over.

    It is PyTorch's, which follows `torch.set_num_threads` and OMP_NUM_THREADS, but at most one for each
    processor that this process may use.
    """
    given = _given.get()
    return min(_outside.threads(), _processors()) if given is None else given


@contextlib.contextmanager
def one_torch_thread() -> Iterator[None]:
    """Have PyTorch work on one thread for a while; also a decorator. `thread_count` stays what it was.

    PyTorch's threads spin while they wait for each other. Where a busy machine keeps one of them from its
    processor, thousands of small operations take many times longer (docs/decisions/threads.md).
    """
    token = _given.set(thread_count())
    before = _outside.enter()
    try:
        yield
    finally:
        _outside.leave(before)
        _given.reset(token)


def spread(function: Callable[[T], R], items: Iterable[T], most: int | None = None) -> list[R]:
    """Return the function's values for all items, worked out on several threads.

    The function spends its time in code that does not hold the interpreter's lock. What it spreads itself
    stays on its own thread.

    Args:
        function: of one item.
        items: each is taken up by the next free thread, so that a thread that is kept from its processor
            delays the others by one item.
        most: threads; by default `thread_count()`.
    """
    items = list(items)
    threads = min(thread_count() if most is None else most, len(items))
    if threads < 2:
        return [function(item) for item in items]

    def alone(item: T) -> R:
        _given.set(1)
        return function(item)

    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(alone, items))


def _processors() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
