"""Sensors with a person in the loop: readings that are typed, and a microphone that is moved."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import torch

from autdtorch.hardware.sensors.sensor import Sensor, SensorConfig, SensorError, Setup, checked_reading
from autdtorch.utils.array_types import REAL
from autdtorch.utils.progress import is_terminal
from autdtorch.utils.validation import ArrayLike, not_negative, points_tensor, require_callable, require_kind

_SIGNAL_PERIOD = 0.2  # [s] between looks for a signal


def typed(question: str) -> str:
    """Return the answer that is typed to a question; `EOFError` if the input has ended or there is none.

    At a terminal, `input` alone misses a signal that comes just before it begins to wait, until the answer.
    """
    if not is_terminal(sys.stdin) or os.name != "posix":
        try:
            return input(question)
        except (RuntimeError, ValueError) as error:  # a program without a console, a closed input
            raise EOFError(str(error)) from error
    print(question, end="", flush=True)
    while not select.select([sys.stdin], [], [], _SIGNAL_PERIOD)[0]:
        pass
    return input()


class ManualSensor:
    """A person who reads an instrument and types its values, point by point."""

    def __init__(self, control_points: ArrayLike, ask: Callable[[str], str] = typed) -> None:
        """Set the control points (P, 3) [m], and the function that shows a question and returns the answer.

        `ValueError` for other control points, or if `ask` is no function.
        """
        require_callable("ask", ask)
        self._points = points_tensor("control_points", control_points)
        self._ask = ask

    def read(self) -> torch.Tensor:
        """Return magnitudes (P,) [Pa]; asks again for a point until the answer is a number >= 0.

        `SensorError` if the input has ended.
        """
        places = (_place(number, self._points) for number in range(len(self._points)))
        readings = [self._answer(f"Pressure at {place} [Pa]: ") for place in places]
        return torch.tensor(readings, **REAL)

    def _answer(self, question: str) -> float:
        hint = ""
        while True:
            text = _asked(self._ask, hint + question)
            try:
                return not_negative("pressure", float(text), "Pa")
            except ValueError:
                hint = f"{text!r}: must be a number >= 0 with a decimal point, as 1.5\n"


class MovedMicrophone:
    """A sensor with one microphone that a person moves between control points while the drive plays."""

    def __init__(self, sensor: Sensor, control_points: ArrayLike, ask: Callable[[str], str] = typed) -> None:
        """Set a sensor of one point, the control points (P, 3) [m], and a function.

        `ask` shows the next place of the microphone, and returns once it is there. `ValueError` for no
        sensor, other control points, or if `ask` is no function.
        """
        require_kind("sensor", sensor, Sensor)
        require_callable("ask", ask)
        self._sensor, self._ask = sensor, ask
        self._points = points_tensor("control_points", control_points)

    def read(self) -> torch.Tensor:
        """Return magnitudes (P,) [Pa].

        `SensorError` if the input has ended, `ValueError` if the sensor reads more than one point.
        """
        readings = []
        for number in range(len(self._points)):
            _asked(self._ask, f"Move the microphone to {_place(number, self._points)}, then press Enter. ")
            readings.append(checked_reading(self._sensor, 1))
        return torch.cat(readings)


def _asked(ask: Callable[[str], str], question: str) -> str:
    try:
        return ask(question)
    except EOFError as error:
        raise SensorError("nobody answers: the input has ended") from error


def _place(number: int, points: torch.Tensor) -> str:
    x, y, z = (1e3 * points[number]).tolist()
    return f"control point {number + 1} of {len(points)} at ({x:.1f}, {y:.1f}, {z:.1f}) mm"


@dataclass(frozen=True)
class ManualConfig(SensorConfig):
    """The config of a `ManualSensor`."""

    @property
    def by_hand(self) -> bool:
        """True: a person types every reading."""
        return True

    def open(self, setup: Setup) -> AbstractContextManager[Sensor]:
        """Return a context with the sensor."""
        return nullcontext(ManualSensor(setup.control_points, setup.ask))
