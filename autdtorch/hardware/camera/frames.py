"""Frames of a thermal camera, from a folder that another program fills, a function, or a UVC camera."""

from __future__ import annotations

import contextlib
import logging
import re
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from autdtorch.hardware.sensors.sensor import SensorError
from autdtorch.utils.files import path_of
from autdtorch.utils.validation import (
    boolean,
    finite_number,
    gappy_tensor,
    integer_at_least,
    invalid,
    number_between,
    positive,
    require_callable,
)

logger = logging.getLogger(__name__)

Degrees: TypeAlias = NDArray[np.float64]

_POLL = 0.01  # [s] between looks at a folder
_PATIENCE = 0.25  # [s] for a file to become complete
_MOST_PIXELS = 2**24
_MOST_VALUES = 2**28  # of the frames of a function in a reading: 2 GiB
_RATES = (0.1, 10_000.0)  # [frames/s]
_SUFFIXES = (".csv", ".npy", ".tif", ".tiff")
_STALE = 8  # frames that a driver may hold back from before a pulse


@dataclass(frozen=True, eq=False)
class Frame:
    """An image of a thermal camera.

    Attributes:
        time: moment of the exposure [s], on the clock of its source.
        image: (H, W) [degrees C], NaN where a pixel is saturated.

    `ValueError` for other shapes or kinds.
    """

    time: float
    image: Degrees

    def __post_init__(self) -> None:
        object.__setattr__(self, "time", finite_number("time", self.time, "s"))
        image = gappy_tensor("image", self.image, "degrees C").detach().cpu().numpy()
        if image.ndim != 2 or image.size == 0:
            raise ValueError(f"image: shape {image.shape}; must be (H, W)")
        object.__setattr__(self, "image", image)


@runtime_checkable
class FrameSource(Protocol):
    """A source of frames."""

    def clock(self) -> float:
        """Return the time now [s], on the clock of the frames."""

    def begin(self) -> None:
        """Drop the frames that have arrived so far."""

    def wait(self, seconds: float) -> None:
        """Let frames arrive for seconds [s], no longer: the sound may be on."""

    def frames(self) -> list[Frame]:
        """Return the frames that arrived since this was called before.

        `SensorError` if the camera is gone.
        """


class FolderFrames:
    """A folder into which another program writes a file for each frame.

    A file is degrees C as CSV, 16-bit TIFF, or NPY. Write it under another name, such as one that begins with
    a dot, and rename it; an incomplete file is tried again for 0.25 s, and then left out with a warning. The
    largest value of integers is a saturated pixel.
    """

    def __init__(
        self,
        folder: str | Path,
        scale: float = 1.0,
        zero: float = 0.0,
        rate: float | None = None,
        delete: bool = False,
        clock: Callable[[], float] = time.time,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Set the folder.

        Args:
            folder: where the files appear.
            scale: degrees C are `scale` times a file's integers, plus `zero`: 0.01 and -273.15 for
                hundredths of a kelvin. Files of decimal numbers are degrees C.
            zero: temperature of the integer 0 [degrees C].
            rate: of the frames [1/s], if the last number in a file's name counts them: files then tell the
                order and the gaps, and the first one the time. By default a file's time of change is the
                frame's.
            delete: true to delete files that have been read: thousands slow a folder down.
            clock: returns the time [s] that the files bear.
            sleep: waits for a number of seconds.

        `ValueError` for an argument out of range, `SensorError` if there is no such folder.
        """
        self._folder = path_of("folder", folder, "a folder")
        self._scale = positive("scale", scale, "K")
        self._zero = finite_number("zero", zero, "degrees C")
        self._rate = None if rate is None else number_between("rate", rate, *_RATES, "1/s")
        self._delete = boolean("delete", delete)
        for name, function in (("clock", clock), ("sleep", sleep)):
            require_callable(name, function)
        self.clock, self._sleep = clock, sleep
        self._seen = set(self._names())
        self._incomplete: dict[str, float] = {}  # when each was first tried
        self._first: tuple[int, float] | None = None  # number and time, for the rate
        self._shape: tuple[int, ...] | None = None

    def begin(self) -> None:
        """Drop the files that are there."""
        names = self._names()
        if self._delete:
            for name in names:
                (self._folder / name).unlink(missing_ok=True)
            names = []
        self._seen, self._incomplete, self._first = set(names), {}, None

    def wait(self, seconds: float) -> None:
        """Wait for seconds [s]; files are read later, as that may take longer."""
        self._sleep(seconds)

    def frames(self) -> list[Frame]:
        """Return the frames of files that appeared since the call before, once they are complete."""
        frames = self._new_frames()
        while self._incomplete:
            self._sleep(_POLL)
            frames += self._new_frames()
        return frames

    def _names(self) -> list[str]:
        """Return the names of frames in the order of the numbers in them."""
        try:
            names = [path.name for path in self._folder.iterdir() if path.suffix.lower() in _SUFFIXES]
        except OSError as error:
            accepted = "must be the folder into which the camera's program writes"
            raise SensorError(f"{self._folder}: {error.strerror or error}; {accepted}") from error
        visible = (name for name in names if not name.startswith("."))
        return sorted(visible, key=lambda name: ([*map(int, re.findall(r"\d+", name))], name))

    def _new_frames(self) -> list[Frame]:
        frames = []
        names = self._names()
        self._incomplete = {name: time for name, time in self._incomplete.items() if name in names}
        for name in names:
            if name not in self._seen and (frame := self._tried(name)) is not None:
                frames.append(frame)
                self._done(name)
                if self._delete:
                    (self._folder / name).unlink(missing_ok=True)
                    self._seen.discard(name)
        return frames

    def _done(self, name: str) -> None:
        self._seen.add(name)
        self._incomplete.pop(name, None)

    def _tried(self, name: str) -> Frame | None:
        """Return the frame of a file; None if it is not complete yet, or never will be."""
        path = self._folder / name
        waited = self.clock() - self._incomplete.setdefault(name, self.clock())
        try:
            changed = path.stat().st_mtime
            image = _read_image(path, self._scale, self._zero)
        except Exception as error:  # Pillow and NumPy raise many kinds for damaged files
            if isinstance(error, PermissionError):
                raise SensorError(f"{path}: may not be read; give this program the right to") from error
            if waited > _PATIENCE:
                logger.warning("%s: no whole frame, and is left out: %s", path, error)
                self._done(name)
            return None
        if self._shape not in (None, image.shape) and waited <= _PATIENCE:  # half of its lines
            return None
        self._shape = image.shape
        return Frame(self._time(name, changed), image)

    def _time(self, name: str, changed: float) -> float:
        if self._rate is None:
            return changed
        numbers = re.findall(r"\d+", Path(name).stem)
        if not numbers:
            raise SensorError(f"{name}: no number; with a rate the names must count the frames")
        number = int(numbers[-1])
        if self._first is None:
            self._first = number, changed
        return self._first[1] + (number - self._first[0]) / self._rate


def _read_image(path: Path, scale: float, zero: float) -> Degrees:
    if path.suffix.lower() == ".csv":
        return _matrix(_read_csv(path))
    if path.suffix.lower() == ".npy":
        values = np.load(path, allow_pickle=False)
    else:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as opened:
            values = np.asarray(opened)
    return _matrix(values, scale, zero)


def _matrix(values: ArrayLike, scale: float = 1.0, zero: float = 0.0) -> Degrees:
    """Return values (H, W) in degrees C; integers by scale and zero; NaN for their largest, and infinite."""
    array = np.asarray(values)
    if array.ndim != 2 or not 0 < array.size <= _MOST_PIXELS or array.dtype.kind not in "iuf":
        raise ValueError(f"shape {array.shape} of {array.dtype}; must be an image of one number a pixel")
    if array.dtype.kind == "f":
        return np.where(np.isfinite(array), array, np.nan).astype(np.float64)
    degrees = scale * array.astype(np.float64) + zero
    largest = min(int(np.iinfo(array.dtype).max), 2**16 - 1)  # Pillow widens to 32 bits
    degrees[array >= largest] = np.nan
    return degrees


def _read_csv(path: Path) -> list[list[float]]:
    """Return rows of degrees between commas, or between semicolons with decimal commas or points."""
    text = path.read_text(encoding="utf-8-sig")
    if not text.endswith("\n"):
        raise ValueError("no line end after the last number")
    if ";" in text:
        text = text.replace(",", ".").replace(";", ",")
    rows = [[float(cell) for cell in line.rstrip(",").split(",")] for line in text.splitlines() if line]
    if len({len(row) for row in rows}) != 1:
        raise ValueError("lines of different lengths")
    return rows


class CallableFrames:
    """A function that waits for the next frame of a camera and returns its image."""

    def __init__(
        self,
        take: Callable[[], ArrayLike | None],
        clock: Callable[[], float] = time.monotonic,
        scale: float = 1.0,
        zero: float = 0.0,
        stale: int = 0,
    ) -> None:
        """Set the function.

        Args:
            take: returns an image (H, W), or None where none came in time. Any error it raises ends the
                trial.
            clock: returns the time [s]; each frame gets the time of its return.
            scale: degrees C are `scale` times integers, plus `zero`; decimal numbers are degrees C.
            zero: temperature of the integer 0 [degrees C].
            stale: frames that a driver may hold from before a pulse, and that are dropped as it begins.

        `ValueError` for an argument out of range.
        """
        for name, function in (("take", take), ("clock", clock)):
            require_callable(name, function)
        self._take, self.clock = take, clock
        self._scale = positive("scale", scale, "K")
        self._zero = finite_number("zero", zero, "degrees C")
        self._stale = integer_at_least("stale", stale, 0)
        self._frames: list[Frame] = []

    def begin(self) -> None:
        """Drop the frames that the driver holds."""
        self._frames = []
        for _ in range(self._stale):
            self._image()

    def wait(self, seconds: float) -> None:
        """Take the frames of the next seconds [s]."""
        end = self.clock() + seconds
        while self.clock() < end - 1e-9:
            image = self._image()
            if image is not None:
                self._frames.append(Frame(self.clock(), image))
                if len(self._frames) * image.size > _MOST_VALUES:
                    accepted = "must wait for the next frame; else lower the rate, or before and after"
                    raise SensorError(f"take: {len(self._frames)} frames in a reading; {accepted}")

    def frames(self) -> list[Frame]:
        """Return the frames that were taken since the call before."""
        frames, self._frames = self._frames, []
        return frames

    def _image(self) -> Degrees | None:
        try:
            image = self._take()
            return None if image is None else _matrix(image, self._scale, self._zero)
        except Exception as error:
            raise SensorError(f"no frame of the camera: {error}") from error


@contextlib.contextmanager
def uvc_frames(number: int = 0, scale: float = 0.01, zero: float = -273.15) -> Iterator[CallableFrames]:
    """Open a UVC camera whose frames are 16-bit integers (Y16), such as a FLIR Lepton on a PureThermal.

    Args:
        number: of the camera among those of the system, from 0.
        scale: degrees C are `scale` times an integer, plus `zero`; by default hundredths of a kelvin.
        zero: temperature of the integer 0 [degrees C].

    `ImportError` without the extra ``camera``, `SensorError` if there is no such camera.
    """
    number = integer_at_least("number", number, 0)
    camera = _opened(number)
    try:
        yield CallableFrames(lambda: _y16(camera), scale=scale, zero=zero, stale=_STALE)
    finally:
        camera.release()


def _opened(number: int) -> Any:
    try:
        import cv2
    except ImportError as error:
        raise ImportError('no package cv2; install it by pip install "autdtorch[camera]"') from error
    camera = cv2.VideoCapture(number)
    camera.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter_fourcc(*"Y16 "))
    camera.set(cv2.CAP_PROP_CONVERT_RGB, 0)
    if not camera.isOpened():
        camera.release()
        raise SensorError(f"camera {number} cannot be opened; it is unplugged, or another program has it")
    return camera


def _y16(camera: Any) -> NDArray[Any]:
    is_there, image = camera.read()
    if not is_there:
        raise SensorError("it is unplugged, or another program has it")
    array = np.asarray(image).squeeze()
    if array.dtype != np.uint16:
        raise invalid("camera", array.dtype, "must give 16-bit integers, Y16")
    return array
