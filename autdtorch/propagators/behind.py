"""Pictures that reach behind a reflector, where there is no sound."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import torch

from autdtorch.scene.drive import validate_drive
from autdtorch.scene.reflectors import are_in_front
from autdtorch.utils.array_types import COMPLEX
from autdtorch.utils.validation import ArrayLike, points_grid

Field = TypeVar("Field", bound=Callable[..., torch.Tensor])


def silent_behind(field: Field) -> Field:
    """Decorate a propagator's `field`: a grid of points may reach behind reflectors, where it is 0.

    A list of points (P, 3) may not: each is a receiver.
    """

    @functools.wraps(field)
    def call(self: Any, drive: torch.Tensor, points: ArrayLike) -> torch.Tensor:
        if not self.scene.reflectors:
            return field(self, drive, points)
        places, grid = points_grid("points", points)
        front = are_in_front(self.scene.reflectors, places.detach()).cpu()
        if len(grid) == 1 or front.all():
            return field(self, drive, points)
        drive = validate_drive(drive, len(self.scene.array))
        everywhere = torch.zeros((*drive.shape[:-1], len(front)), **COMPLEX)
        if front.any():
            everywhere[..., front] = field(self, drive, places[front.to(places.device)][None])[..., 0, :]
        return everywhere.reshape(*drive.shape[:-1], *grid)

    return call  # type: ignore[return-value]
