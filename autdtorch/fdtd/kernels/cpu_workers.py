"""Workers that step the chunks of a grid: tasks claimed in order, and a wait that yields.

Tasks are numbered phase by phase. A worker claims the next one, waits until all tasks of earlier phases are
finished, and does it. A suspended worker delays the others by one task, and waiting workers yield to it.
"""

from __future__ import annotations

import ctypes
import os
import time
from collections.abc import Callable
from typing import Any

import llvmlite.binding
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic

from autdtorch.fdtd.kernels.compiled import INNER
from autdtorch.utils.threads import spread

COUNTERS = 32  # Numbers that hold the two counters, 0 at first
_CLAIMED, _FINISHED = 0, 16  # Their places, on separate cache lines
_TICKS = 10  # Fewest ticks of the thread clock for a meaningful time
# Polls of the counter before a waiting worker yields: a few microseconds, less than waking costs
_LOOKS = 2000


def share_of_processors(work: Callable[[], object], workers: int) -> float:
    """Run `work` on several workers; return the share of the time in which they had a processor, 0 to 1."""

    def timed(_: int) -> float:
        begin = time.thread_time()
        work()
        return time.thread_time() - begin

    begin = time.perf_counter()
    spent, took = sum(spread(timed, range(workers), workers)), time.perf_counter() - begin
    if took < _TICKS * time.get_clock_info("thread_time").resolution:  # 16 ms on Windows
        return 1.0
    return spent / (workers * took)


def _pointer(context: Any, builder: Any, signature: Any, given: Any) -> Any:
    kind = signature.args[0]
    array = context.make_array(kind)(context, builder, given[0])
    return cgutils.get_item_pointer(context, builder, kind, array, [given[1]], wraparound=False)  # type: ignore[no-untyped-call]


def _add_atomically(typing_context: Any, counters: Any, place: Any, amount: Any) -> Any:
    """Add to a counter and return its old value."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return builder.atomic_rmw("add", _pointer(context, builder, signature, given), given[2], "seq_cst")

    return types.int64(counters, types.int64, types.int64), generate


def _read_atomically(typing_context: Any, counters: Any, place: Any) -> Any:
    """Return a counter, with all writes before it was last added to (acquire)."""

    def generate(context: Any, builder: Any, signature: Any, given: Any) -> Any:
        return builder.load_atomic(_pointer(context, builder, signature, given), "acquire", 8)

    return types.int64(counters, types.int64), generate


_add: Any = intrinsic(_add_atomically)
_read: Any = intrinsic(_read_atomically)
# The system's function that yields to other threads, by a name that kernels loaded from disk find
_SYSTEM = ctypes.CDLL("kernel32").SwitchToThread if os.name == "nt" else ctypes.CDLL(None).sched_yield
llvmlite.binding.add_symbol("autdtorch_give_way", ctypes.cast(_SYSTEM, ctypes.c_void_p).value)
_give_way = types.ExternalFunction("autdtorch_give_way", types.int32())


@njit(**INNER)
def claim(counters):  # type: ignore[no-untyped-def]
    """Return the number of the next task."""
    return _add(counters, _CLAIMED, 1)


@njit(**INNER)
def finish(counters):  # type: ignore[no-untyped-def]
    """Count a task as finished."""
    _add(counters, _FINISHED, 1)


@njit(**INNER)
def wait_for(counters, tasks):  # type: ignore[no-untyped-def]
    """Wait until so many tasks are finished."""
    looks = 0
    while _read(counters, _FINISHED) < tasks:
        looks += 1
        if looks > _LOOKS:
            _give_way()
