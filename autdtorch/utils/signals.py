"""Signals from this program to its main thread, whose waits they interrupt."""

from __future__ import annotations

import _thread
import signal
import threading
import time

_LATER = 1e-3  # [s]


def send_again(number: int) -> None:
    """Send a signal to the main thread a little later, if Python drops what its handler raises now."""
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
