"""Tables of numbers in CSV files with columns and units in the header, such as `x [mm]`."""

from __future__ import annotations

import csv
import io
import math
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from autdtorch.utils.array_types import AnyArray, Array
from autdtorch.utils.files import replacing
from autdtorch.utils.validation import require_known

_UNITS: dict[str, dict[str, float]] = {  # factors to SI of the accepted units, by SI unit
    "": {"": 1.0},
    "m": {"m": 1.0, "mm": 1e-3},
    "rad": {"rad": 1.0, "deg": math.pi / 180},
}


def read_table(path: str | os.PathLike[str], columns: Mapping[str, str]) -> dict[str, Array]:
    """Return the columns (R,) of a table in SI units, by name; empty lines and # comments are skipped.

    `columns` has the SI unit of each name that may occur: "m" (or mm in the file), "rad" (or deg), "".
    """
    rows = _rows(path)
    try:
        line, header = next(rows)
    except StopIteration:
        raise ValueError(f"{path}: empty; must begin with the names of the columns") from None
    known = [_column(f"{path}, line {line}", cell, columns) for cell in header]
    names = [name for name, _ in known]
    if len(set(names)) < len(names):
        raise ValueError(f"{path}, line {line}: columns {', '.join(names)}; every name must occur once")
    table = []
    for line, cells in rows:
        where = f"{path}, line {line}"
        if len(cells) != len(known):
            raise ValueError(f"{where}: {len(cells)} cells; must be {len(known)} as in the header")
        pairs = zip(known, cells, strict=True)
        table.append([factor * _number(f"{where}, {name}", cell) for (name, factor), cell in pairs])
    if not table:
        raise ValueError(f"{path}: no row under the header; must have at least one")
    return dict(zip(names, np.array(table).T, strict=True))


def write_table(path: str | os.PathLike[str], columns: Mapping[str, AnyArray]) -> None:
    """Write columns (R,) by header, floats with full precision."""
    with replacing(Path(path)) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(zip(*(values.tolist() for values in columns.values()), strict=True))


def _rows(path: str | os.PathLike[str]) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and cells of every line that is neither empty nor a comment.

    Where the first one has semicolons or tabs, these separate cells; a comma then begins decimals.
    """
    content = Path(path).read_bytes()
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise ValueError(f"{path}, line {line}: {error}; must be CSV in UTF-8") from error
    lines = list(io.StringIO(text, newline=""))  # as a file is read for csv
    header = next((line for line in lines if line.strip() and not line.lstrip().startswith("#")), "")
    separator = max(",;\t", key=header.count)
    reader = csv.reader(lines, delimiter=separator)
    try:
        for cells in reader:
            row = [cell.strip() if separator == "," else cell.strip().replace(",", ".") for cell in cells]
            if any(row) and not row[0].startswith("#"):
                yield reader.line_num, row
    except csv.Error as error:
        raise ValueError(f"{path}, line {reader.line_num + 1}: {error}; must be CSV in UTF-8") from error


def _column(where: str, cell: str, columns: Mapping[str, str]) -> tuple[str, float]:
    """Return the name of a column and the factor to SI of its unit."""
    match = re.fullmatch(r"([^\[\]]*?)\s*(?:\[(.*)\])?", cell)
    name, unit = (match[1], match[2] or "") if match else (cell, "")
    require_known(where, [name], columns, "column")
    units = _UNITS[columns[name]]
    if unit not in units:
        accepted = " or ".join(f"{name} [{unit}]" if unit else name for unit in units)
        raise ValueError(f"{where}: column {cell!r}; must be {accepted}")
    return name, units[unit]


def _number(where: str, cell: str) -> float:
    try:
        number = float(cell)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{where}: {cell!r}; must be a finite number")
    return number
