"""Worker processes of a sweep, which end with it."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from types import FrameType

import psutil

_ENDING = ("SIGTERM", "SIGHUP")  # at Ctrl-C joblib ends its workers


def end_workers_with_us() -> None:
    """Kill the workers of this process at signals that end it; others would go on, and hold their folders.

    Signals that are ignored, as by ``nohup``, or handled, stay so.
    """
    if threading.current_thread() is not threading.main_thread():  # which alone receives signals
        return
    for number in _signals():
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _end)


def leave_workers_alone() -> None:
    """Take back `end_workers_with_us`."""
    for number in _signals():
        if signal.getsignal(number) is _end:
            signal.signal(number, signal.SIG_DFL)


def _signals() -> list[signal.Signals]:
    return [getattr(signal, name) for name in _ENDING if hasattr(signal, name)]


def _end(number: int, _: FrameType | None) -> None:
    for worker in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):  # it has ended
            worker.kill()
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)
