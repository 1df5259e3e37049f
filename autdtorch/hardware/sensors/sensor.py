"""The sensor of a bench: pressure magnitudes at the control points."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import torch

from autdtorch.objectives.objective import validate_magnitudes


class SensorError(OSError):
    """A sensor gives no trustworthy reading."""


@runtime_checkable
class Sensor(Protocol):
    """A sensor that reads the pressure at the control points while a drive is played."""

    def read(self) -> torch.Tensor:
        """Return magnitudes (P,) [Pa] at the control points, once the field is steady."""


def checked_reading(sensor: Sensor, points: int) -> torch.Tensor:
    """Return the reading (P,) [Pa], float64, of a sensor; `ValueError` if not P finite magnitudes."""
    return validate_magnitudes("pressure of the sensor", sensor.read(), points)
