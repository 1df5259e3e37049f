"""The number of threads, and work spread over them.

Threads live for one call, so that none spins while it waits and none is missing after a fork.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from typing import TypeVar

import torch
from threadpoolctl import ThreadpoolController

from autdtorch.utils.forks import hold_at_fork, in_forked

T = TypeVar("T")
R = TypeVar("R")

_given: ContextVar[int | None] = ContextVar("threads", default=None)


class _Outside:
    """The number of threads outside `one_library_thread`, which several threads may enter at once."""

    def __init__(self) -> None:
        self._lock = threading.RLock()  # a fork amid `enter` would also find threadpoolctl's lock held
        hold_at_fork(self._lock)
        self._threads = self._inside = 0
        self._blas = contextlib.ExitStack()

    def threads(self) -> int:
        """Return PyTorch's number of threads before the first thread entered."""
        with self._lock:
            return self._threads if self._inside else torch.get_num_threads()

    def enter(self) -> int:
        """Set one thread, and return the number that this thread had before."""
        with self._lock:
            before = torch.get_num_threads()
            if not self._inside:
                self._threads = before
                self._blas.enter_context(_numpy_threads().limit(limits=1))
            self._inside += 1
            torch.set_num_threads(1)
            return before

    def leave(self, before: int) -> None:
        """Restore the number of threads; the last thread to leave restores the default of new threads."""
        with self._lock:
            self._inside -= 1
            torch.set_num_threads(before if self._inside else self._threads)
            if not self._inside:
                self._blas.close()

    def begin_forked(self) -> None:
        """Set one thread in a forked process, also for the time after `leave`."""
        # PyTorch's threads do not survive a fork, and a forked process would wait for them forever.
        self._threads, self._blas = 1, contextlib.ExitStack()
        torch.set_num_threads(1)


@functools.cache
def _numpy_threads() -> ThreadpoolController:
    import scipy.linalg  # noqa: F401 - has a BLAS of its own, which must be there to be found

    return ThreadpoolController().select(user_api="blas")


_outside = _Outside()
in_forked(_outside.begin_forked)


def thread_count() -> int:
    """Return the number of threads that work may be spread over.

    It is PyTorch's, set by `torch.set_num_threads` or OMP_NUM_THREADS, and at most the processors available.
    """
    given = _given.get()
    return min(_outside.threads(), _processors()) if given is None else given


@contextlib.contextmanager
def one_library_thread() -> Iterator[None]:
    """Restrict PyTorch and NumPy to one thread, without a change to `thread_count`; also a decorator.

    Their threads spin while they wait, also after their work is done. They take the processor from ours, and
    on a busy machine slow thousands of small operations down many times (docs/decisions/threads.md).
    """
    token = _given.set(thread_count())
    before = _outside.enter()
    try:
        yield
    finally:
        _outside.leave(before)
        _given.reset(token)


def spread(function: Callable[[T], R], items: Iterable[T], most: int | None = None) -> list[R]:
    """Return the values of a function for all items, computed on `most` threads, by default `thread_count()`.

    The function should release the interpreter lock most of the time; nested calls of `spread` use one
    thread. Each item goes to the next free thread, so that a delayed thread costs at most one item.
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


def even_parts(count: int, parts: int) -> list[tuple[int, int]]:
    """Return the first of `count` things, and one past the last, of each of some nearly equal parts."""
    return list(itertools.pairwise(count * part // parts for part in range(parts + 1)))


def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
