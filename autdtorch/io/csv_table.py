"""Tables of numbers in CSV files: with names and units in a header or a comment, or without."""

from __future__ import annotations

import csv
import math
import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from autdtorch.utils.array_types import AnyArray, Array
from autdtorch.utils.files import replacing
from autdtorch.utils.validation import require_known

_UNITS: dict[str, dict[str, float]] = {  # factors to SI of the accepted units, by SI unit
    "": {"": 1.0},
    "m": {"m": 1.0, "mm": 1e-3, "cm": 1e-2},
    "rad": {"rad": 1.0, "deg": math.pi / 180, "°": math.pi / 180},
    "Pa m": {"Pa m": 1.0},
}
_LONGEST = 1000  # characters of a name or a comment that are read; the search for units takes their square


class Column(NamedTuple):
    """The name of a column and its unit, None if the file does not state it."""

    name: str
    unit: str | None


class Rows(NamedTuple):
    """The cells of a CSV file.

    Attributes:
        path: of the file.
        lines: numbers and cells of the lines that are neither empty nor comments.
        comments: texts of the comments.
        separator: of cells; "" for blanks. Where it is no comma, a comma begins decimals.
    """

    path: str
    lines: list[tuple[int, list[str]]]
    comments: list[str]
    separator: str

    @property
    def has_header(self) -> bool:
        """True if the first line has other cells than numbers."""
        return any(self.number(cell) is None for cell in self.lines[0][1])

    def number(self, cell: str) -> float | None:
        """Return the number in a cell, None if there is none."""
        try:
            return float(cell if self.separator == "," else cell.replace(",", "."))
        except ValueError:
            return None

    def numbers(self, first: int, names: list[str] | None = None) -> Array:
        """Return the lines from a `first` on as numbers (R, C); they have as many cells as there are names.

        Without names, they have as many as the first one.
        """
        lines = self.lines[first:]
        count = len(names or lines[0][1])
        for line, cells in lines:
            if len(cells) != count:
                as_what = "in the header" if names else "in the first row"
                raise ValueError(
                    f"{self.path}, line {line}: {len(cells)} cells; must be {count} as {as_what}"
                )
        if len({mark for _, cells in lines for cell in cells for mark in ".," if mark in cell}) > 1:
            raise ValueError(
                f"{self.path}: decimals begin with . and with a comma; must be alike in all cells"
            )
        return np.array([self._finite(line, cells, names) for line, cells in lines]).reshape(-1, count)

    def _finite(self, line: int, cells: list[str], names: list[str] | None) -> list[float]:
        row = [self.number(cell) for cell in cells]
        for place, number in enumerate(row):
            if number is None or not math.isfinite(number):
                name = names[place] if names else f"column {place + 1}"
                accepted = f"{cells[place]!r}; must be a finite number"
                raise ValueError(f"{self.path}, line {line}, {name}: {accepted}")
        return [number for number in row if number is not None]


def read_rows(path: str | os.PathLike[str]) -> Rows:
    """Return the cells of a CSV file, separated by commas, semicolons, tabs or blanks; at least one line."""
    content = Path(path).read_bytes()
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise ValueError(f"{path}, line {line}: {error}; must be CSV in UTF-8") from error
    numbered = list(enumerate(re.split("\r\n|\r|\n", text), 1))
    comments = [line.strip()[:_LONGEST].lstrip("# ") for _, line in numbered if line.lstrip().startswith("#")]
    lines = [(number, line) for number, line in numbered if not re.fullmatch(r"[,;\s]*|\s*#.*", line)]
    if not lines:
        raise ValueError(f"{path}: empty; must begin with the names of the columns, or with numbers")
    separator = _separator(lines[0][1])
    cells = [(number, _cells(f"{path}, line {number}", line, separator)) for number, line in lines]
    return Rows(str(path), cells, comments, separator)


def table_of(
    rows: Rows,
    columns: Mapping[str, str],
    named: Callable[[Array], list[str]],
    unit_of: Callable[[str, Mapping[str, Array]], str],
) -> dict[str, Array]:
    """Return the columns (R,) of a table in SI units, by name.

    Args:
        rows: of the file.
        columns: SI unit of each name that may occur: "m" (or mm, cm in the file), "rad" (or deg), "Pa m", "".
        named: returns the names of the columns of numbers (R, C) that have neither header nor comment.
        unit_of: returns the unit of columns that state none, from their SI unit and their numbers by name.
    """
    first, header = (1, _header(rows, columns)) if rows.has_header else (0, _from_comments(rows, columns))
    if first == len(rows.lines):
        raise ValueError(f"{rows.path}: no row under the header; must have at least one")
    if header is None:
        values = rows.numbers(first)
        header = [Column(name, None) for name in named(values)]
    else:
        values = rows.numbers(first, [column.name for column in header])
    table = dict(zip((column.name for column in header), values.T, strict=True))
    for kind in {columns[name]: None for name, unit in header if unit is None}:
        without = [name for name, unit in header if unit is None and columns[name] == kind]
        unit = _unit_in(rows.comments, kind) or unit_of(kind, {name: table[name] for name in without})
        for name in without:
            table[name] = table[name] * _UNITS[kind][unit]
    return table | {
        name: table[name] * _UNITS[columns[name]][unit] for name, unit in header if unit is not None
    }


def write_table(path: str | os.PathLike[str], columns: Mapping[str, AnyArray]) -> None:
    """Write columns (R,) by header, floats with full precision."""
    with replacing(Path(path)) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*(values.tolist() for values in columns.values()), strict=True))


def _separator(line: str) -> str:
    """Return the separator of cells in a line; "" for blanks."""
    strong = max(";\t", key=line.count)
    if strong in line:
        return strong
    words = line.split()
    decimals = len(words) > 1 and all(
        re.fullmatch(r"[+-]?\d+(,\d+)?(e[+-]?\d+)?", word, re.I) for word in words
    )
    return "," if "," in line and not decimals else ""


def _cells(where: str, line: str, separator: str) -> list[str]:
    """Return the cells of a line without blanks around them; an empty one at the end is left out."""
    if not separator:
        return re.sub(r"(?<!\s)\s+(?=[\[(])", "", line).split()  # a unit belongs to its name
    try:
        cells = [cell.strip() for cell in next(csv.reader([line], delimiter=separator))]
    except csv.Error as error:
        raise ValueError(f"{where}: {error}; must be CSV in UTF-8") from error
    return cells[:-1] if len(cells) > 1 and not cells[-1] else cells


def _header(rows: Rows, columns: Mapping[str, str]) -> list[Column]:
    """Return the columns that the first line names."""
    line, cells = rows.lines[0]
    where = f"{rows.path}, line {line}"
    header = [_column(where, cell, columns) for cell in cells]
    names = [column.name for column in header]
    if len(set(names)) < len(names):
        raise ValueError(f"{where}: columns {', '.join(names)}; every name must occur once")
    for name, unit in header:
        kind = columns[name]
        if unit is None and any(columns[other] == kind and stated for other, stated in header):
            accepted = " or ".join(f"{name} [{unit}]" for unit in _UNITS[kind])
            raise ValueError(f"{where}: column {name!r}; must be {accepted}")
    return header


def _from_comments(rows: Rows, columns: Mapping[str, str]) -> list[Column] | None:
    """Return the columns that the last such comment names, None if none does."""
    for comment in reversed(rows.comments):
        for separator in {rows.separator: None, ",": None}:
            cells = _cells(rows.path, comment, separator)
            if len(cells) == len(rows.lines[0][1]):
                try:
                    header = [_column("", cell, columns) for cell in cells]
                except ValueError:  # a comment of other content
                    continue
                if len({column.name for column in header}) == len(header):
                    return header
    return None


def _column(where: str, cell: str, columns: Mapping[str, str]) -> Column:
    """Return the column of a header such as `x [mm]`, `x (mm)`, `x_mm` or `X`."""
    by_name = {name.casefold(): name for name in columns}
    cell = cell[:_LONGEST]
    text = cell.casefold()
    match = re.fullmatch(r"([^\[\]()]*?)\s*[\[(](.*)[\])]", text)
    if match is None and text not in by_name:
        match = re.fullmatch(r"(.+)[_/](\w+)", text)
        if match and match[1].strip() not in by_name:
            match = None
    name, unit = (match[1].strip(), match[2].strip()) if match else (text, None)
    require_known(where, [by_name.get(name, cell if match is None else name)], columns, "column")
    name = by_name[name]
    units = _UNITS[columns[name]]
    if unit is None:
        return Column(name, None if columns[name] else "")
    for known in units:
        if known.casefold() == unit:
            return Column(name, known)
    accepted = " or ".join(f"{name} [{known}]" if known else name for known in units)
    raise ValueError(f"{where}: column {cell!r}; must be {accepted}")


def _unit_in(comments: list[str], kind: str) -> str | None:
    """Return the one unit that the comments state, as in "units: mm", "in mm", "[mm]" or "mm" alone."""
    found = set()
    for unit in _UNITS[kind]:
        word = re.escape(unit)
        pattern = rf"{word}|.*(?:\bin|\bunits?\s*[:=]?)\s*{word}(?!\w).*|.*[\[(]{word}[\])].*"
        if any(re.fullmatch(pattern, comment, re.IGNORECASE | re.DOTALL) for comment in comments):
            found.add(unit)
    return found.pop() if len(found) == 1 else None
