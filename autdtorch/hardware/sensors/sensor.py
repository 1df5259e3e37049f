"""The sensor of a bench: pressure magnitudes at the control points."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Protocol, runtime_checkable

import torch

from autdtorch.objectives.objective import validate_magnitudes
from autdtorch.utils.signals import send

#: Time limit of a reading while the outputs are off [s]: a person may take minutes, a hung sensor forever.
LONGEST = 600.0
# The signal that wakes a reading: by default ignored, so that a late one does no harm. Windows has no such.
_WAKE: signal.Signals = getattr(signal, "SIGURG", signal.SIGINT)
_AGAIN = 0.5  # [s] between two signals


class SensorError(OSError):
    """A sensor gives no trustworthy reading."""


class _Overdue(BaseException):
    """A reading takes too long; not an `Exception`, which a sensor may handle and then wait on."""


@runtime_checkable
class Sensor(Protocol):
    """A sensor that reads the pressure at the control points while a drive is played."""

    def read(self) -> torch.Tensor:
        """Return magnitudes (P,) [Pa] at the control points, once the field is steady."""


def checked_reading(sensor: Sensor, points: int, seconds: float = LONGEST) -> torch.Tensor:
    """Return the reading (P,) [Pa], float64, of a sensor.

    In the main thread, a reading is interrupted after a number of seconds, wherever Python can interrupt it:
    where it sleeps, or waits for a file or a socket, but not in a driver that never returns.

    Raises:
        ValueError: the reading is not P finite magnitudes.
        SensorError: the time is over.
    """
    return validate_magnitudes("pressure of the sensor", _reading(sensor, seconds), points)


def _reading(sensor: Sensor, seconds: float) -> object:
    if threading.current_thread() is not threading.main_thread():  # which alone receives signals
        return sensor.read()
    done, is_late = threading.Event(), threading.Event()
    before = signal.getsignal(_WAKE) or signal.SIG_DFL  # None where a library has set it

    def interrupt(number: int, frame: FrameType | None) -> None:
        if is_late.is_set():
            raise _Overdue
        if callable(before):
            before(number, frame)

    try:
        try:
            signal.signal(_WAKE, interrupt)
            threading.Thread(target=_wake, args=(seconds, done, is_late), daemon=True).start()
            found = sensor.read()
        finally:
            done.set()
            signal.signal(_WAKE, before)
    except _Overdue:
        signal.signal(_WAKE, before)  # it may have come amid the lines above
        if not is_late.is_set():  # that of a reading around this one
            raise
    if is_late.is_set():
        raise SensorError(f"the sensor gives no reading within {seconds:.3g} s")
    return found


def _wake(seconds: float, done: threading.Event, is_late: threading.Event) -> None:
    """Interrupt the main thread after some time, again and again: what a `__del__` raises is dropped."""
    if done.wait(seconds):
        return
    is_late.set()
    while not done.is_set():
        send(_WAKE)
        done.wait(_AGAIN)
