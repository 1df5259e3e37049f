"""Safety of a bench: limits on amplitudes and times, and outputs off however a trial ends."""

from __future__ import annotations

import contextlib
import functools
import logging
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import FrameType

import torch

from autdtorch.hardware.link import AmplitudeScale, Link
from autdtorch.hardware.sensors.sensor import (
    AnySensor,
    Pulse,
    PulsedSensor,
    Sensor,
    SensorError,
    checked_reading,
    require_sensor,
)
from autdtorch.hardware.streaming import Playback, PreparedSequence, require_sequence
from autdtorch.scene.sequence import Sequence
from autdtorch.utils.process import send_again
from autdtorch.utils.validation import (
    integer_at_least,
    invalid,
    not_negative,
    number_between,
    positive,
    require_kind,
)

logger = logging.getLogger(__name__)

# SIGTSTP, Ctrl-Z, would stop the process, and its timer, with the outputs on; so would SIGTTIN, where a trial
# in the background of a shell asks for a reading.
_ENDING = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT", "SIGTSTP", "SIGTTIN", "SIGBREAK")
_SIGNALS = [getattr(signal, name) for name in _ENDING if hasattr(signal, name)]

_LONGEST = 1e6  # time limit [s]: 12 days; timers of some systems take no more than 49
_LONGEST_REST = 86_400.0  # [s]
_LEAST_DUTY_CYCLE = 1e-4
_MOST_READINGS = 10_000
_GRACE = 0.1  # from when the timer switches off until a reading is interrupted [s]


class LimitError(RuntimeError):
    """A limit of a trial is reached."""


class Signalled(KeyboardInterrupt):
    """The signal of a `number` ends the trial."""

    def __init__(self, number: int) -> None:
        """Name the signal."""
        super().__init__(signal.Signals(number).name)
        self.number = number


@contextlib.contextmanager
def ended_by_signals() -> Iterator[None]:
    """Raise `Signalled` at signals that end or stop a process, so that links are closed on the way out.

    Use it around the link, in the main thread, which alone receives signals; elsewhere `ValueError`. The
    signals are Ctrl-C, Ctrl-Z, SIGTERM, SIGHUP, SIGQUIT and SIGTTIN; an ignored one, as by ``nohup``, stays
    ignored. While a `Signalled` is on its way out, further signals do not raise: they must not interrupt the
    switching off. Python drops errors in a ``__del__``: a signal that comes there is sent again after it.
    Where Python drops a `Signalled` elsewhere, as in a callback, the next signal raises.
    """
    outside = sys.exception()

    def end(number: int, frame: FrameType | None) -> None:
        error = sys.exception()
        while error is not outside and error is not None:
            if isinstance(error, Signalled):  # it is on its way out
                return
            error = error.__context__
        if _finalises(frame):
            send_again(number)
            return
        raise Signalled(number)

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    handled = [number for number in _SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.getsignal(number) for number in handled}
    try:
        for number in handled:
            signal.signal(number, end)
        yield
    finally:
        try:
            restore()
        except Signalled:  # the first one; no other is raised while it is handled
            restore()
            raise


def _finalises(frame: FrameType | None) -> bool:
    """Return true if a frame runs in a ``__del__``."""
    while frame is not None:
        if frame.f_code.co_name == "__del__":
            return True
        frame = frame.f_back
    return False


@dataclass(frozen=True)
class Limits:
    """Limits of a trial.

    Attributes:
        amplitude: largest amplitude of a transducer, above 0 up to 1. Drives are scaled: a method's |q| = 1
            is the largest amplitude level of the device within it.
        evaluations: largest number of evaluations, with those before an interruption.
        seconds: longest time that the outputs are on in all [s].
        seconds_in_a_row: longest time that they are on without a rest [s].
        duty_cycle: share of the time that they may be on, 1e-4 to 1: after a stretch of t s they rest for
            t (1 / duty_cycle - 1) s, which must be at most a day.

    `ValueError` for an attribute out of range.
    """

    amplitude: float
    evaluations: int = 10_000
    seconds: float = 3600.0
    seconds_in_a_row: float = 60.0
    duty_cycle: float = 1.0

    def __post_init__(self) -> None:
        integer_at_least("evaluations", self.evaluations, 1)
        number_between("amplitude", positive("amplitude", self.amplitude), 0.0, 1.0)
        for name in ("seconds", "seconds_in_a_row"):
            number_between(name, positive(name, getattr(self, name), "s"), 0.0, _LONGEST, "s")
        number_between("duty_cycle", self.duty_cycle, _LEAST_DUTY_CYCLE, 1.0)
        if self.duty_cycle < (least := 1 / (1 + _LONGEST_REST / self.longest_stretch)):
            after = f"after {self.longest_stretch:g} s in a row"
            accepted = f"must be >= {least:.3g}, so that they rest for at most a day {after}"
            raise invalid("duty_cycle", self.duty_cycle, accepted)

    @property
    def longest_stretch(self) -> float:
        """Longest time without a rest that the outputs can be on [s]."""
        return min(self.seconds, self.seconds_in_a_row)


class LimitedLink:
    """A link that plays within the `limits` of a trial, and switches off by itself when the time is up.

    Methods raise `LinkError` if the device does not take the bytes. Attributes are the `link`, the `limits`,
    and `logs`, the logs whose time on was counted.
    """

    def __init__(self, link: Link, limits: Limits) -> None:
        """Limit a link; `ValueError` if its device has no amplitude up to the limit except 0."""
        require_kind("link", link, Link)
        require_kind("limits", limits, Limits)
        self.link, self.limits = link, limits
        self.logs: set[Path] = set()
        self._scale = AmplitudeScale(link.wiring, limits.amplitude)
        self._lock = threading.RLock()
        self._timer: threading.Timer | None = None
        self._on_since: float | None = None
        self._on_until = 0.0
        self._seconds_before = 0.0
        self._rested_at = 0.0
        self._failure: Exception | None = None

    @property
    def seconds_on(self) -> float:
        """Time that the outputs were on so far [s]."""
        with self._lock:  # against the timer, which adds the stretch
            return self._seconds_before + self._stretch()

    def go_on(self, seconds: float) -> None:
        """Go on with a trial of an earlier process, in which the outputs were on for `seconds` [s], >= 0.

        The length of its last stretch is unknown: the outputs rest as after the longest.
        """
        self._seconds_before += not_negative("seconds", seconds, "s")
        rest = self._rest(self.limits.longest_stretch)
        self._rested_at = time.monotonic() + rest
        if rest > 0:
            logger.info("resting for %.3g s first, for the duty cycle", rest)

    def play(self, drive: torch.Tensor) -> None:
        """Play a drive (M,), |q| <= 1, scaled to the limit, until the next, `off`, or the end of the time.

        The time may end while the sound settles: `reading` and `require_on` raise then.

        `LimitError` if the time limit of the outputs is reached; `ValueError` for another shape, not finite
        complex numbers or an amplitude above 1.
        """
        asked = self._scale.asked(drive)
        if self._stretch() > self.limits.seconds_in_a_row / 2:  # leave the other half to the sensor
            self.off()
        if self._on_since is None:
            self._rest_now()
        left = self._seconds_left()
        with self._lock:
            self._raise_failure()
            self._start_timer(left)
            self.link.begin(asked)
        self.link.wait_for_sound()  # without the lock, which the timer needs

    def play_sequence(self, sequence: Sequence, seconds: float | None = None) -> Playback:
        """Play a sequence, scaled to the limit, as `Link.play_sequence` does; the outputs are off afterwards.

        A loop without `seconds` plays until the end of the time, unless another thread calls `off`.

        Args:
            sequence: frames of drives (T, M), scaled as in `play`.
            seconds: time to play [s], as of `Link.play_sequence`.

        Raises:
            LimitError: the time limit of the outputs is reached, before or meanwhile.
            ValueError: as of `Link.play_sequence`, or a duration above `seconds_in_a_row`.
            LinkError: the device does not take the bytes, or the computer is too slow.
        """
        self.off()
        with self.link.turn() as ended:  # `off` ends it from here on
            require_sequence(sequence, len(self.link.transducers))
            asked = replace(sequence, drives=self._scale.frames_asked(sequence.drives))
            prepared = self.link.prepare_sequence(asked, seconds)
            wanted = min(prepared.count / sequence.rate, math.inf if seconds is None else seconds)
            most = self.limits.seconds_in_a_row
            if most < wanted < math.inf:
                raise invalid("seconds", wanted, f"must be at most {most:g}, the limit in a row", "s")
            return self._play_prepared(prepared, wanted, ended)

    def _play_prepared(
        self, prepared: PreparedSequence, wanted: float, ended: Callable[[], bool]
    ) -> Playback:
        """Play a sequence of the link for the time `wanted` [s], after a rest."""
        self._rest_now()
        left = self._seconds_left()
        if left < wanted < math.inf:
            raise LimitError(f"the sequence takes {wanted:g} s, and the limit leaves {left:.3g} s")
        with self._lock:
            self._raise_failure()
            self._start_timer(left)
        try:
            playback = self.link.play_prepared(prepared, ended)
            if playback.seconds < wanted - _GRACE and time.monotonic() >= self._on_until:
                self.require_on()
            return playback
        finally:
            self.off()

    def _start_timer(self, left: float) -> None:
        """Have the outputs switched off when they were on for as long as they may be, `left` [s] in all."""
        if self._on_since is None:
            self._on_since = time.monotonic()
            most = min(left, self.limits.seconds_in_a_row)
            self._on_until = self._on_since + most
            self._timer = threading.Timer(most, functools.partial(self._time_is_up, self._on_since))
            self._timer.daemon = True
            self._timer.start()

    def quantised(self, drive: torch.Tensor) -> torch.Tensor:
        """Return the device's nearest drives to drives (..., M), both in the scale of `play`."""
        return self._scale.quantised(drive)

    def reading(self, sensor: Sensor, points: int) -> torch.Tensor:
        """Return the reading (P,) [Pa] of a sensor while the outputs are on.

        `LimitError` if they go off meanwhile, which interrupts the reading; `SensorError` if the sensor has
        no trustworthy reading; `ValueError` for no sensor, or for other than P >= 1 finite magnitudes.
        """
        require_kind("sensor", sensor, Sensor)
        points = integer_at_least("points", points, 1)
        self.require_on()
        try:
            reading = checked_reading(sensor, points, self._on_until - time.monotonic() + _GRACE)
        except SensorError:
            if time.monotonic() >= self._on_until:
                self.off()
            self.require_on()
            raise
        self.require_on()
        return reading

    def measure(self, drive: torch.Tensor, sensor: AnySensor, points: int, readings: int = 1) -> torch.Tensor:
        """Play a drive (M,), |q| <= 1, and return readings (R, P) [Pa] of it.

        A `PulsedSensor` gets a pulse for each reading, after the rest of the duty cycle, and the outputs are
        off afterwards; with another sensor the drive plays on. Errors are those of `play` and `reading`.
        """
        require_sensor(sensor)
        points, readings = integer_at_least("points", points, 1), readings_count("readings", readings)
        if isinstance(sensor, PulsedSensor):
            return torch.stack([self._read_pulse(drive, sensor, points) for _ in range(readings)])
        self.play(drive)
        return torch.stack([self.reading(sensor, points) for _ in range(readings)])

    def _read_pulse(self, drive: torch.Tensor, sensor: PulsedSensor, points: int) -> torch.Tensor:
        """Return the reading (P,) [Pa] of a pulse; `LimitError` if the outputs go off before its end."""
        is_over = False

        def end() -> None:
            nonlocal is_over
            self.require_on()
            self.off()
            is_over = True

        self._scale.asked(drive)  # an invalid one must not wait
        self.off()
        self._rest_now()
        self._seconds_left()
        try:
            reading = checked_reading(Pulse(sensor, partial(self.play, drive), end), points)
            if not is_over:  # the sensor leaves it to the link
                end()
            return reading
        finally:
            self.off()

    def require_on(self) -> None:
        """Raise `LimitError` if the outputs went off since `play`, and the readings meanwhile are void."""
        with self._lock:  # against the timer, which may be switching off
            self._raise_failure()
            if self._on_since is None:
                self._seconds_left()
                most = f"{self.limits.seconds_in_a_row:g} s in a row"
                raise LimitError(f"playing and reading took longer than the outputs may stay on, {most}")

    def off(self) -> None:
        """Switch all outputs off, and begin the rest of the duty cycle."""
        with self._lock:
            if self._on_since is None:
                self.link.end_sequence()  # one that is prepared, or rests before it
                return
            if self._timer is not None:
                self._timer.cancel()
            self.link.off()
            stretch = self._stretch()
            self._seconds_before += stretch
            self._rested_at = time.monotonic() + self._rest(stretch)
            self._on_since = None

    def _rest_now(self) -> None:
        time.sleep(max(0.0, self._rested_at - time.monotonic()))

    def _rest(self, stretch: float) -> float:
        return stretch * (1 / self.limits.duty_cycle - 1)

    def _stretch(self) -> float:
        since = self._on_since
        return 0.0 if since is None else time.monotonic() - since

    def _seconds_left(self) -> float:
        left = self.limits.seconds - self.seconds_on
        if left <= 0:
            self.off()
            raise LimitError(f"the outputs were on for {self.limits.seconds:g} s, the limit")
        return left

    def _time_is_up(self, since: float) -> None:
        with self._lock:
            if self._on_since != since:  # switched off meanwhile, and perhaps on again
                return
            try:
                self.off()
            except Exception as error:  # raised in the main thread, after its reading
                self._failure = error
                logger.error("the time is up, but: %s", error)
            else:
                logger.warning("the time is up: the outputs are off, and this reading is void")

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise self._failure


def readings_count(name: str, value: object) -> int:
    """Return a number of readings after checking it, 1 to 10,000."""
    return int(number_between(name, integer_at_least(name, value, 1), 1, _MOST_READINGS))
