"""Magnitudes that a sensor read: which of them are to be believed, and how far."""

from __future__ import annotations

from dataclasses import dataclass

import torch

_GROSS = 4.5  # times the median; of random phases, one magnitude in a million exceeds it
_NOTHING = 1e-3  # times the median; one in a million is below it
_EQUAL = 1e-6  # relative difference of readings at the end of a sensor's range
_SATURATED = 4  # different drives that have this reading
_ENOUGH, _DISTINCT = (
    8,
    0.9,
)  # lower readings, and the share of them that differ, of a sensor that reads finely
_ALIKE = 0.999  # overlap of drives above which they count as one


@dataclass(frozen=True, eq=False)
class Magnitudes:
    """Readings of which some are lower limits: those of a sensor at the end of its range.

    An outlier, which says nothing, has the lower limit 0.

    Attributes:
        value: (N, P) [Pa].
        limit: which of them are lower limits (N, P), bool.
    """

    value: torch.Tensor
    limit: torch.Tensor

    @classmethod
    def of(cls, observed: torch.Tensor, outliers: torch.Tensor, highest: torch.Tensor) -> Magnitudes:
        """Return readings (N, P) [Pa] without `outliers` (N, P), of sensors that end at `highest` (P,)."""
        limit = outliers | (observed >= (1 - _EQUAL) * highest)
        return cls(observed.masked_fill(outliers, 0), limit)

    @property
    def outliers(self) -> torch.Tensor:
        """Readings that say nothing (N, P), bool."""
        return self.limit & (self.value == 0)

    @property
    def power(self) -> torch.Tensor:
        """Mean square of each control point (P,) [Pa^2], without outliers."""
        return self.value.square().sum(dim=0) / (~self.outliers).sum(dim=0).clamp_min(1)

    def column(self, point: int) -> Magnitudes:
        """Return those of one control point (N, 1)."""
        return Magnitudes(self.value[:, point, None], self.limit[:, point, None])

    def first(self, count: int) -> Magnitudes:
        """Return those of the first drives (count, P)."""
        return Magnitudes(self.value[:count], self.limit[:count])

    def nearest(self, magnitude: torch.Tensor) -> torch.Tensor:
        """Return what the readings allow that is nearest to magnitudes (N, ...) [Pa]."""
        if not self.limit.any():
            return self.value
        return torch.where(self.limit & (magnitude > self.value), magnitude, self.value)

    def decided(self, magnitude: torch.Tensor) -> torch.Tensor:
        """Return which readings say something where the magnitudes are (N, P) [Pa]: no limit that is kept."""
        return ~self.limit | (magnitude < self.value)


def gross_outliers(observed: torch.Tensor) -> torch.Tensor:
    """Return which readings (N, P) are far above or far below those of other random phases."""
    middle = observed.median(dim=0).values
    return ((observed > _GROSS * middle) | (observed < _NOTHING * middle)) & (middle > 0)


def range_ends(drives: torch.Tensor, observed: torch.Tensor) -> torch.Tensor:
    """Return where the range of each sensor may end (P,) [Pa], infinite where no reading (N, P) shows it.

    There, several different drives (N, M) have the same highest reading, but not all of them. It is the end
    of the range if the sensor `reads_finely`; coarse steps make equal readings, too.
    """
    unit = drives / drives.norm(dim=1, keepdim=True).clamp_min(1e-300)
    ends = torch.full_like(observed[0], torch.inf)
    for point, column in enumerate(observed.T):
        highest = column.max()
        at_end = unit[column >= (1 - _EQUAL) * highest]
        if _SATURATED <= len(at_end) < len(column):
            alike = ((at_end @ at_end.mH).abs() > _ALIKE).sum(dim=1)
            if (1 / alike).sum() >= _SATURATED:
                ends[point] = highest
    return ends


def reads_finely(observed: torch.Tensor, ends: torch.Tensor) -> torch.Tensor:
    """Return for which sensors (P,) the readings (N, P) below the `ends` differ, and are enough to say so."""
    fine = torch.zeros_like(ends, dtype=torch.bool)
    for point, column in enumerate(observed.T):
        lower = column[(column > 0) & (column < (1 - _EQUAL) * ends[point])].sort().values
        distinct = int((lower.diff() > _EQUAL * lower[1:]).sum()) + 1
        fine[point] = len(lower) >= _ENOUGH and distinct >= _DISTINCT * len(lower)
    return fine
