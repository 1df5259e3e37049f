"""Blocks of the documentation that scripts write."""

import json
import os
import re
import shlex
import statistics
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

NUMBER = re.compile(r"[-+\d.,e]+ (?P<unit>%|s|mm|GiB)")
DOCS = Path(__file__).parents[2] / "docs"


@dataclass(frozen=True)
class Page:
    """A page of the documentation, of which a command writes a block."""

    name: str  # of its file in the documentation
    command: str  # whose block it is, such as "check.py autd3"
    folder: Path  # of the new page, its figures and data

    def write(self, *parts: str) -> None:
        """Write a copy of the page with the paragraphs as the block, after machine, date and command."""
        from autdtorch.utils.process import thread_count

        threads, cores = thread_count(), os.cpu_count()
        machine = f"{cores} cores" if threads == cores else f"{threads} of {cores} cores"
        measured = f"`{command_line()}` ({machine}, {date.today().isoformat()})"
        text = (DOCS / self.name).read_text(encoding="utf-8")
        self._file(self.name).write_text(
            with_block(text, self.command, "\n\n".join((measured, *parts))), encoding="utf-8"
        )

    def write_rows(self, name: str, rows: Iterable[dict[str, object]]) -> None:
        """Write a JSON file of rows, with command, date and cores; numbers with four digits."""
        made = {"command": command_line(), "date": date.today().isoformat(), "cores": os.cpu_count()}
        lines = ",\n ".join(json.dumps(_rounded(row)) for row in rows)
        text = f'{json.dumps(made)[:-1]}, "rows": [\n {lines}\n]}}\n'
        self._file(name).write_text(text, encoding="utf-8")

    def save(self, name: str, figure: object) -> None:
        figure.savefig(self._file(name))

    def _file(self, name: str) -> Path:
        self.folder.mkdir(parents=True, exist_ok=True)
        return self.folder / name


def with_block(text: str, command: str, block: str) -> str:
    """Replace the text between the two marks of a command; ValueError without exactly one pair of them."""
    begin, end = f"<!-- from scripts/{command} -->", "<!-- end -->"
    before, _, after = text.partition(begin)
    old, marked, after = after.partition(end)
    if text.count(begin) != 1 or not marked or "<!--" in old:
        raise ValueError(f"text: must have {begin!r} once and then {end!r}")
    return f"{before}{begin}\n\n{block}\n\n{end}{after}"


def command_line() -> str:
    return shlex.join(["python", f"scripts/{Path(sys.argv[0]).name}", *sys.argv[1:]])


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; a unit that all numbers of a column share is in its header."""
    columns = []
    for title, *cells in zip(header, *rows, strict=True):
        numbers = [NUMBER.fullmatch(cell) for cell in cells if cell]
        units = {number["unit"] for number in numbers if number}
        if None not in numbers and len(units) == 1:
            cells = [cell.split(" ")[0] for cell in cells]
            title = f"{title} [{units.pop()}]"
        columns.append([title, *cells])
    head, *lines = (f"| {' | '.join(line)} |" for line in zip(*columns, strict=True))
    return "\n".join((head, "|" + "---|" * len(columns), *lines))


def printed(rows: Iterable[Sequence[str]]) -> list[Sequence[str]]:
    """Return all rows, each printed as it comes."""
    lines = []
    for row in rows:
        print(*row, sep=" | ", flush=True)
        lines.append(row)
    return lines


def percent(share: float) -> str:
    """Format a share in percent with three digits."""
    return f"{100 * share:.3g} %"


def quartiles(values: Any, form: str = ".3f") -> str:
    """Format the median and the quartiles of an array or a tensor, each number in a `form`."""
    low, middle, high = statistics.quantiles(values.tolist(), n=4, method="inclusive")
    return f"{middle:{form}} ({low:{form}} to {high:{form}})"


def _rounded(row: dict[str, object]) -> dict[str, object]:
    return {name: float(f"{value:.4g}") if isinstance(value, float) else value for name, value in row.items()}
