"""Progress of long work with a forecast: a bar on a terminal, log lines elsewhere and in workers.

Work that shows its progress can be stopped, by `stopping_when`.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any

from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from autdtorch.utils.forks import in_forked

logger = logging.getLogger(__name__)

_PATIENCE = 3.0  # time after which the bar or the first forecast in the log appears [s]
_asked: ContextVar[Callable[[], bool]] = ContextVar("asked to stop", default=lambda: False)

in_forked(lambda: tqdm.set_lock(threading.RLock()))  # a thread that drew a bar may have held the lock


class Stopped(Exception):
    """Work that was asked to stop has done so, without a result."""


@contextlib.contextmanager
def stopping_when(asked: Callable[[], bool]) -> Iterator[None]:
    """Let work within raise `Stopped` at its next step, if `asked` returns True there."""
    token = _asked.set(asked)
    try:
        yield
    finally:
        _asked.reset(token)


class Progress:
    """A counter of steps that shows the current task and the time left."""

    def __init__(self, steps: int, what: str, bar: tqdm[None] | None) -> None:
        """Show the progress on `bar`, or in the log if it is None; `steps` may be an estimate."""
        self._bar, self._steps, self._what, self._done = bar, steps, what, 0
        self._begun = time.monotonic()
        self._first: tuple[float, int] | None = None  # time and number of the first steps
        self._next = _PATIENCE
        self._lock = threading.Lock()  # several threads run simulations
        self._asked = _asked.get()  # those threads have another context

    def begin(self, what: str) -> None:
        """Name the current task."""
        self.describe(what, logging.INFO)

    def describe(self, what: str, level: int = logging.DEBUG) -> None:
        """Show the details of the work on the bar, or in the log for developers."""
        self._what = what
        if self._bar is None:
            logger.log(level, what)
        else:
            self._bar.set_description(what)

    def advance(self, steps: int) -> None:
        """Count finished steps; any thread may call it.

        Raises:
            Stopped: the work was asked to stop.
        """
        if self._asked():
            raise Stopped
        with self._lock:
            self._done += steps
            if self._bar is not None:
                self._bar.total = max(self._bar.total, self._done)
                self._bar.update(steps)
                return
            now = time.monotonic()
            if self._first is None:  # the time before may include compiling kernels
                self._first = now, self._done
            begun, done = self._first
            spent = now - self._begun
            if spent >= self._next and done < self._done < self._steps:
                left = (now - begun) * (self._steps - self._done) / (self._done - done)
                logger.info("%s: %.0f s so far, about %.0f s left", self._what, spent, left)
                self._next = 4 * spent  # ever fewer lines


def is_terminal(stream: Any) -> bool:
    """Return whether a standard stream is at a terminal.

    It is None in a program without a console, closed in a daemon, and any writer in a notebook or a window.
    """
    try:
        return bool(stream.isatty())
    except (AttributeError, ValueError):
        return False


@contextlib.contextmanager
def show_progress(steps: int, what: str = "") -> Iterator[Progress]:
    """Show the progress of a task of `steps`, or an estimate of it; `what` names the first part."""
    if not is_terminal(sys.stderr) or multiprocessing.parent_process() is not None:
        yield Progress(steps, what, None)
        return
    with (
        logging_redirect_tqdm(),
        tqdm(
            desc=what, total=steps, file=sys.stderr, dynamic_ncols=True, delay=_PATIENCE,
            leave=None,  # the outermost bar stays
        ) as bar,
    ):  # fmt: skip
        yield Progress(steps, what, bar)
