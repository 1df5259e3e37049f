"""Readings in tables: a row has a drive, or the call has it, and pressures, perhaps of a point."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from autdtorch.hardware.devices import DEVICES
from autdtorch.io.csv_table import read_rows, without_index
from autdtorch.io.readings_columns import SKIP, Columns, Named, ReadingColumn, columns_of, counted_quantities
from autdtorch.io.readings_units import Unit, drives_of, in_metres, merged, peak_amplitudes, radians, range_of
from autdtorch.objectives.readings import Readings
from autdtorch.scene.drive import AMPLITUDE_TOLERANCE
from autdtorch.utils.array_types import REAL, Array
from autdtorch.utils.units import warned_within
from autdtorch.utils.validation import invalid, within

_GAPS = {"", "nan", "na", "n/a", "-", "null", "none", "<na>"}
_POINT = re.compile(r"point (\d+) \[m\]: (\S+) (\S+) (\S+)")  # a comment of `save_readings`


class Units(NamedTuple):
    """Units that the call states: of phases, of pressures and of their phases; None if it does not."""

    phases: Unit | None = None
    pressure: Unit | None = None
    phase: Unit | None = None


@dataclass(frozen=True)
class Table:
    """A table of cells.

    Attributes:
        place: the file, or the argument.
        header: titles of the columns, if any.
        rows: cells.
        lines: names of the rows in messages.
        number: of a cell that is no gap; None if it is no number.
        points: (P, 3) [m] of the columns of pressures, if the table has them apart.
    """

    place: str
    header: list[str] | None
    rows: Sequence[Sequence[Any]]
    lines: Sequence[str]
    number: Callable[[Any], float | None]
    points: torch.Tensor | None = None

    def read(self, columns: Sequence[ReadingColumn], unit: Unit) -> Array:
        """Return the numbers (R, C) of columns in a unit; those of pressures may have gaps, as NaN."""
        gaps = columns[0].what.startswith("pressure")
        least, most, whole = range_of(columns[0].what, unit)
        values = np.empty((len(self.rows), len(columns)))
        for row, cells in enumerate(self.rows):
            for place, column in enumerate(columns):
                cell = cells[column.index]
                number = math.nan if is_gap(cell) else self.number(cell)
                if number is None or not (_fits(number, least, most, whole) or (gaps and math.isnan(number))):
                    where = f"{self.place}, {self.lines[row]}, column {column.title!r}"
                    raise invalid(where, cell, _accepted(least, most, whole, gaps))
                values[row, place] = number
        return values


def _fits(number: float, least: float, most: float, whole: bool) -> bool:
    """Check that a number is finite and in a range, with room for rounding unless it must be whole."""
    room = 0 if whole else AMPLITUDE_TOLERANCE
    return math.isfinite(number) and least <= number <= most * (1 + room) and not (whole and number % 1)


def _accepted(least: float, most: float, whole: bool, gaps: bool) -> str:
    """Describe the numbers that `_fits` accepts."""
    text = f"must be a {'whole' if whole else 'finite'} number"
    if math.isfinite(least):
        text += f" >= {least:g}" if math.isinf(most) else f" from {least:g} to {most:g}"
    if not gaps:
        return text
    return f"{text}, or empty for a gap{'; of levels in dB, pressure=' + repr('dB') if least == 0 else ''}"


def is_gap(cell: object) -> bool:
    """Check that a cell has no number."""
    if isinstance(cell, str):
        return cell.strip().casefold() in _GAPS
    return cell is None or str(cell) in ("nan", "<NA>", "NaT")


def csv_table(path: Path, named: Named | None) -> Table:
    """Return the cells of a CSV file; columns that the call counts need no titles."""
    file = without_index(read_rows(path, gaps=True))
    first = file.lines[0][1]
    if any("|" in cell for cell in first):
        raise ValueError(f"{path}: cells with |; must be separated by commas, semicolons, tabs or blanks")
    if len(first) > 2 and first == [str(number) for number in range(len(first))]:
        raise ValueError(
            f"{path}: the first line counts the columns; must have their titles, or numbers alone"
        )
    kinds = counted_quantities(named)
    texts = [
        file.number(cell) is None and not is_gap(cell)
        for cell, kind in zip(first, kinds or first, strict=False)
        if kind != SKIP
    ]
    header = first if (all(texts) if kinds else any(texts)) else None
    lines = file.lines[header is not None :]
    if not lines:
        raise ValueError(f"{path}: no row under the header; must have at least one")
    file.require_regular(lines, len(first), "in the first row" if header is None else "in the header")
    points = [
        [float(number) for number in match.groups()[1:]]
        for text in file.comments
        if (match := _POINT.fullmatch(text))
    ]
    numbers = [f"line {number}" for number, _ in lines]
    cells = [row for _, row in lines]
    return Table(
        str(path), header, cells, numbers, file.number, torch.tensor(points, **REAL) if points else None
    )


def frame_table(frame: Any) -> Table:
    """Return the cells of a data frame, as of pandas or polars."""
    header = [str(name) for name in frame.columns]
    rows = np.asarray(frame.to_numpy(), dtype=object)
    if rows.ndim != 2 or len(rows) == 0 or rows.shape[1] != len(header):
        raise ValueError(f"source: frame of shape {rows.shape}; must have rows, and a name for each column")
    lines = [f"row {row}" for row in range(len(rows))]
    unnamed = header == [str(index) for index in range(len(header))]
    return Table("source", None if unnamed else header, rows.tolist(), lines, plain_number)


def readings_of(
    table: Table, named: Named | None, units: Units, drives: torch.Tensor | None, points: torch.Tensor | None
) -> Readings:
    """Return the readings of a table.

    Args:
        table: cells.
        named: columns as the call names them, if it does.
        units: that the call states.
        drives: (R, M) or (M,), if the call has them.
        points: (P, 3) [m] of the columns of pressures, if the call has them.
    """
    columns = columns_of(table.place, table.header, len(table.rows[0]), named)
    pressure = _pressure(table, columns["pressure"], units.pressure)
    phase = _pressure_phase(table, columns["pressure phase"], units.phase)
    rows = _drives(table, columns, units.phases, drives)
    if pressure.isnan().all():
        raise ValueError(f"{table.place}: no pressure in any row; must have at least one")
    coordinates = [column for axis in "xyz" for column in columns[axis]]
    if not coordinates:
        points = table.points if points is None else points
        return Readings(rows.expand(len(pressure), -1), pressure, points, phase)
    if points is not None:
        raise ValueError(f"points: given, but {table.place} has columns x, y, z; must be one of both")
    if [column.what for column in coordinates] != ["x", "y", "z"] or pressure.shape[1] != 1:
        have = ", ".join(column.title for column in coordinates + columns["pressure"])
        accepted = "must be x, y, z and a single pressure, where rows have points"
        raise ValueError(f"{table.place}: columns {have}; {accepted}")
    places = np.concatenate([_metres(table, column) for column in coordinates], axis=1)
    return Readings.of_rows(rows, places, pressure[:, 0], None if phase is None else phase[:, 0])


def _pressure(table: Table, columns: list[ReadingColumn], said: Unit | None) -> torch.Tensor:
    """Return peak amplitudes (R, P) [Pa], NaN at gaps."""
    unit = _unit(table, "pressure", columns, said)
    values = table.read(columns, unit)
    with within(table.place):
        return torch.from_numpy(peak_amplitudes(values, unit, columns[0].unit.unit is not None))


def _pressure_phase(table: Table, columns: list[ReadingColumn], said: Unit | None) -> torch.Tensor | None:
    """Return phases (R, P) [rad] of the pressures, NaN at gaps; None if there are none."""
    if not columns:
        if said is not None:
            raise ValueError(f"phase: {said}; but {table.place} has no column of pressure phases")
        return None
    unit = _unit(table, "phase", columns, said)
    values = table.read(columns, unit)
    with within(table.place), warned_within(table.place):
        return torch.from_numpy(radians(values, unit, "pressure phase"))


def _drives(table: Table, columns: Columns, said: Unit | None, drives: torch.Tensor | None) -> torch.Tensor:
    """Return the drives (R, M) of the rows, or one for all."""
    phases, amplitudes = columns["phase"], columns["amplitude"]
    if drives is not None:
        if phases:
            raise ValueError(f"drives: given, but {table.place} has columns of phases; must be one of both")
        if drives.ndim == 2 and len(drives) != len(table.rows):
            raise ValueError(
                f"drives: {len(drives)}; must be {len(table.rows)}, a drive for each row, or (M,)"
            )
        return drives
    if not phases:
        accepted = "must have them, such as 'phase 0 [deg]', or the call must have drives="
        raise ValueError(f"{table.place}: no column of phases; {accepted}")
    unit = _unit(table, "phases", phases, said)
    of_amplitudes = _unit(table, "amplitudes", amplitudes, None) if amplitudes else Unit()
    if of_amplitudes.unit == "level" and unit.unit in DEVICES:
        of_amplitudes = Unit(unit.unit)
    values = table.read(phases, unit)
    shares = table.read(amplitudes, of_amplitudes) if amplitudes else None
    with within(table.place), warned_within(table.place):
        return drives_of(values, shares, unit, of_amplitudes)


def _metres(table: Table, column: ReadingColumn) -> Array:
    values = table.read([column], column.unit)
    with within(table.place):
        return in_metres(values, column.unit)


def _unit(table: Table, keyword: str, columns: list[ReadingColumn], said: Unit | None) -> Unit:
    """Return the unit of columns, which must agree."""
    stated = {column.unit: column for column in columns}
    if len(stated) > 1:
        titles = " and ".join(repr(column.title) for column in list(stated.values())[:2])
        raise ValueError(f"{table.place}: columns {titles}; must be in one unit")
    return merged(keyword, said, columns[0].unit, f"column {columns[0].title!r} of {table.place}")


def plain_number(cell: object) -> float | None:
    """Return the number in a cell of a frame; None if there is none."""
    try:
        return None if isinstance(cell, bool | np.bool_ | complex) else float(cell)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return None
