"""Blocks of the documentation that scripts write."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterable, Sequence
from datetime import date
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"


def fill_in(document: str, command: str, parts: Iterable[str], folder: Path) -> None:
    """Write a copy of `document` in which `parts` are the block of a command, such as "check.py autd3"."""
    text = with_block((DOCS / document).read_text(encoding="utf-8"), command, "\n\n".join(parts))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / document).write_text(text, encoding="utf-8")


def with_block(text: str, command: str, block: str) -> str:
    """Replace the text between the two marks of a command.

    Raises:
        ValueError: `text` does not have exactly one pair of marks.
    """
    begin, end = (f"<!-- written by scripts/{command}: {which} -->" for which in ("begin", "end"))
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
        raise ValueError(f"text: must have {begin!r} and then {end!r} once each")
    return f"{text.partition(begin)[0]}{begin}\n\n{block}\n\n{end}{text.partition(end)[2]}"


def command_line() -> str:
    """Return the command that started this process."""
    return shlex.join(["python", f"scripts/{Path(sys.argv[0]).name}", *sys.argv[1:]])


def measured() -> str:
    """State the machine, the date and the command of a measurement."""
    from autdtorch.utils.threads import thread_count

    on = f"{os.cpu_count()} cores ({thread_count()} threads)"
    return f"Measured on {on}, {date.today().isoformat()}:\n\n    {command_line()}"


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def percent(share: float) -> str:
    """Format a share in percent with three digits."""
    return f"{100 * share:.3g} %"
