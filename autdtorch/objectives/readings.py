"""Readings: drives, and the pressures that sensors said at points."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from autdtorch.scene.drive import AMPLITUDE_TOLERANCE
from autdtorch.utils.array_types import REAL, AnyArray, Index
from autdtorch.utils.text import counted
from autdtorch.utils.validation import ArrayLike, complex_tensor, gappy_tensor, invalid, points_tensor


@dataclass(frozen=True, eq=False, repr=False)
class Readings:
    """Drives of an array, and the pressures that sensors said at points.

    `len(readings)` is the number of drives N. `readings[rows]` selects drives by a slice, a mask or indices.

    Attributes:
        drives: q = a e^{-i phi} (N, M), |q| <= 1, as played; a single drive (M,) becomes (1, M).
        pressure: peak amplitudes (N, P) [Pa], >= 0; NaN is a gap. One point may be (N,), one drive (P,).
        points: (P, 3) [m]; None for the control points of the scene.
        phase: of the pressure phasors (N, P) [rad], with the time factor e^{-i w t}; NaN is unknown, as it is
            at gaps of the pressure. None for magnitudes alone.
        deviation: standard deviations (N, P) [Pa], > 0, towards higher pressures: pressure^2 deviates by
            (pressure + deviation)^2 - pressure^2, which holds near 0, too. None if unknown, and alike.
    """

    drives: torch.Tensor
    pressure: torch.Tensor
    points: torch.Tensor | None = None
    phase: torch.Tensor | None = None
    deviation: torch.Tensor | None = None

    def __post_init__(self) -> None:
        """Check the arrays, and copy them to the CPU as float64 and complex128."""
        drives = _drives(self.drives)
        single = drives.ndim == 1
        drives = drives[None] if single else drives
        if drives.ndim != 2 or drives.numel() == 0:
            raise ValueError(f"drives: shape {tuple(drives.shape)}; must be (N, M) with N, M >= 1")
        pressure = self._per_drive("pressure", self.pressure, len(drives), single, "Pa")
        if negative := (pressure < 0).nonzero().tolist():
            place, value = negative[0], pressure[tuple(negative[0])].item()
            raise invalid(f"pressure{place}", value, "must be a peak amplitude >= 0, or NaN for a gap", "Pa")
        points = None if self.points is None else points_tensor("points", self.points).cpu()
        if points is not None and len(points) != pressure.shape[1]:
            accepted = f"must be ({pressure.shape[1]}, 3), a point for each column of pressure"
            raise ValueError(f"points: shape {tuple(points.shape)}; {accepted}")
        copies = {"drives": drives.detach().cpu().clone(), "pressure": pressure, "points": points}
        for name, unit in (("phase", "rad"), ("deviation", "Pa")):
            if getattr(self, name) is not None:
                copy = copies[name] = self._per_drive(name, getattr(self, name), len(drives), single, unit)
                if copy.shape != pressure.shape:
                    raise ValueError(f"{name}: shape {tuple(copy.shape)}; must be {tuple(pressure.shape)}")
                copy[pressure.isnan()] = torch.nan
        deviation = copies.get("deviation")
        if deviation is not None and len(wrong := (~(deviation > 0) & ~pressure.isnan()).nonzero()):
            place = wrong[0].tolist()
            raise invalid(f"deviation{place}", deviation[tuple(place)].item(), "must be > 0", "Pa")
        for name, each in copies.items():
            object.__setattr__(self, name, each)

    @staticmethod
    def _per_drive(name: str, value: object, drives: int, single: bool, unit: str) -> torch.Tensor:
        """Return a copy of numbers (N, P) on the CPU, without gradient."""
        tensor = gappy_tensor(name, value, unit).detach().cpu().clone()
        if tensor.ndim == 1:
            tensor = tensor[None] if single else tensor[:, None]
        if tensor.ndim != 2 or len(tensor) != drives or tensor.numel() == 0:
            accepted = f"must be ({drives}, P), a row for each drive"
            raise ValueError(f"{name}: shape {tuple(tensor.shape)}; {accepted}")
        return tensor

    @classmethod
    def of_rows(
        cls, drives: ArrayLike, points: ArrayLike, pressure: ArrayLike, phase: ArrayLike | None = None
    ) -> Readings:
        """Return readings of rows: each has a drive, any point and its pressure.

        Equal drives become one row and equal points one column, in the order of their first rows. Readings
        of a drive and a point that repeat become further rows of the drive.

        Args:
            drives: (R, M), or (M,) for all rows.
            points: (R, 3) [m].
            pressure: peak amplitudes (R,) [Pa]; NaN is a gap.
            phase: of the pressure phasors (R,) [rad], or None.

        Raises:
            ValueError: numbers of rows that differ, or as for `Readings`.
        """
        positions = points_tensor("points", points).cpu()
        count = len(positions)
        table = _drives(drives).detach().cpu()
        table = table.expand(count, -1) if table.ndim == 1 else table
        columns = {"pressure": pressure} if phase is None else {"pressure": pressure, "phase": phase}
        read = {name: gappy_tensor(name, value).detach().cpu() for name, value in columns.items()}
        if table.ndim != 2 or len(table) != count:
            accepted = f"must be ({count}, M), a drive for each of the points, or (M,)"
            raise ValueError(f"drives: shape {tuple(table.shape)}; {accepted}")
        for name, values in read.items():
            if values.shape != (count,):
                accepted = f"must be ({count},), a number for each of the points"
                raise ValueError(f"{name}: shape {tuple(values.shape)}; {accepted}")
        column_of, first_points = _groups(positions.numpy())
        drive_of, _ = _groups(table.numpy())
        repeat_of = _repeats(zip(drive_of, column_of, strict=True))
        row_of, first_rows = _groups(np.stack([drive_of, repeat_of], axis=1))
        arrays = {}
        for name, values in read.items():
            arrays[name] = torch.full((len(first_rows), len(first_points)), torch.nan, **REAL)
            arrays[name][row_of, column_of] = values
        return cls(table[first_rows], points=positions[first_points], **arrays)

    @property
    def count(self) -> int:
        """The number of readings: pressures that are no gaps."""
        return int((~self.pressure.isnan()).sum())

    def __len__(self) -> int:
        return len(self.drives)

    def __getitem__(self, rows: Any) -> Readings:
        """Return the readings of drives, by a slice, a mask, indices or one index."""
        chosen = torch.arange(len(self), dtype=torch.int64, device="cpu")[rows].reshape(-1)
        phase, deviation = (None if part is None else part[chosen] for part in (self.phase, self.deviation))
        return Readings(self.drives[chosen], self.pressure[chosen], self.points, phase, deviation)

    def __repr__(self) -> str:
        (drives, transducers), points = self.drives.shape, self.pressure.shape[1]
        gaps = self.pressure.numel() - self.count
        parts = [
            f"{counted(drives, 'drive')} of {counted(transducers, 'transducer')}",
            f"{counted(points, 'point')}{' of the scene' if self.points is None else ''}",
            f"{counted(self.count, 'reading')}{'' if self.phase is None else ' with phases'}",
        ]
        return f"Readings({', '.join(parts + ([counted(gaps, 'gap')] if gaps else []))})"


def _drives(value: object) -> torch.Tensor:
    """Return drives (..., M) as complex128 after checking that |q| <= 1."""
    accepted = "must be complex, q = a e^(-i phi), as drive_from_phases(phases) makes it"
    drives = complex_tensor("drives", value, accepted)
    too_large = (drives.abs() > 1 + AMPLITUDE_TOLERANCE).nonzero().tolist()
    if too_large:
        place = too_large[0]
        raise invalid(
            f"drives{place}", drives[tuple(place)].abs().item(), "every amplitude |q| must be in [0, 1]"
        )
    return drives


def _groups(rows: AnyArray) -> tuple[Index, list[int]]:
    """Return the group (R,) of each row, where equal rows are a group, and the first row of each group."""
    seen: dict[bytes, int] = {}
    groups = np.array([seen.setdefault(row.tobytes(), len(seen)) for row in rows + 0])  # -0 becomes 0
    return groups, np.unique(groups, return_index=True)[1].tolist()


def _repeats(keys: Iterable[tuple[int, int]]) -> list[int]:
    counts: dict[tuple[int, int], int] = {}
    repeats = []
    for key in keys:
        repeats.append(counts.get(key, 0))
        counts[key] = repeats[-1] + 1
    return repeats


def deviation_of_square(pressure: torch.Tensor, deviation: torch.Tensor) -> torch.Tensor:
    """Return how much [Pa^2] the squares of magnitudes [Pa] deviate by their `Readings.deviation` [Pa]."""
    return (pressure + deviation).square() - pressure.square()


def deviation_by_square(pressure: torch.Tensor, of_square: torch.Tensor) -> torch.Tensor:
    """Return the `Readings.deviation` [Pa] of magnitudes [Pa] whose squares deviate by `of_square` [Pa^2]."""
    least = torch.finfo(pressure.dtype).tiny
    above = (pressure.square() + of_square).sqrt()
    deviation: torch.Tensor = (of_square / (above + pressure).clamp_min(least)).clamp_min(least)
    return deviation
