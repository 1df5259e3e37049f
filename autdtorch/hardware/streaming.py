"""Frames of a sequence that are sent at a steady rate, by the clock of the computer."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from autdtorch.hardware.transport.port import HeldSequence, LinkError
from autdtorch.scene.sequence import Sequence
from autdtorch.utils.array_types import Bytes
from autdtorch.utils.validation import invalid, positive, require_kind

#: Delay from which a frame counts as late [s].
LATE = 1e-3

_AHEAD = 0.5e-3  # frames due within this time are sent together [s]: a transfer takes as long as many frames
_MOST_TOGETHER = 28  # as many messages as the buffer of an OpenMPD holds
_LONGEST_DELAY = 1.0  # [s]; the computer has slept, or the device does not take the rate
_MOST_FRAMES = 2.0**53  # up to here floats count one by one
_ROUNDING = 1e-9  # relative error of a time that is a whole number of frames
_NAP = 20e-3  # longest time until the end of a sequence is seen [s]


@dataclass(frozen=True)
class Playback:
    """The times at which a sequence was played.

    Attributes:
        frames: number of frames that played, counted again in each lap.
        seconds: time that they took [s].
        late: number of frames that were sent more than 1 ms after they were due; None where the device plays
            by its own clock.
        latest: longest delay of a frame [s]; None likewise.
    """

    frames: int
    seconds: float
    late: int | None = None
    latest: float | None = None

    def __str__(self) -> str:
        """Return a line such as "9000 frames in 1.000 s, 0 late (the latest by 0.12 ms)"."""
        played = f"{self.frames} frames in {self.seconds:.3f} s"
        if self.latest is None:
            return f"{played}, by the clock of the device"
        return f"{played}, {self.late} late (the latest by {1e3 * self.latest:.2f} ms)"


@dataclass(frozen=True)
class PreparedSequence:
    """A sequence in the bytes of a device.

    Attributes:
        content: frames (T, C, B) to stream, for C chips with B bytes each, or what the device holds.
        rate: frames per second [Hz].
        count: number of frames to play, counted again in each lap; may be infinite.
    """

    content: Bytes | HeldSequence
    rate: float
    count: float


def require_sequence(sequence: Sequence, transducers: int) -> None:
    """Refuse what is no sequence for so many transducers."""
    require_kind("sequence", sequence, Sequence)
    if sequence.transducers != transducers:
        accepted = f"must be {transducers}, as many as the link has"
        raise ValueError(f"sequence: {sequence.transducers} transducers; {accepted}")


def frames_within(sequence: Sequence, seconds: float | None) -> float:
    """Return the number of whole frames within some `seconds`; infinite for a loop without end.

    `ValueError` unless `seconds` are at least one frame, and within a sequence that does not loop.
    """
    if seconds is None:
        return math.inf if sequence.loop else len(sequence)
    count = math.floor(min(positive("seconds", seconds, "s") * sequence.rate * (1 + _ROUNDING), _MOST_FRAMES))
    if count == 0:
        raise invalid("seconds", seconds, f"must be at least {1 / sequence.rate:g}, one frame", "s")
    if count > len(sequence) and not sequence.loop:
        accepted = f"must be at most {sequence.duration:g}, the duration of a sequence that does not loop"
        raise invalid("seconds", seconds, accepted, "s")
    return count


def outlast(rate: float, count: float, ended: Callable[[], bool]) -> Playback:
    """Wait while a device plays a number of frames by its own clock, at a rate [Hz], or until the end."""
    start = time.perf_counter()
    wait_until(start + count / rate, ended)
    seconds = time.perf_counter() - start
    return Playback(int(min(count, rate * seconds)), seconds)


def stream(
    send: Callable[[bytes], bool],
    frames: Bytes,
    rate: float,
    count: float,
    ended: Callable[[], bool],
    wire_time: float = 0.0,
) -> Playback:
    """Send the frames again and again, each when it is due, and wait for the end of the last.

    Due times are counted from the beginning, so that delays do not add up. Late frames are sent at once and
    in order; none is left out. A frame may come half a millisecond early, with the frame before.

    Args:
        send: takes the bytes of some frames, chip by chip; returns false if the sequence has ended.
        frames: (T, C, B) for C chips with B bytes each.
        rate: frames per second [Hz].
        count: number of frames in all; may be infinite.
        ended: returns whether the sequence was ended meanwhile.
        wire_time: time that a frame takes on the line [s].

    Raises:
        LinkError: a frame is more than a second late.
    """
    sent, late, latest = 0, 0, 0.0
    start = time.perf_counter()
    while sent < count and wait_until(start + sent / rate, ended):
        place = sent % len(frames)
        together = int((time.perf_counter() - start + _AHEAD) * rate) + 1 - sent
        together = int(min(max(together, 1), _MOST_TOGETHER, len(frames) - place, count - sent))
        if not send(frames[place : place + together].swapaxes(0, 1).tobytes()):
            break
        delay = time.perf_counter() - start - sent / rate - wire_time
        if delay > _LONGEST_DELAY:
            raise LinkError(f"frame {sent} was {delay:.3g} s late; must be sent at {rate:g} frames/s")
        late += min(together, max(0, math.ceil((delay - LATE) * rate)))
        latest = max(latest, delay)
        sent += together
    wait_until(start + sent / rate, ended)
    return Playback(sent, time.perf_counter() - start, late, latest)


def wait_until(moment: float, ended: Callable[[], bool]) -> bool:
    """Wait until a `moment` of `time.perf_counter` [s]; return false if the sequence ends before."""
    while not ended():
        left = moment - time.perf_counter()
        if left <= 0:
            return True
        time.sleep(min(left, _NAP))  # not for an event: a signal amid its methods may leave it locked
    return False
