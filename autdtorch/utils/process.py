"""Signals, forks, threads and available memory of this process.

Threads live for one call, so that none spins while it waits and none is missing after a fork.

The process that a fork makes has a copy of every lock, and only the thread that forked. A lock that another
thread held is never released there, and whoever acquires it waits forever.
"""

from __future__ import annotations

import _thread
import contextlib
import functools
import itertools
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from pathlib import Path
from types import FrameType
from typing import Any, ParamSpec, Protocol, Self, TypeVar, cast, overload

import psutil
import torch
from threadpoolctl import ThreadpoolController

from autdtorch.utils.validation import invalid

_LATER = 1e-3  # [s]


def saved_handlers(numbers: Iterable[int]) -> dict[int, Any]:
    """Return the handlers of signals by number; none outside the main thread, which alone may set them."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    return {number: signal.getsignal(number) for number in numbers}


def restore_handlers(handlers: dict[int, Any]) -> None:
    """Set handlers of `saved_handlers` again, and empty the dictionary."""
    while handlers:
        number, handler = handlers.popitem()
        signal.signal(number, handler or signal.SIG_DFL)  # None where it is not Python's


@contextlib.contextmanager
def signals_restored() -> Iterator[None]:
    """Restore the handlers of SIGINT and SIGTERM, and the descriptor that wakes the main thread."""
    if not (handlers := saved_handlers((signal.SIGINT, signal.SIGTERM))):
        yield
        return
    signal.set_wakeup_fd(descriptor := signal.set_wakeup_fd(-1))
    try:
        yield
    finally:
        restore_handlers(handlers)
        signal.set_wakeup_fd(descriptor)


def send_again(number: int) -> None:
    """Send a signal to the main thread 1 ms later, where Python would drop what its handler raises now."""
    # a thread without the locks of `threading`, which the main thread may hold
    _thread.start_new_thread(_send_later, (signal.Signals(number),))


def _send_later(number: signal.Signals) -> None:
    time.sleep(_LATER)
    send(number)


def send(number: signal.Signals) -> None:
    """Send a signal to the main thread."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, number)
    else:
        _thread.interrupt_main(number)  # calls the handler once a wait has ended


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
    _fork.handlers = {
        number: handler
        for number, handler in saved_handlers(signal.valid_signals()).items()
        if callable(handler)
    }
    for number in _fork.handlers:
        signal.signal(number, _note)
    for lock in reversed(_locks):
        lock.acquire()
        _fork.held.append(lock)


def _note(number: int, frame: FrameType | None) -> None:
    _fork.signals.append(number)


def _let_go() -> None:
    while _fork.held:
        _fork.held.pop().release()
    restore_handlers(_fork.handlers)
    while _fork.signals:
        send_again(_fork.signals.pop())


def _let_go_in_child() -> None:
    _fork.signals.clear()  # sent to the parent
    _let_go()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_hold, after_in_parent=_let_go, after_in_child=_let_go_in_child)


T = TypeVar("T")
R = TypeVar("R")
P = ParamSpec("P")

_count: ContextVar[int | None] = ContextVar("threads", default=None)


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
        _count.set(1)
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
    count = _count.get()
    return min(_outside.threads(), _processors()) if count is None else count


@contextlib.contextmanager
def one_library_thread() -> Iterator[None]:
    """Restrict PyTorch and NumPy to one thread, without a change to `thread_count`; also a decorator.

    Their threads spin while they wait, also after their work is done. They take the processor from ours, and
    on a busy machine slow thousands of small operations down many times (docs/decisions/threads.md).
    """
    token = _count.set(thread_count())
    before = _outside.enter()
    try:
        yield
    finally:
        _outside.leave(before)
        _count.reset(token)


def spread(function: Callable[[T], R], items: Iterable[T], most: int | None = None) -> list[R]:
    """Return the values of a function for all items, computed on `most` threads, by default `thread_count()`.

    The function should release the interpreter lock most of the time; nested calls of `spread` share the
    threads that are left. Each item goes to the next free thread, so that a delayed thread costs at most one
    item.
    """
    items = list(items)
    threads = min(thread_count() if most is None else most, len(items))
    if threads < 2:
        return [function(item) for item in items]
    each = max(1, thread_count() // threads)

    def with_its_share(item: T) -> R:
        _count.set(each)
        return function(item)

    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(with_its_share, items))


def even_parts(count: int, parts: int) -> list[tuple[int, int]]:
    """Return the bounds of nearly equal parts of `count` things: the first, and one past the last."""
    return list(itertools.pairwise(count * part // parts for part in range(parts + 1)))


def parts_of_size(count: int, size: int) -> list[tuple[int, int]]:
    """Return the bounds of nearly equal parts of `count` things, of at most `size` each; see `even_parts`."""
    return even_parts(count, 1 + count // size)


def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


T_co = TypeVar("T_co", covariant=True)


def cached_tensors(count: int) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator that keeps the last results of a function, for arguments that have a hash.

    Their tensors serve calls with gradients, also where the first call is in inference mode.
    """

    def decorator(function: Callable[P, R]) -> Callable[P, R]:
        computed = torch.inference_mode(False)(torch.no_grad()(function))
        return cast(Callable[P, R], functools.lru_cache(count)(computed))

    return decorator


class cached_property(functools.cached_property[T_co]):  # noqa: TID251
    """`functools.cached_property` as of Python 3.12, also in 3.11.

    In 3.11 all objects of a class share a lock. Simulations in threads wait for each other, and a process
    that is forked while another thread holds the lock waits forever. Without it, two threads may compute a
    value at once; both get the first one.
    """

    @overload
    def __get__(self, instance: None, owner: type[Any] | None = None) -> Self: ...

    @overload
    def __get__(self, instance: object, owner: type[Any] | None = None) -> T_co: ...

    def __get__(self, instance: object, owner: type[Any] | None = None) -> Self | T_co:
        """Compute and store the value, which Python then reads without this call."""
        if instance is None:
            return self
        assert self.attrname is not None  # Python sets it when the class is made
        value: T_co = instance.__dict__.setdefault(self.attrname, self.func(instance))
        return value


_NEGLIGIBLE = 1e6  # bytes; asking the system takes a millisecond

_CGROUP = Path("/proc/self/cgroup")
_MOUNT = Path("/sys/fs/cgroup")
# Files of a control group by version: the limit, the memory in use, and the reclaimable part of it.
_FILES_1 = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
_FILES_2 = ("memory.max", "memory.current", "inactive_file")


def available_memory() -> int:
    """Return the memory [bytes] that the machine, control groups and limits leave to this process."""
    left = [psutil.virtual_memory().available, *_left_in_groups(), *_left_to_process()]
    return int(max(0, min(left)))


def require_memory(field: str, value: object, needed: float, unit: str = "") -> None:
    """Refuse an argument that needs more memory [bytes] than is available."""
    if needed < _NEGLIGIBLE:
        return
    if needed > (available := available_memory()):
        left = f"this process may use {available / 1e9:.3g} GB"
        raise invalid(field, value, f"needs about {needed / 1e9:.3g} GB of memory, {left}", unit)


def _left_in_groups() -> Iterator[int]:
    """Yield the memory left in each control group of this process."""
    with contextlib.suppress(OSError):  # not Linux
        for line in _CGROUP.read_text("utf-8").splitlines():
            _, controllers, path = line.split(":", 2)
            if not controllers:
                root, files = _MOUNT, _FILES_2
            elif "memory" in controllers.split(","):
                root, files = _MOUNT / "memory", _FILES_1
            else:
                continue
            here = root / path.lstrip("/")
            for folder in (here, *here.parents):
                if folder.is_relative_to(root):
                    yield from _left_in_group(folder, *files)


def _left_in_group(folder: Path, limit: str, usage: str, inactive: str) -> Iterator[int]:
    # a group without a limit has no such file, or "max" in it
    with contextlib.suppress(OSError, ValueError):
        most, used = (int((folder / name).read_text("ascii")) for name in (limit, usage))
        statistics = dict(line.split() for line in (folder / "memory.stat").read_text("ascii").splitlines())
        yield most - used + int(statistics.get(inactive, 0))


def _left_to_process() -> Iterator[int]:
    """Yield the memory left below the limit of `ulimit -v`."""
    with contextlib.suppress(ImportError):  # Windows
        import resource

        most = resource.getrlimit(resource.RLIMIT_AS)[0]
        if most != resource.RLIM_INFINITY:
            yield most - psutil.Process().memory_info().vms
