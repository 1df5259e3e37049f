"""What hears the control points."""

from __future__ import annotations

from typing import Protocol

import torch

from autdtorch.validation import invalid, real_tensor


class Sensor(Protocol):
    """Reads the pressure at the control points while a drive is played."""

    def read(self) -> torch.Tensor:
        """Magnitudes (P,) [Pa] at the control points, once the field stands."""
        ...


def checked_reading(sensor: Sensor, points: int) -> torch.Tensor:
    """What a sensor reads (P,) [Pa], float64.

    Raises:
        ValueError: not P finite magnitudes.
    """
    pressure = real_tensor("pressure of the sensor", sensor.read(), "Pa")
    if pressure.shape != (points,) or pressure.min() < 0:
        raise invalid("pressure of the sensor", pressure.tolist(), f"must be {points} numbers >= 0", "Pa")
    return pressure
