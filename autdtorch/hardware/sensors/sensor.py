"""What hears the control points: what every sensor does, and those that people and other programs are."""

from __future__ import annotations

import os
import select
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol, runtime_checkable

import torch

from autdtorch.objectives.simulated import validate_magnitudes
from autdtorch.utils.validation import (
    ArrayLike,
    integer_at_least,
    invalid,
    not_negative,
    path_of,
    points_tensor,
    positive,
    require_callable,
    require_kind,
)

_POLL = 0.02  # [s] between looks at a file
_HEARD_AFTER = 0.2  # [s], at most, is a signal heard


class SensorError(OSError):
    """A sensor gives no reading that could be trusted."""


@runtime_checkable
class Sensor(Protocol):
    """Reads the pressure at the control points while a drive is played."""

    def read(self) -> torch.Tensor:
        """Magnitudes (P,) [Pa] at the control points, once the field stands."""
        ...


def typed(question: str) -> str:
    """What somebody types to a question.

    At a terminal `input` alone misses a signal that comes just before it begins to wait, until the answer.

    Raises:
        EOFError: the input has ended.
    """
    if not sys.stdin.isatty() or os.name != "posix":
        return input(question)
    print(question, end="", flush=True)
    while not select.select([sys.stdin], [], [], _HEARD_AFTER)[0]:
        pass
    return input()


def checked_reading(sensor: Sensor, points: int) -> torch.Tensor:
    """What a sensor reads (P,) [Pa], float64.

    Raises:
        ValueError: not P finite magnitudes.
    """
    return validate_magnitudes("pressure of the sensor", sensor.read(), points)


class ManualSensor:
    """Somebody who reads an instrument and types what it shows, point by point."""

    def __init__(self, control_points: ArrayLike, ask: Callable[[str], str] = typed) -> None:
        """Say where to measure.

        Args:
            control_points: (P, 3) [m].
            ask: shows a question and gives the answer.

        Raises:
            ValueError: other control points, or `ask` is no function.
        """
        require_callable("ask", ask)
        self._points = points_tensor("control_points", control_points)
        self._ask = ask

    def read(self) -> torch.Tensor:
        """Magnitudes (P,) [Pa]; asks again for a point until the answer is a number >= 0.

        Raises:
            SensorError: nobody answers any more.
        """
        places = (_place(number, self._points) for number in range(len(self._points)))
        return torch.tensor(
            [self._answer(f"Pressure at {place} [Pa]: ") for place in places],
            dtype=torch.float64,
            device="cpu",
        )

    def _answer(self, question: str) -> float:
        hint = ""
        while True:
            text = _asked(self._ask, hint + question)
            try:
                return not_negative("pressure", float(text), "Pa")
            except ValueError:
                hint = f"{text!r}: must be a number >= 0 with a decimal point, as 1.5\n"


class MovedMicrophone:
    """One microphone that somebody moves from control point to control point.

    The drive plays on all the while.
    """

    def __init__(self, sensor: Sensor, control_points: ArrayLike, ask: Callable[[str], str] = typed) -> None:
        """Say where to measure.

        Args:
            sensor: reads one point, where the microphone is.
            control_points: (P, 3) [m].
            ask: shows where the microphone must go, and returns once it is there.

        Raises:
            ValueError: no sensor, other control points, or `ask` is no function.
        """
        require_kind("sensor", sensor, Sensor)
        require_callable("ask", ask)
        self._sensor = sensor
        self._points = points_tensor("control_points", control_points)
        self._ask = ask

    def read(self) -> torch.Tensor:
        """Magnitudes (P,) [Pa].

        Raises:
            SensorError: nobody answers any more, or the sensor has no reading.
            ValueError: the sensor reads another number of points than one.
        """
        readings = []
        for number in range(len(self._points)):
            _asked(self._ask, f"Move the microphone to {_place(number, self._points)}, then press Enter. ")
            readings.append(checked_reading(self._sensor, 1))
        return torch.cat(readings)


class FileSensor:
    """A file into which another program writes each reading.

    It holds the magnitudes of all control points [Pa] in their order, between them blanks, commas or line
    ends, and a line end after the last. It is best written under another name and then renamed.
    """

    def __init__(self, path: str | Path, points: int, settle: float = 0.0, timeout: float = 60.0) -> None:
        """Say where to look.

        Args:
            path: of the file, which need not be there yet.
            points: number of control points P.
            settle: how long after a drive began the other program may still write of the one before [s].
            timeout: how long to wait then for the file to change [s].

        Raises:
            ValueError: an argument out of range.
        """
        self._path = path_of("path", path)
        self._points = integer_at_least("points", points, 1)
        self._settle = not_negative("settle", settle, "s")
        self._timeout = positive("timeout", timeout, "s")

    def read(self) -> torch.Tensor:
        """Magnitudes (P,) [Pa], once the file has changed.

        Raises:
            SensorError: it does not change in time, or what it then holds are not P numbers >= 0.
        """
        time.sleep(self._settle)
        before, deadline = self._stamp(), time.monotonic() + self._timeout
        trouble = "did not change"
        while time.monotonic() < deadline:
            time.sleep(_POLL)
            if self._stamp() == before:
                continue
            try:
                return self._pressure()
            except (OSError, ValueError) as error:  # it may not be written to its end
                trouble = f"holds no reading: {error}"
        raise SensorError(f"{self._path} {trouble}, within {self._timeout:g} s")

    def _stamp(self) -> tuple[int, int, int] | None:
        try:
            found = self._path.stat()
        except FileNotFoundError:
            return None
        return found.st_mtime_ns, found.st_size, found.st_ino

    def _pressure(self) -> torch.Tensor:
        text = self._path.read_text(encoding="utf-8")
        if not text.endswith("\n"):
            raise ValueError("no line end after the last number")
        numbers = [not_negative("pressure", float(word), "Pa") for word in text.replace(",", " ").split()]
        if len(numbers) != self._points:
            raise invalid("pressure", numbers, f"must be {self._points} numbers", "Pa")
        return torch.tensor(numbers, dtype=torch.float64, device="cpu")


def _asked(ask: Callable[[str], str], question: str) -> str:
    try:
        return ask(question)
    except EOFError as error:
        raise SensorError("nobody answers: the input has ended") from error


def _place(number: int, points: torch.Tensor) -> str:
    x, y, z = (1e3 * points[number]).tolist()
    return f"control point {number + 1} of {len(points)} at ({x:.1f}, {y:.1f}, {z:.1f}) mm"
