"""A thermal camera as a sensor: it sees what a pulse of sound heats, a whole plane in each reading.

Frames that repeat, are empty or flash are left out.
"""

from __future__ import annotations

import itertools
import logging
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from autdtorch.hardware.camera.frames import Degrees, Frame, FrameSource
from autdtorch.hardware.camera.heat import HeatInversion
from autdtorch.hardware.camera.picture import Picture, clarity, plane_coordinates
from autdtorch.hardware.camera.registration import Registration
from autdtorch.hardware.camera.screen import Screen
from autdtorch.hardware.sensors.sensor import SensorError
from autdtorch.objectives.readings import deviation_by_square, deviation_of_square
from autdtorch.scene.geometry import Plane
from autdtorch.utils.text import counted
from autdtorch.utils.validation import (
    ArrayLike,
    finite_number,
    number_between,
    points_tensor,
    positive,
    real_tensor,
    require_kind,
    within,
)

logger = logging.getLogger(__name__)

_LONGEST_PULSE = 1.0  # [s]
_LONGEST_WAIT = 60.0  # [s]
_LEAST_BEFORE, _LEAST_DURING = 3, 4  # frames
_LATE = 1.0  # [s] that late frames are waited for
_NEAR = 3e-3  # of a saturated pixel to a point [m]
_CLEAR = 10.0  # clarity of a picture from which on its latency holds for the camera
_MOST_DEAD = 0.3  # share of the pixels

_CLOCKS = 0.5  # largest difference between a frame's time and the clock [s]
_USUAL = (-40.0, 200.0)  # of a screen's frames [degrees C]
_FLASH = 0.3  # smallest jump of a whole image that is a flash, or a shutter [K]
_MOST_FLASHES = 0.25  # share of the frames


class ThermalCamera:
    """A thermal camera that looks at a thin screen in a plane of the field.

    A reading takes frames of the background, of a pulse of sound, and after it. Frames that repeat, flash or
    are black are left out, pixels that never change are dead; every such doubt is logged once, and noted in
    the `picture`, the last `Picture` that was taken. `screen` may be changed between readings.
    """

    def __init__(
        self,
        frames: FrameSource,
        plane: Plane,
        corners: ArrayLike | Registration,
        points: ArrayLike | None = None,
        *,
        screen: Screen | None = None,
        wavelength: float = 8.5e-3,
        spacing: float = 1.5e-3,
        pulse: float = 1.0,
        before: float = 0.4,
        after: float = 1.0,
        blur: float = 0.5,
        saturation: float | None = None,
    ) -> None:
        """Set the camera up; it takes no frame yet.

        Args:
            frames: source of the frames.
            plane: the plane of the screen.
            corners: pixels (4, 2), column and row, of the plane's `corners` [m]; or a `Registration`.
            points: (P, 3) [m] in the plane, where the pressure is read; by default all cells of the picture.
            screen: the screen's properties.
            wavelength: of the sound [m]; by default at 40 kHz in air.
            spacing: edge of a cell of the picture [m]; a sixth of the wavelength shows all there is.
            pulse: time that frames are taken for while the sound is on [s], up to 1.
            before: time that they are taken for before [s], up to 60.
            after: time that they are taken for after [s], up to 60.
            blur: standard deviation of the camera's blur [pixels].
            saturation: temperature from which on a pixel does not count [degrees C]; None where the frames
                have NaN there, as integers at their largest value get.

        `ValueError` for an argument out of range.
        """
        require_kind("frames", frames, FrameSource)
        require_kind("plane", plane, Plane)
        if isinstance(corners, Registration):
            self.registration = corners
        else:
            pixels = real_tensor("corners", corners)
            if pixels.shape != (4, 2):
                raise ValueError(f"corners: shape {tuple(pixels.shape)}; must be (4, 2), as (column, row)")
            with within("corners"):
                self.registration = Registration.of(plane, pixels, plane.corners)
        self._source = frames
        grid = plane.points(spacing)
        self._counts = grid.shape[0], grid.shape[1]
        self._points = grid.reshape(-1, 3) if points is None else points_tensor("points", points)
        self._uv = plane_coordinates(plane, self._points)
        self.screen = Screen() if screen is None else screen
        require_kind("screen", self.screen, Screen)
        self._wavelength = positive("wavelength", wavelength, "m")
        self._pulse = number_between("pulse", positive("pulse", pulse, "s"), 0.0, _LONGEST_PULSE, "s")
        self._before = number_between("before", positive("before", before, "s"), 0.0, _LONGEST_WAIT, "s")
        self._after = number_between("after", after, 0.0, _LONGEST_WAIT, "s")
        self._blur = number_between("blur", blur, 0.0, 100.0, "pixels")
        self._saturation = math.inf if saturation is None else finite_number("saturation", saturation)
        self._heat: HeatInversion | None = None
        self._latency: float | None = None
        self._warmth = _Warmth()
        self._told: set[str] = set()
        self.picture: Picture | None = None
        self._noise = 1.0  # standard deviation of |p|^2 at the points [Pa^2], of the last reading

    def read_pulse(self, on: Callable[[], None], off: Callable[[], None]) -> torch.Tensor:
        """Return magnitudes (P,) [Pa] of a pulse that `on` begins and `off` ends.

        `SensorError` if the frames do not show the pulse.
        """
        source = self._source
        source.begin()
        began = source.clock()
        source.wait(self._before)
        start = source.clock()
        on()
        source.wait(self._pulse)
        end = source.clock()
        off()
        source.wait(self._after)
        frames = source.frames()
        if len(frames_between(frames, start, end)) < _LEAST_DURING:
            source.wait(_LATE)
            frames += source.frames()
        frames = of_reading(frames, began, source.clock())
        doubts: list[str] = []
        usable = usable_frames(frames, doubts)
        self._require_enough(usable, frames, start, end)
        self.picture = self._picture(usable, start, end, doubts)
        pressure, deviation = self.picture.at(self._points)
        self._noise = float(deviation_of_square(pressure, deviation).median())
        return pressure

    def deviation(self, pressure: torch.Tensor) -> torch.Tensor:
        """Return the standard deviations (..., P) [Pa] of readings (..., P) [Pa], as `Readings` has them.

        The squares of pressures have the noise of the last reading, alike at all points.
        """
        pressure = real_tensor("pressure", pressure, "Pa")
        return deviation_by_square(pressure, torch.full_like(pressure, self._noise))

    def _picture(self, frames: list[Frame], start: float, end: float, doubts: list[str]) -> Picture:
        images = np.stack([frame.image for frame in frames])
        times = np.array([frame.time for frame in frames]) - start
        heat = self._inversion(images[0].shape)
        self._leave_out(images, doubts)
        try:
            picture = heat.picture(
                times,
                images,
                end - start,
                latency=self._latency,
                remaining=self._warmth.at(start, self.screen),
            )
        except ValueError as error:
            raise SensorError(f"no picture: {error}") from error
        if not picture.doubts and clarity(picture.pressure, picture.deviation) > _CLEAR:
            self._latency = picture.latency
        self._warmth.add(self.screen.rate * float(picture.pressure.max()) ** 2 * (end - start), end)
        doubts += picture.doubts
        for doubt in doubts:
            kind = re.sub(r"[\d.]+", "", doubt)
            if kind not in self._told:
                logger.warning("camera: %s", doubt)
                self._told.add(kind)
        return replace(picture, doubts=tuple(doubts))

    def _inversion(self, shape: tuple[int, ...]) -> HeatInversion:
        """Return the inversion for images of a shape, which must stay."""
        if self._heat is None or self._heat.screen != self.screen:
            size = shape[0], shape[1]
            counts = self._counts
            self._heat = HeatInversion(
                self.registration, size, counts, self._wavelength, self.screen, self._blur
            )
        if shape != self._heat.shape:
            accepted = f"must be {self._heat.shape} as before; was the camera turned, or set to another size?"
            raise SensorError(f"images of shape {shape}: {accepted}")
        return self._heat

    def _leave_out(self, images: Degrees, doubts: list[str]) -> None:
        """Set dead and saturated pixels to NaN; `SensorError` if most are dead, or a point is saturated."""
        finite = np.isfinite(images)
        dead = np.where(finite, images, -np.inf).max(axis=0) <= np.where(finite, images, np.inf).min(axis=0)
        if dead.mean() > _MOST_DEAD:
            raise SensorError(f"{100 * dead.mean():.0f} % of the pixels never change; is the camera frozen?")
        if dead.any():
            images[:, dead] = np.nan
            doubts.append(f"{counted(int(dead.sum()), 'pixel')} dead")
        images[images >= self._saturation] = np.nan
        hot = ~np.isfinite(images).all(axis=0) & ~dead
        if hot.any():
            rows, columns = np.nonzero(hot)
            places = self.registration.to_plane(np.stack([columns, rows], axis=1).astype(np.float64))
            distance = np.linalg.norm(places[:, None] - self._uv, axis=2).min()
            if distance < _NEAR:
                accepted = "lower the amplitude, shorten the pulse, or widen the camera's range"
                raise SensorError(f"pixels are saturated {1e3 * distance:.1f} mm from a point; {accepted}")
            doubts.append(f"{counted(len(rows), 'pixel')} saturated")

    def _require_enough(
        self, usable: Sequence[Frame], frames: Sequence[Frame], start: float, end: float
    ) -> None:
        before = sum(frame.time <= start for frame in usable)
        during = len(frames_between(usable, start, end))
        if before >= _LEAST_BEFORE and during >= _LEAST_DURING:
            return
        what = f"{counted(before, 'usable frame')} before the pulse and {during} in it, of {len(frames)}"
        reason = reason_for(frames, usable)
        raise SensorError(f"{what}; must be at least {_LEAST_BEFORE} and {_LEAST_DURING}: {reason}")


class _Warmth:
    """The largest rise of temperature that earlier pulses may have left [K]."""

    def __init__(self) -> None:
        self._rise, self._time = 0.0, 0.0

    def at(self, time: float, screen: Screen) -> float:
        self._rise *= math.exp(-max(0.0, time - self._time) / screen.loss_time)
        self._time = time
        return self._rise

    def add(self, rise: float, time: float) -> None:
        self._rise, self._time = self._rise + rise, time


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
    usual = median_filter(medians, 5, mode="mirror" if len(medians) > 2 else "nearest")
    return np.asarray(np.abs(medians - usual) > _FLASH)


def reason_for(frames: Sequence[Frame], usable: Sequence[Frame]) -> str:
    """Return why few frames are usable."""
    if not frames:
        return "no frame came; is the camera on, and does its program write?"
    if len(usable) < len(frames) / 2:
        return "most repeat each other or are empty; is the camera frozen or covered?"
    return "they come too seldom or too late; raise the camera's rate, or pulse and before"
