"""Progress of long work with a forecast: a bar on a terminal, log lines elsewhere and in workers.

Work that shows its progress can be stopped, by `stopping_when`.
"""

from __future__ import annotations

import contextlib
import logging
import math
import multiprocessing
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any

from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm
from tqdm.std import TqdmDefaultWriteLock

from autdtorch.utils.process import in_forked

logger = logging.getLogger(__name__)

_PATIENCE = 3.0  # time after which the bar or the first forecast in the log appears [s]
_MOST_POINTS = 1000  # times of earlier steps
# without tqdm's forecast, which is of means
_BAR = "{desc}: {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}{postfix}]"
_SOON = 0.5  # [s] left, of which nothing is said
_UNSURE = 1.5  # ratio of two forecasts, from which both are shown
_TimeLeft = Callable[[], tuple[float, float]]  # least and most [s]; infinite if unknown
_asked: ContextVar[Callable[[], bool]] = ContextVar("asked to stop", default=lambda: False)


def _renew_lock() -> None:
    """Replace tqdm's lock, which a thread that drew a bar may have held, but not one that a user set."""
    if isinstance(tqdm.get_lock(), TqdmDefaultWriteLock):
        tqdm.set_lock(threading.RLock())  # all of the default ones share theirs


in_forked(_renew_lock)


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

    def __init__(self, steps: int, what: str, bar: tqdm[None] | None, left: _TimeLeft | None = None) -> None:
        """Show the progress on `bar`, or in the log if it is None; `steps` may be an estimate."""
        self._bar, self._steps, self._what, self._done = bar, steps, what, 0
        self._left = left or self._by_pace
        self._begun = time.monotonic()
        self._points: list[tuple[float, int]] = []  # times after advances, with the number of steps
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
            self._bar.set_description_str(what)

    def advance(self, steps: int) -> None:
        """Count finished steps; any thread may call it.

        Raises:
            Stopped: the work was asked to stop.
        """
        if self._asked():
            raise Stopped
        with self._lock:
            self._done += steps
            now = time.monotonic()
            self._points.append((now, self._done))
            if len(self._points) > _MOST_POINTS:
                self._points = [*self._points[:-1:2], self._points[-1]]
            if self._bar is not None:
                self._bar.total = max(self._bar.total, self._done)
                self._bar.set_postfix_str(self._forecast(), refresh=False)
                self._bar.update(steps)
                return
            spent = now - self._begun
            if spent >= self._next and self._done != self._steps and (left := self._forecast()):
                logger.info("%s: %.0f s so far, %s", self._what, spent, left)
                self._next = 4 * spent  # ever fewer lines

    def _forecast(self) -> str:
        """Return the time left as text; nothing before it is known, and when the work ends soon."""
        if self._done > self._steps:
            return f"{self._done} steps where {self._steps} were expected"
        least, most = self._left()
        known = math.isfinite(most)
        if (most if known else least) < _SOON:
            return ""
        if not known:
            return f"at least {least:.0f} s left"
        if most < _UNSURE * least:
            return f"about {(least + most) / 2:.0f} s left"
        return f"about {least:.0f} to {most:.0f} s left"

    def _by_pace(self) -> tuple[float, float]:
        """Return the least and most time left [s], 0 before it is known.

        The remaining steps take as long as those of the later half so far, or become slower along the line
        through both halves.
        """
        left = self._steps - self._done
        (begun, first), (now, done) = self._points[0], self._points[-1]
        if done == first:  # the time before the first may include compiling kernels
            return 0.0, 0.0
        middle, half = min(self._points, key=lambda point: abs(point[1] - (first + done) / 2))
        if not first < half < done:
            return (left * (now - begun) / (done - first),) * 2
        early, late = (middle - begun) / (half - first), (now - middle) / (done - half)
        # of the time of a step, by each step; at most from nothing, as the first ones may be of another kind
        growth = min(max(0.0, late - early) / 0.5, late / 0.75) / (done - first)
        least = left * late
        return least, least + left * growth * (done - half + left) / 2


def is_terminal(stream: Any) -> bool:
    """Return whether a standard stream is at a terminal.

    It is None in a program without a console, closed in a daemon, and any writer in a notebook or a window.
    """
    try:
        return bool(stream.isatty())
    except (AttributeError, ValueError):
        return False


@contextlib.contextmanager
def show_progress(steps: int, what: str = "", left: _TimeLeft | None = None) -> Iterator[Progress]:
    """Show the progress of a task of `steps`, or an estimate of it; `what` names the first part.

    `left` gives the time that the work still takes where steps are of several kinds. By default it follows
    from the times of the steps so far.
    """
    if not is_terminal(sys.stderr) or multiprocessing.parent_process() is not None:
        yield Progress(steps, what, None, left)
        return
    with (
        logging_redirect_tqdm(),
        tqdm(
            desc=what, total=steps, file=sys.stderr, dynamic_ncols=True, delay=_PATIENCE,
            leave=None,  # the outermost bar stays
            bar_format=_BAR,
        ) as bar,
    ):  # fmt: skip
        yield Progress(steps, what, bar, left)
