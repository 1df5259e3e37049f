"""Results of runs in boxes: steady states at receivers, and the scattered field that they radiate."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch

from autdtorch.fdtd.scattered_field import NearToFar, ScatteredField
from autdtorch.fdtd.steady_state import MOST_JUDGED
from autdtorch.propagators.simulation import Run
from autdtorch.utils.apertures import Apertures
from autdtorch.utils.process import spread

_TOGETHER = 8  # Runs whose phasors one thread maps at once


class Judged(NamedTuple):
    """Receivers that decide when a run has converged: each `every`-th of some, in groups that all must."""

    receivers: Apertures
    every: int
    groups: tuple[slice, ...]

    @classmethod
    def of(cls, receivers: Apertures) -> Judged:
        """Return at most `MOST_JUDGED` of the receivers, in one group."""
        return cls(receivers, math.ceil(len(receivers.centers) / MOST_JUDGED), (slice(None),))


@dataclass(frozen=True)
class Radiation:
    """A linear map from K drives to the scattered field outside of boxes.

    Attributes:
        boxes: the boxes.
        amplitudes: of each box's Huygens surface (n, K) [Pa m].
        runs: the simulations behind it.
    """

    boxes: Sequence[ScatteredField]
    amplitudes: tuple[torch.Tensor, ...]
    runs: tuple[Run, ...]

    @property
    def nbytes(self) -> int:
        """Memory [bytes]."""
        return sum(part.nbytes for part in self.amplitudes)

    def reaches(self, points: torch.Tensor) -> bool:
        """Return whether no point (P, 3) [m] is in a box, where its cells are read."""
        return not any(box.inside(points).any() for box in self.boxes)

    def pressure(self, receivers: Apertures) -> torch.Tensor:
        """Return the scattered field (P, K) [Pa] at P receivers that it reaches."""
        parts = zip(self.boxes, self.amplitudes, strict=True)
        return torch.stack([box.near_to_far(receivers).radiated(part) for box, part in parts]).sum(dim=0)


class Solved(NamedTuple):
    """The steady states of R runs in boxes: the phasors (k, R) of the cells that each transform reads.

    They are on the kernel's device.
    """

    transforms: Sequence[NearToFar]
    phasors: Sequence[torch.Tensor]

    @property
    def pressure(self) -> torch.Tensor:
        """The scattered field (P, R) [Pa] at the receivers."""
        parts = zip(self.transforms, self.phasors, strict=True)
        return torch.stack([spread_runs(transform.field, part) for transform, part in parts]).sum(dim=0)

    @property
    def amplitudes(self) -> list[torch.Tensor]:
        """The amplitudes (n, R) [Pa m] of each box's Huygens surface."""
        pairs = zip(self.transforms, self.phasors, strict=True)
        return [spread_runs(transform.amplitudes, part).cpu() for transform, part in pairs]


def spread_runs(linear: Callable[[torch.Tensor], torch.Tensor], phasors: torch.Tensor) -> torch.Tensor:
    """Return a linear map of phasors (k, R), computed for some runs at a time on all threads."""
    return torch.cat(spread(linear, torch.split(phasors, _TOGETHER, dim=1)), dim=1)
