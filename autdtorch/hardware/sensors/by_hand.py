"""Sensors with a person in the loop: readings that are typed, and a microphone that is moved."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import torch

from autdtorch.hardware.sensors.sensor import (
    PRESSURE,
    InstrumentConfig,
    Quantity,
    Sensor,
    SensorError,
    Setup,
    checked_reading,
    magnitudes_of,
    quantity_of,
)
from autdtorch.utils.array_types import REAL
from autdtorch.utils.progress import is_terminal
from autdtorch.utils.validation import ArrayLike, points_tensor, require_callable, require_kind

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

    def __init__(
        self, control_points: ArrayLike, ask: Callable[[str], str] = typed, quantity: Quantity = PRESSURE
    ) -> None:
        """Set the control points (P, 3) [m], the function that asks, and the quantity of the instrument.

        `ask` shows a question and returns the answer. `ValueError` for other control points, if `ask` is no
        function, or for no quantity.
        """
        require_callable("ask", ask)
        require_kind("quantity", quantity, Quantity)
        self._points = points_tensor("control_points", control_points)
        self._ask, self.quantity = ask, quantity

    def read(self) -> torch.Tensor:
        """Return magnitudes (P,); asks again for a point until the answer is a number >= 0.

        `SensorError` if the input has ended.
        """
        places = (_place(number, self._points) for number in range(len(self._points)))
        name, unit = self.quantity.name.capitalize(), self.quantity.unit
        readings = [self._answer(f"{name} at {place} [{unit}]: ") for place in places]
        return torch.tensor(readings, **REAL)

    def _answer(self, question: str) -> float:
        hint = ""
        while True:
            text = _asked(self._ask, hint + question)
            try:
                return magnitudes_of(self.quantity, self.quantity.name, [float(text)], 1).item()
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
        self._sensor, self._ask, self.quantity = sensor, ask, quantity_of(sensor)
        self._points = points_tensor("control_points", control_points)

    def read(self) -> torch.Tensor:
        """Return magnitudes (P,).

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
class ManualConfig(InstrumentConfig):
    """The config of a `ManualSensor`."""

    @property
    def by_hand(self) -> bool:
        """True: a person types every reading."""
        return True

    def open(self, setup: Setup) -> AbstractContextManager[Sensor]:
        """Return a context with the sensor."""
        return nullcontext(ManualSensor(setup.control_points, setup.ask, self.read_quantity()))
