"""Run times, memory, processes and warnings of measurements."""

import contextlib
import logging
import resource
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from logging.handlers import BufferingHandler
from multiprocessing import get_context
from typing import TypeVar

Argument = TypeVar("Argument")
Result = TypeVar("Result")


def timed(work: Callable[[], Result], clock: Callable[[], float] = time.perf_counter) -> tuple[Result, float]:
    """Return a result and the time it took [s]."""
    begin = clock()
    return work(), clock() - begin


def shortest(work: Callable[[], Result], repeats: int) -> tuple[Result, float]:
    """Return the last result and the shortest time [s] of some repetitions."""
    runs = [timed(work) for _ in range(repeats)]
    return runs[-1][0], min(seconds for _, seconds in runs)


def in_new_process(work: Callable[[Argument], Result], argument: Argument) -> Result:
    """Return `work(argument)`, computed by a process that has done nothing else."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(work, argument).result()


def peak_memory() -> int:
    """Return the largest resident set of this process so far [byte]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


@contextlib.contextmanager
def logged_warnings() -> Iterator[list[logging.LogRecord]]:
    """Collect the warnings that the package logs within the context."""
    handler = BufferingHandler(1000)
    handler.setLevel(logging.WARNING)
    logger = logging.getLogger("autdtorch")
    logger.addHandler(handler)
    yield handler.buffer
    logger.removeHandler(handler)
