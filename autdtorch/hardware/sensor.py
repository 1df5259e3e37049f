"""What hears the control points."""

from __future__ import annotations

from typing import Protocol

import torch


class Sensor(Protocol):
    """Reads the pressure at the control points while a drive is played."""

    def read(self) -> torch.Tensor:
        """Magnitudes (P,) [Pa] at the control points, once the field stands."""
        ...
