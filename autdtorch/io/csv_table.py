"""Tables of numbers in CSV files: with names and units in a header or a comment, or without."""

from __future__ import annotations

import csv
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np

from autdtorch.utils.array_types import AnyArray, Array
from autdtorch.utils.files import replacing, require_file
from autdtorch.utils.units import warn_user, warned_within
from autdtorch.utils.validation import invalid, require_known, within

_LONGEST = 1000  # characters of a name or a comment that are read

_FACTORS: dict[str, dict[str, float]] = {  # to SI, of the accepted units, by SI unit
    "": {"": 1.0},
    "m": {"m": 1.0, "mm": 1e-3, "cm": 1e-2},
    "rad": {"rad": 1.0, "deg": math.pi / 180},
    "Pa m": {"Pa m": 1.0},
}
# Patterns of what people write. The case of a lone m counts: M is a number of transducers.
_SPELLED = {
    "": "",
    "Pa m": r"Pa\s?m",
    "mm": "mm|millimet(?:er|re)s?",
    "cm": "cm|centimet(?:er|re)s?",
    "m": "(?-i:m)|met(?:er|re)s?",
    "rad": "rad|radians?",
    "deg": "deg|degrees?|°",
}
_OTHERS = {  # units that are refused where they are stated
    "m": "inch(?:es)?|[µμu]m|micromet(?:er|re)s?|microns?|nm|dm|km|ft|feet|mils?|wavelengths?|lambda|λ",
    "rad": "pi|π|turns|cycles|revolutions|gon|grad|gradians?|levels?",
}
_WORD = "|".join([*filter(None, _SPELLED.values()), *_OTHERS.values()])
# Neither a part of a word nor of another unit, such as m/s or mm^2, nor the size of steps
_UNIT = rf"(?<![\w'])(?P<unit>{_WORD})(?![\w/^*·])(?!\s+(?:steps?|grid)\b)"
_ANYWHERE = re.compile(_UNIT, re.IGNORECASE)
_STATED = re.compile(
    rf"\b(?:in(?:\s+(?:units|multiples)\s+of)?|units?(?:\s+of)?)\s*[:=]?\s*{_UNIT}"
    rf"|[\[(]\s*{_UNIT.replace('?P<unit>', '?P<bracketed>')}\s*[\])]",
    re.IGNORECASE,
)
_LABEL = re.compile(r"\bunits?\s*[:=]\s*(.*)", re.IGNORECASE | re.DOTALL)


class Guessed(NamedTuple):
    """A unit that a file does not state."""

    unit: str
    why: str  # text of the warning; empty where no other unit is in use


Guess: TypeAlias = Callable[[str, Mapping[str, Array]], Guessed | None]


class Column(NamedTuple):
    """The name of a column and its unit, None if the file does not state it."""

    name: str
    unit: str | None


class CsvRows(NamedTuple):
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
        self.require_regular(lines, count, "in the header" if names else "in the first row")
        return np.array([self._finite(line, cells, names) for line, cells in lines]).reshape(-1, count)

    def require_regular(self, lines: list[tuple[int, list[str]]], count: int, like: str) -> None:
        """Check that lines have `count` cells each, and decimals that begin alike."""
        for line, cells in lines:
            if len(cells) != count:
                raise ValueError(f"{self.path}, line {line}: {len(cells)} cells; must be {count} as {like}")
        cells_of_all = [cell for _, cells in lines for cell in cells if "." in cell or "," in cell]
        decimals = [cell for cell in cells_of_all if self.number(cell) is not None or {".", ","} <= {*cell}]
        marks = {mark for cell in decimals for mark in ".," if mark in cell}
        if len(marks) > 1:
            raise ValueError(
                f"{self.path}: decimals begin with . and with a comma; must be alike in all cells"
            )

    def _finite(self, line: int, cells: list[str], names: list[str] | None) -> list[float]:
        row = [self.number(cell) for cell in cells]
        for place, number in enumerate(row):
            if number is None or not math.isfinite(number):
                name = names[place] if names else f"column {place + 1}"
                raise invalid(f"{self.path}, line {line}, {name}", cells[place], "must be a finite number")
        return [number for number in row if number is not None]


def read_rows(path: str | os.PathLike[str], gaps: bool = False) -> CsvRows:
    """Return the cells of a CSV file, separated by commas, semicolons, tabs or blanks; at least one line.

    An empty cell at the end of a line is left out, unless there may be `gaps` and other lines are longer.
    """
    content = require_file(path).read_bytes()
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
    width = max(len(_shortened(row)) for _, row in cells) if gaps else 1
    return CsvRows(
        str(path), [(number, _shortened(row, width)) for number, row in cells], comments, separator
    )


def table_of(
    rows: CsvRows, columns: Mapping[str, str], named: Callable[[Array], list[str]], guess: Guess
) -> dict[str, Array]:
    """Return the columns (R,) of a table in SI units, by name.

    Args:
        rows: of the file.
        columns: SI unit of each name that may occur: "m" (or mm, cm in the file), "rad" (or deg), "Pa m", "".
        named: returns the names of the columns of numbers (R, C) that have neither header nor comment.
        guess: returns the unit of columns that state none, from their SI unit and their numbers by name, and
            why; None where the columns are not used.

    The errors of both functions, and the warnings of the first, get the path in front.
    """
    rows = without_index(rows)
    first, header = (1, _header(rows, columns)) if rows.has_header else (0, _from_comments(rows, columns))
    if first == len(rows.lines):
        raise ValueError(f"{rows.path}: no row under the header; must have at least one")
    if header is None:
        values = rows.numbers(first)
        with within(rows.path), warned_within(rows.path):
            header = [Column(name, None) for name in named(values)]
    else:
        values = rows.numbers(first, [column.name for column in header])
    table = dict(zip((column.name for column in header), values.T, strict=True))
    for kind in {columns[name]: None for name, unit in header if unit is None and columns[name]}:
        without = {name: table[name] for name, unit in header if unit is None and columns[name] == kind}
        if (unit := _unit(rows, kind, without, guess)) is not None:
            table |= {name: values * _FACTORS[kind][unit] for name, values in without.items()}
    return table | {name: table[name] * _FACTORS[columns[name]][unit] for name, unit in header if unit}


def _unit(rows: CsvRows, kind: str, table: Mapping[str, Array], guess: Guess) -> str | None:
    """Return the unit of columns whose names have none, from the comments or a guess that agrees."""
    with within(rows.path), warned_within(rows.path):
        if (stated := _unit_stated(rows.comments, kind)) is not None:
            return stated
        if (guessed := guess(kind, table)) is None:
            return None
        unit, why = guessed
        if others := _mentioned_units(rows.comments, kind) - {unit}:
            guess_text = f"columns {', '.join(table)} seem to be in {unit}"
            accepted = f"the header must be as {next(iter(table))} [{unit}]"
            raise ValueError(f"{guess_text}, but a comment has {', '.join(sorted(others))}; {accepted}")
        if why:
            warn_user(f"no unit of {why}")
        return unit


def write_table(
    path: str | os.PathLike[str], columns: Mapping[str, AnyArray], comments: Sequence[str] = ()
) -> None:
    """Write columns (R,) by header, floats with full precision, under lines of comments."""
    with replacing(Path(path)) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        file.writelines(f"# {comment}\n" for comment in comments)
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
    """Return the cells of a line without blanks around them."""
    if not separator:
        return re.split(r"(?<!\s)\s+(?![\[(\s]|[^\[(]*[\])])", line.strip())  # a unit belongs to its name
    try:
        cells = [cell.strip() for cell in next(csv.reader([line], delimiter=separator))]
    except csv.Error as error:
        raise ValueError(f"{where}: {error}; must be CSV in UTF-8") from error
    return cells


def _shortened(cells: list[str], width: int = 1) -> list[str]:
    """Return cells without an empty one at the end, if they are more than `width`."""
    return cells[:-1] if len(cells) > width and not cells[-1] else cells


def without_index(rows: CsvRows) -> CsvRows:
    """Return rows without a first column that has no name and counts from 0, as pandas writes it."""
    (line, header), *others = rows.lines
    if header[0] or [cells[0] for _, cells in others] != [str(number) for number in range(len(others))]:
        return rows
    return rows._replace(lines=[(line, header[1:]), *((number, cells[1:]) for number, cells in others)])


def _header(rows: CsvRows, columns: Mapping[str, str]) -> list[Column]:
    line, cells = rows.lines[0]
    where = f"{rows.path}, line {line}"
    header = [_column(where, cell, columns) for cell in cells]
    names = [column.name for column in header]
    if len(set(names)) < len(names):
        raise ValueError(f"{where}: columns {', '.join(names)}; every name must occur once")
    for name, unit in header:
        kind = columns[name]
        if unit is None and any(columns[other] == kind and stated for other, stated in header):
            accepted = " or ".join(f"{name} [{unit}]" for unit in _FACTORS[kind])
            raise ValueError(f"{where}: column {name!r}; must be {accepted}")
    return header


def _from_comments(rows: CsvRows, columns: Mapping[str, str]) -> list[Column] | None:
    """Return the columns that the last such comment names, None if none does."""
    for comment in reversed(rows.comments):
        for separator in {rows.separator: None, ",": None}:
            cells = _shortened(_cells(rows.path, comment, separator))
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
    match = re.fullmatch(r"([^\[\]()]*?)\s*[\[(](.*)[\])]", cell)
    if match is None and cell.casefold() not in by_name:
        match = re.fullmatch(r"(.+)[_/](\w+)", cell)
        if match and match[1].strip().casefold() not in by_name:
            match = None
    written, text = (match[1].strip(), match[2].strip()) if match else (cell, None)
    name = by_name.get(written.casefold(), written)
    require_known(where, [name], columns, "column")
    kind = columns[name]
    if text is None:
        return Column(name, None if kind else "")
    if (unit := _unit_called(text, kind)) is not None:
        return Column(name, unit)
    accepted = " or ".join(f"{name} [{known}]" if known else name for known in _FACTORS[kind])
    raise ValueError(f"{where}: column {cell!r}; must be {accepted}")


def _unit_called(text: str, kind: str) -> str | None:
    """Return the unit of an SI unit's kind that a text names, None if it names none."""
    return next((unit for unit in _FACTORS[kind] if re.fullmatch(_SPELLED[unit], text, re.IGNORECASE)), None)


def _unit_stated(comments: Sequence[str], kind: str) -> str | None:
    """Return the unit that comments state, as in "units: mm", "in millimetres", "[mm]" or "mm" alone.

    Raises:
        ValueError: they state several units of this kind, or another one than the accepted.
    """
    stated = {unit: None for comment in comments for unit in _of_kind(_stated(comment), kind)}
    if not stated:
        return None
    if len(stated) > 1 or not stated.keys() <= _FACTORS[kind].keys():
        accepted = f"must be one of {', '.join(_FACTORS[kind])}"
        raise ValueError(f"the comments state the unit {' and '.join(map(repr, stated))}; {accepted}")
    return next(iter(stated))


def _mentioned_units(comments: Sequence[str], kind: str) -> set[str]:
    """Return the accepted units that comments name at all; a lone m may be anything else."""
    words = [match["unit"] for comment in comments for match in _ANYWHERE.finditer(comment)]
    return _FACTORS[kind].keys() & set(_of_kind([word for word in words if word != "m"], kind))


def _stated(comment: str) -> Iterator[str]:
    """Yield the words that a comment states as units, known or not."""
    if re.fullmatch(_UNIT, comment, re.IGNORECASE):
        yield comment
    for match in _STATED.finditer(comment):
        yield match["unit"] or match["bracketed"]
    if label := _LABEL.search(comment):
        yield from [match["unit"] for match in _ANYWHERE.finditer(label[1])] or label[1].split()[:1]


def _of_kind(words: Iterable[str], kind: str) -> Iterator[str]:
    """Yield the units of a kind that words name, and words of unknown kind as they are."""
    for word in words:
        if (unit := _unit_called(word, kind)) is not None:
            yield unit
        elif not any(_is_of(word, other) for other in _FACTORS if other != kind):
            yield word


def _is_of(word: str, kind: str) -> bool:
    others = _OTHERS.get(kind)
    return _unit_called(word, kind) is not None or (
        others is not None and re.fullmatch(others, word, re.IGNORECASE) is not None
    )
