"""Signals: their handlers saved and restored, and signals of this program to its main thread."""

from __future__ import annotations

import _thread
import contextlib
import signal
import threading
import time
from collections.abc import Iterable, Iterator
from typing import Any

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
