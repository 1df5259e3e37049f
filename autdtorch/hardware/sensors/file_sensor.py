"""A file into which another program writes the readings."""

from __future__ import annotations

import time
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from autdtorch.hardware.sensors.sensor import (
    PRESSURE,
    InstrumentConfig,
    Quantity,
    Sensor,
    SensorError,
    Setup,
    magnitudes_of,
)
from autdtorch.utils.files import path_of
from autdtorch.utils.validation import (
    integer_at_least,
    invalid,
    number_between,
    positive,
    require_kind,
)

_LONGEST = 3600.0  # of the times of a reading [s]
_POLL = 0.02  # [s] between looks at the file


class FileSensor:
    """A file into which another program writes each reading.

    The file holds the magnitudes of all control points in their order, separated by blanks, commas or
    line ends, and ends with a line end. Write it under another name, then rename it.
    """

    def __init__(
        self,
        path: str | Path,
        points: int,
        settle: float = 0.0,
        timeout: float = 60.0,
        quantity: Quantity = PRESSURE,
    ) -> None:
        """Set the file.

        Args:
            path: of the file, which need not exist yet.
            points: number of control points P.
            settle: time after a drive began in which the file may still be of the drive before [s], up to an
                hour.
            timeout: time limit for the file to change then [s], up to an hour.
            quantity: of the readings, and their unit.

        `ValueError` for an argument out of range.
        """
        require_kind("quantity", quantity, Quantity)
        self.quantity = quantity
        self._path = path_of("path", path)
        self._points = integer_at_least("points", points, 1)
        self._settle = number_between("settle", settle, 0.0, _LONGEST, "s")
        self._timeout = number_between("timeout", positive("timeout", timeout, "s"), 0.0, _LONGEST, "s")

    def read(self) -> torch.Tensor:
        """Return the magnitudes (P,), once the file has changed.

        `SensorError` if it does not change in time, or then holds anything but P magnitudes; see `Quantity`.
        """
        time.sleep(self._settle)
        before, deadline = self._stamp(), time.monotonic() + self._timeout
        trouble = "did not change"
        while time.monotonic() < deadline:
            time.sleep(_POLL)
            if self._stamp() == before:
                continue
            try:
                return self._magnitudes()
            except (OSError, ValueError) as error:  # it may not be complete yet
                trouble = f"holds no reading: {error}"
        raise SensorError(f"{self._path} {trouble}, within {self._timeout:g} s")

    def _stamp(self) -> tuple[int, int, int] | None:
        try:
            status = self._path.stat()
        except FileNotFoundError:
            return None
        return status.st_mtime_ns, status.st_size, status.st_ino

    def _magnitudes(self) -> torch.Tensor:
        text = self._path.read_text(encoding="utf-8")
        if not text.endswith("\n"):
            raise ValueError("no line end after the last number")
        numbers = [float(word) for word in text.replace(",", " ").split()]
        return magnitudes_of(self.quantity, self.quantity.name, numbers, self._points)


@dataclass(frozen=True)
class FileConfig(InstrumentConfig):
    """The config of a `FileSensor`."""

    path: Any

    def check(self, emulated: bool) -> None:
        """Require a path, and check the quantity."""
        super().check(emulated)
        if self.path is None:
            raise invalid("hardware.sensor.path", None, "must be the file that holds the readings")

    def open(self, setup: Setup) -> AbstractContextManager[Sensor]:
        """Return a context with the sensor."""
        points = len(setup.control_points)
        return nullcontext(FileSensor(self.path, points, quantity=self.read_quantity()))
