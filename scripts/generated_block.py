"""The part of a document that a script writes."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from datetime import date
from pathlib import Path


def fill_in(document: Path, script: str, parts: Iterable[str], folder: Path) -> None:
    """Write `document` into `folder`, with `parts` in the block of a script."""
    text = with_block(document.read_text(encoding="utf-8"), script, "\n\n".join(parts))
    (folder / document.name).write_text(text, encoding="utf-8")


def with_block(text: str, script: str, block: str) -> str:
    """`text` with what is between the marks of a script replaced.

    Raises:
        ValueError: it has not exactly one pair of marks.
    """
    begin, end = (f"<!-- written by scripts/{script}.py: {which} -->" for which in ("begin", "end"))
    before, found, rest = text.partition(begin)
    _, closed, after = rest.partition(end)
    if not found or not closed or begin in after or end in after:
        raise ValueError(f"text: must have {begin!r} and {end!r} once each")
    return f"{before}{begin}\n\n{block}\n\n{end}{after}"


def measured(command: str) -> str:
    """On what, when and by which command figures were measured."""
    return f"Measured on {os.cpu_count()} cores, {date.today().isoformat()}:\n\n    {command}"


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)
