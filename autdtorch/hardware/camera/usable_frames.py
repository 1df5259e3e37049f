"""The frames of a camera that a reading can use."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from autdtorch.hardware.camera.frames import Degrees, Frame
from autdtorch.hardware.sensors.sensor import SensorError
from autdtorch.utils.text import counted

_CLOCKS = 0.5  # largest difference between a frame's time and the clock [s]
_USUAL = (-40.0, 200.0)  # of a screen's frames [degrees C]
_FLASH = 0.3  # smallest jump of a whole image that is a flash, or a shutter [K]
_MOST_FLASHES = 0.25  # share of the frames


def of_reading(frames: Sequence[Frame], began: float, now: float) -> list[Frame]:
    """Return the frames of the times in which they arrived: late ones of before are dropped."""
    recent = [frame for frame in frames if frame.time > began - _CLOCKS]
    off = max((frame.time - now for frame in recent), default=0.0)
    if frames and not recent:
        off = began - max(frame.time for frame in frames)
    if off > _CLOCKS:
        accepted = "their clock differs from this machine's, or has jumped"
        raise SensorError(f"frames are {off:.3g} s outside the time they arrived in: {accepted}")
    return recent


def frames_between(frames: Sequence[Frame], start: float, end: float) -> list[Frame]:
    """Return the frames after a start up to an end [s]."""
    return [frame for frame in frames if start < frame.time <= end]


def usable_frames(frames: Sequence[Frame], doubts: list[str]) -> list[Frame]:
    """Return the frames that differ, show something and do not flash, by time; say what is left out."""
    ordered = sorted(frames, key=lambda frame: frame.time)
    fresh = ordered[:1]
    fresh += [frame for before, frame in itertools.pairwise(ordered) if not _repeats(before, frame)]
    shown = [frame for frame in fresh if _shows(frame.image)]
    for count, what in ((len(ordered) - len(fresh), "repeated"), (len(fresh) - len(shown), "empty")):
        if count:
            doubts.append(f"{counted(count, 'frame')} {what}")
    if not shown:
        return []
    sizes = {frame.image.shape for frame in shown}
    if len(sizes) > 1:
        raise SensorError(f"images of shapes {sorted(sizes)} in one reading; must be of one shape")
    medians = np.array([np.nanmedian(frame.image[::2, ::2]) for frame in shown])
    middle = float(np.median(medians))
    if not _USUAL[0] <= middle <= _USUAL[1]:
        accepted = (
            f"must be {_USUAL[0]:g} to {_USUAL[1]:g} degrees C; check scale and zero (of integers alone)"
        )
        raise SensorError(f"the frames show {middle:.4g}: {accepted}")
    flashes = _flashes(medians)
    if flashes.mean() > _MOST_FLASHES:
        raise SensorError(
            f"{flashes.sum()} of {len(shown)} frames jump as a whole; does a shutter or a light come in?"
        )
    if flashes.any():
        doubts.append(f"{counted(int(flashes.sum()), 'frame')} with a flash or a shutter")
    return [frame for frame, flash in zip(shown, flashes, strict=True) if not flash]


def _repeats(before: Frame, frame: Frame) -> bool:
    return frame.time == before.time or np.array_equal(frame.image, before.image, equal_nan=True)


def _shows(image: Degrees) -> bool:
    """Return true if an image has at least two different numbers."""
    finite = image[np.isfinite(image)]
    return bool(finite.size) and bool(finite.max() > finite.min())


def _flashes(medians: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which of the frames' medians (T,) are off those of their neighbours."""
    padded = np.pad(medians, 2, mode="reflect") if len(medians) > 2 else np.pad(medians, 2, mode="edge")
    usual = np.median(np.lib.stride_tricks.sliding_window_view(padded, 5), axis=1)
    return np.asarray(np.abs(medians - usual) > _FLASH)


def reason_for(frames: Sequence[Frame], usable: Sequence[Frame]) -> str:
    """Return why few frames are usable."""
    if not frames:
        return "no frame came; is the camera on, and does its program write?"
    if len(usable) < len(frames) / 2:
        return "most repeat each other or are empty; is the camera frozen or covered?"
    return "they come too seldom or too late; raise the camera's rate, or pulse and before"
