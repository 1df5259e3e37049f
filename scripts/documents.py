"""Generated blocks of documents, each between two marks that name the script that writes it."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from datetime import date
from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs"


def with_block(text: str, script: str, block: str) -> str:
    """`text` with what is between the marks of a script replaced.

    Raises:
        ValueError: it has not exactly one pair of its marks.
    """
    begin, end = (f"<!-- written by scripts/{script}: {edge} -->" for edge in ("begin", "end"))
    before, found, rest = text.partition(begin)
    _, closed, after = rest.partition(end)
    if not found or not closed or begin in after or end in after:
        raise ValueError(f"document: must have {begin!r} and {end!r} once each")
    return f"{before}{begin}\n\n{block}\n\n{end}{after}"


def measured(command: str) -> str:
    """On what, when and by which command figures were measured."""
    return f"Measured on {os.cpu_count()} cores, {date.today().isoformat()}:\n\n    {command}"


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def update(document: str, script: str, *parts: str) -> None:
    """Write the parts of a script's block into a document of `docs`."""
    path = DOCS / document
    path.write_text(
        with_block(path.read_text(encoding="utf-8"), script, "\n\n".join(parts)), encoding="utf-8"
    )
