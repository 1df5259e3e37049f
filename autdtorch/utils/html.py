"""HTML tables for Jupyter."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape


def html_facts(title: str, facts: Sequence[tuple[str, str]]) -> str:
    """Return a table of names and values with a title."""
    rows = "".join(
        f'<tr><th scope="row" style="text-align: left">{escape(name)}</th>'
        f'<td style="text-align: left">{escape(value)}</td></tr>'
        for name, value in facts
    )
    return f"<table>{_caption(title)}{rows}</table>"


def html_table(title: str, rows: Sequence[Sequence[str]]) -> str:
    """Return a table with a title; the first row is the header."""
    head, *body = rows
    lines = [_row('th scope="col"', head), *(_row("td", row) for row in body)]
    return f"<table>{_caption(title)}{''.join(lines)}</table>"


def _caption(title: str) -> str:
    return f'<caption style="text-align: left; font-weight: bold">{escape(title)}</caption>'


def _row(tag: str, cells: Sequence[str]) -> str:
    end = tag.partition(" ")[0]
    return "<tr>" + "".join(f"<{tag}>{escape(cell)}</{end}>" for cell in cells) + "</tr>"
